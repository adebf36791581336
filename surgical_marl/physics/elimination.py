"""Objects are eliminated from a linear system: each alone, or by blocks of six where some touch each other."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.lax.linalg import triangular_solve

from surgical_marl.physics.factor import cholesky, packed
from surgical_marl.physics.rows import absent


class Eliminated(NamedTuple):
    """What the elimination of k objects leaves of their rows."""

    half: Array
    """Forces on objects, divided by the Cholesky factor of the objects' matrix, [k, 6]."""
    wide: Array
    """How they fall with the acceleration of arms, likewise, [k, a, 6, m]."""
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


def eliminate(blocks: Blocks, force: Array, coupling: Array, coupled: Array, linked: Array) -> Eliminated:
    """Return what is left of objects.

    Args:
        blocks: how forces fall with accelerations.
        force: forces on the objects, [k, 6].
        coupling: how they fall with the acceleration of arms, [k, a, 6, m].
        coupled: which objects touch an arm, [k].
        linked: whether any objects touch each other, [].
    """
    alone = lambda: apart(blocks.own, force, coupling, coupled)  # noqa: E731
    if len(force) < 2:
        return alone()
    return jax.lax.cond(linked, lambda: touching(blocks, force, coupling), alone)


def ways(found: Eliminated, arms: Array, coupled: Array, linked: Array) -> Array:
    """Return the ways [k, 6] of objects, by those of the arms' joints [a, m]; the rest as for `eliminate`."""
    alone = lambda: ways_apart(found, arms, coupled)  # noqa: E731
    if len(coupled) < 2:
        return alone()
    return jax.lax.cond(linked, lambda: ways_touching(found, arms), alone)


def apart(own: Array, force: Array, coupling: Array, coupled: Array) -> Eliminated:
    """Return what is left of objects of which no two touch.

    Args:
        own: the lower half of each object's block, [k, 21].
        force: forces on the objects, [k, 6].
        coupling: how they fall with the acceleration of arms, [k, a, 6, m].
        coupled: which objects touch an arm, [k].
    """

    def one(row: Any) -> Any:
        own, force, coupling, coupled = row
        factor = cholesky(own[packed(6)])
        wide = coupling
        if coupling.size:
            divided = lambda coupling: _on_arms(factor, coupling)  # noqa: E731
            wide = jax.lax.cond(coupled, divided, jnp.zeros_like, coupling)
        return _divided(factor, force), wide, factor

    rows = absent(jax.ShapeDtypeStruct((_size(coupling) if len(own) > 1 else 0,), force.dtype))
    half, wide, factor = jax.lax.map(one, (own, force, coupling, coupled))
    return Eliminated(half, wide, factor, rows)


def ways_apart(found: Eliminated, arms: Array, coupled: Array) -> Array:
    """Return the ways [k, 6] of objects of which no two touch, by those of the arms' joints [a, m]."""

    def one(row: Any) -> Array:
        half, wide, factor, coupled = row
        less = lambda half: half - jnp.einsum("acm,am->c", wide, arms)  # noqa: E731
        left = jax.lax.cond(coupled, less, lambda half: half, half) if len(arms) else half
        return _back(factor, left)

    found_ways: Array = jax.lax.map(one, (found.half, found.wide, found.factor, coupled))
    return found_ways


