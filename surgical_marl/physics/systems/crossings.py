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


WIDER = (np.pi / 2 - 1) / 4
"""An angle is at most its chord on the unit circle, c, times 1 + this times c^2."""


class Course(NamedTuple):
    """The course of a chain of p parts."""

    middle: Array
    """Of each part, m, [p, 3]."""
    half: Array
    """Half length of each part, m, [p]."""
    turned: Array
    """Angle by which the chain turns from its start to each part, never too small, rad, [p]."""
    halves: tuple[Array, Array]
    """Least and largest half length, m."""
    speed: Array
    """Largest speed, m/s, []."""


class Joined(NamedTuple):
    """The pairs in the matrix of a step: p of them, on n nodes."""

    moves: Array
    """Displacements and tensions by a pull at a pair, scaled by the root of its stiffness, [3 p n, 4].

    The n rows of one pull after those of another: a kernel has arrays of one axis.
    """
    factor: Array
    """Cholesky factor of the pairs' own matrix, [3 p, 3 p]."""


def apart_from_itself(rows: int, nodes: int) -> Joined:
    """Return the matrix of no pairs."""
    return Joined(jnp.zeros((3 * rows * nodes, 4)), jnp.zeros((3 * rows, 3 * rows)))


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
    radius = jnp.broadcast_to(jnp.asarray(shapes.radius), (parts,))
    course = _course(shapes)
    longest, moves = 2 * course.halves[1], jnp.minimum(2 * dt * course.speed, AHEAD)
    bent = _bent(2 * course.halves[0], 2 * jnp.max(radius) + NEAR + moves)

    def pair(first: Array, second: Array) -> tuple[End, Array]:
        one, other = (Segments(shapes.start[k], shapes.end[k], radius[k]) for k in (second, first))
        point, none = between_segments(one, other), jnp.zeros(3)
        where = none.at[0].set(_share(other, point.place))
        end = End(second, _share(one, point.place), first, point.depth, where, point.normal, jnp.float32(stiffness),
                  jnp.float32(sliding), jnp.bool_(False), none, none)  # fmt: skip
        nearer = -dt * (point.normal @ apart(end, velocity))
        return end, point.depth + jnp.clip(nearer, 0.0, AHEAD) > -NEAR

    def next_near(first: Array, second: Array) -> Array:
        """Return the next part, from the second one on, that is near the first one, or a number past the last one."""

        def going(loop: tuple[Array, Array]) -> Array:
            return (loop[0] < parts) & ~loop[1]

        def look(loop: tuple[Array, Array]) -> tuple[Array, Array]:
            k = loop[0]
            off = size(course.middle[k] - course.middle[first])
            gap = off - course.half[k] - course.half[first] - 2 * radius[first] - NEAR - moves
            # the next parts are at most their lengths nearer: those that can't be near are passed over
            on = jnp.maximum(jnp.floor(gap / longest).astype(jnp.int32), 1)
            return jnp.where(gap < 0, k, k + on), gap < 0

        return jax.lax.while_loop(going, look, (second, jnp.bool_(False)))[0]

    def of_part(loop: tuple[Ends, Array], first: Array) -> tuple[tuple[Ends, Array], None]:
        found, second = loop
        straight = jax.lax.while_loop(
            lambda k: (k < parts) & (course.turned[jnp.minimum(k, parts - 1)] - course.turned[first] < bent),
            lambda k: k + 1,
            jnp.maximum(second, first + APART),
        )

        def look(loop: tuple[Array, Ends]) -> tuple[Array, Ends]:
            second, found = loop
            end, touches = pair(first, second)
            kept = put(found.rows, jnp.where(touches, jnp.minimum(found.total, rows), rows), end)
            found = Ends(kept, found.moving, found.total + touches, found.left_out)
            return next_near(first, second + 1), found

        start = next_near(first, straight), found
        return (jax.lax.while_loop(lambda loop: loop[0] < parts, look, start)[1], straight), None

    shape = jax.eval_shape(lambda: pair(jnp.int32(0), jnp.int32(APART))[0])
    start = Ends(room(shape, rows + 1), jnp.int32(0), jnp.int32(0), jnp.int32(0)), jnp.int32(0)
    (found, _), _ = jax.lax.scan(of_part, start, jnp.arange(parts - APART, dtype=jnp.int32))
    kept = jax.tree.map(lambda x: x[:-1], found.rows)
    left_out = jnp.maximum(found.total - rows, 0)
    return Ends(kept, found.moving, jnp.minimum(found.total, rows), left_out)


