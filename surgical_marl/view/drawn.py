"""The shapes of a picture as its kernels need them: geoms of a model, a stage around them, balls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgical_marl.view.lighting import GLOW, GRAIN
from surgical_marl.view.shading import GAMMA, PLASTIC, Material, flesh, materials, visual_rgba
from surgical_marl.view.tracer import PLANE, Shape, World, wp
from surgical_marl.vision.raycaster import GROUPS, KINDS, corner_normals, warp_mesh
from surgical_marl.vision.rays import CAPSULE, CYLINDER, ELLIPSOID, FAR, MESH
from surgical_marl.vision.skin import Skin

Array = NDArray[np.float64]

# A ball that is drawn but is no part of the model: position, radius, rgba.
Sphere = tuple[Sequence[float], float, Sequence[float]]

# Made once, because NumPy parses its text as Python code each time, which two threads cannot do at the same time in
# Python 3.11.
_LAYOUT: Any = np.dtype(Shape.numpy_dtype())  # type: ignore[attr-defined]  # a struct of Warp
_LINE = 1.0
"""Radius of a capsule in the picture at least, pixels."""
_KINDS = {mujoco.mjtGeom.mjGEOM_PLANE: PLANE, **KINDS}


class Extra(NamedTuple):
    """A shape that is drawn but is no part of the model, and stands still."""

    kind: int
    """A kind of `vision/rays.py`, or `PLANE`."""
    size: tuple[float, float, float]
    """Size of a geom of MuJoCo, m."""
    place: Array
    axes: Array
    """Axes of the shape as columns, [3, 3]."""
    material: Material
    casts: bool = True
    """True if it throws a shadow."""


class Placed(NamedTuple):
    """A `World` of a pose, without eyes, and what it is made of, to be kept as long as it is."""

    world: Any
    shapes: NDArray[np.void]
    meshes: list[Any]


class Drawn:
    """Shapes of one model.

    Args:
        model: whose geoms are primitives or meshes; of other kinds nothing is seen.
        stage: shapes besides those of the model.
        paint: geom -> what it is made of, or the rgb that suggests it, in place of its own colour.
        skins: surfaces that are drawn in place of some geoms.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        stage: Sequence[Extra] = (),
        paint: Mapping[int, Material | Sequence[float]] = MappingProxyType({}),
        skins: Sequence[Skin] = (),
    ) -> None:
        seen = (model.geom_group < GROUPS) & (visual_rgba(model)[:, 3] > 0)
        for skin in skins:
            seen[skin.geoms] = False
        known = np.array([mujoco.mjtGeom(kind) in _KINDS for kind in model.geom_type], bool)
        self._geoms = geoms = np.flatnonzero(seen & known)
        kinds = [int(_KINDS[mujoco.mjtGeom(kind)]) for kind in model.geom_type[geoms]]
        sizes = [_size(model, geom) for geom in geoms.tolist()]
        self._skins = list(skins)
        shapes = np.zeros(len(kinds) + len(stage) + len(skins), _LAYOUT)
        shapes["kind"] = [*kinds, *(extra.kind for extra in stage), *(int(MESH) for _ in skins)]
        shapes["size"] = np.array([*sizes, *(extra.size for extra in stage), *np.ones((len(skins), 3))]).reshape(-1, 3)
        shapes["radius"] = np.where(shapes["kind"] == PLANE, float(FAR), np.linalg.norm(_halves(shapes), axis=1))
        shapes["shadow_kind"], shapes["shadow_size"] = _shadows(shapes["kind"], shapes["size"])
        shapes["breadth"], shapes["alpha"] = _breadths(shapes["shadow_size"]), 1.0
        made = materials(model, paint)
        looks = [
            *(made[geom] for geom in geoms),
            *(extra.material for extra in stage),
            *(flesh(skin) for skin in skins),
        ]
        for row, of in zip(shapes, looks, strict=True):
            row["colour"], row["gloss"], row["pattern"] = of
        for row, extra in zip(shapes[len(geoms) :], stage, strict=False):
            row["place"], row["back"] = extra.place, extra.axes.T
            row["shadow_kind"] = row["shadow_kind"] if extra.casts else -1
        with wp.ScopedDevice("cpu"):
            meshes = [
                int(model.geom_dataid[geom]) if kind == MESH else -1 for geom, kind in zip(geoms, kinds, strict=True)
            ]
            self._meshes = {mesh: warp_mesh(model, mesh) for mesh in set(meshes) - {-1}}  # handles keep no mesh alive
        for row, mesh in zip(shapes, meshes, strict=False):
            if mesh >= 0:
                row["mesh"], row["first_face"] = self._meshes[mesh].id, model.mesh_faceadr[mesh]
        self._shapes = shapes
        self._grain = wp.array(_grain(), dtype=wp.vec4, device="cpu")
        self._normals = corner_normals(model)
        self._face_normals = wp.array(self._normals, dtype=wp.vec3, device="cpu")
        self._fade = 3.2 * float(model.stat.extent)

    @property
    def count(self) -> int:
        """Number of shapes without balls."""
        return len(self._shapes)

    def at(
        self,
        data: mujoco.MjData,
        eye: Array,
        pixel: float,
        spheres: Sequence[Sphere],
        through: float,
        nodes: Sequence[Array] | None = None,
    ) -> Placed:
        """Return a world of a pose.

        Args:
            data: poses of the model's geoms.
            eye: where it is seen from, m.
            pixel: width of a pixel at distance 1.
            spheres, through, nodes: as `Renderer.render` has them.
        """
        centres = np.array([centre for centre, _, _ in spheres], float).reshape(-1, 3)
        farthest = np.argsort(-np.linalg.norm(centres - eye, axis=1), kind="stable")
        shapes = np.zeros(self.count + len(spheres), _LAYOUT)
        still, more = shapes[: self.count], shapes[self.count :]
        still[:] = self._shapes
        still["place"][: len(self._geoms)] = data.geom_xpos[self._geoms]
        still["back"][: len(self._geoms)] = data.geom_xmat[self._geoms].reshape(-1, 3, 3).transpose(0, 2, 1)
        more["kind"] = more["shadow_kind"] = int(ELLIPSOID)
        more["back"], more["gloss"], more["pattern"] = np.eye(3), PLASTIC, int(GLOW)
        for row, (centre, radius, rgba) in zip(more, (spheres[ball] for ball in farthest), strict=True):
            row["place"], row["size"], row["shadow_size"], row["radius"] = centre, radius, radius, radius
            row["breadth"], row["colour"], row["alpha"] = radius, np.array(rgba[:3]) ** GAMMA, rgba[3]
        meshes, face_normals = self._deform(still, nodes or [skin.rest for skin in self._skins])
        towards = eye - shapes["place"]
        shapes["viewer"] = np.einsum("nij,nj->ni", shapes["back"], towards)
        shapes["near"] = np.linalg.norm(towards, axis=1) - shapes["radius"]
        reach = np.einsum("ni,ni->n", np.abs(shapes["back"][:, :, 2]), _halves(shapes))
        shapes["bottom"], shapes["top"] = shapes["place"][:, 2] - reach, shapes["place"][:, 2] + reach
        thin = shapes["kind"] == CAPSULE  # a needle is a line at least, not a row of dots
        away = np.linalg.norm(shapes["place"][thin] - eye, axis=1)
        shapes["size"][thin, 0] = np.maximum(shapes["size"][thin, 0], _LINE * pixel * away)
        world = World()
        # By its address, because Warp would make the layout anew to compare it.
        world.shapes = wp.array(ptr=shapes.ctypes.data, dtype=Shape, shape=shapes.shape, device="cpu")
        world.balls, world.through, world.fade = self.count, through, self._fade
        world.grain, world.face_normals = self._grain, face_normals
        return Placed(world, shapes, meshes)

    def _deform(self, shapes: NDArray[np.void], nodes: Sequence[Array]) -> tuple[list[Any], Any]:
        """Set the shapes of skins, the last ones, for these nodes; return their meshes, and the normals of all faces.

        A skin's frame stands where it is at rest, so that its pattern stays there.
        """
        if not self._skins:
            return [], self._face_normals
        meshes, normals = [], [self._normals]
        for row, skin, points in zip(shapes[-len(self._skins) :], self._skins, nodes, strict=True):
            middle = skin.rest.mean(0)
            local = np.asarray(points, float) - middle
            row["place"], row["back"], row["size"] = middle, np.eye(3), np.abs(local).max(0)
            row["radius"] = np.linalg.norm(row["size"])
            row["first_face"] = sum(map(len, normals))
            normals.append(skin.normals(local))
            with wp.ScopedDevice("cpu"):
                meshes.append(wp.Mesh(wp.array(local, dtype=wp.vec3), wp.array(skin.triangles.ravel(), dtype=int)))
            row["mesh"] = meshes[-1].id
        return meshes, wp.array(np.concatenate(normals), dtype=wp.vec3, device="cpu")


