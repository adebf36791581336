"""Newton steps of arms that one object joins: each arm is factorised alone, and six numbers of the object join them.

Without the object, the matrix B of all arms has one block for each arm. The object takes W.T @ W from it, where W is
six rows. By Woodbury's identity (W. Hager, "Updating the inverse of a matrix", SIAM Review 31, 1989) the solution x of
(B - W.T @ W) @ x = e is that of B @ x = e + W.T @ z, where (1 - W @ inv(B) @ W.T) @ z = W @ inv(B) @ e. So no matrix is
larger than that of an arm, and all arms share the code of one, in loops.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.factor import back, cholesky, forward


def bridged_step(
    stiff: Array, wide: Callable[[Array], Array], places: np.ndarray, gives: Array, excess: Array
) -> Array:  # fmt: skip
    """Return x [a, m] with (B - W.T @ W + diag(gives)) @ x = excess.

    Args:
        stiff: the lower half of each arm's block of B, [a, m (m + 1) / 2].
        wide: from the number of an arm to its columns of W, [6, m].
        places: where each element of an arm's matrix is in its lower half, [m, m].
        gives: [a, m].
        excess: [a, m].
    """
    numbers = jnp.arange(len(stiff))

    def factorise(sums: tuple[Array, Array], row: Any) -> tuple[tuple[Array, Array], Array]:
        number, stiff, gives, excess = row
        factor = cholesky(stiff[places] + jnp.diag(gives))
        eased = forward(factor, jnp.concatenate([excess[:, None], wide(number).T], 1))
        joined = sums[0] - eased[:, 1:].T @ eased[:, 1:], sums[1] + eased[:, 1:].T @ eased[:, 0]
        return joined, factor

    def step_of(row: Any) -> Array:
        number, excess, factor = row
        return _solved(factor, excess + wide(number).T @ joined)  # `wide` again: quicker than to keep it

    none = jnp.eye(6), jnp.zeros(6)
    (matrix, right), factors = jax.lax.scan(factorise, none, (numbers, stiff, gives, excess))
    joined = _solved(cholesky(matrix), right)
    found: Array = jax.lax.map(step_of, (numbers, excess, factors))
    return found


def _solved(factor: Array, right: Array) -> Array:
    """Return x [n] with factor @ factor.T @ x = right."""
    return back(factor, forward(factor, right))
