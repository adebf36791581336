"""A system beside arms and rigid bodies: something that moves by its own equations and meets these in contacts.

A package declares its systems in the entry-point group `surgical_marl.systems`, a program registers them
(`surgical_marl.register_system`), and a scene file names them:

    systems:
      beads: {type: bead_string, position: [0.0, 0.0, 0.05]}

docs/your_own_system.md walks through one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.scenes.objects import Surface


class Clusters(NamedTuple):
    """Balls around parts that follow each other, g of them: most of many parts are left out with their ball. World."""

    centre: Array
    """m, [g, 3]"""
    radius: Array
    """m, [g]"""
    first: np.ndarray
    """Number of the first part of each, and that of all parts, [g + 1]."""
    fastest: Array
    """Largest speed of any part, m/s, []."""
    part: Callable[[Array], tuple[Array, Array]]
    """Takes the number of a part, a sphere; returns its centre, m, [3], and speed, m/s: only of parts that are near."""
    nodes: Any = None
    """`NodeBalls` that make all of the above, by which a GPU finds contacts in a stage; None where it does not."""


class Shapes(NamedTuple):
    """The collision shapes of a system: p capsules, its parts. A sphere's two ends are one point. World."""

    start: Array
    """m, [p, 3]"""
    end: Array
    """m, [p, 3]"""
    radius: Any
    """m, [p]"""
    speed: Array
    """Largest speed of any point of it, m/s, [p]."""
    clusters: Clusters | None = None
    """Of many spheres. Then nothing else that is computed here is read."""
    side: Array | None = None
    """Direction from the skin that each part was near in the last step, [p, 3]; 0 for none."""


class Tie(NamedTuple):
    """A point of a system that is fastened to a free body or to the world."""

    part: int
    """Number of the part."""
    share: float
    """Where on it the point is: 0 at its start, 1 at its end."""
    body: str | None
    """Name of the body; None for the world."""
    place: tuple[float, float, float]
    """The place that it is fastened to: in the body's frame, from its origin, or in the world, m."""


class Spot(NamedTuple):
    """A point of a system's skin, or in its material: a mean of q of its nodes, [...]."""

    nodes: Any
    """Their numbers, [..., q]."""
    weights: Any
    """Their shares, [..., q]; they sum to 1."""


class End(NamedTuple):
    """A contact of a part of a system with a shape of an arm, a body, a fixed thing or another system, [...]. World."""

    part: Array
    """Number of the part."""
    share: Array
    """Where on it the contact is: 0 at its start, 1 at its end."""
    shape: Array
    """Number of the shape; below 0 for another system's skin: -1 for the first one."""
    depth: Array
    """Overlap, m; negative for a distance."""
    place: Array
    """Midway between the two surfaces, m, [..., 3]."""
    normal: Array
    """Unit vector from the shape to the part, [..., 3]."""
    stiffness: Array
    """Of the contact, along the normal and along the surface, N/m."""
    sliding: Array
    """Coefficient of friction."""
    bilateral: Array
    """True of a tie, which pulls too and does not slip; with a skin: of a thread that is held inside of the system."""
    shift: Array
    """Displacement of the shape in the step if it accelerates as in the last one, m, [..., 3]."""
    stretch: Array
    """Of the spring along the surface at the start of the step, m, [..., 3]; 0 if nothing is remembered."""
    on: Spot | None = None
    """Where it is on the skin of another system; None in a scene where this system meets no skin."""


class Ends(NamedTuple):
    """All contacts of a system: a list of fixed size. Those with what moves come first."""

    rows: End
    """[c, ...]"""
    moving: Array
    """Number of contacts with other systems, arms and free bodies, []. Those with other systems come first."""
    total: Array
    """Number of all contacts, []. Rows from there on may hold anything."""
    left_out: Array
    """Number of contacts that found no room, []."""


