"""Suture thread: a chain that arms, objects and boards touch, and that they hold by friction alone.

thread = scene.systems["thread"]                 # of an object with `kind: thread`
physics.systems["thread"].chain.position         # m, [n, 3]
world.systems["thread"].tension                  # N, [n - 1]
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

from surgical_marl.content import unknown
from surgical_marl.physics.contact.skin_detection import sides
from surgical_marl.physics.contact.spring_contact import Felt, Stretches, each, feel, none, pushes, recall, remember
from surgical_marl.physics.solver.cholesky import FULL, LOWER
from surgical_marl.physics.systems import crossings
from surgical_marl.physics.systems.chain import (
    ENOUGH,
    ChainState,
    Factors,
    Loaded,
    Newton,
    Rod,
    free_forces,
    moved,
    search,
    solve,
)
from surgical_marl.physics.systems.channel_state import hold
from surgical_marl.physics.systems.crossings import Joined
from surgical_marl.physics.systems.soft import Soft
from surgical_marl.physics.systems.system import Bars, End, Ends, Response, Shapes, Strand, Tie
from surgical_marl.physics.tree_utils import row_of
from surgical_marl.scenes.objects import Placement, Surface
from surgical_marl.scenes.thread_file import ThreadFile
from surgical_marl.untrusted.schema import Place

ITERATIONS = 20
"""Newton steps of a physics step at most. One to three are enough but where stiff thread slides over what is not flat:
it takes up to 20 to find which edges bear it, and friction of edges that do not would stop it at once."""
SPARE, SEWN = 24, 32
"""Room for contacts beyond one for each edge: a thread may lie on a board, and be held by jaws too, and one behind a
needle may be in tissue, which holds an edge at several places."""
TAIL = "tail"
"""The site of a needle that a thread is fastened to."""


class ThreadState(NamedTuple):
    """The state of a thread."""

    chain: ChainState
    stretches: Stretches
    rubbed: Stretches
    """Friction of the thread with itself."""
    holds: Array
    """1 for edges that hold, 0 for a broken one and after the last node, [n]."""
    still: Array
    """True if nothing that moves touches it, and no node moved further than `ENOUGH` in this step and the last, []."""
    side: Array
    """Direction from the tissue that each edge is near, [n - 1, 3]; 0 for none."""


class ThreadView(NamedTuple):
    """A thread of n nodes as tasks see it. World."""

    position: Array
    """m, [n, 3]"""
    velocity: Array
    """m/s, [n, 3]"""
    tension: Array
    """Of the edges between nodes, N, [n - 1]; negative where a stiff one is compressed."""
    broken: Array
    """True once an edge has been torn, [] bool."""


class Solved(NamedTuple):
    """A step of a thread whose ends move as expected."""

    newton: Newton
    ends: Ends
    """With the stretches that are remembered."""
    pairs: Ends
    """Where it touches itself."""
    falls: Array
    """Of the force of each contact with what moves as its point moves, N/m: lower halves, [c, 6]."""
    holds: Any
    """As in `ThreadState`."""


@dataclass(frozen=True)
class Thread(Soft):
    """A thread."""

    nodes: int
    length: float
    """m"""
    diameter: float
    """m"""
    young: float
    """Young's modulus, Pa."""
    density: float
    """kg/m3"""
    surface: Surface
    path: tuple[tuple[float, float, float], ...]
    """Where the nodes are at the start, m, [n, 3]."""
    ties: tuple[Tie, ...] = ()
    drag: float = 2.0
    """Force of the air per mass and speed, 1/s."""
    strength: float | None = None
    """Tension at which it tears, N; None if it never does."""
    crossings: int = 4
    """Room for contacts with itself."""
    colour: tuple[float, float, float] = (0.25, 0.2, 0.55)
    """In pictures."""
    file: ClassVar[type] = ThreadFile
    """The content of its file."""
    reports: ClassVar[tuple[str, ...]] = ("tension",)

    @classmethod
    def placed(cls, item: Placement, entry: Any, others: Mapping[str, Placement], place: Place) -> Thread:
        """Return a thread that lies in a scene.

        Args:
            item: its file and where its first node is.
            entry: of the scene file (`PlacementEntry`).
            others: rigid objects of the scene by name.
            place: of the entry in the file.

        Raises:
            ValueError: an end is tied to what is not there or has no tail.
        """
        about: ThreadFile = item.object.soft
        young, density = about.elasticity
        path = item.position + about.path() @ item.rotation.T
        last = about.nodes - 2
        wanted = (0, 0.0, getattr(entry.tied, "first", None)), (last, 1.0, getattr(entry.tied, "last", None))
        ties = tuple(
            _tie(part, share, name, path[round(part + share)], others, place) for part, share, name in wanted if name
        )
        nodes, colour = tuple(map(tuple, path.tolist())), entry.colour or about.colour
        return cls(
            about.nodes, about.length, about.diameter, young, density, item.object.surface, nodes, ties, about.drag,
            about.strength, colour=colour,
        )  # fmt: skip

    @cached_property
    def rod(self) -> Rod:
        """Material and size of the chain."""
        area, inertia = np.pi * self.diameter**2 / 4, np.pi * self.diameter**4 / 64
        young = self.factors.stiffness * self.young
        return Rod(self.nodes, self.length / (self.nodes - 1), self.density * area, young * area, young * inertia,
                   self.drag)  # fmt: skip

    @property
    def bars(self) -> Bars:
        """A capsule for each edge."""
        edges = np.arange(self.nodes - 1)[:, None, None] + np.array([[0], [1]])
        return Bars("chain.position", np.array(self.path), edges, self.diameter / 2, self.colour)

    @property
    def contacts(self) -> int:
        sewn = SEWN if any(tie.body for tie in self.ties) else 0
        return self.nodes - 1 + SPARE + sewn + len(self.ties)

    def start(self, places: Array) -> ThreadState:
        """Return the thread at rest. It begins where its first tie is."""
        position = jnp.asarray(self.path, jnp.float32)
        if self.ties:
            tie = self.ties[0]
            position += places[0] - position[tie.part + round(tie.share)]
        still = jnp.zeros((self.nodes, 3), jnp.float32)
        holds = jnp.asarray(np.append(np.ones(self.nodes - 1), 0.0), jnp.float32)
        chain = ChainState(position, still, still[:, 0])
        return ThreadState(
            chain, none(self.contacts), none(self.crossings), holds, jnp.bool_(False), jnp.zeros((self.nodes - 1, 3))
        )  # fmt: skip

    def laid(self, state: ThreadState, places: Array) -> ThreadState:
        """Return the thread with its nodes elsewhere, as far apart as edges are long; ValueError if it is tied."""
        if self.ties:
            raise ValueError("only loose threads can be laid elsewhere than the scene says, not one that is tied")
        return state._replace(chain=state.chain._replace(position=places))

    def shapes(self, state: ThreadState) -> Shapes:
        position = state.chain.position
        speed = jnp.sqrt(jnp.sum(state.chain.velocity * state.chain.velocity, -1))
        radius = np.full(self.nodes - 1, self.diameter / 2, np.float32)
        return Shapes(position[:-1], position[1:], radius, jnp.maximum(speed[:-1], speed[1:]), side=state.side)

    def free_motion(self, state: ThreadState, dt: Any) -> Array:
        """Return inertia and weight of the nodes, N, [n, 3]."""
        return free_forces(self.rod, state.chain, dt)

    def respond(self, state: ThreadState, motion: Array, ends: Ends, dt: Any) -> Response:
        ends, holds = recall(state.stretches, self.rubbed(ends), self.nodes - 1), self._holds(state)
        itself = self.surface.against(self.surface)
        pairs = crossings.find(
            self.shapes(state),
            state.chain.velocity,
            self.crossings,
            itself.stiffness,
            self.factors.friction * itself.sliding,
            dt,
        )
        pairs = recall(state.rubbed, pairs, self.nodes - 1)

        def load(u: Array, before: Array) -> Loaded:
            felt = _load(ends, u, before)
            return felt._replace(force=crossings.add_forces(pairs, u, felt.force))

        def join(
            u: Array, change: Array, most: Array, factors: Factors, last: Joined
        ) -> tuple[Array, Array, Joined]:  # fmt: skip
            own = crossings.joined(pairs, u, lambda force: solve(self.rod, factors, force, holds), last)
            whole = crossings.add(pairs, u, own, change)
            largest = jax.lax.cond(pairs.total > 0, lambda: jnp.max(jnp.abs(whole[:, :3])), lambda: most)
            return whole, largest, own

        apart = crossings.apart_from_itself(self.crossings, self.nodes)
        found = search(self.rod, state.chain, motion, load, dt, ITERATIONS, holds, join, apart)

        def at_end(row: Array, end: End) -> tuple[Array, Array]:
            del row
            felt = _feel(end, *(_point(end, u) - end.shift for u in (found.shift, found.before)))
            force = felt.force - felt.stiffness @ _point(end, found.change[:, :3])
            return -force, felt.stiffness[LOWER]

        force, falls = each(ends, at_end, moving=True)
        return Response(force, Solved(found, ends, pairs, falls, holds), pairs.left_out)

    def yielding(self, response: Response, ends: Ends, accelerations: Array, dt: Any) -> Array:
        pushed, change = self._carried(response.solved, accelerations, dt)

        def eased(row: Array, end: End) -> Array:
            return pushed[row] - response.solved.falls[row][FULL] @ _point(end, change[:, :3])

        found: Array = each(ends, eased, moving=True)
        return found

    def apply(self, state: ThreadState, response: Response, ends: Ends, accelerations: Array, dt: Any) -> ThreadState:
        found, own = response.solved.newton, response.solved.ends
        carried = jax.lax.cond(
            ends.moving > 0,
            lambda: self._carried(response.solved, accelerations, dt)[1],
            lambda: jnp.zeros((self.nodes, 4)),
        )
        chain, u, most = moved(state.chain, found, carried, dt)
        stretches = remember(
            own,
            lambda row, end: _point(end, u) - end.shift - dt * dt * accelerations[row],
            self.nodes - 1,
        )
        holds = state.holds
        if self.strength is not None:
            holds = jnp.where(chain.tension > self.strength, 0.0, holds)
        pairs = response.solved.pairs
        rubbed = remember(pairs, lambda row, end: crossings.apart(end, u), self.nodes - 1)
        side = state.side if ends.rows.on is None else sides(own, self.nodes - 1)
        return ThreadState(chain, stretches, rubbed, holds, (ends.moving == 0) & (most < ENOUGH), side)

    def strand(self, state: ThreadState, body: str) -> Strand | None:
        for tie in self.ties:
            if tie.body == body:
                backwards, holds = tie.part > 0, self._holds(state)[:-1]
                order = slice(None, None, -1) if backwards else slice(None)
                return Strand(state.chain.position[order], holds[order], self.rod.length, backwards)
        return None

    def awake(self, state: ThreadState) -> Array:
        return ~state.still

    def view(self, state: ThreadState) -> ThreadView:
        chain = state.chain
        broken = jnp.sum(state.holds) < self.nodes - 1.5
        return ThreadView(chain.position, chain.velocity, chain.tension[:-1], broken)

    def _carried(self, solved: Solved, accelerations: Array, dt: Any) -> tuple[Array, Array]:
        """Return what the ends add to the step by accelerating: pushes, N, [c, 3], and changes of unknowns, [n, 4]."""
        ends, n = solved.ends, self.nodes
        pushed = pushes(ends, solved.falls, accelerations, dt)

        def add(row: Array, sums: Array) -> Array:
            end = row_of(ends.rows, row)
            return _spread(sums, end.part, (1 - end.share) * pushed[row], end.share * pushed[row])

        forces = jax.lax.fori_loop(0, ends.moving, add, jnp.zeros((n, 3)))
        newton, pairs = solved.newton, solved.pairs
        change = solve(self.rod, newton.factors, forces, solved.holds)
        return pushed, crossings.add(pairs, newton.shift, newton.joined, change)

    def _holds(self, state: ThreadState) -> Any:
        """Return which edges hold, [n]: constants if the thread can't tear."""
        return state.holds if self.strength is not None else np.append(np.ones(self.nodes - 1), 0.0).astype(np.float32)


