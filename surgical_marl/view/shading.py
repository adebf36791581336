"""The look of the renderer's pictures: colours of geoms, one lamp, a bright room around them."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GAMMA = 2.2  # colours are mixed in linear light and shown as sRGB

_HORIZON = np.array([0.86, 0.89, 0.93])
_ZENITH = np.array([0.30, 0.42, 0.58])
_DRAPE = np.array([0.045, 0.15, 0.17])
_BOUNCE = np.array([0.07, 0.05, 0.05])
_LAMP = np.array([1.0, 0.97, 0.92])
_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)


def background(rays: Array) -> Array:
    """Return the room [n, 3] in linear light: sky above the horizon, blue-green drapes below it."""
    height = rays[:, 2:3]
    up = np.sqrt(np.clip(height, 0.0, 1.0))
    down = np.clip(-1.6 * height, 0.0, 1.0) ** 0.7
    return _HORIZON + up * (_ZENITH - _HORIZON) + down * (_DRAPE - _HORIZON)


@dataclass(frozen=True)
class Look:
    """The look of a model: colours in linear light, gloss, planes and the lamp."""

    colour: Array
    gloss: Array
    plane: NDArray[np.bool_]
    extent: float
    tile: float
    lamp: Array

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Look:
        """Read a model's look."""
        colour = visual_rgba(model)[:, :3].astype(float)
        plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        # Greys are rendered as steel, which reflects the room; colours as plastic or tissue, which hardly do.
        saturation = np.ptp(colour, axis=1) / np.maximum(colour.max(axis=1), 1e-6)
        gloss = np.where(plane, 0.0, 0.05 + 0.45 * np.clip(1 - 3 * saturation, 0.0, 1.0))
        extent = float(model.stat.extent)
        lamp = model.stat.center + extent * np.array([-1.6, -2.2, 4.0])
        return cls(colour**GAMMA, gloss, plane, extent, _round_length(extent / 8), lamp)

    def base_colour(self, data: mujoco.MjData, geom: NDArray[np.int32], points: Array) -> Array:
        """Return the colours of points on geoms, before light; planes have faint square tiles."""
        base = self.colour[geom]
        for index in np.unique(geom[self.plane[geom]]):
            on = np.flatnonzero(geom == index)
            axes = data.geom_xmat[index].reshape(3, 3)
            tiles = np.floor((points[on] - data.geom_xpos[index]) @ axes[:, :2] / self.tile)
            base[on] *= np.where(tiles.sum(axis=1) % 2, 0.92, 1.0)[:, None]
        return base

    def shade(
        self,
        base: Array,
        geom: NDArray[np.int32],
        normal: Array,
        rays: Array,
        points: Array,
        light: Array,
    ) -> Array:
        """Return lit colours: Lambert's law under the lamp and the room, plus reflections of both."""
        to_lamp = self.lamp - points
        to_lamp /= np.linalg.norm(to_lamp, axis=1, keepdims=True)
        lambert = np.clip(np.einsum("ij,ij->i", normal, to_lamp), 0.0, None) * light
        facing = np.clip(-np.einsum("ij,ij->i", normal, rays), 0.0, 1.0)
        sky = 0.5 + 0.5 * normal[:, 2:3]
        room = _BOUNCE + sky * (0.42 * _HORIZON - _BOUNCE)
        # A part of the light comes from the viewer, so that no side is ever black.
        diffuse = room + 0.62 * lambert[:, None] * _LAMP + 0.10 * facing[:, None]

        mirrored = rays + 2 * facing[:, None] * normal
        spot = np.clip(np.einsum("ij,ij->i", mirrored, to_lamp), 0.0, 1.0) ** 40 * light
        # Reflection grows at grazing angles (Schlick), which gives each shape a bright rim.
        gloss = np.where(geom >= 0, self.gloss[geom], 0.06)
        rim = np.where((geom >= 0) & self.plane[geom], 0.0, (1 - facing) ** 4 * 0.5)
        mirror = (gloss + (1 - gloss) * rim)[:, None]
        shine = background(mirrored) + 2.5 * spot[:, None] * _LAMP
        return base * diffuse * (1 - 0.6 * mirror) + mirror * shine

    def fade(self, colour: Array, room: Array, geom: NDArray[np.int32], distance: Array) -> Array:
        """Blend planes into the horizon, where their tiles would flicker."""
        far = np.clip(distance / self.extent / 4 - 0.5, 0.0, 1.0)
        mist = np.where(self.plane[geom], far * far * (3 - 2 * far), 0.0)[:, None]
        return colour + mist * (np.maximum(room, _HORIZON) - colour)


def visual_rgba(model: mujoco.MjModel) -> NDArray[np.float32]:
    """Return the colours of all geoms, [ngeom, 4]; a geom's own rgba overrides its material's, as in MuJoCo."""
    rgba: NDArray[np.float32] = model.geom_rgba.copy()
    painted = (model.geom_matid >= 0) & (rgba == _DEFAULT_RGBA).all(axis=1)
    rgba[painted] = model.mat_rgba[model.geom_matid[painted]]
    return rgba


def _round_length(length: float) -> float:
    """Return the nearest of 1, 2 and 5 times a power of ten.

    Tiles of such a length have a size that is easy to tell in words.
    """
    power = 10 ** np.floor(np.log10(length))
    return float(power * min((1, 2, 5, 10), key=lambda step: abs(step - length / power)))
