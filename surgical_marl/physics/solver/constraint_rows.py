"""A solver of MuJoCo's constraint problem in few steps.

The acceleration of a system with limits, friction and contacts minimises a convex function: half the square of its
distance to the smooth acceleration in the metric of the mass matrix, plus a piecewise quadratic cost of each constraint
row (https://mujoco.readthedocs.io/en/stable/computation/index.html#the-optimization-problem). Rows without an elliptic
cone all have one form: the force is `clip(impedance * (reference - J qacc), low, high)`, with bounds (0, inf) for a
limit or a contact and (-f, f) for friction f. `solve` is Newton's method with a line search, as in MuJoCo, with a fixed
number of line search steps, so that many environments can be solved together. For rows that concern one joint alone
`relax` comes first: it solves one joint after the other exactly (projected Gauss-Seidel), and so nearly always finds
which rows hold and which slip or are free. Newton's method alone often fails on such rows: friction and limits are
stiff, and a row that changes sides changes the whole step.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.solver.cholesky import solve_factored, solve_positive, woodbury
from surgical_marl.physics.solver.newton import line_search, newton

RELAXATION = 1.15
"""Relaxation factor: a little more than 1 makes coupled joints converge soonest (successive over-relaxation, Young,
1950)."""
SWEEPS = 6
"""Sweeps of `relax` over all joints of an arm."""


class Rows(NamedTuple):
    """Constraints on n degrees of freedom, [r] each."""

    jacobian: Array
    """[r, n]"""
    impedance: Array
    """MuJoCo's efc_D."""
    reference: Array
    """Reference acceleration of the row, efc_aref."""
    low: Array
    """Least force."""
    high: Array


class JointRows(NamedTuple):
    """Friction and limit of each of n joints, [n] each; zeros where a joint has none.

    The columns are as in `Rows`, but signed: a limit pushes towards `side`, which is -1, 0 or 1.
    """

    friction: Array
    """The largest friction force."""
    friction_impedance: Array
    friction_reference: Array
    side: Array
    limit_impedance: Array
    limit_reference: Array


def rows_of(joints: JointRows) -> Rows:
    """Return friction and limits of n joints as rows, [2 n]: all frictions, then all limits."""
    one = np.eye(len(joints.side), dtype=np.float32)

    def both(first: Any, second: Any) -> Any:
        return jnp.concatenate([first, second])

    return Rows(
        both(one, joints.side[:, None] * one),
        both(joints.friction_impedance, joints.limit_impedance),
        both(joints.friction_reference, joints.limit_reference),
        both(-joints.friction, 0 * joints.side),
        both(joints.friction, jnp.full(len(one), jnp.inf)),
    )


