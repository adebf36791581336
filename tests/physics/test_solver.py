"""The constraint solver: properties at random, and C MuJoCo as the reference.

It works in float32: a number is right to about 1e-7 of the largest that it was summed from. Tolerances are a hundred
times that or more, because a solution also magnifies by how unlike the masses are.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import jax
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl import load_scene
from surgical_marl.physics.solver import constraint_rows
from surgical_marl.physics.solver.constraint_rows import JointRows, Rows, relax, solve
from surgical_marl.physics.solver.solref import response
from surgical_marl.physics.systems.arms import ITERATIONS
from surgical_marl.physics.systems.dynamics import Dynamics

SEEDS = st.integers(0, 2**32 - 1)
JOINTS, CONTACTS = 5, 2
TYPES = mujoco.mjtConstraint
FRICTION, LIMIT = int(TYPES.mjCNSTR_FRICTION_DOF), int(TYPES.mjCNSTR_LIMIT_JOINT)
CONTACT = int(TYPES.mjCNSTR_CONTACT_FRICTIONLESS)


class Problem(SimpleNamespace):
    """Mass [n, n], smooth force [n], rows of n joints and of contacts, and where to start [n]; in float32."""

    mass: np.ndarray
    smooth: np.ndarray
    joints: JointRows
    rows: Rows
    start: np.ndarray


def problem(seed: int, n: int = JOINTS, contacts: int = 0) -> Problem:
    """Masses from a gram to a kilogram, coupled; impedances as MuJoCo has them, a few times the mass; some joints have
    friction, some are at a limit, and all is of a size to matter."""
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-3, 0, n)
    mix = np.eye(n) + 0.4 * rng.uniform(-1, 1, (n, n)) / np.sqrt(n)
    mass = np.sqrt(size)[:, None] * (mix @ mix.T) * np.sqrt(size)
    acceleration = 10.0 ** rng.uniform(0, 3)
    rubs, side = rng.random(n) < 0.6, rng.choice([-1.0, 0.0, 1.0], n)
    joints = JointRows(
        friction=rubs * size * acceleration * rng.uniform(0.01, 1, n),
        friction_impedance=rubs * size * rng.uniform(1, 20, n),
        friction_reference=rubs * acceleration * rng.uniform(-1, 1, n),
        side=side,
        limit_impedance=np.abs(side) * size * rng.uniform(1, 20, n),
        limit_reference=np.abs(side) * acceleration * rng.uniform(-1, 2, n),
    )
    none, touching, presses = np.zeros(n), np.ones(contacts), acceleration * rng.uniform(-1, 2, contacts)
    jacobian = rng.uniform(-1, 1, (contacts, n))
    weight = np.einsum("ri,ij,rj->r", jacobian, np.linalg.inv(mass), jacobian)
    rows = Rows(
        np.concatenate([np.eye(n), np.diag(joints.side), jacobian]),
        np.concatenate([joints.friction_impedance, joints.limit_impedance, rng.uniform(1, 20, contacts) / weight]),
        np.concatenate([joints.friction_reference, joints.limit_reference, presses]),
        np.concatenate([-joints.friction, none, 0 * touching]),
        np.concatenate([joints.friction, none + np.inf, np.inf * touching]),
    )
    smooth, start = size * acceleration * rng.uniform(-2, 2, n), acceleration * rng.uniform(-2, 2, n)
    parts = {"mass": mass, "smooth": smooth, "joints": joints, "rows": rows, "start": start}
    return Problem(**jax.tree.map(np.float32, parts))


def forces(p: Problem, qacc: np.ndarray) -> np.ndarray:
    rows = jax.tree.map(np.float64, p.rows)
    return np.clip(rows.impedance * (rows.reference - rows.jacobian @ qacc), rows.low, rows.high)


def cost(p: Problem, qacc: np.ndarray) -> float:
    """What MuJoCo minimises, in float64."""
    rows, qacc = jax.tree.map(np.float64, p.rows), np.float64(qacc)
    force = forces(p, qacc)
    off = rows.reference - rows.jacobian @ qacc
    # quadratic where the force is not at its bound, and goes on straight from there
    bent = np.divide(force, rows.impedance, out=np.zeros_like(force), where=rows.impedance > 0)
    return float(0.5 * qacc @ p.mass @ qacc - p.smooth @ qacc + (force * off - 0.5 * force * bent).sum())


def unbalanced(p: Problem, qacc: np.ndarray) -> float:
    """The cost's gradient, of which the minimum has none, as a share of the forces that it was summed from."""
    rows, qacc = jax.tree.map(np.float64, p.rows), np.float64(qacc)
    gradient = p.mass @ qacc - p.smooth - rows.jacobian.T @ forces(p, qacc)
    summed = np.abs(p.mass) @ np.abs(qacc) + np.abs(p.smooth)
    jacobian = np.abs(rows.jacobian)
    summed += jacobian.T @ (rows.impedance * (np.abs(rows.reference) + jacobian @ np.abs(qacc)))
    return float((np.abs(gradient) / summed).max())


