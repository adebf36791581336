"""A chain of nodes that stretches and bends, implicit in time: the mechanics of a suture thread.

A step solves, for the displacements u of n nodes and the tensions q of the edges between them,

    m (u - dt v) / dt^2 = weight + tension + bending + contacts        three equations a node
    |edge| - length     = q length / EA                                one equation an edge

by Newton's method. With the tension as an unknown, the stiffness EA / length is nowhere in the matrix, only its
inverse: a thread that bears 76 N at twice its length and nodes of 0.2 mg go together in float32.

A node and the edge after it are one block of unknowns. A block meets the next one by tension, and the next two by
bending, so one scan over the nodes eliminates them and a second one goes back. The matrix is quasi-definite (positive
for displacements, negative for tensions), so no pivoting is needed (R. J. Vanderbei, 1995).

Torsion is left out: a thread turns about itself freely.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.solver.cholesky import FULL, LOWER
from surgical_marl.physics.tree_utils import put

GRAVITY = np.array([0.0, 0.0, -9.81], np.float32)
ENOUGH = 1e-8
"""Displacement, m, below which a Newton step is the last one."""
FARTHEST = 1.0
"""Displacement of a Newton step at most, in lengths of an edge: beyond it the linear equations say nothing."""
KINKING = 100.0
"""Compliance of an edge under compression, relative to that under tension: a thread kinks where it is pushed along
itself, at loads that edges of this length can't show, as they are straight."""
_EYE = np.eye(3, dtype=np.float32)


class Rod(NamedTuple):
    """The material and the size of a chain."""

    nodes: int
    length: float
    """Of an edge, m."""
    density: float
    """Mass per length, kg/m."""
    axial: float
    """EA, N."""
    bending: float
    """EI, N m2."""
    drag: float = 0.0
    """Force of the air per mass and speed, 1/s."""

    @property
    def mass(self) -> np.ndarray:
        """Mass of each node, kg, [n]."""
        mass = np.full(self.nodes, self.density * self.length, np.float32)
        mass[[0, -1]] /= 2
        return mass


class ChainState(NamedTuple):
    """The motion of a chain of n nodes."""

    position: Array
    """m, [n, 3]"""
    velocity: Array
    """m/s, [n, 3]"""
    tension: Array
    """Of the edge after each node, N, [n]; 0 after the last one."""


class Loaded(NamedTuple):
    """Forces of contacts on the nodes, and how much they fall as nodes move."""

    force: Array
    """N, [n, 3]"""
    own: Array
    """Fall of the force on a node per displacement of the node, N/m: lower halves, [n, 6]."""
    across: Array
    """The same between a node and the next one, [n, 6]."""


class Factors(NamedTuple):
    """The matrix of a step, eliminated node by node, [n, ...]."""

    own: Array
    """Inverse of a node's block with the tension after it eliminated, m/N: lower halves, [n, 6]."""
    tight: Array
    """The part of that inverse between node and tension, [n, 3]."""
    slack: Array
    """And that of the tension, N/m, [n]."""
    one: Array
    """Of the elimination, by which the next node is reached, [n, 3, 3]."""
    pulled: Array
    """The same by the tension, [n, 3]."""


class Newton(NamedTuple):
    """A step of a chain: its unknowns so far, and the last Newton step, not yet taken."""

    shift: Array
    """Displacements of the nodes, m, [n, 3]."""
    tension: Array
    """N, [n]"""
    change: Array
    """Change of displacements and tension by the Newton step, [n, 4]."""
    factors: Factors
    joined: Any
    """Whatever `join` has found last."""
    before: Array
    """Displacements before the Newton step that led to `shift`, m, [n, 3]."""


def free_forces(rod: Rod, state: ChainState, dt: Any) -> Array:
    """Return the forces that would move each node in a step if nothing held it: inertia and weight, N, [n, 3]."""
    return rod.mass[:, None] * (state.velocity / dt + GRAVITY)


