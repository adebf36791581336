"""The Newton step of arms, once objects are eliminated from it."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.factor import packed
from surgical_marl.physics.solver import JointRows, Rows, rows_of, solve

ITERATIONS = (6, 4)
"""Newton steps for arms alone at most, and line search steps in each, while contacts are linear functions."""


class Reduced(NamedTuple):
    """What is left to be solved for n joints of a arms with m joints each, after k objects."""

    stiff: Array
    """How forces fall with the acceleration of joints, but for what objects do, [n, n]."""
    force: Array
    """Forces that are left over, [n]."""
    start: Array
    """Acceleration of joints, [n]."""
    rows: Rows
    """Friction and limits of joints."""
    joints: JointRows
    """The same by joint."""
    half: Array
    """Forces left over on objects, divided by the Cholesky factor of how these fall, [k, 6]."""
    wide: Array
    """How forces on objects fall with the acceleration of joints, likewise, [k, a, 6, m]."""
    touched: Array
    """Which objects touch which arms, [k, a]."""


class Arms:
    """Solves for the ways of arms. `dofs` [a, m] are the numbers of their joints, as for `Newton`."""

    def __init__(self, dofs: np.ndarray, joints: int) -> None:
        self._dofs, self._none = dofs, dofs == joints

    def together(self, left: Reduced) -> Array:
        """Return the way [n] of arms that objects, or contacts of arms with arms, join."""

        def subtract(total: tuple[Array, Array], row: Any) -> tuple[tuple[Array, Array], None]:
            half, each, touched = row

            def less(total: tuple[Array, Array]) -> tuple[Array, Array]:
                wide = jnp.zeros((6, len(left.force)))
                for arm, (dofs, none) in enumerate(zip(self._dofs, self._none, strict=True)):
                    wide = wide.at[:, dofs[~none]].set(each[arm][:, ~none])
                return total[0] - wide.T @ wide, total[1] - wide.T @ half

            return jax.lax.cond(touched.any(), less, lambda total: total, total), None

        (stiff, force), _ = jax.lax.scan(subtract, (left.stiff, left.force), (left.half, left.wide, left.touched))
        return _way(stiff, force, left.rows, left.start)

    def each(self, left: Reduced) -> Array:
        """Return the way [n] of arms of which no two are joined: one problem after the other, no larger than an arm."""
        n, m, pad = len(left.force), self._dofs.shape[1], lambda x: jnp.pad(x, [(0, 1)] * x.ndim)
        one_, other = np.tril_indices(m)
        blocks = pad(left.stiff)[self._dofs[:, one_], self._dofs[:, other]]
        blocks = jnp.where(self._none[:, one_] | self._none[:, other], (one_ == other).astype(np.float32), blocks)

        def one(row: Any) -> Array:
            arm, stiff, force, joints, start = row

            def subtract(total: tuple[Array, Array], of_object: Any) -> tuple[tuple[Array, Array], None]:
                half, wide, touched = of_object
                less = lambda total: (total[0] - wide[arm].T @ wide[arm], total[1] - wide[arm].T @ half)  # noqa: E731
                return jax.lax.cond(touched[arm], less, lambda total: total, total), None

            start_at = stiff[packed(m)], force
            (stiff, force), _ = jax.lax.scan(subtract, start_at, (left.half, left.wide, left.touched))
            return _way(stiff, force, rows_of(joints), start)

        by_arm = lambda x: pad(x)[self._dofs]  # noqa: E731
        each = blocks, by_arm(left.force), jax.tree.map(by_arm, left.joints), by_arm(left.start)
        found = jax.lax.map(one, (jnp.arange(len(self._dofs)), *each))
        return jnp.zeros(n + 1).at[self._dofs].set(found)[:n]


def _way(stiff: Array, force: Array, rows: Rows, start: Array) -> Array:
    """Return the way from an acceleration to the one at which these forces balance with those of joints."""
    return solve(stiff, stiff @ start + force, rows, start, *ITERATIONS, steady=1)[0] - start