@functools.cache
def compiled_relax(sweeps: int, relaxation: float) -> Callable[..., np.ndarray]:
    compiled = jax.jit(lambda *arguments: relax(*arguments))

    def run(p: Problem, start: np.ndarray) -> np.ndarray:
        with patch.object(constraint_rows, "SWEEPS", sweeps), patch.object(constraint_rows, "RELAXATION", relaxation):
            return np.asarray(compiled(p.mass, p.smooth, p.joints, start))

    return run


compiled_solve = jax.jit(solve, static_argnums=(4, 5))


@settings(max_examples=200, deadline=None)
@given(SEEDS)
def test_an_exact_sweep_never_raises_the_cost(seed: int) -> None:
    p = problem(seed)
    qacc, before = p.start, cost(p, p.start)
    for _ in range(5):
        qacc = compiled_relax(1, 1.0)(p, qacc)
        after = cost(p, qacc)
        assert after <= before + 1e-6 * abs(before)  # at the minimum it may differ by rounding
        before = after


@settings(max_examples=200, deadline=None)
@given(SEEDS)
def test_the_sweeps_that_ship_come_nearer_to_the_minimum(seed: int) -> None:
    p = problem(seed)
    found = compiled_relax(constraint_rows.SWEEPS, constraint_rows.RELAXATION)(p, p.start)
    least = cost(p, compiled_relax(500, 1.0)(p, p.start))
    assert cost(p, found) - least <= 0.01 * (cost(p, p.start) - least) + 1e-5 * abs(least)


@pytest.mark.parametrize("relaxation", [1.0, constraint_rows.RELAXATION])
@settings(max_examples=100, deadline=None)
@given(seed=SEEDS)
def test_many_sweeps_end_at_the_minimum(relaxation: float, seed: int) -> None:
    p = problem(seed)
    assert unbalanced(p, p.start) > 1e-3
    assert unbalanced(p, compiled_relax(500, relaxation)(p, p.start)) < 1e-5


@settings(max_examples=200, deadline=None)
@given(SEEDS)
def test_one_joint_alone_is_solved_exactly(seed: int) -> None:
    """In one sweep, wherever it starts: the root of a force that falls with the acceleration, found by bisection."""
    p = problem(seed, n=1)
    low, high = -1e7, 1e7
    for _ in range(100):
        middle = (low + high) / 2
        left = p.smooth[0] + (p.rows.jacobian.T @ forces(p, np.array([middle])))[0] - np.float64(p.mass[0, 0]) * middle
        low, high = (middle, high) if left > 0 else (low, middle)
    found = compiled_relax(1, 1.0)(p, p.start)
    assert float(found[0]) == pytest.approx(low, rel=1e-5, abs=1e-5 * float(abs(p.start[0])))


@settings(max_examples=200, deadline=None)
@given(SEEDS)
def test_newton_s_method_ends_at_the_minimum(seed: int) -> None:
    """Friction, limits and contacts together: no force is left over, each is what its row says, within its bounds."""
    p = problem(seed, contacts=CONTACTS)
    qacc, force = map(np.asarray, compiled_solve(p.mass, p.smooth, p.rows, p.start, 30, 20))
    assert unbalanced(p, p.start) > 1e-3
    assert unbalanced(p, qacc) < 1e-5
    size = p.rows.impedance * (np.abs(p.rows.reference) + np.abs(p.rows.jacobian) @ np.abs(qacc))
    assert (np.abs(force - forces(p, qacc)) <= 1e-5 * size).all()
    assert (force >= p.rows.low).all() and (force <= p.rows.high).all()


@settings(max_examples=50, deadline=None)
@given(SEEDS)
def test_one_newton_step_solves_rows_without_bounds(seed: int) -> None:
    p = problem(seed, contacts=CONTACTS)
    p.rows = p.rows._replace(low=np.full_like(p.rows.low, -np.inf), high=np.full_like(p.rows.high, np.inf))
    qacc, _ = compiled_solve(p.mass, p.smooth, p.rows, p.start, 1, 1)
    assert unbalanced(p, np.asarray(qacc)) < 1e-5