def search(
    rod: Rod, state: ChainState, pull: Array, load: Callable[[Array, Array], Loaded], dt: Any, iterations: int,
    holds: Any,
    join: Callable[[Array, Array, Array, Factors, Any], tuple[Array, Array, Any]] | None = None, joined: Any = (),
) -> Newton:  # fmt: skip
    """Return the Newton iterations of a step, the last of which is not yet added to the displacements.

    Args:
        rod: the material.
        state: at the start of the step.
        pull: `free_forces`, and other forces on nodes that do not depend on their displacements, N, [n, 3].
        load: takes displacements, and those of the Newton step before, [n, 3]; returns the forces of contacts there.
        dt: duration of the step, s.
        iterations: Newton steps at most.
        holds: 1 for edges that hold, 0 for a broken one and after the last node, [n].
        join: takes displacements [n, 3], a Newton step [n, 4], the largest displacement in it, its factors and what
            it has found last; returns step and largest displacement with what joins nodes far apart, and what it has
            found now.
        joined: what it begins with.
    """
    n, bends = rod.nodes, holds * _before(holds)
    inertia = rod.mass * np.float32(1 / dt**2 + rod.drag / dt)
    known = inertia, holds, _before(bends), bends, _after(bends), pull
    apart, guess = _start(state, dt)

    def going(loop: tuple[Newton, Array, Array]) -> Array:
        _, most, count = loop
        return (most > ENOUGH) & (count < iterations)

    def step(loop: tuple[Newton, Array, Array]) -> tuple[Newton, Array, Array]:
        found, _, count = loop
        u, q, edges = _taken(found, apart)
        factors, reduced = _eliminate(rod, u, q, edges, known, load(u, found.shift))
        (change, most), kept = _back(rod, bends, factors, reduced), found.joined
        if join is not None:
            change, most, kept = join(u, change, most, factors, kept)
        change = _shortened(change, FARTHEST * rod.length, most)
        return Newton(u, q, change, factors, kept, found.shift), most, count + 1

    empty = Factors(*(jnp.zeros((n, *shape)) for shape in ((6,), (3,), (), (3, 3), (3,))))
    still = jnp.zeros((n, 3))
    start = Newton(still, state.tension, guess, empty, joined, still), jnp.float32(jnp.inf), jnp.int32(0)
    found: Newton = jax.lax.while_loop(going, step, start)[0]
    return found


# Arithmetic on all nodes is in scans, which the fused engine keeps as loops.