def _tie(
    part: int, share: float, name: str, node: np.ndarray, others: Mapping[str, Placement], place: Place
) -> Tie:  # fmt: skip
    """Return the tie of a node to the tail of an object of this name, or to where it is in the world."""
    if name == "world":
        return Tie(part, share, None, tuple(node.tolist()))
    good = [other for other, item in others.items() if item.object.free and TAIL in item.object.sites]
    if name not in good:
        raise ValueError(f"{place}.tied: {unknown('object with a tail', name, ['world', *good])}")
    return Tie(part, share, name, tuple(others[name].object.sites[TAIL][0].tolist()))


def _feel(end: End, moved: Array, before: Array) -> Felt:
    """Return the force of a contact with a shape, or with a place inside of tissue, whose point moves by this much."""
    felt = feel(end, moved, before)
    if end.on is None:
        return felt
    held = end.bilateral & (end.shape < 0)
    found: Felt = jax.tree.map(lambda a, b: jnp.where(held, a, b), hold(end, moved), felt)
    return found


def _point(end: End, u: Array) -> Array:
    """Return the displacement [3] of the point of a contact by those of the nodes, [n, 3]."""
    return (1 - end.share) * u[end.part] + end.share * u[end.part + 1]


def _spread(rows: Array, part: Array, first: Array, second: Array) -> Array:
    """Return rows [n, ...] with more at both nodes of an edge."""
    rows = rows.at[part].add(first, mode="promise_in_bounds")
    return rows.at[part + 1].add(second, mode="promise_in_bounds")


def _load(ends: Ends, u: Array, before: Array) -> Loaded:
    """Return the forces of contacts on the nodes at displacements u, and before the last Newton step, m, [n, 3]."""

    def add(row: Array, sums: Loaded) -> Loaded:
        end = row_of(ends.rows, row)
        felt = _feel(end, _point(end, u) - end.shift, _point(end, before) - end.shift)
        first, second, falls = 1 - end.share, end.share, felt.stiffness[LOWER]
        return Loaded(
            _spread(sums.force, end.part, first * felt.force, second * felt.force),
            _spread(sums.own, end.part, first * first * falls, second * second * falls),
            sums.across.at[end.part].add(first * second * falls, mode="promise_in_bounds"),
        )

    n = len(u)
    start = Loaded(jnp.zeros((n, 3)), jnp.zeros((n, 6)), jnp.zeros((n, 6)))
    found: Loaded = jax.lax.fori_loop(0, ends.total, add, start)
    return found
