"""Draws a scene's cameras for many environments at once, from the poses of its bodies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from surgical_marl.runtime import prepare_warp
from surgical_marl.vision.rays import BOX, CAPSULE, CYLINDER, ELLIPSOID, MESH, SKIN, TILE, Light, cull, make_draw, place
from surgical_marl.vision.skin import SMOOTH, Skin
from surgical_marl.vision.surfaces import Surfaces

wp = prepare_warp()

GROUPS = 3
"""Geoms of the groups below this one are drawn."""
BLOCK = 128
"""Threads in a CUDA block."""
KINDS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_CAPSULE: CAPSULE,
    mujoco.mjtGeom.mjGEOM_CYLINDER: CYLINDER,
    mujoco.mjtGeom.mjGEOM_BOX: BOX,
    mujoco.mjtGeom.mjGEOM_MESH: MESH,
}


class RayCaster:
    """Cameras of a scene in N copies of it, on Warp's current device.

    Args:
        model: a scene's, with one lamp that stands still.
        cameras: ids of C cameras with one field of view.
        num_envs: N.
        width, height: of a picture, pixels.
        background: colour of what no geom covers, from 0 to 1.
        skins: drawn in place of their geoms.

    Attributes:
        surfaces: the skins in all copies.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        cameras: Sequence[int],
        num_envs: int,
        width: int,
        height: int,
        background: Sequence[float],
        skins: Sequence[Skin] = (),
    ) -> None:
        shown = (model.geom_group < GROUPS) & (model.geom_rgba[:, 3] > 0)
        for skin in skins:
            shown[skin.geoms] = np.isin(np.arange(len(skin.geoms)), skin.owners)
        geoms = np.flatnonzero(shown)
        kinds = np.array([KINDS[mujoco.mjtGeom(kind)] for kind in model.geom_type[geoms]], np.int32)
        for skin in skins:
            kinds[np.isin(geoms, skin.geoms)] = SKIN
        meshes = np.where(kinds == MESH, model.geom_dataid[geoms], -1)
        pictures, tiles = num_envs * len(cameras), -(-width // TILE) * -(-height // TILE)
        pixel = float(2 * np.tan(np.radians(model.cam_fovy[cameras[0]]) / 2) / height)
        self._meshes = {mesh: warp_mesh(model, mesh) for mesh in set(meshes) - {-1}}  # handles keep no mesh alive
        self._handles = wp.array([self._meshes[m].id if m >= 0 else 0 for m in meshes], dtype=wp.uint64)
        self._first_faces = wp.array(np.append(model.mesh_faceadr, 0)[meshes], dtype=int)
        self._normals = wp.array(corner_normals(model), dtype=wp.vec3)
        self._kinds, self._geoms, self._cameras = (wp.array(ids, dtype=int) for ids in (kinds, geoms, cameras))
        self._sizes = wp.array(_sizes(model, geoms), dtype=wp.vec3)
        self._colours = wp.array(model.geom_rgba[geoms, :3], dtype=wp.vec3)
        self._turns = wp.empty((pictures, len(geoms)), dtype=wp.mat33)
        self._eyes = wp.empty((pictures, len(geoms)), dtype=wp.vec3)
        self._listed = wp.empty((pictures, tiles, len(geoms)), dtype=wp.uint16)
        self._counts = wp.empty((pictures, tiles), dtype=int)
        self._screen = pixel, width, height
        self._light, self._background = _light(model), wp.vec3(*background)
        self.surfaces = Surfaces(skins, geoms, num_envs)
        self._draw = make_draw(bool(self._meshes), bool(skins))

    def draw(self, data: Any, rgb: Any, depth: Any, segmentation: Any) -> None:
        """Write pictures into arrays [N * C, height, width], or [N * C, height, width, 3] for colour.

        C is the number of cameras. The arrays are torch's, or numpy's on a CPU. A channel whose array is empty is not
        drawn.

        Args:
            data: poses of geoms and cameras, of `vision/kinematics.py` or MuJoCo Warp.
            rgb: colour; may be empty.
            depth: distance along the optical axis, m; may be empty.
            segmentation: ids of geoms; may be empty.
        """
        cameras, placed = [data.cam_xpos, data.cam_xmat, self._cameras], [self._turns, self._eyes]
        listed = [self._listed, self._counts]
        own = self.surfaces
        own.update()
        inputs = [data.geom_xpos, data.geom_xmat, self._geoms, self._kinds, *cameras, own.balls, *placed]
        wp.launch(place, self._turns.shape, inputs, block_dim=BLOCK)
        inputs = [self._kinds, self._sizes, *placed, own.balls, len(self._cameras), *self._screen, *listed]
        wp.launch(cull, self._counts.shape, inputs, block_dim=BLOCK)
        inputs = [self._kinds, self._sizes, self._colours, self._geoms, self._handles, self._first_faces, self._normals]
        inputs += [own.nodes, own.faces, own.firsts, own.counts, own.normals]
        inputs += [*placed, *listed, *cameras, *self._screen, self._light, self._background]
        inputs += [_warp(rgb, wp.vec3ub), _warp(depth, wp.float32), _warp(segmentation, wp.int32)]
        wp.launch(self._draw, (*self._counts.shape, TILE**2), inputs, block_dim=BLOCK)


def _warp(array: Any, dtype: Any) -> Any:
    """Return an array of Warp's in the same memory."""
    if isinstance(array, np.ndarray):
        return wp.array(array, dtype=dtype, copy=False, device="cpu")
    return wp.from_torch(array, dtype=dtype)


def _sizes(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray:
    """Return sizes for the kernels: three radii of an ellipsoid, the bounding box about its origin of a mesh."""
    sizes = model.geom_size[geoms]
    balls, meshes = (
        model.geom_type[geoms] == kind for kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_MESH)
    )
    sizes[balls] = sizes[balls][:, :1]
    box = model.geom_aabb[geoms]
    sizes[meshes] = (np.abs(box[:, :3]) + box[:, 3:])[meshes]
    return sizes


def warp_mesh(model: mujoco.MjModel, mesh: int) -> Any:
    start, first = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    points = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
    faces = model.mesh_face[first : first + model.mesh_facenum[mesh]]
    return wp.Mesh(wp.array(points, dtype=wp.vec3), wp.array(faces.ravel(), dtype=int))


def corner_normals(model: mujoco.MjModel) -> np.ndarray:
    """Return normals at the corners of faces, [faces, 3, 3]: the vertex's, or the face's where that is far off."""
    found = np.zeros((max(len(model.mesh_face), 1), 3, 3), np.float32)
    for mesh in range(model.nmesh):
        rows = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
        corners = model.mesh_vert[model.mesh_vertadr[mesh] + model.mesh_face[rows]]
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
        smooth = model.mesh_normal[model.mesh_normaladr[mesh] + model.mesh_facenormal[rows]]
        alike = np.einsum("fcx,fx->fc", smooth, flat) >= SMOOTH
        found[rows] = np.where(alike[..., None], smooth, flat[:, None])
    return found


def _light(model: mujoco.MjModel) -> Any:
    light, head = Light(), model.vis.headlight
    light.position, light.direction = wp.vec3(*model.light_pos[0]), wp.vec3(*model.light_dir[0])
    light.cutoff, light.exponent = float(np.cos(np.radians(model.light_cutoff[0]))), float(model.light_exponent[0])
    light.diffuse, light.specular = wp.vec3(*model.light_diffuse[0]), wp.vec3(*model.light_specular[0])
    light.head_ambient, light.head_diffuse = wp.vec3(*head.ambient), wp.vec3(*head.diffuse)
    light.head_specular = wp.vec3(*head.specular)
    return light