def _size(model: mujoco.MjModel, geom: int) -> Array:
    """Return a geom's size: three radii of an ellipsoid, the half sides of a box about its origin for a mesh."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.repeat(size[:1], 3)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        box = model.geom_aabb[geom]
        return np.asarray(np.abs(box[:3]) + box[3:])
    return np.asarray(size, float)


def _shadows(kinds: NDArray[np.int32], sizes: Array) -> tuple[NDArray[np.int32], Array]:
    """Return kinds and sizes of boxes, ellipsoids and capsules that throw shadows in place of shapes; -1 for planes.

    A cylinder becomes the capsule of its length, or an ellipsoid if it is a disc.
    """
    kinds, sizes = kinds.copy(), sizes.copy()
    discs = (kinds == CYLINDER) & (sizes[:, 1] < sizes[:, 0])
    rods = (kinds == CYLINDER) & ~discs
    kinds[discs], kinds[rods], kinds[kinds == PLANE] = ELLIPSOID, CAPSULE, -1
    sizes[discs] = sizes[discs][:, [0, 0, 1]]
    sizes[rods, 1] -= sizes[rods, 0]
    sizes[kinds == CAPSULE, 2] = 0.0
    return kinds, sizes


def _halves(shapes: NDArray[Any]) -> Array:
    """Return half the sides of boxes along their axes that hold shapes, [n, 3]; planes have none."""
    kinds, sizes = shapes["kind"], shapes["size"].astype(float)
    round_ = (kinds == CAPSULE) | (kinds == CYLINDER)
    capped = sizes[:, 1] + np.where(kinds == CAPSULE, sizes[:, 0], 0.0)
    tubes = np.stack([sizes[:, 0], sizes[:, 0], capped], axis=1)
    return np.where(round_[:, None], tubes, sizes)


def _breadths(sizes: Array) -> NDArray[np.float32]:
    """Return half width and half length of shapes as seen from some side, [n, 2]."""
    sizes = np.sort(sizes, axis=1)
    sizes[:, 0] = np.where(sizes[:, 0] > 0, sizes[:, 0], sizes[:, 1])  # a capsule has two sizes
    return np.stack([(sizes[:, 0] + sizes[:, 1]) / 2, sizes[:, 2]], axis=1).astype(np.float32)


@cache
def _grain() -> NDArray[np.float32]:
    """Return noise whose waves are 4 to 16 units long, and its slopes, [GRAIN, GRAIN, GRAIN, 4]: the same always."""
    side = int(GRAIN)
    ways = np.stack(np.meshgrid(*[np.fft.fftfreq(side)] * 3, indexing="ij"), axis=-1)
    pitch = np.linalg.norm(ways, axis=-1)
    waves = np.fft.fftn(np.random.default_rng(0).standard_normal((side,) * 3)) * ((pitch > 1 / 16) & (pitch < 1 / 4))
    noise = np.fft.ifftn(
        waves[..., None] * np.concatenate([np.ones((*waves.shape, 1)), 2j * np.pi * ways], -1), axes=(0, 1, 2)
    ).real
    return np.ascontiguousarray(noise / noise[..., 0].std(), np.float32)