def relax(mass: Array, smooth: Array, joints: JointRows, qacc: Array) -> Array:
    """Return an acceleration [n] nearer to the solution, by `SWEEPS` sweeps that solve one joint's equation at a time.

    The equation has one unknown, and its sum of forces falls with the unknown, piecewise linearly. The sign of the
    residual at each corner says on which piece the root lies. No derivative goes through it: `solve` begins with it.
    """
    mass, smooth, joints, qacc = jax.lax.stop_gradient((mass, smooth, joints, qacc))
    n = len(qacc)
    slack = joints.friction / jnp.where(joints.friction > 0, joints.friction_impedance, 1.0)
    corners = joints.friction_reference - slack, joints.friction_reference + slack, joints.side * joints.limit_reference
    inverse = {
        (sticks, held): 1 / (jnp.diag(mass) + sticks * joints.friction_impedance + held * joints.limit_impedance)
        for sticks in (0, 1)
        for held in (0, 1)
    }

    def limit_force(i: int, x: Array) -> Array:
        side = joints.side[i]
        return side * jnp.maximum(joints.limit_impedance[i] * (joints.limit_reference[i] - side * x), 0.0)

    def joint(i: int, qacc: list[Array]) -> Array:
        own, friction = mass[i, i], joints.friction[i]
        others = sum((mass[i, j] * qacc[j] for j in range(n) if j != i), -smooth[i])
        low, high, end = (corner[i] for corner in corners)
        ahead = own * low + others - friction - limit_force(i, low) > 0  # the root is below: friction pushes ahead
        back = own * high + others + friction - limit_force(i, high) < 0
        sticking = joints.friction_impedance[i] * (joints.friction_reference[i] - end)
        held = joints.side[i] * (own * end + others - jnp.clip(sticking, -friction, friction)) > 0
        sticks = ~(ahead | back)
        push = jnp.where(
            ahead, friction, jnp.where(back, -friction, joints.friction_impedance[i] * joints.friction_reference[i])
        )
        push = (
            push - others + jnp.where(held, joints.side[i] * joints.limit_impedance[i] * joints.limit_reference[i], 0.0)
        )
        free, stuck = (jnp.where(held, inverse[k, 1][i], inverse[k, 0][i]) for k in (0, 1))
        return push * jnp.where(sticks, stuck, free)

    def sweep(qacc: list[Array], _: None) -> tuple[list[Array], None]:
        qacc = list(qacc)
        for i in range(n):
            qacc[i] = qacc[i] + RELAXATION * (joint(i, qacc) - qacc[i])
        return qacc, None

    found, _ = jax.lax.scan(sweep, [qacc[i] for i in range(n)], None, length=SWEEPS)
    return jnp.stack(found)


@partial(jax.custom_jvp, nondiff_argnums=(4, 5, 6, 7))
def solve(
    mass: Array,
    smooth: Array,
    rows: Rows,
    start: Array,
    iterations: int,
    looks: int,
    arms: np.ndarray | None = None,
    steady: int = 2,
) -> tuple[Array, Array]:
    """Return the acceleration [n] and the force of each row [r].

    They are found for a mass matrix [n, n] and the sum `smooth` [n] of all other forces, by Newton steps from `start`.
    Each Newton step has `looks` steps of line search. Of several arms, `arms` has the numbers of their joints, [a, m],
    filled up with n, and the first 2 n rows are those of `rows_of`: then no matrix larger than that of an arm is
    factorised (`woodbury`).

    There are at most `iterations` Newton steps. A whole step over which no row changes sides ends at the solution, and
    a second such step removes its rounding error. After `steady` of them the search stops.

    Its derivative is that of the solution (`_differentiate`), whatever led there.
    """

    def step(qacc: Array, _: Array) -> tuple[Array, Array]:
        unbounded = unbounded_forces(rows, qacc)
        force = jnp.clip(unbounded, rows.low, rows.high)
        above, below = unbounded > rows.low, unbounded < rows.high
        rest = mass @ qacc - smooth
        gives = jnp.where(above & below, rows.impedance, 0.0)
        search = _newton_step(mass, rows.jacobian, gives, rows.jacobian.T @ force - rest, arms)
        part = partial(_length, mass, rows, unbounded, rest, search, looks)
        if iterations == 1:
            return qacc + part() * search, jnp.bool_(True)
        # The whole step is the best one if no row changes sides over it. A part of a step ends where one does, on
        # either side of there by rounding, and not at the solution.
        end = unbounded - rows.impedance * (rows.jacobian @ search)
        whole = (((end > rows.low) == above) & ((end < rows.high) == below)).all()
        return qacc + jax.lax.cond(whole, lambda: jnp.float32(1.0), part) * search, whole

    qacc = newton(step, start, iterations, steady)
    return qacc, row_forces(rows, qacc)


