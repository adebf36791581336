"""Objects are eliminated from a linear system: each alone, or by blocks of six where some touch each other."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.solver.cholesky import back, cholesky, forward, packed
from surgical_marl.physics.tree_utils import absent, put


class Eliminated(NamedTuple):
    """What the elimination of k objects leaves of their rows."""

    half: Array
    """Forces on objects, divided by the Cholesky factor of the objects' matrix, [k, 6]."""
    wide: Array
    """How they fall with the acceleration of arms, likewise: that of object o with arm i is row a o + i,
    [(k + 1) a, 6, m]. Nothing where they don't touch, unless objects touch each other, and for the object k."""
    factor: Array
    """Blocks on the factor's diagonal, lower, [k, 6, 6]: of objects that touch no other."""
    rows: Array
    """Of objects that touch each other, all that the elimination leaves: see `touching`. None of it is there of
    others."""


class Blocks(NamedTuple):
    """A symmetric matrix of objects: how forces on each of them fall with the accelerations of all."""

    own: Array
    """The lower half of each object's own block, [k, 21]."""
    cross: Array
    """The block of objects i and j of each pair `i < j`, from 36 (k i + j) on; only read of objects that touch."""


def eliminate(blocks: Blocks, force: Array, coupling: Array, touched: Array, linked: Array) -> Eliminated:
    """Return what is left of objects.

    Args:
        blocks: how forces fall with accelerations.
        force: forces on the objects, [k, 6].
        coupling: how they fall with the acceleration of arms, [(k + 1) a, 6, m]: see `Eliminated.wide`. Only read where
            an object touches an arm.
        touched: which objects touch which arms, [k, a].
        linked: whether any objects touch each other, [].
    """

    def alone(coupling: Any) -> Any:
        return apart(blocks.own, force, coupling, touched)

    if len(force) < 2:
        return alone(coupling)
    return jax.lax.cond(linked, lambda coupling: touching(blocks, force, coupling, touched), alone, coupling)


def back_substitute(found: Eliminated, arms: Array, touched: Array, linked: Array) -> Array:
    """Return the directions [k, 6] of objects, by those of the arms' joints [a, m]; the rest as for `eliminate`."""

    def alone() -> Any:
        return substituted_apart(found, arms, touched)

    if len(touched) < 2:
        return alone()
    return jax.lax.cond(linked, lambda: substituted_touching(found, arms), alone)


def apart(own: Array, force: Array, coupling: Array, touched: Array) -> Eliminated:
    """Return what is left of objects of which no two touch; arguments as for `eliminate`.

    `own` [k, 21] is the lower half of each object's block.
    """
    (k, a), m = touched.shape, coupling.shape[2]

    def one(wide: Array, row: Any) -> tuple[Array, tuple[Array, Array]]:
        i, own, force, touched = row
        factor = cholesky(own[packed(6)])

        def of_arm(wide: Array, arm: Array) -> tuple[Array, None]:
            def divided(wide: Any) -> Any:
                return put(wide, a * i + arm, forward(factor, wide[a * i + arm]))

            return jax.lax.cond(touched[arm], divided, lambda wide: wide, wide), None

        if coupling.size:
            wide = jax.lax.scan(of_arm, wide, jnp.arange(a))[0]
        return wide, (forward(factor, force), factor)

    rows = absent(jax.ShapeDtypeStruct((_size(k, a, m) if k > 1 else 0,), force.dtype))
    wide, (half, factor) = jax.lax.scan(one, coupling, (jnp.arange(k), own, force, touched))
    return Eliminated(half, wide, factor, rows)


def substituted_apart(found: Eliminated, arms: Array, touched: Array) -> Array:
    """Return the directions [k, 6] of objects of which no two touch, by those of the arms' joints [a, m]."""

    def one(row: Any) -> Array:
        i, half, factor, touched = row

        def of_arm(left: Array, arm: Array) -> tuple[Array, None]:
            def less(left: Any) -> Any:
                return left - found.wide[len(arms) * i + arm] @ arms[arm]

            return jax.lax.cond(touched[arm], less, lambda left: left, left), None

        left = jax.lax.scan(of_arm, half, jnp.arange(len(arms)))[0] if len(arms) else half
        return back(factor, left)

    found_steps: Array = jax.lax.map(one, (jnp.arange(len(touched)), found.half, found.factor, touched))
    return found_steps