def touching(blocks: Blocks, force: Array, coupling: Array) -> Eliminated:
    """Return what is left of objects of which some touch each other. What is 0 costs little.

    A row of blocks is kept as columns of six: those of all objects, the force, and those of all arms. All rows are one
    array, [k * columns * 6], and what works on a column is in a loop: so the code is the same for any number of them.
    """
    k, a, _, m = coupling.shape
    count, width = jnp.arange(k), _size(coupling) // (6 * k)

    def note(rows: Array, row: Any) -> tuple[Array, None]:
        j, own, force, coupling = row

        def other(rows: Array, i: Array) -> tuple[Array, None]:
            at = 36 * (k * jnp.minimum(i, j) + jnp.maximum(i, j))
            block = jax.lax.dynamic_slice(blocks.cross, (at,), (36,)).reshape(6, 6)
            block = jnp.where(i == j, own[packed(6)], jnp.where(i < j, block, block.T))  # its columns, one by one
            return _put(rows, j * width + 6 * i, block), None

        rows = jax.lax.scan(other, rows, count)[0]
        columns = jnp.concatenate([force, jnp.moveaxis(coupling, 1, 2).ravel()])
        return _put(rows, j * width + 6 * k, columns), None

    def eliminate(rows: Array, j: Array) -> tuple[Array, None]:
        diagonal = j * (width + 6)
        factor = cholesky(_columns(rows, diagonal, 6))

        def divide(rows: Array, at: Array) -> tuple[Array, None]:
            column = _columns(rows, at, 1)[0]
            divided = lambda rows: _put(rows, at, _divided(factor, column))  # noqa: E731
            return jax.lax.cond((column != 0).any(), divided, lambda rows: rows, rows), None

        def subtract(rows: Array, i: Array) -> tuple[Array, None]:
            block = _columns(rows, j * width + 6 * i, 6)

            def column(rows: Array, c: Array) -> tuple[Array, None]:
                at = i * width + c
                less = _columns(rows, at, 1)[0] - block @ _columns(rows, j * width + c, 1)[0]
                return _put(rows, at, less), None

            all_ = lambda rows: jax.lax.scan(column, rows, jnp.arange(width))[0]  # noqa: E731
            return jax.lax.cond((i > j) & (block != 0).any(), all_, lambda rows: rows, rows), None

        rows = jax.lax.scan(divide, rows, j * width + jnp.arange(width))[0]
        rows = _put(rows, diagonal, factor)
        return jax.lax.scan(subtract, rows, count)[0], None

    start = absent(jax.ShapeDtypeStruct((_size(coupling),), force.dtype))
    rows = jax.lax.scan(note, start, (count, blocks.own, force, coupling))[0]
    rows = jax.lax.scan(eliminate, rows, count)[0]
    parts = rows.reshape(k, width, 6)
    wide = jnp.moveaxis(parts[:, 6 * k + 1 :].reshape(k, a, m, 6), 2, 3)
    return Eliminated(parts[:, 6 * k], wide, absent(jax.ShapeDtypeStruct((k, 6, 6), force.dtype)), rows)


def ways_touching(found: Eliminated, arms: Array) -> Array:
    """Return the ways [k, 6] of objects of which some touch each other, by those of the arms' joints [a, m]."""
    k, rows = len(found.half), found.rows
    width = rows.size // (6 * k)

    def one(ways: Array, j: Array) -> tuple[Array, None]:
        def add(total: Array, c: Array) -> tuple[Array, None]:
            return total - ways[c] * _columns(rows, j * width + c, 1)[0], None

        left = jax.lax.scan(add, jnp.zeros(6), jnp.arange(width))[0]  # those up to j are still 0
        factor = _columns(rows, j * (width + 6), 6)
        return jax.lax.dynamic_update_slice(ways, _back(factor, left), (6 * j,)), None

    all_ = jnp.concatenate([jnp.zeros(6 * k), -jnp.ones(1), arms.ravel()])
    return jax.lax.scan(one, all_, jnp.arange(k), reverse=True)[0][: 6 * k].reshape(k, 6)


def _size(coupling: Array) -> int:
    """Return how many numbers the rows of `touching` are."""
    k, a, _, m = coupling.shape
    return k * (6 * k + 1 + a * m) * 6


def _columns(rows: Array, at: Array, count: int) -> Array:
    """Return columns from the one with the number `at` on, [count, 6]."""
    return jax.lax.dynamic_slice(rows, (6 * at,), (6 * count,)).reshape(count, 6)


def _put(rows: Array, at: Array, columns: Array) -> Array:
    return jax.lax.dynamic_update_slice(rows, columns.ravel(), (6 * at,))


def _divided(factor: Array, right: Array) -> Array:
    return triangular_solve(factor, right[:, None], left_side=True, lower=True)[:, 0]


def _back(factor: Array, left: Array) -> Array:
    return triangular_solve(factor, left[:, None], left_side=True, lower=True, transpose_a=True)[:, 0]


def _on_arms(factor: Array, coupling: Array) -> Array:
    """Return what couples an object to arms [a, 6, m], divided by its factor."""
    a, _, m = coupling.shape
    wide = jnp.moveaxis(coupling, 0, 1).reshape(6, a * m)
    wide = triangular_solve(factor, wide, left_side=True, lower=True)
    return jnp.moveaxis(wide.reshape(6, a, m), 1, 0)
