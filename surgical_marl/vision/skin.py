"""Surfaces that deform, such as tissue: faces between nodes, smooth where they are so at rest.

own = skins(scene.systems, scene.model)
Renderer(scene.model, skins=own).render(data, nodes=[skin.rest for skin in own])

`surgical_marl/vision/surfaces.py` draws them for many environments.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMOOTH = 0.8
"""A surface looks smooth where its faces' directions differ by less than this cosine, as in MuJoCo."""

_HALVES = [[0, 1, 2], [0, 2, 3]]
"""Corners of the two triangles of a face."""


class _Surface(NamedTuple):
    name: str
    """Name of the system."""
    rest: Array
    """Its nodes at rest, m, [n, 3]."""
    faces: NDArray[np.int32]
    """Nodes around each face, counterclockwise as seen from outside, [f, 4]."""
    geoms: NDArray[np.int64]
    """Geoms of the model that it is drawn in place of: the bars of the system."""
    middles: Array
    """Where these are at rest, m, [geoms, 3]."""
    colour: Array
    """From 0 to 1, [3]."""


class Skin(_Surface):
    """The skin of a system."""

    @property
    def triangles(self) -> NDArray[np.int32]:
        """Nodes of two triangles for each face, [2 f, 3]."""
        return self.faces[:, _HALVES].reshape(-1, 3)

    def normals(self, nodes: Array) -> Array:
        """Return unit normals at the corners of the triangles for nodes [n, 3] somewhere, [2 f, 3, 3].

        At a corner, the normals of the faces are averaged between which the surface is smooth at rest.
        """
        corners, faces = self.joined
        found = np.zeros((self.faces.size, 3))
        np.add.at(found, corners, _crossed(nodes[self.faces])[faces])
        found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-30)
        return found.reshape(-1, 4, 3)[:, _HALVES].reshape(-1, 3, 3)

    @cached_property
    def owners(self) -> NDArray[np.intp]:
        """Return which of `geoms` each face is drawn in place of, [f]: that which is nearest at rest."""
        away = self.rest[self.faces].mean(1)[:, None] - self.middles
        return np.square(away).sum(-1).argmin(1)

    @cached_property
    def joined(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Pairs of a corner and of a face that is smoothly joined there."""
        flat = _crossed(self.rest[self.faces])
        flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        nodes = self.faces.reshape(-1)
        one, other = np.nonzero(nodes[:, None] == nodes)
        alike = (flat[one // 4] * flat[other // 4]).sum(1) >= SMOOTH
        return one[alike], other[alike] // 4


def skins(systems: Mapping[str, Any], model: mujoco.MjModel) -> list[Skin]:
    """Return the skins of the systems of a model that have one."""
    owners = np.array([model.body(int(body)).name.partition("/")[0] for body in model.geom_bodyid])
    found = []
    for name, system in systems.items():
        if (bars := system.bars) is not None and _has_skin(system):
            geoms, middles = np.flatnonzero(owners == name), bars.start[bars.ends].mean((1, 2))
            found.append(Skin(name, bars.start, system.faces, geoms, middles, np.array(bars.colour)))
    return found


def _has_skin(system: Any) -> bool:
    from surgical_marl.physics.systems.system import SkinnedSystem  # here, because pictures alone need no physics

    return isinstance(system, SkinnedSystem)


def _crossed(corners: Array) -> Array:
    """Return the normals of faces with these corners [f, 4, 3], of twice the length of their areas, [f, 3]."""
    return np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