@pytest.mark.parametrize("line_search", [4, 5, 20])
def test_the_line_search_does_not_run_to_and_fro(line_search: int) -> None:
    """From -1, Newton's step leads to 1 and from there back: friction alone is between them, and holds at 0."""
    one = np.ones(1, np.float32)
    rows = Rows(np.float32([[1]]), 1000 * one, 0 * one, -one, one)
    qacc, force = compiled_solve(np.float32([[1]]), 0 * one, rows, -one, 6, line_search)
    assert np.abs(qacc).max() < 1e-6 and np.abs(force).max() < 1e-3


def mujoco_problem(model: mujoco.MjModel, data: mujoco.MjData, count: int) -> Problem:
    """What C MuJoCo has to solve, with its own rows; empty ones up to `count`."""
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    kinds = data.efc_type
    assert set(kinds.tolist()) <= {FRICTION, LIMIT, CONTACT}
    rubs = kinds == FRICTION
    rows = Rows(
        data.efc_J.reshape(-1, model.nv),
        data.efc_D,
        data.efc_aref,
        np.where(rubs, -data.efc_frictionloss, 0.0),
        np.where(rubs, data.efc_frictionloss, np.inf),
    )
    rows = Rows(*(np.concatenate([part, np.zeros((count - len(part), *part.shape[1:]))]) for part in rows))
    own = np.zeros((6, model.nv))
    for row, (kind, joint) in enumerate(zip(kinds, data.efc_id, strict=True)):
        if kind == FRICTION:
            own[:3, joint] = data.efc_frictionloss[row], data.efc_D[row], data.efc_aref[row]
        elif kind == LIMIT:
            own[3:, joint] = rows.jacobian[row, joint], data.efc_D[row], data.efc_aref[row]
    parts = {"mass": mass, "smooth": data.qfrc_smooth, "joints": JointRows(*own), "rows": rows}
    return Problem(**jax.tree.map(np.float32, parts), start=np.zeros(model.nv, np.float32))


@functools.cache
def a_scene(name: str) -> tuple[Any, mujoco.MjModel, np.ndarray]:
    scene = load_scene(name)
    velocity = np.concatenate([[joint.velocity for joint in mount.arm.joints] for mount in scene.mounts.values()])
    return scene, scene.model, velocity


