"""Where a thread touches itself: pairs of its parts, and what they add to the equations of a step.

A pair joins two nodes that may be far apart along the chain, so it has no place in a matrix with a few bands. It is
added afterwards, by Woodbury's identity: for each pair the chain is solved three more times, and a small matrix of all
pairs is factored. Without a pair nothing of this is done.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.broadphase import size
from surgical_marl.physics.contact.part_detection import AHEAD, NEAR
from surgical_marl.physics.contact.shapes import Segments, between_segments
from surgical_marl.physics.contact.spring_contact import each, feel
from surgical_marl.physics.solver.cholesky import cholesky, solve_factored
from surgical_marl.physics.systems.system import End, Ends, Shapes
from surgical_marl.physics.tree_utils import put, room, row_of

APART = 3
"""Parts between two that can touch, and one more: nearer ones meet at the nodes between them."""


class Joined(NamedTuple):
    """The pairs in the matrix of a step: p of them, [3 p, ...]."""

    moves: Array
    """Displacements and tensions by a pull at a pair, scaled by the root of its stiffness, [3 p, n, 4]."""
    factor: Array
    """Cholesky factor of the pairs' own matrix, [3 p, 3 p]."""


def apart_from_itself(rows: int, nodes: int) -> Joined:
    """Return the matrix of no pairs."""
    return Joined(jnp.zeros((3 * rows, nodes, 4)), jnp.zeros((3 * rows, 3 * rows)))


def find(shapes: Shapes, velocity: Array, rows: int, stiffness: float, sliding: float, dt: Any) -> Ends:
    """Return the pairs of parts that touch each other, or may in the step, at most so many.

    The first part of a pair is the `shape` of its contact, and the first element of `place` is where it is on that.

    Args:
        shapes: the parts of a chain, one after the other.
        velocity: of its nodes, m/s, [n, 3].
        rows: room for pairs.
        stiffness: of a contact, N/m.
        sliding: coefficient of friction.
        dt: duration of a step, s.
    """
    parts = len(shapes.speed)
    middle, half = (shapes.start + shapes.end) / 2, size(shapes.end - shapes.start) / 2
    radius = jnp.broadcast_to(jnp.asarray(shapes.radius), (parts,))
    longest, moves = 2 * jnp.max(half), jnp.minimum(2 * dt * jnp.max(shapes.speed), AHEAD)

    def pair(first: Array, second: Array) -> tuple[End, Array]:
        one, other = (Segments(shapes.start[k], shapes.end[k], radius[k]) for k in (second, first))
        point, none = between_segments(one, other), jnp.zeros(3)
        where = none.at[0].set(_share(other, point.place))
        end = End(second, _share(one, point.place), first, point.depth, where, point.normal, jnp.float32(stiffness),
                  jnp.float32(sliding), jnp.bool_(False), none, none)  # fmt: skip
        nearer = -dt * (point.normal @ apart(end, velocity))
        return end, point.depth + jnp.clip(nearer, 0.0, AHEAD) > -NEAR

    def of_part(found: Ends, first: Array) -> tuple[Ends, None]:
        def going(loop: tuple[Array, Ends]) -> Array:
            return loop[0] < parts

        def look(loop: tuple[Array, Ends]) -> tuple[Array, Ends]:
            second, found = loop
            gap = size(middle[second] - middle[first]) - half[first] - half[second] - 2 * radius[first] - NEAR - moves
            end, touches = jax.lax.cond(
                gap < 0, lambda: pair(first, second), lambda: (row_of(found.rows, rows), jnp.bool_(False))
            )
            kept = put(found.rows, jnp.where(touches, jnp.minimum(found.total, rows), rows), end)
            # the next parts are at most their lengths nearer: those that can't be near are passed over
            on = jnp.maximum(jnp.floor(gap / longest).astype(jnp.int32), 1)
            return second + on, Ends(kept, found.moving, found.total + touches, found.left_out)

        return jax.lax.while_loop(going, look, (first + APART, found))[1], None

    shape = jax.eval_shape(lambda: pair(jnp.int32(0), jnp.int32(APART))[0])
    start = Ends(room(shape, rows + 1), jnp.int32(0), jnp.int32(0), jnp.int32(0))
    found, _ = jax.lax.scan(of_part, start, jnp.arange(parts - APART, dtype=jnp.int32))
    kept = jax.tree.map(lambda x: x[:-1], found.rows)
    left_out = jnp.maximum(found.total - rows, 0)
    return Ends(kept, found.moving, jnp.minimum(found.total, rows), left_out)