class Strand(NamedTuple):
    """A thread of p parts of one length, from the end on that is tied to the tail of a needle. World."""

    position: Array
    """Of its nodes, m, [p + 1, 3]."""
    holds: Any
    """1 for parts that hold, 0 for torn ones, [p]."""
    part: float
    """Length of a part at rest, m."""
    backwards: bool
    """True if its system numbers the parts from the other end."""

    @property
    def length(self) -> float:
        """At rest, m."""
        return self.part * len(self.holds)

    def at(self, along: Array) -> tuple[Array, Array]:
        """Return the part, counted from the needle, and the share of it at a length from the needle, m."""
        part = jnp.clip(jnp.floor(along / self.part).astype(jnp.int32), 0, len(self.holds) - 1)
        return part, along / self.part - part

    def point(self, along: Array) -> tuple[Array, Array]:
        """Return the point [3] at a length from the needle, m, and the unit tangent [3] there, towards the needle.

        Beyond its ends the thread goes on straight. Tangents turn evenly along a part, from node to node.
        """
        part, share = self.at(along)
        place = (1 - share) * self.position[part] + share * self.position[part + 1]
        share = jnp.clip(share, 0.0, 1.0)
        way = (1 - share) * self._tangent(part) + share * self._tangent(part + 1)
        return place, way / jnp.sqrt(jnp.maximum(way @ way, 1e-12))

    def _tangent(self, node: Array) -> Array:
        last = len(self.holds)
        way = self.position[jnp.maximum(node - 1, 0)] - self.position[jnp.minimum(node + 1, last)]
        return way / jnp.sqrt(jnp.maximum(way @ way, 1e-18))


class Followed(NamedTuple):
    """The free bodies that a system follows, n of them. World."""

    origin: Array
    """Of their frames, m, [n, 3]."""
    axes: Array
    """Of their frames, [n, 3, 3]."""
    size: Any
    """Factors of all their lengths, [n]."""
    centre: Array
    """Of mass, m, [n, 3]."""
    velocity: Array
    """Of the centres, m/s, and angular, rad/s, at the end of the step if they accelerate as in the last one, [n, 6]."""
    shape: Any
    """Number of the first shape of each, [n]."""
    shapes: Any
    """Number of shapes of each, [n]."""
    strands: tuple[Strand | None, ...] = ()
    """The thread at the tail of each; nothing where none has any."""


class Response(NamedTuple):
    """The answer of a system to its contacts."""

    force: Array
    """On the ends if they move by `shift`, N, [c, 3]."""
    solved: Any
    """Whatever `yielding` and `apply` need."""
    left_out: Any = 0
    """Number of contacts with itself that found no room, []."""
    falls: Array | None = None
    """By how much the force on each end falls as that end moves, N/m: lower halves, [c, 6]. None if the motion of one
    end changes the forces on others, as `yielding` says then."""


class Skin(NamedTuple):
    """The nodes of a system whose skin others touch, n of them. World."""

    position: Array
    """m, [n, 3]"""
    velocity: Array
    """m/s, [n, 3]"""


class Springs(NamedTuple):
    """Linear springs at c points of a system with a skin, of which the first `used` are there."""

    nodes: Array
    """On which each point hangs, [c, q]."""
    weights: Array
    """Shares of these nodes, [c, q]."""
    force: Array
    """On the point without displacement, N, [c, 3]."""
    stiffness: Array
    """By how much it falls as the point moves, N/m, lower half, [c, 6]; symmetric, positive semidefinite."""
    used: Array
    """[]"""


class Bars(NamedTuple):
    """Capsules by which pictures show a system: b of them, between means of q nodes each."""

    state: str
    """Name of the part of the state with the positions of its nodes, as in "chain.position"."""
    start: np.ndarray
    """Where the nodes are at the start, m, [n, 3]."""
    ends: np.ndarray
    """Numbers of the nodes at both ends, [b, 2, q]."""
    radius: float
    """m"""
    colour: tuple[float, float, float]
    """Red, green and blue, from 0 to 1."""


