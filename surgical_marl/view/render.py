"""Pictures of a MuJoCo model without OpenGL, by rays that a compiled kernel casts on one core.

    renderer = Renderer(model, width=480, height=360)
    image = renderer.render(data, camera=View(lookat=(0, 0, 0), distance=0.5))

Rays go through the middle of each pixel first; four finer ones follow where neighbours show different things. A large
lamp throws soft shadows, and what stands close together darkens each other. What an agent observes through a camera is
drawn elsewhere, by `vision/endoscope.py`, and does not depend on how pictures for people look.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgical_marl.content import unknown
from surgical_marl.view import painter, tracer
from surgical_marl.view.drawn import Drawn, Extra, Sphere
from surgical_marl.view.shading import Material
from surgical_marl.vision.skin import Skin

Array = NDArray[np.float64]

_LAMP = np.array([-0.7, 0.6, 1.6])
"""Way from the middle of a model to the lamp, in extents: to the viewer's right, towards the viewer, and up."""
_LAMP_SIZE, _SKY_SIZE = 0.045, 0.55
"""Radii over distance of the lamp, and of the part of the sky that things near by hide."""
_FAR, _SKY_FAR = 1e6, 0.2
"""Greatest distance of shapes that hide the lamp and the sky, in extents of the model."""
_LAMP_TILES, _SKY_TILES = 128, 96
_LIT = 1.6
"""Reach of shadows from the model's middle, in its extents."""
_LAMP_MARGIN, _SKY_MARGIN = 0.02, 0.05
"""Reach of a half shadow beyond a shape, as a share of the extent; the rest is cut off."""


@dataclass(frozen=True)
class View:
    """A free camera: it looks at a point from a distance. Angles in degrees, as MuJoCo has them."""

    lookat: Sequence[float] = (0.0, 0.0, 0.0)
    distance: float = 1.0
    azimuth: float = 90.0
    elevation: float = -25.0
    fovy: float = 40.0

    def pose(self) -> tuple[Array, Array]:
        """Return the position, and the axes right, up, back as columns."""
        azimuth, elevation = np.deg2rad((self.azimuth, self.elevation))
        level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        forward = np.cos(elevation) * level + np.array([0.0, 0.0, np.sin(elevation)])
        right = np.array([level[1], -level[0], 0.0])
        axes = np.stack([right, np.cross(right, forward), -forward], axis=1)
        return np.asarray(self.lookat, float) - self.distance * forward, axes


