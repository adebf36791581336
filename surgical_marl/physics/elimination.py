"""Objects are eliminated from a linear system: each alone, or by blocks of six where some touch each other."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.lax.linalg import triangular_solve

from surgical_marl.physics.factor import cholesky
from surgical_marl.physics.rows import room


class Eliminated(NamedTuple):
    """The Cholesky factor of the matrix of k objects, and what it divides."""

    factor: Array
    """Blocks on the diagonal, lower, [k, 6, 6]."""
    half: Array
    """Forces on objects, divided by the factor, [k, 6]."""
    wide: Array
    """How they fall with the acceleration of arms, likewise, [k, a, 6, m]."""
    above: Array
    """Blocks of the factor's transpose: of each object with those after it, [k, k, 6, 6]. Not read if none touch."""


def apart(own: Array, force: Array, coupling: Array, coupled: Array) -> Eliminated:
    """Return the factor of objects of which no two touch.

    Args:
        own: each object's block, [k, 6, 6].
        force: forces on the objects, [k, 6].
        coupling: how they fall with the acceleration of arms, [k, a, 6, m].
        coupled: which objects touch an arm, [k].
    """

    def one(row: Any) -> Any:
        own, force, coupling, coupled = row
        factor = cholesky(own)
        wide = coupling
        if coupling.size:
            divided = lambda coupling: _on_arms(factor, coupling)  # noqa: E731
            wide = jax.lax.cond(coupled, divided, jnp.zeros_like, coupling)
        return factor, _divided(factor, force[:, None])[:, 0], wide

    factor, half, wide = jax.lax.map(one, (own, force, coupling, coupled))
    return Eliminated(factor, half, wide, room(jnp.zeros((len(own), 6, 6)), len(own)))


def ways_apart(found: Eliminated, arms: Array, coupled: Array) -> Array:
    """Return the ways [k, 6] of objects of which no two touch, by those of the arms' joints [a, m]."""

    def one(row: Any) -> Array:
        factor, half, wide, coupled = row
        less = lambda half: half - jnp.einsum("acm,am->c", wide, arms)  # noqa: E731
        left = jax.lax.cond(coupled, less, lambda half: half, half) if len(arms) else half
        return _back(factor, left)

    ways: Array = jax.lax.map(one, (found.factor, found.half, found.wide, coupled))
    return ways


def touching(own: Array, pairs: Array, force: Array, coupling: Array) -> Eliminated:
    """Return the factor of objects of which some touch.

    Arguments are those of `apart`, and `pairs` [k, k, 6, 6]: the blocks of two objects. Those that are 0 cost nothing.
    """
    k = len(own)

    def row(j: Array, left: Eliminated) -> Eliminated:
        factor = cholesky(left.factor[j])
        half, wide = _divided(factor, left.half[j][:, None])[:, 0], left.wide[j]
        if coupling.size:
            wide = _on_arms(factor, wide)
        done = left.factor.at[j].set(factor), left.half.at[j].set(half), left.wide.at[j].set(wide)

        def subtract(i: Array, left: Eliminated) -> Eliminated:
            block = _divided(factor, left.above[j, i])

            def between(n: Array, above: Array) -> Array:
                return above.at[n, i].add(-(above[j, n].T @ block))

            return Eliminated(
                left.factor.at[i].add(-(block.T @ block)),
                left.half.at[i].add(-(block.T @ half)),
                left.wide.at[i].add(-jnp.einsum("dc,adm->acm", block, wide)) if coupling.size else left.wide,
                jax.lax.fori_loop(j + 1, i, between, left.above.at[j, i].set(block)),
            )

        def one(i: Array, left: Eliminated) -> Eliminated:
            joined = (left.above[j, i] != 0).any()
            return jax.lax.cond(joined, lambda left: subtract(i, left), lambda left: left, left)

        return jax.lax.fori_loop(j + 1, k, one, Eliminated(*done, left.above))

    found: Eliminated = jax.lax.fori_loop(0, k, row, Eliminated(own, force, coupling, pairs))
    return found


def ways_touching(found: Eliminated, arms: Array) -> Array:
    """Return the ways [k, 6] of objects of which some touch, by those of the arms' joints [a, m]."""
    k = len(found.half)

    def one(n: Array, ways: Array) -> Array:
        j = k - 1 - n
        left = found.half[j] - jnp.einsum("icd,id->c", found.above[j], ways)  # those up to j are still 0
        if len(arms):
            left -= jnp.einsum("acm,am->c", found.wide[j], arms)
        return ways.at[j].set(_back(found.factor[j], left))

    ways: Array = jax.lax.fori_loop(0, k, one, jnp.zeros((k, 6)))
    return ways


def _divided(factor: Array, right: Array) -> Array:
    return triangular_solve(factor, right, left_side=True, lower=True)


def _back(factor: Array, left: Array) -> Array:
    return triangular_solve(factor, left[:, None], left_side=True, lower=True, transpose_a=True)[:, 0]


def _on_arms(factor: Array, coupling: Array) -> Array:
    """Return what couples an object to arms [a, 6, m], divided by its factor."""
    a, _, m = coupling.shape
    wide = _divided(factor, jnp.moveaxis(coupling, 0, 1).reshape(6, a * m))
    return jnp.moveaxis(wide.reshape(6, a, m), 1, 0)
