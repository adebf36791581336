"""Contacts of what is soft or light: a spring along the normal and one along the surface, at one point each.

The normal spring pushes and never pulls. That along the surface is friction by Coulomb's law: it remembers how far it
is stretched, and gives way where its force is the coefficient of friction times the normal force. A bilateral contact
does neither: it ties a point to another one.

In the matrix of Newton's method friction is its secant, the force at a displacement divided by it, which is symmetric.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.solver.cholesky import FULL
from surgical_marl.physics.systems.system import End, Ends
from surgical_marl.physics.tree_utils import put, room, row_of


class Felt(NamedTuple):
    """The force of a contact on its part."""

    force: Array
    """N, [3]"""
    stiffness: Array
    """By how much the force falls as the point moves, N/m, [3, 3]; symmetric, positive semidefinite."""
    stretch: Array
    """Of the spring along the surface at the end of the step, m, [3]."""


class Stretches(NamedTuple):
    """The memory of friction: how far the springs of the last step's contacts are stretched, in their order."""

    key: Array
    """Numbers of shape and part in one, ascending, [c]."""
    stretch: Array
    """m, [c, 3]"""
    total: Array
    """Number of contacts, []."""


def feel(end: End, moved: Array, before: Array | None = None) -> Felt:
    """Return the force of one contact whose point moves by this much relative to the shape, m, [3].

    `before` is the motion that the last Newton step found, m, [3]. A contact that was open there has no friction yet:
    it would stick to what may not press at all.
    """
    along = end.normal @ moved
    reach, both = end.depth - along, end.bilateral
    normal = end.stiffness * jnp.where(both, reach, jnp.maximum(reach, 0.0))
    slid = end.stretch - end.normal * (end.normal @ end.stretch) + moved - end.normal * along
    far = jnp.sqrt(jnp.maximum(slid @ slid, 1e-24))
    bears = normal
    if before is not None:
        bears = jnp.where(end.depth > end.normal @ before, normal, 0.0)
    secant = jnp.where(both, end.stiffness, jnp.minimum(end.stiffness, end.sliding * bears / far))
    pressed = jnp.where(both | (reach > 0), end.stiffness, 0.0)
    stiffness = secant * jnp.eye(3) + (pressed - secant) * jnp.outer(end.normal, end.normal)
    return Felt(normal * end.normal - secant * slid, stiffness, secant / end.stiffness * slid)


def none(rows: int) -> Stretches:
    """Return the memory of no contacts, with room for so many."""
    return Stretches(jnp.full(rows, -1, jnp.int32), jnp.zeros((rows, 3), jnp.float32), jnp.int32(0))


def recall(memory: Stretches, ends: Ends, parts: int) -> Ends:
    """Return contacts with the stretches that are remembered of the same shape at the same part, or at the next one.

    So friction goes on as what slides leaves one part and comes to another. Both lists are in the order of their keys.
    """
    last = len(memory.key) - 1

    def one(row: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
        stretches, at = found
        end = row_of(ends.rows, row)
        key = _key(end, parts)

        def behind(at: Array) -> Array:
            return (at < memory.total) & (memory.key[jnp.minimum(at, last)] < key - 1)

        at = jax.lax.while_loop(behind, lambda at: at + 1, at)
        best, stretch = jnp.int32(2), end.stretch
        for ahead in range(3):
            place = jnp.minimum(at + ahead, last)
            off = jnp.where(at + ahead < memory.total, jnp.abs(memory.key[place] - key), 2)
            nearer = (off < best) & ~end.bilateral
            stretch, best = jnp.where(nearer, memory.stretch[place], stretch), jnp.where(nearer, off, best)
        return stretches.at[row].set(stretch, mode="promise_in_bounds"), at

    stretches, _ = jax.lax.fori_loop(0, ends.total, one, (ends.rows.stretch, jnp.int32(0)))
    return ends._replace(rows=ends.rows._replace(stretch=stretches))


def remember(ends: Ends, moved: Callable[[Array, End], Array], parts: int) -> Stretches:
    """Return the memory of contacts whose points move by `moved` relative to the shapes, as `each` calls it."""

    def note(row: Array, end: End) -> tuple[Array, Array]:
        stretch = feel(end, moved(row, end)).stretch
        return _key(end, parts), jnp.where(end.bilateral, 0.0, stretch)  # a tie has no friction to be remembered

    key, stretch = each(ends, note)
    return Stretches(key, stretch, ends.total)


def each(ends: Ends, of: Callable[[Array, End], Any], moving: bool = False) -> Any:
    """Return `of(row, end)` for every contact, or for those with what moves, [c, ...]; 0 elsewhere."""
    shape = jax.eval_shape(lambda: of(jnp.int32(0), row_of(ends.rows, 0)))
    start = jax.tree.map(jnp.zeros_like, room(shape, len(ends.rows.part)))

    def note(row: Array, found: Any) -> Any:
        return put(found, row, of(row, row_of(ends.rows, row)))

    return jax.lax.fori_loop(0, ends.moving if moving else ends.total, note, start)


def pushes(ends: Ends, falls: Array, accelerations: Array, dt: Any) -> Array:
    """Return what ends that accelerate push in a step in addition, N, [c, 3].

    Args:
        ends: the contacts.
        falls: of the force of each contact as its end moves, N/m: lower halves, [c, 6].
        accelerations: of the ends, beyond those that were expected, m/s2, [c, 3].
        dt: duration of a step, s.
    """
    found: Array = each(ends, lambda row, end: dt * dt * (falls[row][FULL] @ accelerations[row]), moving=True)
    return found


def _key(end: End, parts: int) -> Array:
    """Return a number that grows along the list of contacts. A shape's last part has no neighbour on the next shape."""
    return jnp.where(end.bilateral, -1, end.shape * (parts + 1) + end.part)
