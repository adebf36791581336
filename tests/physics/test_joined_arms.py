"""Arms that one object joins are solved as arms and object together are, in float64."""

from __future__ import annotations

from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from surgical_marl.physics.solver.arm_solver import ArmSolver, ArmSystem
from surgical_marl.physics.solver.constraint_rows import JointRows, Rows, rows_of
from surgical_marl.physics.solver.schur import Eliminated

JOINTS = 5


def _positive(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.normal(size=(n, n))
    return root @ root.T / n + 0.2 * np.eye(n)


def _joints(rng: np.random.Generator, arms: int) -> JointRows:
    """Return friction of two joints in three, and limits of half of them."""
    shape = arms, JOINTS
    rubs, side = rng.random(shape) < 0.7, rng.choice([-1, 0, 0, 1], size=shape)
    columns = (
        np.where(rubs, rng.random(shape), 0), np.where(rubs, 20 * rng.random(shape), 0), rng.normal(size=shape),
        side, np.where(side != 0, 20 * rng.random(shape), 0), rng.normal(size=shape),
    )  # fmt: skip
    return JointRows(*(jnp.asarray(column, jnp.float32) for column in columns))


def _solved(matrix: np.ndarray, force: np.ndarray, rows: Rows) -> np.ndarray:
    """Return x with matrix @ x = force and the forces of rows, by Newton's method with halved steps."""

    def unbounded(x: np.ndarray) -> np.ndarray:
        return rows.impedance * (rows.reference - rows.jacobian @ x)

    def excess(x: np.ndarray) -> np.ndarray:
        return force + rows.jacobian.T @ np.clip(unbounded(x), rows.low, rows.high) - matrix @ x

    x = np.linalg.solve(matrix, force)
    for _ in range(200):
        gives = np.where((unbounded(x) > rows.low) & (unbounded(x) < rows.high), rows.impedance, 0.0)
        step = np.linalg.solve(matrix + rows.jacobian.T @ (gives[:, None] * rows.jacobian), excess(x))
        length = 1.0
        while step @ excess(x + length * step) < -1e-12 and length > 1e-6:  # it is beyond the least cost
            length /= 2
        x = x + length * step
    assert np.abs(excess(x)).max() < 1e-9
    return x


class _Drawn(NamedTuple):
    """Arms and objects at random, one of which joins two arms."""

    problem: SimpleNamespace
    here: jax.Array
    left: ArmSystem
    whole: np.ndarray
    """The matrix of all joints, then all objects."""
    force: np.ndarray
    """The forces on them, likewise."""


def _drawn(rng: np.random.Generator, arms: int, objects: int, bridge: int) -> _Drawn:
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    halves = lambda x: single(x[:, *np.tril_indices(JOINTS)])  # noqa: E731
    dofs, shape, n = np.arange(arms * JOINTS).reshape(arms, JOINTS), (arms, JOINTS), arms * JOINTS
    touched = np.zeros((objects, arms), bool)
    touched[bridge, rng.permutation(arms)[:2]] = True
    if objects > 1:
        touched[1 - bridge, rng.integers(arms)] = True
    mass, smooth = np.array([_positive(rng, JOINTS) for _ in range(arms)]), rng.normal(size=shape)
    push, here = rng.normal(size=(objects, 6)), rng.normal(size=shape)
    whole, stiff = np.zeros((n + 6 * objects,) * 2), np.zeros((arms, JOINTS, JOINTS))
    half, wide = np.zeros((objects, 6)), np.full(((objects + 1) * arms, 6, JOINTS), np.nan)
    for o in range(objects):
        own, at, pushed = 0.1 * np.eye(6), n + 6 * o + np.arange(6), push[o]
        for i in np.flatnonzero(touched[o]):
            contact, jacobian = _positive(rng, 6), rng.normal(size=(6, JOINTS))
            own, couples = own + contact, contact @ jacobian
            stiff[i] += jacobian.T @ couples
            wide[arms * o + i], pushed = couples, pushed + couples @ here[i]
            whole[at[:, None], dofs[i]], whole[dofs[i][:, None], at] = -couples, -couples.T
        whole[at[:, None], at], factor = own, np.linalg.cholesky(own)
        half[o] = -np.linalg.solve(factor, pushed)  # with the arms as they are `here`
        wide[arms * o : arms * (o + 1)] = np.linalg.solve(factor, wide[arms * o : arms * (o + 1)])
    for i in range(arms):
        whole[dofs[i][:, None], dofs[i]] = mass[i] + stiff[i]
    none = Rows(single(np.zeros((0, *shape))), *[single([])] * 4)
    felt = -np.einsum("ijk,ik->ij", stiff, here)
    gone = Eliminated(single(half), single(wide), *[single(np.nan)] * 2, jnp.asarray(touched))
    left = ArmSystem(halves(stiff), jnp.ones(arms, bool), single(felt), gone)
    problem = SimpleNamespace(mass=halves(mass), smooth=single(smooth), joints=_joints(rng, arms), between=none)
    return _Drawn(problem, single(here), left, whole, np.concatenate([smooth.ravel(), push.ravel()]))


@pytest.mark.parametrize("arms", [2, 3])
@pytest.mark.parametrize("objects", [1, 2])
def test_arms_that_an_object_joins_are_solved_as_all_at_once_in_float64(
    arms: int, objects: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("surgical_marl.physics.solver.arm_solver.ITERATIONS", (60, 4))  # six do not solve all of these
    rng, errors = np.random.default_rng(10 * arms + objects), []
    solver = ArmSolver(np.arange(arms * JOINTS).reshape(arms, JOINTS), arms * JOINTS)
    joined = jax.jit(lambda fields, *given: given[0] + solver.joined(SimpleNamespace(**fields), *given))  # type: ignore[arg-type]
    for n in range(40):
        drawn = _drawn(rng, arms, objects, n % objects)
        begin = drawn.here * np.float32(rng.choice([1.0, 0.7, -2.0]))  # wherever it begins
        found = joined(vars(drawn.problem), drawn.here, begin, drawn.left)
        flat = JointRows(*(np.asarray(column, np.float64).ravel() for column in drawn.problem.joints))
        rows = Rows(*(np.asarray(column, np.float64) for column in rows_of(flat)))  # type: ignore[arg-type]
        rows = rows._replace(jacobian=np.pad(rows.jacobian, ((0, 0), (0, 6 * objects))))
        errors.append(np.abs(np.ravel(found) - _solved(drawn.whole, drawn.force, rows)[: found.size]).max())
    assert np.max(errors) < 1e-4
