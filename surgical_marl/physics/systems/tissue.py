"""Soft tissue: a sheet or a block of bricks that arms and objects press, pinch and lift by friction.

tissue = scene.systems["tissue"]                 # of an object with `kind: tissue`
physics.systems["tissue"].nodes.position         # m, [n, 3]
world.systems["tissue"].tissue_force             # N, of the hardest touch
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.spring_contact import Stretches, each, feel, none, pushes, recall, remember
from surgical_marl.physics.solver.cholesky import FULL, LOWER
from surgical_marl.physics.systems.brick import Brick
from surgical_marl.physics.systems.brick_grid import BrickGrid, SurfacePoints
from surgical_marl.physics.systems.brick_solve import BrickSolver, Linear, Nodes, Springs, Support
from surgical_marl.physics.systems.system import Bars, End, Ends, Response, Shapes, System
from surgical_marl.physics.tree_utils import row_of
from surgical_marl.scenes.objects import Placement, Surface
from surgical_marl.scenes.tissue_file import TissueFile
from surgical_marl.untrusted.schema import Place

ROUNDS, ITERATIONS = 4, 3
"""Linearisations of contacts in a physics step, and conjugate gradients after each. With fewer, friction overshoots
where it begins to slide."""
ROOM = 48
"""Most contacts at a time."""
SKIN = 0.1
"""Radius of the balls at surface points that others touch, in thicknesses of a brick; they lie in the tissue."""


class TissueState(NamedTuple):
    """The state of tissue."""

    nodes: Nodes
    stretches: Stretches
    force: Array
    """Of the hardest touch in the last step: the sum over all points that touch one shape, N, []."""
    place: Array
    """Where that was, m, [3]."""
    torn: Array
    """True once it has been stretched past `tears`, [] bool."""


class TissueView(NamedTuple):
    """Tissue of n nodes as tasks see it. World."""

    position: Array
    """m, [n, 3]"""
    velocity: Array
    """m/s, [n, 3]"""
    tissue_force: Array
    """The largest force of a shape on it, N, []."""
    place: Array
    """Where that is, m, [3]; the origin if nothing touches it."""
    torn: Array
    """True once it has been stretched past `tears`, [] bool."""


class Solved(NamedTuple):
    """A step of tissue whose contacts' ends move as expected."""

    shift: Array
    """Displacements of the nodes, m, [n, 3]."""
    block: Array
    """Each node's own block of the matrix, N/m, lower half, [n, 6]."""
    ends: Ends
    """With the stretches that are remembered."""
    force: Array
    """Of each contact on the tissue, N, [c, 3]."""
    falls: Array
    """Of that force as the end moves, with what the tissue at its point gives way, N/m: lower halves, [c, 6]."""


@dataclass(frozen=True)
class Tissue(System):
    """A piece of tissue."""

    size: tuple[float, float, float]
    """m"""
    present: tuple[tuple[tuple[bool, ...], ...], ...]
    """Which bricks are there, [nx, ny, nz]."""
    young: float
    """Young's modulus, Pa."""
    poisson: float
    """Poisson's ratio."""
    density: float
    """kg/m3"""
    damping: float
    """s"""
    fixed: tuple[str, ...]
    """Borders that do not move."""
    springs: tuple[tuple[str, float], ...]
    """Borders on springs, and their stiffness per area, N/m3."""
    surface: Surface
    position: tuple[float, float, float]
    """Of the tissue's frame, whose origin is the corner of the grid, m."""
    rotation: tuple[tuple[float, ...], ...]
    """Axes of that frame, [3, 3]."""
    tears: float | None = None
    """Stretch past which it counts as torn."""
    colour: tuple[float, float, float] = (0.75, 0.35, 0.33)
    """In pictures."""
    file: ClassVar[type] = TissueFile
    """The content of its file."""

    @classmethod
    def placed(cls, item: Placement, entry: Any, others: Mapping[str, Placement], place: Place) -> Tissue:
        """Return tissue that is held in a scene, from its file and the place of its frame."""
        del others
        if entry.tied:
            raise ValueError(f"{place}.tied: only the ends of a thread are tied, and {entry.object} is tissue")
        about: TissueFile = item.object.soft
        present = tuple(tuple(map(tuple, plane)) for plane in about.present.tolist())
        return cls(about.size, present, about.young, about.poisson, about.density, about.damping, about.fixed,
                   tuple((about.springs or {}).items()), item.object.surface, tuple(item.position.tolist()),
                   tuple(map(tuple, item.rotation.tolist())), about.tears, about.colour)  # fmt: skip

    @cached_property
    def grid(self) -> BrickGrid:
        """The mesh."""
        return BrickGrid(self.size, np.array(self.present), self.density)

    @cached_property
    def rest(self) -> np.ndarray:
        """Positions of the nodes at rest, m, [n, 3]."""
        found: np.ndarray = (np.array(self.position) + self.grid.rest @ np.array(self.rotation).T).astype(np.float32)
        return found

    @cached_property
    def solver(self) -> BrickSolver:
        """The implicit step."""
        grid = self.grid
        fixed, stiffness = np.zeros(grid.nodes, bool), np.zeros(grid.nodes)
        for name in self.fixed:
            fixed |= grid.side(name)
        for name, per_area in self.springs:
            stiffness += per_area * grid.areas(name)
        support = Support(fixed, stiffness.astype(np.float32), self.rest)
        return BrickSolver(grid, Brick(grid.cell, self.young, self.poisson), support, self.damping, ITERATIONS)

    @cached_property
    def points(self) -> SurfacePoints:
        """The points that others touch."""
        return self.grid.surface()

    @property
    def bars(self) -> Bars:
        """A capsule for each edge along x, in the middle of the thickness: side by side they look like a sheet."""
        grid, (_, rows, levels) = self.grid, self.grid.counts
        i, j = np.argwhere(grid.present.any(2)).T
        lowest = np.unique([(i * rows + j) * levels, (i * rows + j + 1) * levels])
        ends = lowest[:, None, None] + np.array([[0], [rows * levels]]) + np.array([0, levels - 1])
        return Bars("nodes.position", self.rest, ends, min(self.size[2], float(grid.cell[1])) / 2, self.colour)

    @property
    def contacts(self) -> int:
        return ROOM

    def start(self, places: Array) -> TissueState:
        """Return the tissue at rest, without weight."""
        del places
        rest = jnp.asarray(self.rest)
        return TissueState(
            Nodes(rest, jnp.zeros_like(rest)), none(ROOM), jnp.float32(0.0), jnp.zeros(3), jnp.bool_(False)
        )

    def shapes(self, state: TissueState) -> Shapes:
        """Return a ball at each surface point, under the surface."""
        position, velocity = state.nodes

        def ball(row: Any) -> tuple[Array, Array]:
            nodes, weights, inward = row
            skin, under = weights @ position[nodes], weights @ position[nodes + inward]
            moves = weights @ velocity[nodes]
            return (1 - SKIN) * skin + SKIN * under, jnp.sqrt(moves @ moves)

        centre, speed = jax.lax.map(ball, jax.tree.map(jnp.asarray, self.points))
        radius = np.full(len(self.points.nodes), SKIN * self.grid.cell[2], np.float32)
        return Shapes(centre, centre, radius, speed)

    def free_motion(self, state: TissueState, dt: Any) -> Linear:
        """Return the step's linear equations without contacts."""
        return self.solver.linearise(state.nodes, dt)

    def respond(self, state: TissueState, motion: Linear, ends: Ends, dt: Any) -> Response:
        ends = recall(state.stretches, ends, len(self.points.nodes))

        def improve(_: Any, found: tuple[Array, Array]) -> tuple[Array, Array]:
            felt = self._springs(ends, found[0])
            u = self.solver.displacements(motion, felt, found[0], dt)
            return u, self._forces(ends, felt, u)

        u, force = jax.lax.fori_loop(0, ROUNDS, improve, (motion.guess, jnp.zeros((ROOM, 3))))
        falls = each(ends, lambda row, end: self._eased(end, u, motion.block), moving=True)
        return Response(-force, Solved(u, motion.block, ends, force, falls))

    def yielding(self, response: Response, ends: Ends, accelerations: Array, dt: Any) -> Array:
        return pushes(response.solved.ends, response.solved.falls, accelerations, dt)

    def apply(self, state: TissueState, response: Response, ends: Ends, accelerations: Array, dt: Any) -> TissueState:
        own, parts = response.solved, len(self.points.nodes)
        u = jax.lax.cond(
            own.ends.moving > 0,
            lambda: self._carried(own, pushes(own.ends, own.falls, accelerations, dt)),
            lambda: own.shift,
        )
        u = self.solver.shortened(state.nodes, u)
        stretches = remember(
            own.ends, lambda row, end: self._point(end, u) - end.shift - dt * dt * accelerations[row], parts
        )
        nodes = self.solver.moved(state.nodes, u, dt)
        torn = state.torn if self.tears is None else state.torn | self.solver.stretched(nodes.position, self.tears)
        return TissueState(nodes, stretches, *hardest(own.ends, own.force), torn)

    def view(self, state: TissueState) -> TissueView:
        return TissueView(*state.nodes, state.force, state.place, state.torn)

    def _nodes(self, end: End) -> tuple[Array, Array]:
        """Return the nodes [4] of the point of a contact, and their shares [4]."""
        return jnp.asarray(self.points.nodes)[end.part], jnp.asarray(self.points.weights)[end.part]

    def _point(self, end: End, u: Array) -> Array:
        """Return the displacement [3] of the point of a contact by those of the nodes, [n, 3]."""
        nodes, weights = self._nodes(end)
        return weights @ u[nodes]

    def _springs(self, ends: Ends, u: Array) -> Springs:
        """Return the forces of contacts, linearised at displacements u, m, [n, 3]."""

        def spring(row: Array, end: End) -> tuple[Array, Array, Array, Array]:
            del row
            moved = self._point(end, u)
            felt = feel(end, moved - end.shift)
            return *self._nodes(end), felt.force + felt.stiffness @ moved, felt.stiffness[LOWER]

        nodes, weights, force, stiffness = each(ends, spring)
        return Springs(nodes, weights, force, stiffness, ends.total)

    def _forces(self, ends: Ends, springs: Springs, u: Array) -> Array:
        """Return the forces of linearised contacts on the tissue, N, [c, 3]."""
        found: Array = each(
            ends, lambda row, end: springs.force[row] - springs.stiffness[row][FULL] @ self._point(end, u)
        )
        return found

    def _eased(self, end: End, u: Array, block: Array) -> Array:
        """Return by how much the force of a contact falls as its end moves, N/m, lower half, [6].

        The contact's spring is in series with the tissue at its point, whose stiffness is that of the nodes' own
        blocks: the nodes around these stay.
        """
        nodes, weights = self._nodes(end)
        stiffness = feel(end, self._point(end, u) - end.shift).stiffness
        normal = end.normal @ stiffness @ end.normal
        along = (jnp.trace(stiffness) - normal) / 2
        own = (block[nodes, 0] + block[nodes, 2] + block[nodes, 5]) / 3
        gives = jnp.sum(weights * weights * jnp.asarray(self.solver.free)[nodes] / own)
        normal, along = (k / (1 + k * gives) for k in (normal, along))
        found: Array = along * jnp.eye(3) + (normal - along) * jnp.outer(end.normal, end.normal)
        return found[LOWER]

    def _carried(self, solved: Solved, pushed: Array) -> Array:
        """Return the displacements of the nodes with additional forces at contacts, m, [n, 3]."""
        free = jnp.asarray(self.solver.free)

        def add(row: Array, u: Array) -> Array:
            nodes, weights = self._nodes(row_of(solved.ends.rows, row))
            own = (solved.block[nodes, 0] + solved.block[nodes, 2] + solved.block[nodes, 5]) / 3
            for node, share in zip(nodes, weights * free[nodes] / own, strict=True):
                u = u.at[node].add(share * pushed[row], mode="promise_in_bounds")
            return u

        found: Array = jax.lax.fori_loop(0, solved.ends.moving, add, solved.shift)
        return found


def hardest(ends: Ends, forces: Array) -> tuple[Array, Array]:
    """Return the largest force of one shape, N, [], by those of contacts [c, 3], and where that is, m, [3].

    Contacts with one shape are a run in the list.
    """

    def add(row: Array, found: tuple[Array, ...]) -> tuple[Array, ...]:
        largest, where, shape, total = found
        end = row_of(ends.rows, row)
        total = forces[row] + jnp.where(end.shape == shape, total, 0.0)
        size = jnp.sqrt(total @ total)
        return jnp.maximum(largest, size), jnp.where(size > largest, end.place, where), end.shape, total

    start = jnp.float32(0.0), jnp.zeros(3), jnp.int32(-1), jnp.zeros(3)
    largest, where, _, _ = jax.lax.fori_loop(0, ends.total, add, start)
    return largest, where
