"""The mesh of soft tissue: equal bricks on a regular grid, of which some may be cut out.

Nodes of the whole grid are numbered, so the eight nodes of any brick are at the same distances from its first one.
Nodes that belong to no brick have no mass and stay where they are.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from surgical_marl.physics.systems.brick import CORNERS

SIDES = {"left": (0, 0), "right": (0, -1), "front": (1, 0), "back": (1, -1), "bottom": (2, 0)}
"""Borders that can be held: axis, and which end of it."""


class SurfacePoints(NamedTuple):
    """Points on the upper and the lower face: s of them, on four nodes each."""

    nodes: np.ndarray
    """[s, 4]"""
    weights: np.ndarray
    """Shares of the nodes, [s, 4]; they sum to 1."""
    inward: np.ndarray
    """Difference of the numbers of the node under it, in the tissue, and of the node itself, [s]."""
    faces: np.ndarray
    """Nodes of the faces of bricks on which they are, [f, 4]."""
    first: np.ndarray
    """Number of the first point of each face, and that of all points, [f + 1]: a point is of the first of its faces."""


class BrickGrid:
    """The nodes and bricks of a piece of tissue at rest, and their masses."""

    def __init__(self, size: Any, present: np.ndarray, density: float) -> None:
        """Build the mesh.

        Args:
            size: of the whole grid, m, [3].
            present: which bricks are there, [nx, ny, nz] bool.
            density: kg/m3.
        """
        self.cells, self.present = np.array(present.shape), present
        self.cell = np.asarray(size, float) / self.cells
        self.counts = self.cells + 1
        self.nodes = int(self.counts.prod())
        grid = np.stack(np.meshgrid(*[np.arange(n) for n in self.counts], indexing="ij"), -1).reshape(-1, 3)
        self.places = grid
        """Where the nodes are in the grid, [n, 3]."""
        self.rest = (grid * self.cell).astype(np.float32)
        """Their positions, m, [n, 3]."""
        strides = np.array([self.counts[1] * self.counts[2], self.counts[2], 1])
        self.offsets = (CORNERS @ strides).astype(np.int32)
        """Distances of the numbers of a brick's nodes from its first one, [8]."""
        self.first = (np.argwhere(present) @ strides).astype(np.int32)
        """First node of each brick, [e]."""
        mass = np.zeros(self.nodes)
        np.add.at(mass, self.first[:, None] + self.offsets, density * self.cell.prod() / 8)
        self.mass = mass.astype(np.float32)
        """Of the nodes, kg, [n]; 0 where no brick is."""

    def side(self, name: str) -> np.ndarray:
        """Return which nodes are on a side of the grid, [n] bool."""
        axis, end = SIDES[name]
        found: np.ndarray = (self.places[:, axis] == range(self.counts[axis])[end]) & (self.mass > 0)
        return found

    def areas(self, name: str) -> np.ndarray:
        """Return the share of a side that belongs to each node, m2, [n]."""
        axis, end = SIDES[name]
        found = np.zeros(self.nodes)
        bricks = np.argwhere(self.present)
        outer = bricks[:, axis] == range(self.cells[axis])[end]
        corners = self.first[outer][:, None] + self.offsets[CORNERS[:, axis] == (0 if end == 0 else 1)]
        np.add.at(found, corners, np.delete(self.cell, axis).prod() / 4)
        return found

    def faces(self) -> np.ndarray:
        """Return the nodes around each outer face of a brick, counterclockwise as seen from outside, [f, 4]."""
        around, found = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), []
        for axis, end in np.ndindex(3, 2):
            beyond = np.roll(np.pad(self.present, 1), 1 - 2 * end, axis)[1:-1, 1:-1, 1:-1]
            order = np.insert(around if end else around[::-1], 0, end, 1)  # this axis, and the next two after it
            corners = self.offsets[np.roll(order, axis, 1) @ [4, 2, 1]]
            found.append(self.first[~beyond[self.present]][:, None] + corners)
        return np.concatenate(found).astype(np.int32)

    def surface(self) -> SurfacePoints:
        """Return the nodes of both faces, and the points midway between them, on which others press."""
        points: dict[tuple[int, ...], int] = {}
        faces, first = [], []
        strides = self.offsets[[4, 2, 1]]
        for layer, inward in ((0, 1), (self.cells[2] - 1, -1)):
            level = layer if inward == 1 else layer + 1
            for i, j in np.argwhere(self.present[:, :, layer]):
                corners = [int(np.array([i + a, j + b, level]) @ strides) for a in (0, 1) for b in (0, 1)]
                faces.append(corners)
                first.append(len(points))
                for own in ((0,), (1,), (2,), (3,), (0, 1), (0, 2), (1, 3), (2, 3), (0, 1, 2, 3)):
                    points[tuple(corners[k] for k in own)] = inward
        nodes = np.array([(own * 4)[:4] for own in points], np.int32)
        count = np.array([len(own) for own in points])[:, None]
        weights = np.where(np.arange(4) < count, 1 / count, 0.0).astype(np.float32)
        starts = np.array([*first, len(points)], np.int32)
        return SurfacePoints(
            nodes, weights, np.array([*points.values()], np.int32), np.array(faces, np.int32), starts
        )  # fmt: skip