def touching(blocks: Blocks, force: Array, coupling: Array, touched: Array) -> Eliminated:
    """Return what is left of objects of which some touch each other. What is 0 costs little.

    A row of blocks is kept as columns of six: those of all objects, the force, and those of all arms. All rows are one
    array, [k * columns * 6], and what works on a column is in a loop: so the code is the same for any number of them.
    """
    (k, a), m = touched.shape, coupling.shape[2]
    count, size = jnp.arange(k), _size(k, a, m)
    width = size // (6 * k)

    def note(rows: Array, row: Any) -> tuple[Array, None]:
        j, own, force, touched = row

        def other(rows: Array, i: Array) -> tuple[Array, None]:
            at = 36 * (k * jnp.minimum(i, j) + jnp.maximum(i, j))
            block = jax.lax.dynamic_slice(blocks.cross, (at,), (36,)).reshape(6, 6)
            block = jnp.where(i == j, own[packed(6)], jnp.where(i < j, block, block.T))  # its columns, one by one
            return _put(rows, j * width + 6 * i, block), None

        rows = jax.lax.scan(other, rows, count)[0]
        rows = _put(rows, j * width + 6 * k, force)

        def of_arm(rows: Array, arm: Array) -> tuple[Array, None]:
            columns = jax.lax.cond(touched[arm], lambda: coupling[a * j + arm].T, lambda: jnp.zeros((m, 6)))
            return _put(rows, j * width + 6 * k + 1 + arm * m, columns), None

        return (jax.lax.scan(of_arm, rows, jnp.arange(a))[0] if a else rows), None

    def eliminate(rows: Array, j: Array) -> tuple[Array, None]:
        diagonal = j * (width + 6)
        factor = cholesky(_columns(rows, diagonal, 6))

        def divide(rows: Array, at: Array) -> tuple[Array, None]:
            column = _columns(rows, at, 1)[0]

            def divided(rows: Any) -> Any:
                return _put(rows, at, forward(factor, column))

            return jax.lax.cond((column != 0).any(), divided, lambda rows: rows, rows), None

        def subtract(rows: Array, i: Array) -> tuple[Array, None]:
            block = _columns(rows, j * width + 6 * i, 6)

            def column(rows: Array, c: Array) -> tuple[Array, None]:
                at = i * width + c
                less = _columns(rows, at, 1)[0] - block @ _columns(rows, j * width + c, 1)[0]
                return _put(rows, at, less), None

            def all_(rows: Any) -> Any:
                return jax.lax.scan(column, rows, jnp.arange(width))[0]

            return jax.lax.cond((i > j) & (block != 0).any(), all_, lambda rows: rows, rows), None

        rows = jax.lax.scan(divide, rows, j * width + jnp.arange(width))[0]
        rows = _put(rows, diagonal, factor)
        return jax.lax.scan(subtract, rows, count)[0], None

    def leave(wide: Array, pair: Array) -> tuple[Array, None]:
        at = pair // a * width + 6 * k + 1 + pair % a * m
        return put(wide, pair, _columns(rows, at, m).T), None

    start = absent(jax.ShapeDtypeStruct((size,), force.dtype))
    rows = jax.lax.scan(note, start, (count, blocks.own, force, touched))[0]
    rows = jax.lax.scan(eliminate, rows, count)[0]
    wide = jax.lax.scan(leave, coupling, jnp.arange(k * a))[0] if a else coupling
    half = jax.lax.map(lambda j: _columns(rows, j * width + 6 * k, 1)[0], count)
    return Eliminated(half, wide, absent(jax.ShapeDtypeStruct((k, 6, 6), force.dtype)), rows)


def substituted_touching(found: Eliminated, arms: Array) -> Array:
    """Return the directions [k, 6] of objects of which some touch, by those of the arms' joints [a, m]."""
    k, rows = len(found.half), found.rows
    width = rows.size // (6 * k)

    def one(directions: Array, j: Array) -> tuple[Array, None]:
        def add(total: Array, c: Array) -> tuple[Array, None]:
            return total - directions[c] * _columns(rows, j * width + c, 1)[0], None

        left = jax.lax.scan(add, jnp.zeros(6), jnp.arange(width))[0]  # those up to j are still 0
        factor = _columns(rows, j * (width + 6), 6)
        return jax.lax.dynamic_update_slice(directions, back(factor, left), (6 * j,)), None

    all_ = jnp.concatenate([jnp.zeros(6 * k), -jnp.ones(1), arms.ravel()])
    return jax.lax.scan(one, all_, jnp.arange(k), reverse=True)[0][: 6 * k].reshape(k, 6)


def _size(k: int, a: int, m: int) -> int:
    """Return how many numbers the rows of `touching` are."""
    return k * (6 * k + 1 + a * m) * 6


def _columns(rows: Array, at: Array, count: int) -> Array:
    """Return columns from the one with the number `at` on, [count, 6]."""
    return jax.lax.dynamic_slice(rows, (6 * at,), (6 * count,)).reshape(count, 6)


def _put(rows: Array, at: Array, columns: Array) -> Array:
    return jax.lax.dynamic_update_slice(rows, columns.ravel(), (6 * at,))