class Renderer:
    """Draws the visual geoms (groups 0 to 2) of one model, at one size. Threads may draw at the same time.

    Args:
        model: whose geoms are primitives or meshes.
        width: of a picture, pixels.
        height: likewise.
        stage: shapes besides those of the model, such as a table.
        paint: geom -> what it is made of, or the rgb that suggests it, in place of its own colour.
        skins: surfaces that are drawn in place of some geoms.

    Raises:
        ValueError: a size without pixels.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int = 480,
        height: int = 360,
        stage: Sequence[Extra] = (),
        paint: Mapping[int, Material | Sequence[float]] = MappingProxyType({}),
        skins: Sequence[Skin] = (),
    ) -> None:
        if width < 1 or height < 1:
            raise ValueError(f"a picture of {width} x {height} pixels has nothing to show: use 1 or more")
        self.model, self.width, self.height = model, width, height
        self._drawn = Drawn(model, stage, paint, skins)
        self._wp = tracer.wp
        for module in (tracer, painter):  # here, so that threads need not wait for each other
            self._wp.load_module(module, device="cpu")

    def render(
        self,
        data: mujoco.MjData,
        camera: str | View | None = None,
        spheres: Sequence[Sphere] = (),
        through: float = 0.0,
        nodes: Sequence[Array] | None = None,
    ) -> NDArray[np.uint8]:
        """Return a picture [height, width, 3] of the pose in `data`, after `mj_forward`.

        Args:
            data: poses of the model's geoms and cameras.
            camera: a camera of the model by name, or a free view. Without one the model's first camera looks, or a free
                view of the whole model.
            spheres: drawn besides the model.
            through: share of a sphere's colour, from 0 to 1, that is seen through what hides it.
            nodes: where the nodes of each skin are, [n, 3] each, m; None for at rest.
        """
        place, axes, fovy = self._camera(data, camera)
        wp, size = self._wp, (self.height, self.width)
        pixel = 2 * np.tan(np.deg2rad(fovy) / 2) / self.height
        placed = self._drawn.at(data, place, pixel, spheres, through, nodes)
        world = placed.world
        self._list(world, placed.shapes, [self._eye(place, axes, pixel, self.width, self.height), *self._lamps(axes)])
        coarse = tuple(-(-side // int(painter.COARSE)) for side in size)
        pixels = painter.Pixels()
        pixels.depths = wp.empty(size, dtype=float, device="cpu")
        pixels.normals = wp.empty(size, dtype=wp.vec3, device="cpu")
        pixels.sides, pixels.orbs = (wp.empty(size, dtype=int, device="cpu") for _ in range(2))
        pixels.lights = wp.zeros(coarse, dtype=wp.vec2, device="cpu")
        wp.launch(painter.cast, size, [world, pixels], device="cpu")
        wp.launch(painter.light_up, coarse, [world, pixels], device="cpu")
        picture = np.empty((*size, 3), np.uint8)
        written = wp.array(picture, dtype=wp.vec3ub, copy=False, device="cpu")
        wp.launch(painter.paint, size, [world, pixels, written], device="cpu")
        return picture

    def lamp(self, axes: Array) -> Array:
        """Return where the lamp is for a camera with these axes, m: above the viewer's left shoulder."""
        right = np.array([*axes[:2, 0], 0.0])
        length = np.linalg.norm(right)
        right = right / length if length > 1e-3 else np.array([1.0, 0.0, 0.0])
        level = np.stack([right, np.cross(right, [0.0, 0.0, 1.0]), [0.0, 0.0, 1.0]], axis=1)
        place: Array = self.model.stat.center + self.model.stat.extent * (level @ _LAMP)
        return place

    def _camera(self, data: mujoco.MjData, camera: str | View | None) -> tuple[Array, Array, float]:
        model = self.model
        if camera is None:
            stat = model.stat
            whole = View(lookat=stat.center, distance=1.8 * stat.extent, azimuth=120.0)
            camera = model.camera(0).name if model.ncam else whole
        if isinstance(camera, View):
            return *camera.pose(), camera.fovy
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if index < 0:
            raise unknown("camera", camera, [model.camera(i).name for i in range(model.ncam)])
        axes = data.cam_xmat[index].reshape(3, 3)
        return data.cam_xpos[index], axes, float(model.cam_fovy[index])

    def _lamps(self, axes: Array) -> list[Any]:
        """Return the lamp, and the sky as a lamp overhead."""
        extent = self.model.stat.extent
        sky = self.model.stat.center + np.array([0.0, 0.0, 6.0 * extent])
        key, above = self._lamp(self.lamp(axes), _LAMP_TILES), self._lamp(sky, _SKY_TILES)
        key.spread, key.far, key.margin = _LAMP_SIZE, _FAR, _LAMP_MARGIN * extent
        above.spread, above.far, above.margin = _SKY_SIZE, _SKY_FAR * extent, _SKY_MARGIN * extent
        return [key, above]

    def _lamp(self, place: Array, tiles: int) -> Any:
        """Return a lamp that looks at the middle of the model."""
        back = place - self.model.stat.center
        distance = np.linalg.norm(back)
        back = back / distance
        right = np.cross([0.0, 1.0, 0.0], back)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(back, right), back], axis=1)
        pixels = tiles * int(tracer.TILE)
        return self._eye(place, axes, 2 * _LIT * self.model.stat.extent / distance / pixels, pixels, pixels)

    def _list(self, world: Any, drawn: NDArray[np.void], eyes: list[Any]) -> None:
        """Set the eyes of a picture, and which shapes each tile of theirs may show: of a camera, a lamp and the sky."""
        wp = self._wp
        for one, after in pairwise(eyes):
            after.first = one.first + one.columns * one.rows
        tiles = eyes[-1].first + eyes[-1].columns * eyes[-1].rows
        world.eyes = wp.array(eyes, dtype=tracer.Eye, device="cpu")
        world.listed = wp.empty((tiles, max(len(drawn), 1)), dtype=wp.uint16, device="cpu")
        world.counts = wp.zeros(tiles, dtype=int, device="cpu")
        # For the eye the nearest first: if one begins behind what a ray has met, so do all after it. For the lamp the
        # largest first: they may hide all of it. For the sky from below: if one is too high, so are all after it.
        nearest = np.argsort(drawn["near"][: self._drawn.count])
        orders = [nearest, np.argsort(-drawn["radius"]), np.argsort(drawn["bottom"])]
        for number, order in enumerate(orders):
            numbers = wp.array(order.astype(np.int32), dtype=int, device="cpu")
            wp.launch(tracer.list_shapes, 1, [world, numbers, number], device="cpu")

    def _eye(self, place: Array, axes: Array, pixel: float, width: int, height: int) -> Any:
        eye, tile, wp = tracer.Eye(), int(tracer.TILE), self._wp
        eye.place, eye.axes = wp.vec3(*place), wp.mat33(*axes.ravel())
        eye.tile, eye.columns, eye.rows = pixel * tile, -(-width // tile), -(-height // tile)
        eye.left, eye.top = -pixel * width / 2, pixel * height / 2
        return eye