def _newton_step(mass: Array, jacobian: Array, gives: Array, excess: Array, arms: np.ndarray | None) -> Array:
    """Return x [n] with (mass + jacobian.T @ diag(gives) @ jacobian) @ x = excess.

    With `arms`, as for `solve`: without the rows after the first 2 n the matrix has a block for each arm and zeros
    elsewhere.
    """
    if arms is None:
        return solve_positive(mass + jacobian.T @ (gives[:, None] * jacobian), excess)
    n = len(mass)
    blocks = mass + jacobian[: 2 * n].T @ (gives[: 2 * n, None] * jacobian[: 2 * n])
    root = jnp.sqrt(gives[2 * n :])[:, None] * jacobian[2 * n :]
    pairs, there = (arms[:, :, None], arms[:, None]), arms < n
    each = jnp.where(there[:, :, None] & there[:, None], jnp.pad(blocks, (0, 1))[pairs], np.eye(arms.shape[1]))
    across = jnp.pad(root, ((0, 0), (0, 1)))[:, arms].swapaxes(0, 1)
    rows = each, jnp.append(excess, 0.0)[arms], across
    right, factors, share = woodbury(lambda arm: arm, rows, len(root), 1.0)

    def one(row: tuple[Array, Array, Array]) -> Array:
        factor, right, across = row
        return solve_factored(factor, right - across.T @ share)

    return jnp.zeros(n + 1).at[arms].set(jax.lax.map(one, (factors, right, across)))[:n]


@solve.defjvp
def _differentiate(
    iterations: int,
    looks: int,
    arms: np.ndarray | None,
    steady: int,
    primals: tuple[Any, ...],
    tangents: tuple[Any, ...],
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return the solution and its derivative, by the implicit function theorem.

    At the solution all forces balance the inertia, and each row stays on its side. So the derivative takes one linear
    system, which is never degenerate. The direction to the solution is no use: at rest it divides zero by zero.
    """
    mass, smooth, rows, _ = primals
    qacc, force = solve(*primals, iterations, looks, arms, steady)

    def excess(mass: Array, smooth: Array, rows: Rows) -> Array:
        return smooth + rows.jacobian.T @ row_forces(rows, qacc) - mass @ qacc

    _, pull = jax.jvp(excess, (mass, smooth, rows), tangents[:3])
    gives = giving(rows, unbounded_forces(rows, qacc))
    change = solve_positive(mass + rows.jacobian.T @ (gives[:, None] * rows.jacobian), pull)
    _, push = jax.jvp(row_forces, (rows, qacc), (tangents[2], change))
    return (qacc, force), (change, push)


def row_forces(rows: Rows, qacc: Array) -> Array:
    """Return the force of each row [r] at an acceleration [n]."""
    return jnp.clip(unbounded_forces(rows, qacc), rows.low, rows.high)


def unbounded_forces(rows: Rows, qacc: Array) -> Array:
    """Return the force that each row [r] would have at an acceleration [n] without bounds."""
    return rows.impedance * (rows.reference - rows.jacobian @ qacc)


def giving(rows: Rows, unbounded: Array) -> Array:
    """Return by how much the force of each row [r] falls per acceleration along it, from what it is without bounds."""
    return jnp.where((unbounded > rows.low) & (unbounded < rows.high), rows.impedance, 0.0)


def _length(
    mass: Array, rows: Rows, unbounded: Array, rest: Array, search: Array, looks: int
) -> Array:  # fmt: skip
    """Return how far to go along `search`: the root of the slope of the cost, which grows piecewise linearly."""
    along = rows.jacobian @ search
    fall = rows.impedance * along
    slope_0, slope_1 = search @ rest, search @ (mass @ search)

    def measure(length: Array) -> tuple[Array, Array]:
        at = unbounded - length * fall
        slope = slope_0 + length * slope_1 - along @ jnp.clip(at, rows.low, rows.high)
        return slope, slope_1 + along @ jnp.where((at > rows.low) & (at < rows.high), fall, 0.0)

    begin = slope_0 - along @ jnp.clip(unbounded, rows.low, rows.high)
    return line_search(begin, 0.0, measure, looks, 0.0).length
