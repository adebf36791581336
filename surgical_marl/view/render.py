"""Pictures of a MuJoCo model without OpenGL: C MuJoCo's ray caster and simple shading.

    renderer = Renderer(model, width=480, height=360)
    image = renderer.render(data, camera=View(lookat=(0, 0, 0), distance=0.5))

Rays go through the middle of each pixel first. Pixels that differ from a neighbour are then cast
again with a grid of finer rays, so that edges are smooth and flat areas stay cheap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgical_marl.content import unknown
from surgical_marl.view import shading

Array = NDArray[np.float64]

# A sphere that is drawn but is no part of the model: position, radius, rgba.
Sphere = tuple[Sequence[float], float, Sequence[float]]

_VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)
_FAR = 1e10
_EDGE = 0.03  # difference in colour, of 1, above which finer rays are cast
_FINER = 3  # finer rays along each side of a pixel


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
    """Draws the visual geoms (groups 0 to 2) of one model, at one size."""

    def __init__(self, model: mujoco.MjModel, width: int = 480, height: int = 360) -> None:
        if width < 1 or height < 1:
            raise ValueError(f"a picture of {width} x {height} pixels has nothing to show: use 1 or more")
        self.model, self.width, self.height = model, width, height
        self._look = shading.Look.of(model)

    def render(
        self,
        data: mujoco.MjData,
        camera: str | View | None = None,
        spheres: Sequence[Sphere] = (),
    ) -> NDArray[np.uint8]:
        """Return a picture [height, width, 3] of the pose in `data`, after `mj_forward`.

        `camera` is a camera of the model by name or a free `View`; without one the model's first
        camera looks, or a free view of the whole model. `spheres` are drawn besides the model.
        """
        origin, axes, fovy = self._camera(data, camera)
        scale = 2 * np.tan(np.deg2rad(fovy) / 2) / self.height

        def colours(rows: Array, columns: Array) -> Array:
            right = (columns - self.width / 2) * scale
            up = (self.height / 2 - rows) * scale
            rays = np.stack([right, up, np.full_like(up, -1.0)], axis=1) @ axes.T
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            return self._colours(data, origin, rays, spheres)

        rows, columns = np.mgrid[: self.height, : self.width].reshape(2, -1) + 0.5
        image = colours(rows, columns).reshape(self.height, self.width, 3)
        edge = np.argwhere(_edges(image)) + 0.5
        offsets = (np.arange(_FINER) + 0.5) / _FINER - 0.5
        fine = edge[:, None] + np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(1, -1, 2)
        if len(edge):
            finer = colours(fine[..., 0].ravel(), fine[..., 1].ravel())
            image[_edges(image)] = finer.reshape(len(edge), -1, 3).mean(axis=1)
        return (image * 255 + 0.5).astype(np.uint8)

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

    def _colours(self, data: mujoco.MjData, origin: Array, rays: Array, spheres: Sequence[Sphere]) -> Array:
        """Return the colours [n, 3], from 0 to 1, of rays from one origin."""
        distance, geom, normal = self._cast(data, origin, rays)
        image = shading.background(rays)
        hit = np.flatnonzero(geom >= 0)
        if hit.size:
            points = origin + distance[hit, None] * rays[hit]
            base = self._look.base_colour(data, geom[hit], points)
            light = self._light(data, points, spheres)
            colour = self._look.shade(base, geom[hit], normal[hit], rays[hit], points, light)
            image[hit] = self._look.fade(colour, image[hit], geom[hit], distance[hit])
        away = [np.linalg.norm(np.asarray(centre) - origin) for centre, _, _ in spheres]
        for index in np.argsort(away)[::-1]:
            centre, radius, rgba = spheres[index]
            near = _sphere_distance(origin, rays, np.asarray(centre, float), radius)
            seen = np.flatnonzero(near < np.where(geom >= 0, distance, np.inf))
            points = origin + near[seen, None] * rays[seen]
            facing = (points - centre) / radius
            base = np.broadcast_to(np.asarray(rgba[:3], float) ** shading.GAMMA, facing.shape)
            none = np.full(len(seen), -1)
            light = np.ones(len(seen))
            colour = self._look.shade(base, none, facing, rays[seen], points, light)
            image[seen] += rgba[3] * (colour - image[seen])
        return np.clip(image, 0.0, 1.0) ** (1 / shading.GAMMA)

    def _light(self, data: mujoco.MjData, points: Array, spheres: Sequence[Sphere]) -> Array:
        """Return how much of the lamp each point sees. The lamp is a point, so one cast serves all."""
        rays = points - self._look.lamp
        length = np.linalg.norm(rays, axis=1)
        rays /= length[:, None]
        reached = length * (1 - 1e-4)
        blocked, geom, _ = self._cast(data, self._look.lamp, rays)
        light = np.where((geom >= 0) & (blocked < reached), 0.0, 1.0)
        for centre, radius, rgba in spheres:
            near = _sphere_distance(self._look.lamp, rays, np.asarray(centre, float), radius)
            light *= np.where(near < reached, 1 - rgba[3], 1.0)
        return light

    def _cast(self, data: mujoco.MjData, origin: Array, rays: Array) -> tuple[Array, NDArray[np.int32], Array]:
        """Return distance, geom (-1: none) and the normal towards the viewer of each ray's first hit."""
        count = len(rays)
        geom = np.empty(count, np.int32)
        distance, normal = np.empty(count), np.empty((count, 3))
        mujoco.mj_multiRay(
            m=self.model,
            d=data,
            pnt=origin,
            vec=np.ascontiguousarray(rays).reshape(-1),
            geomgroup=_VISIBLE_GROUPS,
            flg_static=True,
            bodyexclude=-1,
            geomid=geom,
            dist=distance,
            normal=normal.reshape(-1),
            nray=count,
            cutoff=_FAR,
        )
        normal[np.einsum("ij,ij->i", normal, rays) > 0] *= -1
        return distance, geom, normal


def _sphere_distance(origin: Array, rays: Array, centre: Array, radius: float) -> Array:
    """Return the distance along unit rays to a sphere, infinite where they miss it."""
    towards = centre - origin
    along = rays @ towards
    inside = radius**2 - (towards @ towards - along**2)
    near = along - np.sqrt(np.maximum(inside, 0.0))
    return np.where((inside > 0) & (near > 0), near, np.inf)


def _edges(image: Array) -> NDArray[np.bool_]:
    """Return which pixels differ from the one beside, above or below them."""
    edge = np.zeros(image.shape[:2], bool)
    across = np.abs(np.diff(image, axis=1)).max(axis=2) > _EDGE
    down = np.abs(np.diff(image, axis=0)).max(axis=2) > _EDGE
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge
