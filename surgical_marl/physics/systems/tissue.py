"""Soft tissue: a sheet or a block of bricks that arms and objects press, pinch and lift by friction.

tissue = scene.systems["tissue"]                 # of an object with `kind: tissue`
physics.systems["tissue"].nodes.position         # m, [n, 3]
world.systems["tissue"].tissue_force             # N, of the hardest touch
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.node_balls import NodeBalls
from surgical_marl.physics.contact.spring_contact import Stretches, each, none, pushes, recall, remember
from surgical_marl.physics.systems.brick import Brick
from surgical_marl.physics.systems.brick_grid import BrickGrid, SurfacePoints
from surgical_marl.physics.systems.brick_solve import BrickSolver, Nodes, Support
from surgical_marl.physics.systems.channel import Channels
from surgical_marl.physics.systems.channel_state import ChannelState, ChannelView
from surgical_marl.physics.systems.channel_thread import Sewn
from surgical_marl.physics.systems.needle import Needle
from surgical_marl.physics.systems.soft import Soft
from surgical_marl.physics.systems.system import (
    Bars,
    End,
    Ends,
    Followed,
    Response,
    Shapes,
    Skin,
    SkinnedSystem,
    Springs,
)
from surgical_marl.physics.systems.tissue_step import Answer, Held, TissueStep
from surgical_marl.physics.tree_utils import row_of
from surgical_marl.scenes.channel_file import ChannelFile
from surgical_marl.scenes.objects import Placement, Surface
from surgical_marl.scenes.tissue_file import TissueFile
from surgical_marl.untrusted.schema import Place

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
    channels: ChannelState | None = None
    """Where needles go through it; None if none can."""


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
    channels: ChannelView | None = None
    """Where needles go or went through it; None if none can."""
    tip_force: Any = 0.0
    """The largest normal force of a needle's tip on a face of it, N, []."""

    @property
    def bite_depth(self) -> Array:
        """Depth of the deepest channel below the upper face at rest, m, []."""
        return jnp.max(self.channels.depth) if self.channels else jnp.float32(0.0)

    @property
    def swept(self) -> Array:
        """Largest way of a needle across its centre line in a channel, m, []."""
        return jnp.max(self.channels.swept) if self.channels else jnp.float32(0.0)

    @property
    def channel_count(self) -> Array:
        """Number of channels, []."""
        return jnp.sum(self.channels.there) if self.channels else jnp.int32(0)


class Solved(NamedTuple):
    """A step of tissue whose contacts' ends move as expected."""

    answer: Answer
    held: Held
    """The points of contacts."""
    ends: Ends
    """With the stretches that are remembered."""


@dataclass(frozen=True)
class Tissue(Soft, SkinnedSystem):
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
    channel: ChannelFile | None = None
    """The forces on needles that go through it."""
    needles: tuple[Needle, ...] = ()
    """The needles that may."""
    file: ClassVar[type] = TissueFile
    """The content of its file."""

    @classmethod
    def placed(cls, item: Placement, entry: Any, others: Mapping[str, Placement], place: Place) -> Tissue:
        """Return tissue that is held in a scene, from its file and the place of its frame."""
        if entry.tied:
            raise ValueError(f"{place}.tied: only the ends of a thread are tied, and {entry.object} is tissue")
        about: TissueFile = item.object.soft
        present = tuple(tuple(map(tuple, plane)) for plane in about.present.tolist())
        needles = [Needle.of(name, other.object) for name, other in others.items()] if about.channels else []
        return cls(about.size, present, about.young, about.poisson, about.density, about.damping, about.fixed,
                   tuple((about.springs or {}).items()), item.object.surface, tuple(item.position.tolist()),
                   tuple(map(tuple, item.rotation.tolist())), about.tears, about.colour,
                   about.channels, tuple(filter(None, needles)))  # fmt: skip

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
        brick = Brick(grid.cell, self.young, self.poisson)
        return BrickSolver(grid, brick, support, self.damping, stiffer=self.factors.stiffness)

    @cached_property
    def points(self) -> SurfacePoints:
        """The points that others touch."""
        return self.grid.surface()

    @cached_property
    def faces(self) -> np.ndarray:
        """The outer faces of its bricks, which threads touch."""
        return self.grid.faces()

    @cached_property
    def channels(self) -> Channels | None:
        """Channels of needles; None if none can go through."""
        if not (self.channel and self.needles):
            return None
        return Channels(self.channel, self.needles, self.grid, len(self.points.nodes), self.surface.stiffness)

    @property
    def reports(self) -> tuple[str, ...]:  # type: ignore[override]
        of_channels = ("bite_depth", "swept", "channel_count", "tip_force")
        return ("tissue_force", *(of_channels if self.channels else ()))

    @property
    def follows(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(needle.body for needle in self.needles) if self.channels else ()

    @property
    def bars(self) -> Bars:
        """A capsule along x for each brick seen from above, in the middle of the thickness. They fill a sheet."""
        grid, (_, rows, levels) = self.grid, self.grid.counts
        i, j = np.argwhere(grid.present.any(2)).T
        side = (np.array([0, rows])[:, None, None] + np.array([0, 1])[:, None]) * levels + np.array([0, levels - 1])
        ends = ((i * rows + j) * levels)[:, None, None] + side.reshape(2, 4)
        return Bars("nodes.position", self.rest, ends, min(self.size[2], float(grid.cell[1])) / 2, self.colour)

    @property
    def contacts(self) -> int:
        return ROOM + (self.channels.rows if self.channels else 0)

    def start(self, places: Array) -> TissueState:
        """Return the tissue at rest, without weight."""
        del places
        rest = jnp.asarray(self.rest)
        return TissueState(
            Nodes(rest, jnp.zeros_like(rest)), none(self.contacts), jnp.float32(0.0), jnp.zeros(3), jnp.bool_(False),
            self.channels.start() if self.channels else None,
        )  # fmt: skip

    def follow(
        self, state: TissueState, ends: Ends, bodies: Followed, dt: Any
    ) -> tuple[TissueState, Ends]:  # fmt: skip
        assert self.channels and state.channels, "only tissue with channels follows needles"
        others = self.rubbed(ends)  # friction in channels is not that of surfaces
        channels, ends = self.channels.follow(state.channels, state.nodes.position, others, bodies, dt)
        return state._replace(channels=channels), ends

    def inside(self, state: TissueState, bodies: Followed, n: int) -> Array:
        return self._sewn(state, bodies, n).inside(self._channels_of(state))

    def held(self, state: TissueState, bodies: Followed, n: int, ends: Ends, number: int) -> Ends:
        return self._sewn(state, bodies, n).with_holds(self._channels_of(state), ends, number)

    def _sewn(self, state: TissueState, bodies: Followed, n: int) -> Sewn:
        strand = bodies.strands[n]
        assert self.channels and strand, "tissue without channels follows no needle"
        return self.channels.sewn(state.nodes.position, bodies, n, strand)

    def _channels_of(self, state: TissueState) -> ChannelState:
        assert state.channels, "tissue without channels follows no needle"
        return state.channels

    def shapes(self, state: TissueState) -> Shapes:
        """Return a ball at each surface point, under the surface."""
        return NodeBalls(*state.nodes, self.points, SKIN, SKIN * float(self.grid.cell[2])).shapes()

    def skin(self, state: TissueState) -> Skin:
        return Skin(*state.nodes)

    def free_motion(self, state: TissueState, dt: Any) -> tuple[()]:
        """Return nothing: one stage has all forces."""
        return ()

    def respond(self, state: TissueState, motion: Any, ends: Ends, dt: Any, loads: Sequence[Springs] = ()) -> Response:
        ends = ends if self.channels else self.rubbed(ends)
        ends, held = recall(state.stretches, ends, len(self.points.nodes)), self._held(state, ends)
        answer = self._step(dt).respond(state.nodes, held, ends, loads)
        return Response(-answer.force, Solved(answer, held, ends), falls=answer.falls)

    def displacements(self, response: Response) -> Array:
        found: Array = response.solved.answer.shift
        return found

    def yielding(self, response: Response, ends: Ends, accelerations: Array, dt: Any) -> Array:
        return pushes(response.solved.ends, response.solved.answer.falls, accelerations, dt)

    def apply(self, state: TissueState, response: Response, ends: Ends, accelerations: Array, dt: Any) -> TissueState:
        answer, held, ends = response.solved
        pushed = pushes(ends, answer.falls, accelerations, dt)
        after = self._step(dt).move(state.nodes, held, ends, answer, pushed)

        def went(row: Array, end: End) -> Array:
            return end.shift + dt * dt * accelerations[row]

        def moved(row: Array, end: End) -> Array:
            return after.points[row] - went(row, end)

        stretches, channels = remember(ends, moved, len(self.points.nodes)), state.channels
        if self.channels and channels:
            channels = self.channels.remember(channels, ends, moved, went)
        nodes, torn = Nodes(after.position, after.velocity), state.torn | after.torn
        return TissueState(nodes, stretches, *hardest(ends, answer.force), torn, channels)

    def view(self, state: TissueState) -> TissueView:
        seen = TissueView(*state.nodes, state.force, state.place, state.torn)
        if not (self.channels and state.channels):
            return seen
        channels = self.channels.view(state.channels, state.nodes.position)
        return seen._replace(channels=channels, tip_force=jnp.max(state.channels.tips.pressed))

    def _step(self, dt: Any) -> TissueStep:
        return TissueStep(self.solver, self.tears, dt, self.channels)

    def _held(self, state: TissueState, ends: Ends) -> Held:
        """Return the points of contacts."""
        nodes, weights = jnp.asarray(self.points.nodes), jnp.asarray(self.points.weights)

        def at(row: Array, end: End) -> Held:
            del row
            if not (self.channels and state.channels):
                return Held(nodes[end.part], weights[end.part])
            part = jnp.minimum(end.part, len(nodes) - 1)
            inner, outer = self.channels.spot(state.channels, end), Held(nodes[part], weights[part])
            return Held(*(jnp.where(self.channels.own(end), a, b) for a, b in zip(inner, outer, strict=True)))

        found: Held = each(ends, at)
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