class System(ABC):
    """One system of a scene. Its state is a tree of arrays; all methods are pure JAX functions of one environment.

    A physics step calls `shapes`, finds the ends of contacts, asks `respond` for the forces on them, loads arms and
    rigid bodies with these and with how they yield, solves them, and calls `apply` with the accelerations of the ends.
    """

    surface: Surface
    """Friction and stiffness of its parts."""
    ties: tuple[Tie, ...] = ()
    """Where it is fastened."""
    reports: ClassVar[tuple[str, ...]] = ()
    """Fields of its view that are infos of every agent: numbers, of which the largest in a scene counts."""
    follows: tuple[str, ...] = ()
    """Names of free bodies that its contacts depend on beyond their shapes: needles that go through it."""

    @property
    def bars(self) -> Bars | None:
        """Return capsules that pictures show; None for nothing."""
        return None

    @property
    @abstractmethod
    def contacts(self) -> int:
        """Room for contacts, ties included."""

    @abstractmethod
    def start(self, places: Array) -> Any:
        """Return the state at the beginning of an episode, with its ties fastened at these places, m, [t, 3]."""

    def laid(self, state: Any, places: Array) -> Any:
        """Return the state at the beginning of an episode with its nodes at these places, m, [n, 3].

        ValueError where it can't begin elsewhere than the scene says.
        """
        raise ValueError(f"only loose threads can be laid elsewhere than the scene says, not a {type(self).__name__}")

    @abstractmethod
    def shapes(self, state: Any) -> Shapes:
        """Return the capsules that others can touch."""

    def follow(self, state: Any, ends: Ends, bodies: Followed, dt: Any) -> tuple[Any, Ends]:
        """Return state and contacts as the bodies are now that it `follows`."""
        del bodies, dt
        return state, ends

    @abstractmethod
    def free_motion(self, state: Any, dt: Any) -> Any:
        """Return the forces on the system without contacts, in any form that `respond` takes."""

    @abstractmethod
    def respond(self, state: Any, motion: Any, ends: Ends, dt: Any) -> Response:
        """Return the forces on the ends of contacts, with the system's own unknowns eliminated (Schur complement)."""

    @abstractmethod
    def yielding(self, response: Response, ends: Ends, accelerations: Array, dt: Any) -> Array:
        """Return by how much the forces on the ends fall as the ends accelerate, N, [c, 3].

        It is linear in the accelerations beyond those of `shift`, m/s2, [c, 3], symmetric and positive semidefinite.
        """

    @abstractmethod
    def apply(self, state: Any, response: Response, ends: Ends, accelerations: Array, dt: Any) -> Any:
        """Return the state after a step in which the ends accelerate by so much beyond `shift`, m/s2, [c, 3]."""

    def strand(self, state: Any, body: str) -> Strand | None:
        """Return the thread that it has at the tail of a free body; None if it has none."""
        del state, body
        return None

    def awake(self, state: Any) -> Any:
        """Return whether it moves, [] bool; True if it never sleeps.

        A system that sleeps keeps its state, and touches nothing, until what moves comes near it.
        """
        del state
        return True

    def view(self, state: Any) -> Any:
        """Return the part of the state that tasks see: all of it by default."""
        return state

    def randomise(self, key: Array) -> System:
        """Return the system with values drawn by a key: itself by default."""
        del key
        return self


class SkinnedSystem(System):
    """A system whose skin others touch: faces of four nodes each.

    Its own parts touch arms, bodies and fixed things. Systems that have no skin touch it, in the same step: they
    respond first, and load it with their forces and with how these fall as it moves.
    """

    @property
    @abstractmethod
    def faces(self) -> np.ndarray:
        """Return the nodes around each face, counterclockwise as seen from outside, [f, 4]."""

    @abstractmethod
    def skin(self, state: Any) -> Skin:
        """Return the nodes."""

    def inside(self, state: Any, bodies: Followed, n: int) -> Array:
        """Return which parts of the thread behind a body that it follows do not touch its skin, [p] bool.

        They are in it, or at the place where the thread goes in or out.
        """
        strand = bodies.strands[n]
        assert strand
        return jnp.zeros(len(strand.holds), bool)

    def held(self, state: Any, bodies: Followed, n: int, ends: Ends, number: int) -> Ends:
        """Return the contacts of the thread behind a body with those inside of this system, the last of its skins.

        Args:
            state: of this system.
            bodies: that it follows.
            n: number of the body.
            ends: other contacts of the thread with skins, in arrays with one row more than there is room for.
            number: of this skin.
        """
        del state, bodies, n, number
        return ends

    @abstractmethod
    def respond(self, state: Any, motion: Any, ends: Ends, dt: Any, loads: Sequence[Springs] = ()) -> Response:
        """Return the forces on the ends of its own contacts, as it bears the loads of others: of each that touches it.

        Args:
            state: of the system.
            motion: its `free_motion`.
            ends: of its own contacts.
            dt: duration of a step, s.
            loads: forces at the other systems' contacts with the skin.
        """

    @abstractmethod
    def displacements(self, response: Response) -> Array:
        """Return the displacements of the nodes in the step if the ends move by `shift`, m, [n, 3]."""
