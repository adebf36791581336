"""Symmetric matrices: lower halves, Cholesky factors of what is positive definite but for float32, and their use."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.lax.linalg import triangular_solve

LEAST = 1e-7
"""Least pivot, as a share of the element of the diagonal that it is left of. What is smaller is rounding: of a light
object in a stiff contact, the eigenvalues lie a million times apart."""


def packed(n: int) -> np.ndarray:
    """Return where each element of a symmetric matrix [n, n] is among those of its lower half, row by row."""
    places = np.zeros((n, n), int)
    rows, columns = np.tril_indices(n)
    places[rows, columns] = places[columns, rows] = np.arange(len(rows))
    return places


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
