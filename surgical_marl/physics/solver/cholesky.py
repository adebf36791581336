"""Symmetric matrices: lower halves, Cholesky factors that survive float32, and linear systems that these solve."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.lax.linalg import triangular_solve
from jax.scipy.linalg import cho_solve

LEAST = 1e-7
"""Least pivot, as a share of the element of the diagonal that it is left of. What is smaller is rounding: of a light
object in a stiff contact, the eigenvalues lie a million times apart."""


def packed(n: int) -> np.ndarray:
    """Return where each element of a symmetric matrix [n, n] is among those of its lower half, row by row."""
    places = np.zeros((n, n), int)
    rows, columns = np.tril_indices(n)
    places[rows, columns] = places[columns, rows] = np.arange(len(rows))
    return places


LOWER, FULL = np.tril_indices(3), packed(3)
"""Indices by which a symmetric matrix [3, 3] becomes its lower half [6], row by row, and that the matrix again."""


def cholesky(matrix: Array) -> Array:
    """Return the lower factor [n, n] of a symmetric matrix [n, n].

    Pivots are kept above what rounding leaves of them, so that the factor is finite where `jnp.linalg.cholesky` returns
    NaN, and is that of a matrix with a slightly larger diagonal. Elsewhere both are the same.
    """
    n, left, columns = len(matrix), matrix, []
    for j in range(n):
        pivot = jnp.sqrt(jnp.maximum(left[0, 0], LEAST * matrix[j, j]))
        below = left[1:, 0] * (1 / pivot)
        columns.append(jnp.concatenate([jnp.zeros(j), pivot[None], below]))
        left = left[1:, 1:] - below[:, None] * below
    return jnp.stack(columns, 1)


def forward(factor: Array, right: Array) -> Array:
    """Return x [n] or [n, k] with factor @ x = right, for a lower factor [n, n]."""
    columns = right.reshape(len(right), -1)
    return triangular_solve(factor, columns, left_side=True, lower=True).reshape(right.shape)


def back(factor: Array, right: Array) -> Array:
    """Return x [n] or [n, k] with factor.T @ x = right, for a lower factor [n, n]."""
    columns = right.reshape(len(right), -1)
    return triangular_solve(factor, columns, left_side=True, lower=True, transpose_a=True).reshape(right.shape)


def solve_factored(factor: Array, right: Array) -> Array:
    """Return x [n] or [n, k] with factor @ factor.T @ x = right, for a lower factor [n, n]."""
    return back(factor, forward(factor, right))


def solve_positive(matrix: Array, right: Array) -> Array:
    """Return x [n] or [n, k] with matrix @ x = right, for a symmetric positive definite matrix [n, n].

    Pivots are not guarded as in `cholesky`: matrices of arms are far from singular.
    """
    return cho_solve((jax.lax.linalg.cholesky(matrix, symmetrize_input=False), True), right)


def woodbury(
    system: Callable[[Any], tuple[Array, Array, Array]], arms: Any, rank: int, sign: float
) -> tuple[Array, Array, Array]:
    """Return right sides [a, m], factors of blocks [a, m, m] and shares [r], which solve for arms that few rows join.

    The matrix of all arms is B + sign * W.T @ W, where B has one block for each arm and W has `rank` rows. By
    Woodbury's identity (W. Hager, "Updating the inverse of a matrix", SIAM Review 31, 1989) the solution for the right
    side e is that of B @ x = e - W.T @ share. So no matrix is larger than that of an arm, and arms share one loop.

    Args:
        system: from one row of `arms` to an arm's block of B [m, m], its part of e [m], and its columns of W [r, m].
        arms: a tree of arrays [a, ...].
        rank: number of rows of W, r.
        sign: 1.0 or -1.0.
    """

    def factorise(sums: tuple[Array, Array], arm: Any) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        matrix, excess, across = system(arm)
        factor = cholesky(matrix)
        eased = forward(factor, jnp.concatenate([excess[:, None], across.T], 1))
        joined = eased[:, 1:].T @ eased[:, 1:]
        matrix = sums[0] + joined if sign > 0 else sums[0] - joined
        return (matrix, sums[1] + eased[:, 1:].T @ eased[:, 0]), (excess, factor)

    (matrix, right), (excess, factors) = jax.lax.scan(factorise, (jnp.eye(rank), jnp.zeros(rank)), arms)
    share = solve_factored(cholesky(matrix), right)
    return excess, factors, share if sign > 0 else -share