def far_off(model: mujoco.MjModel, velocity: np.ndarray, qacc: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference after a physics step, as a share of a joint's velocity limit."""
    return float((np.abs(qacc - expected) * model.opt.timestep / velocity).max())


@pytest.mark.parametrize("name", ["psm", "star"])
@settings(max_examples=50, deadline=None)
@given(seed=SEEDS)
def test_an_arm_accelerates_as_in_c_mujoco(name: str, seed: int) -> None:
    """Anywhere, some joints past a limit, some at rest: by many Newton steps, and by what a physics step affords."""
    _, model, velocity = a_scene(name)
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    low, high = model.jnt_range.T
    where = rng.choice([-0.005, 1.005, 0.5], model.nv) + rng.uniform(0, 0.004, model.nv)
    data.qpos[:] = low + where * (high - low)
    data.qvel[:] = 0.5 * velocity * rng.uniform(-1, 1, model.nv) * (rng.random(model.nv) < 0.6)
    data.ctrl[:] = rng.uniform(*model.actuator_ctrlrange.T)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    mujoco.mj_forward(model, data)
    p = mujoco_problem(model, data, 2 * model.nv)
    exact, _ = compiled_solve(p.mass, p.smooth, p.rows, p.start, 30, 20)
    assert far_off(model, velocity, np.asarray(exact), data.qacc) < 1e-4
    start = compiled_relax(constraint_rows.SWEEPS, constraint_rows.RELAXATION)(p, p.start)
    quick, _ = compiled_solve(p.mass, p.smooth, p.rows, start, *ITERATIONS)
    assert far_off(model, velocity, np.asarray(quick), data.qacc) < 1e-3


@settings(max_examples=50, deadline=None)
@given(SEEDS)
def test_two_arms_in_contact_accelerate_as_in_c_mujoco(seed: int) -> None:
    scene, model, velocity = a_scene("bimanual_psm")
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    crossed = {"psm_0": np.array([0.03, 0.02, 0.16, 0, 0, 0, 0.0]), "psm_1": np.array([-0.03, 0, 0.16, 0, 0, 0, 0.0])}
    data.qpos[:] = scene.full_qpos({agent: q + 1e-4 * rng.uniform(-1, 1, 7) for agent, q in crossed.items()})
    data.qvel[:] = 0.02 * velocity * rng.uniform(-1, 1, model.nv)
    data.ctrl[:] = scene.moment @ data.qpos
    mujoco.mj_forward(model, data)
    assert data.ncon
    p = mujoco_problem(model, data, 3 * model.nv)
    qacc, force = map(np.asarray, compiled_solve(p.mass, p.smooth, p.rows, p.start, 30, 20))
    assert far_off(model, velocity, qacc, data.qacc) < 1e-4
    touching = data.efc_type == CONTACT
    expected = data.efc_force[touching]
    assert force[: len(touching)][touching] == pytest.approx(expected, rel=1e-3, abs=1e-3 * (1 + expected.max()))


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_a_step_by_blocks_is_a_step_of_the_whole(seed: int) -> None:
    """Arms of four, two and four joints, friction and limits of each, and stiff contacts of which some are open."""
    rng, n, k = np.random.default_rng(seed), 10, 3
    mass, arms = np.zeros((n, n)), np.array([[0, 1, 2, 3], [4, 5, n, n], [6, 7, 8, 9]])
    for own in (arm[arm < n] for arm in arms):
        root = rng.normal(size=(len(own),) * 2)
        mass[np.ix_(own, own)] = root @ root.T + np.eye(len(own))
    jacobian = np.concatenate([np.eye(n), np.diag(rng.choice([-1.0, 0.0, 1.0], n)), rng.normal(size=(k, n))])
    gives = rng.choice([0.0, 1.0, 100.0], len(jacobian))
    excess = rng.normal(size=n)
    whole = np.linalg.solve(mass + jacobian.T @ (gives[:, None] * jacobian), excess)
    found = constraint_rows._newton_step(*(np.float32(x) for x in (mass, jacobian, gives, excess)), arms)
    np.testing.assert_allclose(found, whole, atol=1e-4 * np.abs(whole).max())


POWERS = st.sampled_from([1.0, 2.0, 3.5])
REFERENCES = st.one_of(
    st.tuples(st.floats(0.0005, 0.1), st.floats(0.3, 2.0)),  # the shortest is below two steps
    st.tuples(st.floats(-5000, -1), st.floats(-100, -1)),
)
LEAST = st.one_of(st.just(0.0), st.floats(0.001, 1))  # 0 is raised to the least that MuJoCo allows
IMPEDANCES = st.tuples(LEAST, st.floats(0.05, 1), st.floats(1e-4, 0.01), st.floats(0.1, 0.9), POWERS)


Numbers = tuple[float, ...]


def touching(solref: Numbers, solimp: Numbers, depth: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A ball on a slide, so deep in the ground and on its way deeper."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.0025" gravity="0 0 0" jacobian="dense"/><worldbody>
        <geom name="ground" type="plane" size="1 1 1"/>
        <body name="ball"><joint type="slide" axis="0 0 1"/><geom name="ball" size="0.1" mass="0.5"/></body></worldbody>
        <contact><pair geom1="ground" geom2="ball" condim="1" solref="{" ".join(map(repr, solref))}"
        solimp="{" ".join(map(repr, solimp))}"/></contact></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = 0.1 - depth, -0.2
    mujoco.mj_forward(model, data)
    assert data.nefc == 1
    return model, data


@settings(max_examples=100, deadline=None)
@given(REFERENCES, IMPEDANCES, st.floats(1e-5, 0.02))
def test_stiffness_damping_and_impedance_are_those_of_c_mujoco(solref: Numbers, solimp: Numbers, depth: float) -> None:
    model, data = touching(solref, solimp, depth)
    found = response(model.pair_solref[0], model.pair_solimp[0], data.efc_pos, model.opt.timestep)
    expected = data.efc_KBIP[0, :3]
    assert [float(np.squeeze(part)) for part in found] == pytest.approx(expected, rel=2e-4, abs=1e-6)


@pytest.mark.parametrize("depth", [1e-4, 0.0004, 0.0007, 0.003])
def test_the_row_of_a_contact_is_that_of_c_mujoco(depth: float) -> None:
    model, data = touching((0.005, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0), depth)
    weight = model.body_invweight0[model.geom("ball").bodyid[0], :1]
    rows = Dynamics(model).contact_rows(*(np.float32(x) for x in (data.efc_J, data.efc_pos, weight, data.qvel)))
    assert float(rows.impedance[0]) == pytest.approx(data.efc_D[0], rel=1e-4)
    assert float(rows.reference[0]) == pytest.approx(data.efc_aref[0], rel=1e-4)
