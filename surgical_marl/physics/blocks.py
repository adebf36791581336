"""A symmetric matrix of all joints of a arms, in blocks of m by m, and its Cholesky factor, in loops over blocks.

Each row is kept as one vector of m numbers for each arm, and only those up to the diagonal mean anything. Below these
rows is another one, which becomes the right side of an equation: what makes rows those of the factor divides it by the
factor, too. All of it is one array [a m + 1, a, m], and the code is the same for any number of arms.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.factor import back, cholesky, forward, packed


class Blocks:
    """Matrices of a arms with m joints each."""

    def __init__(self, arms: int, joints: int) -> None:
        self._arms, self._joints = np.arange(arms, dtype=np.int32), np.arange(joints, dtype=np.int32)
        self._rows = np.arange(arms * joints + 1, dtype=np.int32)

    def of_arms(self, own: Array) -> Array:
        """Return the matrix in which arms are not joined, from the lower half of each arm's block [a, ...]."""
        empty = jnp.zeros((self._rows.size, self._arms.size, self._joints.size))

        def put_block(matrix: Array, i: Array) -> tuple[Array, None]:
            return self._put_block(matrix, i, i, own[i][packed(self._joints.size)]), None

        return jax.lax.scan(put_block, empty, self._arms)[0]

    def add(self, matrix: Array, joins: Array, of_row: Callable[[Array, Array], Callable[[Array], Array]]) -> Array:
        """Return a matrix with something more in the blocks of some arms.

        Args:
            matrix: as all functions here return it.
            joins: which arms it concerns, [a] bool.
            of_row: from the numbers of an arm and of its joint, [] each, to what is added to that row: a function of
                the number of another arm that returns m numbers.
        """
        m = self._joints.size

        def to_row(matrix: Array, row: Array) -> tuple[Array, None]:
            i = row // m

            def to_blocks(matrix: Array) -> Array:
                more = of_row(i, row - m * i)

                def to_block(matrix: Array, j: Array) -> tuple[Array, None]:
                    added = lambda matrix: self._put(matrix, row, j, self._at(matrix, row, j) + more(j))  # noqa: E731
                    return jax.lax.cond((j <= i) & joins[j], added, lambda matrix: matrix, matrix), None

                return jax.lax.scan(to_block, matrix, self._arms)[0]

            return jax.lax.cond(joins[i], to_blocks, lambda matrix: matrix, matrix), None

        return jax.lax.scan(to_row, matrix, self._rows[:-1])[0]

    def step(self, matrix: Array, gives: Array, excess: Array) -> Array:
        """Return x [a, m] with (matrix + diag(gives)) @ x = excess; `gives` and `excess` [a, m]."""
        last = self._rows[-1]

        def fill(matrix: Array, i: Array) -> tuple[Array, None]:
            block = self._block(matrix, i, i) + jnp.diag(gives[i])
            return self._put(self._put_block(matrix, i, i, block), last, i, excess[i]), None

        def solve(ways: Array, j: Array) -> tuple[Array, None]:
            def subtract(left: Array, k: Array) -> tuple[Array, None]:
                less = lambda left: left - ways[k] @ self._block(matrix, k, j)  # noqa: E731
                return jax.lax.cond(k > j, less, lambda left: left, left), None

            left = jax.lax.scan(subtract, self._at(matrix, last, j), self._arms)[0]
            return ways.at[j].set(back(self._block(matrix, j, j), left), mode="promise_in_bounds"), None

        matrix = jax.lax.scan(self._eliminate, jax.lax.scan(fill, matrix, self._arms)[0], self._arms)[0]
        found: Array = jax.lax.scan(solve, jnp.zeros_like(excess), self._arms, reverse=True)[0]
        return found

    def _eliminate(self, matrix: Array, j: Array) -> tuple[Array, None]:
        """Make the columns of an arm those of the factor, and take what they leave from all below and to the right."""
        factor = cholesky(self._block(matrix, j, j))
        matrix, m = self._put_block(matrix, j, j, factor), self._joints.size

        def divide(matrix: Array, row: Array) -> tuple[Array, None]:
            divided = lambda matrix: self._put(matrix, row, j, forward(factor, self._at(matrix, row, j)))  # noqa: E731
            return jax.lax.cond(row >= m * (j + 1), divided, lambda matrix: matrix, matrix), None

        def subtract(matrix: Array, row: Array) -> tuple[Array, None]:
            def from_blocks(matrix: Array) -> Array:
                own = self._at(matrix, row, j)

                def from_block(matrix: Array, k: Array) -> tuple[Array, None]:
                    less = lambda matrix: self._put(  # noqa: E731
                        matrix, row, k, self._at(matrix, row, k) - self._block(matrix, k, j) @ own
                    )
                    return jax.lax.cond((k > j) & (m * k <= row), less, lambda matrix: matrix, matrix), None

                return jax.lax.scan(from_block, matrix, self._arms)[0]

            return jax.lax.cond(row >= m * (j + 1), from_blocks, lambda matrix: matrix, matrix), None

        matrix = jax.lax.scan(divide, matrix, self._rows)[0]
        return jax.lax.scan(subtract, matrix, self._rows)[0], None

    def _at(self, matrix: Array, rows: Array, j: Array) -> Array:
        """Return the numbers of an arm in some rows, [..., m]."""
        return matrix.at[rows, j].get(mode="promise_in_bounds")

    def _put(self, matrix: Array, rows: Array, j: Array, numbers: Array) -> Array:
        return matrix.at[rows, j].set(numbers, mode="promise_in_bounds")

    def _block(self, matrix: Array, i: Array, j: Array) -> Array:
        """Return the block of two arms, [m, m]."""
        return self._at(matrix, self._joints.size * i + self._joints, j)

    def _put_block(self, matrix: Array, i: Array, j: Array, block: Array) -> Array:
        return self._put(matrix, self._joints.size * i + self._joints, j, block)
