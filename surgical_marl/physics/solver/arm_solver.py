"""The Newton step of arms, once objects are eliminated from it.

Arrays have one row for each of a arms, with m numbers for their joints. An arm with fewer joints than others has joints
in its row that are not there: nothing pushes them, and they stay at rest.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.solver.cholesky import packed
from surgical_marl.physics.solver.constraint_rows import JointRows, Rows, row_forces, rows_of, solve
from surgical_marl.physics.solver.joined_arms import ArmBlocks, JoinedArms
from surgical_marl.physics.solver.problem import Problem
from surgical_marl.physics.solver.schur import Eliminated
from surgical_marl.physics.tree_utils import when

ITERATIONS = (6, 4)
"""Newton steps for arms at most, and line search steps in each, while contacts are linear functions."""
ITERATIONS_WITH_ROWS = (6, 6)
"""Newton steps, and line search steps in each, at most, of arms with their contacts as rows
(`python -m docs.studies.solver_iterations`)."""


class ArmSystem(NamedTuple):
    """The linear system of arms, with contacts as linear functions and after the elimination of k objects."""

    stiff: Array
    """Curvature of contacts: their force falls by this per acceleration of joints; lower halves,
    [a, m (m + 1) / 2]."""
    on_arm: Array
    """Arms that have contacts, [a] bool: `stiff` is not defined for others."""
    force: Array
    """Forces of contacts, [a, m]."""
    objects: Eliminated


class _Row(NamedTuple):
    """One arm, or each [a, ...]: fields of `Problem` and `ArmSystem`, and its acceleration `here`."""

    number: Array
    mass: Array
    smooth: Array
    joints: JointRows
    here: Array
    on_arm: Array
    stiff: Array
    force: Array


class ArmSolver:
    """Solves for the directions of arms. `dofs` [a, m] are the numbers of their joints, as for `ContactSolver`.

    Directions lead from an acceleration `here`, and Newton's method begins at an acceleration `begin`, [a, m] each.
    """

    def __init__(self, dofs: np.ndarray, joints: int) -> None:
        self._there, self._dofs, self._joints = dofs < joints, dofs, joints
        self._places, self._all = packed(dofs.shape[1]), packed((dofs < joints).sum())

    def with_rows(
        self, mass: Array, smooth: Array, joints: JointRows, start: Array, between: Rows
    ) -> tuple[Array, Array]:
        """Return the accelerations [a, m] of arms with contacts among themselves alone, and the contacts' forces [r].

        Args:
            mass: lower halves of the arms' mass matrices, [a, m (m + 1) / 2].
            smooth: sums of all other forces, [a, m].
            joints: friction and limits of joints, [a, m].
            start: accelerations where Newton's method begins, [a, m].
            between: contacts of arms with arms; their Jacobian is [r, a, m].
        """
        n, dofs = self._joints, self._dofs

        def by_joint(rows: Array) -> Array:
            return jnp.zeros(n + 1).at[dofs].set(rows)[:n]

        whole = jnp.zeros((n + 1, n + 1)).at[dofs[:, :, None], dofs[:, None]].set(mass[:, self._places])[:n, :n]
        jacobian = jax.vmap(by_joint)(between.jacobian)
        own, contacts = rows_of(JointRows(*map(by_joint, joints))), between._replace(jacobian=jacobian)
        rows = Rows(*(jnp.concatenate(parts) for parts in zip(own, contacts, strict=True)))
        qacc, force = solve(whole, by_joint(smooth), rows, by_joint(start), *ITERATIONS_WITH_ROWS, dofs)
        return jnp.append(qacc, 0.0)[dofs], force[2 * n :]

    def together(self, problem: Problem, here: Array, begin: Array, left: ArmSystem) -> Array:
        """Return the directions [a, m] from an acceleration [a, m] of arms that objects, or contacts of arms, join."""
        there, (first, second), objects = self._there, np.tril_indices(len(self._all)), left.objects

        def flat(each: Array) -> Array:
            return jnp.concatenate([row[own] for row, own in zip(each, there, strict=True)])

        # lower halves: what a loop carries for both halves it would carry, and compute, twice
        stiff = self._lower(problem.mass + jnp.where(left.on_arm[:, None], left.stiff, 0.0))
        force = flat(problem.smooth + left.force)
        start, mass = flat(here), self._lower(problem.mass)[self._all]

        def press(total: tuple[Array, Array], row: Rows) -> tuple[tuple[Array, Array], None]:
            jacobian = flat(row.jacobian)
            pressed = jnp.maximum(row.impedance * (row.reference - jacobian @ start), 0.0)
            whole = jnp.where(pressed > 0, row.impedance, 0.0) * jacobian
            return (total[0] + whole[first] * jacobian[second], total[1] + pressed * jacobian), None

        def subtract(total: tuple[Array, Array], row: Any) -> tuple[tuple[Array, Array], None]:
            i, half, touched = row

            def less(total: tuple[Array, Array]) -> tuple[Array, Array]:
                each = jnp.where(touched[:, None, None], objects.coupling[len(there) * i + np.arange(len(there))], 0.0)
                wide = jnp.concatenate([of_arm[:, own] for of_arm, own in zip(each, there, strict=True)], 1)
                return total[0] - jnp.sum(wide[:, first] * wide[:, second], 0), total[1] - wide.T @ half

            return when(touched.any(), less, total), None

        total = stiff, force - mass @ start
        if len(problem.between.low):
            total = when(problem.overlap, lambda total: jax.lax.scan(press, total, problem.between)[0], total)
        (stiff, force), _ = jax.lax.scan(
            subtract, total, (jnp.arange(len(objects.force)), objects.force, objects.touched)
        )
        joints = rows_of(JointRows(*map(flat, problem.joints)))
        found, rows = _direction_of(stiff[self._all], force, joints, start, flat(begin)), np.cumsum(there.sum(1))
        directions = [
            jnp.zeros(len(own)).at[own].set(direction)
            for own, direction in zip(there, jnp.split(found, rows[:-1]), strict=True)
        ]
        return jnp.stack(directions)

    def each(self, problem: Problem, here: Array, begin: Array, moving: Array, left: ArmSystem) -> Array:
        """Return the directions [a, m] of arms of which no two are joined: one problem after the other.

        Those that are not `moving` [a] have none.
        """
        takes = np.ones(len(left.objects.force), bool)

        def one(each: tuple[_Row, Array, Array]) -> Array:
            row, begin, moves = each

            def direction() -> Array:
                stiff, force = self._alone(left, takes, row)
                return _direction_of(stiff[self._places], force, rows_of(row.joints), row.here, begin)

            return jax.lax.cond(moves, direction, lambda: jnp.zeros_like(row.here))

        found: Array = jax.lax.map(one, (self._rows(problem, here, left), begin, moving))
        return found

    def joined(self, problem: Problem, here: Array, begin: Array, left: ArmSystem) -> Array:
        """Return the directions [a, m] of arms that one object joins and nothing else."""
        a, k = len(self._there), len(left.objects.force)
        joint = jnp.argmax(left.objects.touched.sum(1) > 1)
        rows = self._rows(problem, here, left)
        stiff, force = jax.lax.map(partial(self._alone, left, np.arange(k) != joint), rows)

        def wide(arm: Array) -> Array:
            found = left.objects.coupling[a * joint + arm]
            return found if a == 2 else jnp.where(left.objects.touched[joint, arm], found, 0.0)

        own = ArmBlocks(rows.number, stiff, force, problem.joints, here)
        resisted = partial(self._resisted, problem, np.ones(a, bool))
        return JoinedArms(own, wide, resisted, self._places).solve(begin - here, ITERATIONS[0])

    def _rows(self, problem: Problem, here: Array, left: ArmSystem) -> _Row:
        arms = jnp.arange(len(self._there))
        contacts = left.on_arm, left.stiff, left.force
        return _Row(arms, problem.mass, problem.smooth, problem.joints, here, *contacts)

    def _alone(self, left: ArmSystem, takes: Any, row: _Row) -> tuple[Array, Array]:
        """Return what is left of an arm's matrix, its lower half, and of the forces on it.

        `takes` [k] are those objects that take something from the matrix.
        """
        first, second = np.tril_indices(len(self._places))

        def subtract(total: tuple[Array, Array], of_object: Any) -> tuple[tuple[Array, Array], None]:
            i, half, touched, takes = of_object

            def less(total: tuple[Array, Array]) -> tuple[Array, Array]:
                wide = left.objects.coupling[len(self._there) * i + row.number]

                def lower(whole: Array) -> Array:
                    return whole - jnp.sum(wide[:, first] * wide[:, second], 0)

                return when(takes, lower, total[0]), total[1] - wide.T @ half

            return when(touched[row.number], less, total), None

        whole = jax.lax.cond(row.on_arm, lambda: row.mass + row.stiff, lambda: row.mass)
        total = whole, row.smooth + row.force - row.mass[self._places] @ row.here
        objects = jnp.arange(len(left.objects.force)), left.objects.force, left.objects.touched, jnp.asarray(takes)
        found: tuple[Array, Array] = jax.lax.scan(subtract, total, objects)[0]
        return found

    def slopes(
        self, problem: Problem, moves: Array, here: Array, direction: Array, force: Array
    ) -> tuple[Array, Array, Array]:
        """Return slopes of the cost along directions [a, m] of arms, of which some move [a], [] each.

        The first is that of the whole cost, with forces of contacts [a, m]. The second is the slope, there, of what
        does not depend on contacts, nor on friction and limits; the third is by how much that grows per length.
        """

        def add(sums: tuple[Array, Array, Array], row: Any) -> tuple[tuple[Array, Array, Array], None]:
            moves, lower, smooth, joints, here, direction, force = row

            def more(sums: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
                mass, rows = lower[self._places], rows_of(joints)
                rest = mass @ here - smooth
                whole = rest - force - rows.jacobian.T @ row_forces(rows, here)
                return sums[0] + direction @ whole, sums[1] + direction @ rest, sums[2] + direction @ (mass @ direction)

            return when(moves, more, sums), None

        zero = jnp.float32(0.0)
        rows = moves, problem.mass, problem.smooth, problem.joints, here, direction, force
        whole, slope, growth = jax.lax.scan(add, (zero, zero, zero), rows)[0]
        if len(problem.between.low):
            whole = when(problem.overlap, lambda whole: whole - self._power(problem, here, direction), whole)
        return whole, slope, growth

    def resisted(
        self, problem: Problem, moves: Array, here: Array, direction: Array, length: Array
    ) -> tuple[Array, Array]:
        """Return the slope of friction and limits of joints at a length along directions, and its growth per length.

        Arms that do not move [a] are left out.
        """
        found = self._resisted(problem, moves, here, direction, length)
        if not len(problem.between.low):
            return found

        flat = here.ravel(), direction.ravel()

        def press(sums: tuple[Array, Array], row: Rows) -> tuple[tuple[Array, Array], None]:
            own = Rows(row.jacobian.reshape(1, -1), *(x[None] for x in row[1:]))
            return _added(sums, own, *flat, length), None

        return when(problem.overlap, lambda sums: jax.lax.scan(press, sums, problem.between)[0], found)

    def between(self, problem: Problem, arms: Array) -> Array:
        """Return the forces of contacts of arms with arms at an acceleration [a, m], N, [r]."""
        none = jnp.zeros(len(problem.between.low))
        if not len(none):
            return none

        def pressed(arms: Any) -> Any:
            return row_forces(_flat(problem.between), arms.ravel())

        return jax.lax.cond(problem.overlap, pressed, lambda _: none, arms)

    def _resisted(
        self, problem: Problem, moves: Any, here: Array, direction: Array, length: Array
    ) -> tuple[Array, Array]:
        """Return what `resisted` does, but for contacts of arms with arms."""

        def add(sums: tuple[Array, Array], row: Any) -> tuple[tuple[Array, Array], None]:
            moves, joints, here, direction = row

            return when(moves, lambda sums: _added(sums, rows_of(joints), here, direction, length), sums), None

        rows = moves, problem.joints, here, direction
        found: tuple[Array, Array] = jax.lax.scan(add, (jnp.float32(0.0),) * 2, rows)[0]
        return found

    def _power(self, problem: Problem, here: Array, direction: Array) -> Array:
        """Return the power along directions of contacts of arms with arms, []."""
        rows = _flat(problem.between)
        return row_forces(rows, here.ravel()) @ (rows.jacobian @ direction.ravel())

    def _lower(self, halves: Array) -> Array:
        """Return the lower half of one matrix for all joints that are there, of the lower halves of each arm's."""
        sizes = self._there.sum(1)
        whole, starts = jnp.zeros(sizes.sum() * (sizes.sum() + 1) // 2), np.cumsum(sizes) - sizes
        for arm, own in enumerate(self._there):
            (i, j), places = np.tril_indices(sizes[arm]), self._places[np.ix_(own, own)]
            whole = whole.at[self._all[starts[arm] + i, starts[arm] + j]].set(halves[arm][places[i, j]])
        return whole


def _flat(rows: Rows) -> Rows:
    """Return rows [r] whose Jacobian [r, a, m] has one axis for all joints."""
    return rows._replace(jacobian=rows.jacobian.reshape(len(rows.low), -1))


def _added(sums: tuple[Array, Array], rows: Rows, here: Array, direction: Array, length: Array) -> tuple[Array, Array]:
    """Return slope and growth of the cost along a direction with those of rows, at a length of it."""
    along = rows.jacobian @ direction
    force, by = rows.impedance * (rows.reference - rows.jacobian @ here - length * along), rows.impedance * along
    gives = jnp.where((force > rows.low) & (force < rows.high), by, 0.0)
    return sums[0] - along @ jnp.clip(force, rows.low, rows.high), sums[1] + along @ gives


def _direction_of(stiff: Array, force: Array, rows: Rows, here: Array, begin: Array) -> Array:
    """Return the direction to the acceleration at which these forces balance with those of joints."""
    return solve(stiff, stiff @ here + force, rows, begin, *ITERATIONS, steady=1)[0] - here