def _course(shapes: Shapes) -> Course:
    """Return the course of a chain."""

    def part(before: Any, row: Any) -> tuple[Any, tuple[Array, Array, Array]]:
        (along, turned, shortest, longest, fastest), (start, end, speed) = before, row
        way = end - start
        half = size(way) / 2
        own = way / jnp.maximum(2 * half, 1e-12)
        chord = jnp.minimum(size(own - along), 2.0)
        turned += chord * (1 + WIDER * chord * chord)
        after = own, turned, jnp.minimum(shortest, half), jnp.maximum(longest, half), jnp.maximum(fastest, speed)
        return after, ((start + end) / 2, half, turned)

    zero = jnp.float32(0.0)
    first = jnp.zeros(3), zero, jnp.float32(jnp.inf), zero, zero
    last, (middle, half, turned) = jax.lax.scan(part, first, (shapes.start, shapes.end, shapes.speed))
    return Course(middle, half, turned, last[2:4], last[4])


def _bent(length: Array, reach: Array) -> Array:
    """Return the angle, rad, by which a chain turns at least between two parts that are this near each other, m.

    All directions of a curve that turns by an angle are within half of it of one direction. Along that direction the
    edges between the two parts, of this length or more, m, add up to their lengths times the cosine of that half, and
    cos(x / 2) >= 1 - x^2 / 8.
    """
    return jnp.sqrt(8 * jnp.maximum(1 - reach / jnp.maximum((APART - 1) * length, 1e-12), 0.0))


def apart(end: End, u: Array, first: Any = 0) -> Array:
    """Return how far the points of one pair move apart, [3], by displacements of nodes, from row `first` of u on."""
    return _at(u, first + end.part, end.share) - _at(u, first + end.shape, end.place[0])


def add_forces(pairs: Ends, u: Array, others: Array) -> Array:
    """Return forces on the nodes with those of pairs, N, [n, 3], at displacements of the nodes, m, [n, 3]."""

    def add(row: Array, sums: Array) -> Array:
        end = row_of(pairs.rows, row)
        return pulled(end, sums, feel(end, apart(end, u)).force)

    found: Array = jax.lax.fori_loop(0, pairs.total, add, others)
    return found


def pulled(end: End, sums: Array, force: Array) -> Array:
    """Return forces on nodes [n, 3] with one at the first point of a pair, and the opposite one at the second."""
    first = _spread(sums, end.part, end.share, force)
    return _spread(first, end.shape, end.place[0], -force)


def joined(pairs: Ends, u: Array, solve: Callable[[Array], Array], last: Joined) -> Joined:
    """Return what pairs add to the matrix of a step at displacements u, in the place of what they added last.

    Args:
        pairs: the pairs.
        u: displacements of the nodes, m, [n, 3].
        solve: takes forces on nodes [n, 3], returns displacements and tensions [n, 4] of the chain without pairs.
        last: of the Newton step before, or `apart_from_itself`.
    """
    (n, _), p, roots = u.shape, len(pairs.rows.part), _roots(pairs, u)

    def pull(number: Array, moves: Array) -> Array:
        end = row_of(pairs.rows, number // 3)
        force = roots[number // 3] @ jnp.where(jnp.arange(3) == number % 3, 1.0, 0.0)
        return jax.lax.dynamic_update_slice(moves, solve(pulled(end, jnp.zeros_like(u), force)), (n * number, 0))

    moves = jax.lax.fori_loop(0, 3 * pairs.total, pull, last.moves)

    def factored() -> Array:
        numbers = jnp.arange(3 * p, dtype=jnp.int32)
        across = jax.lax.map(lambda number: _projected(pairs, roots, moves, n * number), numbers)
        return cholesky(np.eye(3 * p, dtype=np.float32) + (across + across.T) / 2)

    return Joined(moves, jax.lax.cond(pairs.total > 0, factored, lambda: last.factor))


def add(pairs: Ends, u: Array, own: Joined, change: Array) -> Array:
    """Return the solution [n, 4] of a step's equations with pairs, from that without them."""

    def weights() -> Array:
        return solve_factored(own.factor, _projected(pairs, _roots(pairs, u), change))

    pull = jax.lax.cond(pairs.total > 0, weights, lambda: jnp.zeros(3 * len(pairs.rows.part)))

    n = len(change)

    def less(k: Array, change: Array) -> Array:
        share, nodes = pull[k], jnp.arange(n, dtype=jnp.int32)
        return jax.lax.map(lambda row: row[1] - share * own.moves[n * k + row[0]], (nodes, change))

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


def _projected(pairs: Ends, roots: Array, change: Array, first: Any = 0) -> Array:
    """Return the displacements in rows of 4, from `first` on, as pairs see them, times their roots, [3 p]."""
    found: Array = each(pairs, lambda row, end: roots[row] @ apart(end, change[:, :3], first))
    return found.ravel()


def _share(part: Segments, place: Array) -> Array:
    along = part.end - part.start
    return jnp.clip((place - part.start) @ along / jnp.maximum(along @ along, 1e-12), 0.0, 1.0)


def _at(u: Array, part: Array, share: Array) -> Array:
    return (1 - share) * u[part] + share * u[part + 1]


def _spread(rows: Array, part: Array, share: Array, force: Array) -> Array:
    rows = rows.at[part].add((1 - share) * force, mode="promise_in_bounds")
    return rows.at[part + 1].add(share * force, mode="promise_in_bounds")