def _start(state: ChainState, dt: Any) -> tuple[Array, Array]:
    """Return the edges at the start of a step, m, [n, 3], and the first guess of the change of unknowns, [n, 4].

    From here on, edges are sums of small differences.
    """

    def node(after: Array, row: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        position, velocity = row
        return position, (after - position, jnp.append(dt * velocity, 0.0))

    rows = state.position, state.velocity
    found: tuple[Array, Array] = jax.lax.scan(node, jnp.zeros(3), rows, reverse=True)[1]
    return found


def _taken(newton: Newton, apart: Array) -> tuple[Array, Array, Array]:
    """Return displacements and tensions after a Newton step, and the edges after each node and the next, [n, 2, 3]."""

    def node(after: tuple[Array, Array], row: Any) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        (u_1, edge_1), (shift, tension, change, apart) = after, row
        u = shift + change[:3]
        edge = apart + (u_1 - u)
        return (u, edge), (u, tension + change[3], jnp.stack([edge, edge_1]))

    none = jnp.zeros(3)
    rows = newton.shift, newton.tension, newton.change, apart
    found: tuple[Array, Array, Array] = jax.lax.scan(node, (none, none), rows, reverse=True)[1]
    return found


def _shortened(change: Array, most: float, largest: Array) -> Array:
    """Return a Newton step [n, 4] whose largest displacement is `most` at most, m."""

    def shorten(row: Array, change: Array) -> Array:
        return put(change, row, most / largest * change[row])

    rows = jnp.where(largest > most, len(change), 0)  # seldom any
    found: Array = jax.lax.fori_loop(0, rows, shorten, change)
    return found


def moved(state: ChainState, newton: Newton, more: Array, dt: Any) -> tuple[ChainState, Array, Array]:
    """Return a chain after a step, its displacements, m, [n, 3], and the largest one in this step and the last, m, [].

    Args:
        state: at the start of the step.
        newton: of the step.
        more: changes of the unknowns beyond it, [n, 4].
        dt: duration of the step, s.
    """

    def node(most: Array, row: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        position, velocity, shift, tension, change, more = row
        change += more
        u = shift + change[:3]
        most = jnp.maximum(most, jnp.max(jnp.maximum(jnp.abs(u), jnp.abs(dt * velocity))))
        return most, (position + u, u / dt, tension + change[3], u)

    rows = state.position, state.velocity, newton.shift, newton.tension, newton.change, more
    most, (position, velocity, tension, u) = jax.lax.scan(node, jnp.float32(0.0), rows)
    return ChainState(position, velocity, tension), u, most


def solve(rod: Rod, factors: Factors, force: Array, holds: Any) -> Array:
    """Return the change of displacements and tensions [n, 4] by forces on nodes, N, [n, 3]."""
    bends = holds * _before(holds)
    skips = _skips(rod, bends)

    def forward(carry: tuple[Array, Array], row: Any) -> tuple[tuple[Array, Array], Array]:
        factor, skip, force = row
        right, later = carry[0] + force, carry[1]
        reduced = jnp.append(factor.own[FULL] @ right, -factor.tight @ right)
        return (later - factor.one @ right, -skip * reduced[:3]), reduced

    none = jnp.zeros(3)
    _, reduced = jax.lax.scan(forward, (none, none), (factors, skips, force))
    return _back(rod, bends, factors, reduced)[0]


def _eliminate(
    rod: Rod, u: Array, q: Array, edges: Array, known: tuple[Any, ...], load: Loaded
) -> tuple[Factors, Array]:  # fmt: skip
    """Return the eliminated matrix of a Newton step at displacements u and tensions q, and its right side, [n, 4].

    `edges` are those after each node and after the next one, m, [n, 2, 3].
    """
    stiffness, stretchy, length_at_rest = rod.bending / rod.length**3, rod.length / rod.axial, rod.length

    def node(carry: Any, row: Any) -> tuple[Any, tuple[Factors, Array]]:
        (bent_1, bent, pull_1), (block, meets, right), (block_2, right_2) = carry
        u, q, (edge, edge_2), (inertia, holds, bends_1, bends, bends_2, pull), load = row
        length = jnp.sqrt(jnp.maximum(edge @ edge, 1e-18))
        along = holds / length * edge
        bent_2 = bends_2 * (edge_2 - edge)
        pulls, compliance = q * along, jnp.where(q < 0, KINKING * stretchy, stretchy)
        force = pull - inertia * u + pulls - pull_1 - stiffness * (bent_1 - 2 * bent + bent_2) + load.force + right
        slack = holds * (compliance * q - (length - length_at_rest)) + (1 - holds) * q
        # Tension resists what moves across an edge. Compression is left out, as the matrix has to stay definite.
        across = holds * jnp.maximum(q, 0.0) / length * (_EYE - jnp.outer(along, along))
        block = block + load.own[FULL] + across + (inertia + stiffness * (bends_1 + 4 * bends + bends_2)) * _EYE
        meets = meets + load.across[FULL] - across - 2 * stiffness * (bends + bends_2) * _EYE
        skip = stiffness * bends_2
        inverse = _inverse(block)
        gives = inverse @ along
        over = 1 / (holds * compliance + (1 - holds) + along @ gives)
        tight = over * gives
        own = inverse - jnp.outer(gives, tight)
        one = meets @ own - jnp.outer(along, tight)
        pulled = meets @ tight + over * along
        reduced = jnp.append(own @ force - tight * slack, -tight @ force - over * slack)
        carry = (
            (bent, bent_2, pulls),
            (
                block_2 + across - one @ meets.T + jnp.outer(pulled, along),
                -skip * one.T,
                right_2 - one @ force + pulled * slack,
            ),
            (-skip * skip * own, -skip * reduced[:3]),
        )
        return carry, (Factors(own[LOWER], tight, over, one, pulled), reduced)

    none, empty = jnp.zeros(3), jnp.zeros((3, 3))
    start = (none, none, none), (empty, empty, none), (empty, none)
    _, found = jax.lax.scan(node, start, (u, q, edges, known, load))
    eliminated: tuple[Factors, Array] = found
    return eliminated


def _back(rod: Rod, bends: Any, factors: Factors, reduced: Array) -> tuple[Array, Array]:
    """Return the unknowns [n, 4] of eliminated equations, and the largest displacement among them, m, []."""

    def node(carry: tuple[Array, Array, Array], row: Any) -> tuple[tuple[Array, Array, Array], Array]:
        (next_1, next_2, most), (factor, skip, reduced) = carry, row
        moved = reduced[:3] - factor.one.T @ next_1 - skip * (factor.own[FULL] @ next_2)
        tension = reduced[3] + factor.pulled @ next_1 + skip * (factor.tight @ next_2)
        return (moved, next_1, jnp.maximum(most, jnp.max(jnp.abs(moved)))), jnp.append(moved, tension)

    none, rows = jnp.zeros(3), (factors, _skips(rod, bends), reduced)
    (_, _, most), changes = jax.lax.scan(node, (none, none, jnp.float32(0.0)), rows, reverse=True)
    return changes, most


def _skips(rod: Rod, bends: Any) -> Any:
    """Return the stiffness of bending between each node and the next but one, N/m, [n]."""
    return rod.bending / rod.length**3 * _after(bends)


def _inverse(matrix: Array) -> Array:
    """Return the inverse of a positive definite matrix [3, 3] by L D L^T, stable where rows differ in size."""
    a, b, c, d, e, f = (matrix[i, j] for i, j in zip(*LOWER, strict=True))
    p = 1 / a
    m, n = b * p, d * p
    q = 1 / jnp.maximum(c - m * b, 1e-7 * c)
    s = (e - n * b) * q
    r = 1 / jnp.maximum(f - n * d - s * (e - n * b), 1e-7 * f)
    t = m * s - n  # L^-1 has -m, t and -s below its diagonal
    low = jnp.stack([p + m * m * q + t * t * r, -m * q - t * s * r, q + s * s * r, t * r, -s * r, r])
    return low[FULL]


def _after(x: Any) -> Any:
    """Return the row after each row, [n, ...], and zeros for the last one."""
    xp = np if isinstance(x, np.ndarray) else jnp
    return xp.concatenate([x[1:], xp.zeros_like(x[:1])])


def _before(x: Any) -> Any:
    """Return the row before each row, [n, ...], and zeros for the first one."""
    xp = np if isinstance(x, np.ndarray) else jnp
    return xp.concatenate([xp.zeros_like(x[:1]), x[:-1]])
