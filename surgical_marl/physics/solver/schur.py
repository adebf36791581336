"""Schur complement: objects are eliminated from the linear system of a Newton step, which leaves that of the arms.

Let M be the matrix of objects, in blocks of six, and C its coupling with arms. With a Cholesky factor M = L @ L.T the
arms lose (L^-1 @ C).T @ (L^-1 @ C) of their matrix and (L^-1 @ C).T @ (L^-1 @ f) of their forces. Objects are
eliminated one after the other, and only objects that touch each other change each other's blocks.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.solver.cholesky import back, cholesky, forward, packed
from surgical_marl.physics.tree_utils import add, for_each, put, when

_FIRST, _SECOND = np.tril_indices(6)
_Rows = tuple[Array, Array, Array, Array]
"""Blocks on the diagonal and beside it, forces and coupling of objects that are being eliminated."""


class Eliminated(NamedTuple):
    """The rows of k objects after their elimination, with a arms of m joints each."""

    force: Array
    """L^-1 @ f for the forces f on objects, [k, 6]."""
    coupling: Array
    """L^-1 @ C: of object o and arm i in row a o + i, [(k + 1) a, 6, m]. Only defined where `touched`."""
    factor: Array
    """Blocks on the diagonal of L, lower, [k, 6, 6]."""
    cross: Array
    """Blocks of L.T beside the diagonal: of objects i < j from 36 (k i + j) on. Only defined if objects touch."""
    touched: Array
    """Pairs of object and arm that touch, or do so by way of other objects, [k, a] bool."""


def eliminate(own: Array, cross: Array, force: Array, coupling: Array, touched: Array, linked: Array) -> Eliminated:
    """Return the rows of objects after their elimination.

    Args:
        own: lower half of each object's block of M, [k, 21].
        cross: blocks of M beside the diagonal, as in `Eliminated`; zeros where two objects do not touch.
        force: forces on objects, [k, 6].
        coupling: C, as in `Eliminated`; only read where `touched`.
        touched: objects that touch arms, [k, a] bool.
        linked: true if any objects touch each other, [].
    """
    (k, a), zeros = touched.shape, jnp.zeros(coupling.shape[1:])

    def one(state: _Rows, j: Array) -> tuple[_Rows, Array]:
        own, cross, force, coupling = state
        factor = cholesky(own[j][packed(6)])

        def divide(coupling: Array, arm: Array) -> Array:
            return put(coupling, a * j + arm, forward(factor, coupling[a * j + arm]))

        force, coupling = put(force, j, forward(factor, force[j])), for_each(touched[j], divide, coupling)
        state = own, cross, force, coupling
        if k > 1:
            state = when(linked, partial(_subtract, j, touched, factor), state)
        return state, factor

    if not k:
        return Eliminated(force, coupling, jnp.zeros((0, 6, 6)), cross, touched)
    if k > 1:
        filled = touched | (linked & touched.any(0))  # if objects touch, an arm that touches one counts for all
        coupling = for_each((filled & ~touched).ravel(), lambda rows, pair: put(rows, pair, zeros), coupling)
        touched = filled
    (_, cross, force, coupling), factor = jax.lax.scan(one, (own, cross, force, coupling), jnp.arange(k))
    return Eliminated(force, coupling, factor, cross, touched)


def _subtract(j: Array, touched: Array, factor: Array, state: _Rows) -> _Rows:
    """Return the rows of all objects after object j is eliminated from those that it touches and that follow it."""
    (k, a), (own, cross, force, coupling) = touched.shape, state

    def divide(cross: Array, i: Array) -> Array:
        return _put_block(cross, k * j + i, forward(factor, _block(cross, k * j + i)))

    def subtract(state: _Rows, i: Array) -> _Rows:
        own, cross, force, coupling = state
        across = _block(cross, k * j + i)

        def from_cross(cross: Array, n: Array) -> Array:
            return _put_block(cross, k * i + n, _block(cross, k * i + n) - across.T @ _block(cross, k * j + n))

        def from_coupling(coupling: Array, arm: Array) -> Array:
            return add(coupling, a * i + arm, -across.T @ coupling[a * j + arm])

        own = add(own, i, -jnp.sum(across[:, _FIRST] * across[:, _SECOND], 0))
        cross = for_each(_after(i, cross, j, k), from_cross, cross)
        return own, cross, add(force, i, -across.T @ force[j]), for_each(touched[j], from_coupling, coupling)

    after = _after(j, cross, j, k)
    cross = for_each(after, divide, cross)
    return for_each(after, subtract, (own, cross, force, coupling))


def back_substitute(found: Eliminated, arms: Array, linked: Array) -> Array:
    """Return the directions of objects, [k, 6], by those of the arms' joints, [a, m]; `linked` as in `eliminate`."""
    k, a = found.touched.shape

    def one(directions: Array, row: Any) -> tuple[Array, None]:
        j, left, factor, touched = row
        left = for_each(touched, lambda left, arm: left - found.coupling[a * j + arm] @ arms[arm], left)

        def others(left: Array) -> Array:
            def less(left: Array, i: Array) -> Array:
                return left - _block(found.cross, k * j + i) @ directions[i]

            return for_each(_after(j, found.cross, j, k), less, left)

        if k > 1:
            left = when(linked, others, left)
        return put(directions, j, back(factor, left)), None

    rows = jnp.arange(k), found.force, found.factor, found.touched
    if not k:
        return found.force
    return jax.lax.scan(one, jnp.zeros((k, 6)), rows, reverse=True)[0]


def _after(i: Array, cross: Array, j: Array, k: int) -> Array:
    """Return which objects follow object i and touch object j, [k] bool."""
    found: Array = jax.lax.map(lambda n: (n > i) & (_block(cross, k * j + n) != 0).any(), jnp.arange(k))
    return found


def _block(cross: Array, number: Array) -> Array:
    """Return one of the blocks [6, 6] of a flat array."""
    return jax.lax.dynamic_slice(cross, (36 * number,), (36,)).reshape(6, 6)


def _put_block(cross: Array, number: Array, block: Array) -> Array:
    return jax.lax.dynamic_update_slice(cross, block.ravel(), (36 * number,))