def apart(end: End, u: Array) -> Array:
    """Return how far the points of one pair move apart, [3], by the displacements of nodes, [n, 3]."""
    return _at(u, end.part, end.share) - _at(u, end.shape, end.place[0])


def forces(pairs: Ends, u: Array) -> Array:
    """Return the forces of pairs on the nodes, N, [n, 3], at displacements of these, m, [n, 3]."""

    def add(row: Array, sums: Array) -> Array:
        end = row_of(pairs.rows, row)
        return pulled(end, sums, feel(end, apart(end, u)).force)

    found: Array = jax.lax.fori_loop(0, pairs.total, add, jnp.zeros_like(u))
    return found


def pulled(end: End, sums: Array, force: Array) -> Array:
    """Return forces on nodes [n, 3] with one at the first point of a pair, and the opposite one at the second."""
    first = _spread(sums, end.part, end.share, force)
    return _spread(first, end.shape, end.place[0], -force)


def joined(pairs: Ends, u: Array, solve: Callable[[Array], Array]) -> Joined:
    """Return what pairs add to the matrix of a step at displacements u.

    Args:
        pairs: there is one at least.
        u: displacements of the nodes, m, [n, 3].
        solve: takes forces on nodes [n, 3], returns displacements and tensions [n, 4] of the chain without pairs.
    """
    p, roots = len(pairs.rows.part), _roots(pairs, u)

    def column(number: Array) -> Array:
        end = row_of(pairs.rows, number // 3)
        pull = roots[number // 3] @ jnp.where(jnp.arange(3) == number % 3, 1.0, 0.0)
        return solve(pulled(end, jnp.zeros_like(u), pull))

    rows = room(jax.ShapeDtypeStruct((len(u), 4), jnp.float32), 3 * p)
    start = jnp.zeros_like(rows)
    moves = jax.lax.fori_loop(0, 3 * pairs.total, lambda k, found: put(found, k, column(k)), start)
    across = jax.lax.map(lambda own: _projected(pairs, roots, own), moves)
    return Joined(moves, cholesky(np.eye(3 * p, dtype=np.float32) + (across + across.T) / 2))


def add(pairs: Ends, u: Array, own: Joined, change: Array) -> Array:
    """Return the solution [n, 4] of a step's equations with pairs, from that without them."""
    weights = solve_factored(own.factor, _projected(pairs, _roots(pairs, u), change))

    def less(k: Array, change: Array) -> Array:
        return change - weights[k] * own.moves[k]

    found: Array = jax.lax.fori_loop(0, 3 * pairs.total, less, change)
    return found


def _roots(pairs: Ends, u: Array) -> Array:
    """Return the roots of the stiffnesses of pairs, [p, 3, 3]."""

    def root(row: Array, end: End) -> Array:
        del row
        stiffness, along = feel(end, apart(end, u)).stiffness, jnp.outer(end.normal, end.normal)
        normal = jnp.sum(stiffness * along)
        across = (jnp.trace(stiffness) - normal) / 2
        return jnp.sqrt(jnp.maximum(normal, 0.0)) * along + jnp.sqrt(jnp.maximum(across, 0.0)) * (jnp.eye(3) - along)

    found: Array = each(pairs, root)
    return found


def _projected(pairs: Ends, roots: Array, change: Array) -> Array:
    """Return the displacements [n, 4] as pairs see them, times the roots of their stiffnesses, [3 p]."""
    found: Array = each(pairs, lambda row, end: roots[row] @ apart(end, change[:, :3]))
    return found.ravel()


def _share(part: Segments, place: Array) -> Array:
    along = part.end - part.start
    return jnp.clip((place - part.start) @ along / jnp.maximum(along @ along, 1e-12), 0.0, 1.0)


def _at(u: Array, part: Array, share: Array) -> Array:
    return (1 - share) * u[part] + share * u[part + 1]


def _spread(rows: Array, part: Array, share: Array, force: Array) -> Array:
    rows = rows.at[part].add((1 - share) * force, mode="promise_in_bounds")
    return rows.at[part + 1].add(share * force, mode="promise_in_bounds")
