"""Arms that touch nothing move as if alone, whatever others hold."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from surgical_marl.bench.physics import PhysicsAlone
from surgical_marl.bench.starts import grasps
from surgical_marl.engines.choose import make_engine
from surgical_marl.envs.env import Env
from surgical_marl.physics.solver.cholesky import packed
from surgical_marl.physics.solver.constraint_rows import rows_of, solve
from surgical_marl.physics.systems.arms import ArmForces

COUNT, STEPS, SEEN = 64, 48, 8


def test_an_arm_that_touches_nothing_moves_as_if_alone_while_another_holds_something() -> None:
    """Its forces balance, as of a problem of its own that is solved in many more steps."""
    env, rng = Env("reach", "bimanual_psm_needle"), np.random.default_rng(0)
    simulator, engine = env.simulator, make_engine(PhysicsAlone(env), COUNT, "fused", "cpu")
    step: Any = simulator.step
    starts = grasps(env.scene, COUNT, rng)
    engine.reset(0)
    for path, values in {"arms.qpos": starts.qpos, "rigid_bodies.bodies.position": starts.position,
                         "rigid_bodies.bodies.quaternion": starts.quaternion}.items():  # fmt: skip
        engine.write(f".physics.{path}", values.astype(np.float32))
    closed = np.array(simulator.home.ctrl)

    def alone(arm: ArmForces) -> Any:
        whole = arm.implicit[packed(len(arm.smooth))]
        return solve(whole, arm.smooth, rows_of(arm.joints), arm.start, 60, 4)[0]

    @jax.jit
    @jax.vmap
    def expected(physics: Any) -> Any:
        slots = step.slots(physics)
        touched = (step._arm_of(slots)[:, None] == np.arange(len(env.agents))).any(0)
        return step.arms.by_joint(jax.vmap(alone)(step.arms.free_motion(physics.arms))), touched

    home, tree = jax.tree_util.tree_flatten_with_path(simulator.home)
    paths = [f".physics{jax.tree_util.keystr(path)}" for path, _ in home]
    read = partial(engine.read, library="numpy")
    errors, dofs = [], step.arms.dofs
    for k in range(STEPS):
        if k % 12 == 0:  # jaws close, and all else moves to and fro
            moves = rng.uniform(-0.05, 0.05, (COUNT, len(closed))).astype(np.float32)
            engine.write(".physics.arms.ctrl", np.where(closed > 0, closed + moves, closed - 0.03).astype(np.float32))
        if k < STEPS - SEEN:
            engine.step({})
            continue
        before = jax.tree_util.tree_unflatten(tree, [read(path) for path in paths])
        engine.step({})
        found, (qacc, touched) = read(".physics.arms.qacc_warmstart"), map(np.asarray, expected(before))
        one = touched.any(1) & ~touched.all(1)
        for e, arm in zip(*np.nonzero(~touched & one[:, None]), strict=True):
            own = dofs[arm]
            errors.append(np.abs(found[e, own] - qacc[e, own]).max() / (1 + np.abs(qacc[e, own]).max()))
    assert len(errors) > 50
    assert np.max(errors) < 1e-3


def test_friction_of_joints_is_as_before_at_the_acceleration_that_arms_begin_with() -> None:
    simulator, rng = Env("reach", "bimanual_psm_needle").simulator, np.random.default_rng(0)
    arms, physics = cast(Any, simulator.step.arms), simulator.home
    qvel, qacc = (jnp.asarray(rng.uniform(-1, 1, len(physics.qvel)), jnp.float32) for _ in range(2))

    @jax.jit
    def force(qvel: Any, accelerations: Any) -> Any:
        """As if it had no bounds."""
        joints = arms.free_motion(physics.arms._replace(qvel=qvel)).joints
        return joints.friction_impedance * (joints.friction_reference - accelerations)

    by_arm = qacc[arms.dofs]
    start = arms.friction_start(SimpleNamespace(start=by_arm))
    before, after = force(qvel, by_arm), force(qvel + arms.dt * qacc, start)
    np.testing.assert_allclose(after, before, rtol=1e-4)
    assert np.abs(before).min() > 0
