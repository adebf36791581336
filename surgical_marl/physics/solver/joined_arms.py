"""The direction of arms that one object joins: each arm is factorised alone, and six rows of the object join them.

Without the object, the matrix of all arms has one block for each arm. The object takes W.T @ W from it, where W is its
eliminated coupling (`schur.py`), six rows. `cholesky.woodbury` solves this in a loop over arms.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.solver.cholesky import solve_factored, woodbury
from surgical_marl.physics.solver.constraint_rows import JointRows, Rows, giving, rows_of, unbounded_forces
from surgical_marl.physics.solver.newton import line_search, newton


class ArmBlocks(NamedTuple):
    """The systems of a arms with m joints each at most, each without the others."""

    number: Array
    """[a]"""
    stiff: Array
    """Lower halves of their matrices, without the object, [a, m (m + 1) / 2]."""
    force: Array
    """All forces at `here`, but for friction and limits of joints, [a, m]."""
    joints: JointRows
    """Friction and limits of joints, [a, m]."""
    here: Array
    """The acceleration that directions lead from, [a, m]."""


class _State(NamedTuple):
    directions: Array
    """[a, m]"""
    moved: Array
    """W times the directions, [6]."""


class JoinedArms:
    """Newton's method for the directions of arms that one object joins.

    Args:
        own: the system of each arm.
        wide: from the number of an arm to its columns of W, [6, m].
        resisted: from accelerations [a, m], directions [a, m] and a length to the slope of friction and limits of
            joints there, and by how much it grows per length.
        places: where each element of an arm's matrix is in its lower half, [m, m].
    """

    def __init__(
        self,
        own: ArmBlocks,
        wide: Callable[[Array], Array],
        resisted: Callable[[Array, Array, Array], tuple[Array, Array]],
        places: np.ndarray,
    ) -> None:
        self._own, self._wide, self._resisted, self._places = own, wide, resisted, places

    def solve(self, begin: Array, iterations: int) -> Array:
        """Return the directions [a, m] after at most `iterations` Newton steps; the last is whole and changes no side.

        The first of them begins at the directions `begin` [a, m].
        """

        def add(moved: Array, row: tuple[Array, Array]) -> tuple[Array, None]:
            number, direction = row
            return moved + self._wide(number) @ direction, None

        moved, _ = jax.lax.scan(add, jnp.zeros(6), (self._own.number, begin))
        found: _State = newton(self._step, _State(begin, moved), iterations)
        return found.directions

    def _step(self, state: _State, _: Array) -> tuple[_State, Array]:
        """Return the state after a Newton step, and whether it was whole and changed no side."""
        excess, factors, share = self._factorise(state)

        def step_of(sums: tuple[Array, Array, Array], row: Any) -> tuple[tuple[Array, Array, Array], Array]:
            own, direction, excess, factor = row
            across, (rows, force) = self._wide(own.number), _rows(own, direction)  # again: quicker than to keep them
            step = solve_factored(factor, excess - across.T @ share)
            end = force - rows.impedance * (rows.jacobian @ step)
            kept = ((force > rows.low) == (end > rows.low)) & ((force < rows.high) == (end < rows.high))
            moved, begin, whole = sums
            return (moved + across @ step, begin - excess @ step, whole & kept.all()), step

        start = jnp.zeros(6), jnp.float32(0.0), jnp.bool_(True)
        (moved, begin, whole), steps = jax.lax.scan(step_of, start, (self._own, state.directions, excess, factors))

        def part() -> Any:
            return self._length(state, steps, moved, begin)

        length = jax.lax.cond(whole, lambda: jnp.float32(1.0), part)
        return _State(state.directions + length * steps, state.moved + length * moved), whole

    def _factorise(self, state: _State) -> tuple[Array, Array, Array]:
        """Return the forces left over [a, m], the factors of the arms' matrices [a, m, m], and the shares [6]."""

        def system(row: Any) -> tuple[Array, Array, Array]:
            own, direction = row
            matrix, across, (rows, force) = own.stiff[self._places], self._wide(own.number), _rows(own, direction)
            excess = own.force + rows.jacobian.T @ jnp.clip(force, rows.low, rows.high)
            excess += across.T @ state.moved - matrix @ direction
            gives = giving(rows, force)
            return matrix + rows.jacobian.T @ (gives[:, None] * rows.jacobian), excess, across

        return woodbury(system, (self._own, state.directions), 6, -1.0)

    def _length(self, state: _State, steps: Array, moved: Array, begin: Array) -> Array:
        """Return how far to go along steps [a, m], by which W moves `moved` [6]; `begin` is the slope before them."""

        def add(sums: tuple[Array, Array], row: Any) -> tuple[tuple[Array, Array], None]:
            own, direction, step = row
            spread = own.stiff[self._places] @ step
            return (sums[0] + direction @ spread - own.force @ step, sums[1] + step @ spread), None

        none = jnp.float32(0.0)
        (slope, growth), _ = jax.lax.scan(add, (none, none), (self._own, state.directions, steps))
        slope, growth = slope - state.moved @ moved, growth - moved @ moved
        here = self._own.here + state.directions

        def measure(length: Array) -> tuple[Array, Array]:
            resists, gives = self._resisted(here, steps, length)
            return slope + length * growth + resists, growth + gives

        return line_search(begin, 0.0, measure).length


def _rows(own: ArmBlocks, direction: Array) -> tuple[Rows, Array]:
    """Return friction and limits of an arm's joints as rows, and their forces without bounds after a step."""
    rows = rows_of(own.joints)
    return rows, unbounded_forces(rows, own.here + direction)
