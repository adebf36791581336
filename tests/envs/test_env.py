"""One environment and many: episodes, resets, determinism, and physics against C MuJoCo."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from surgical_marl import list_scenes
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.physics.contact.arm_contacts import SLOTS
from surgical_marl.physics.state import ArmState, Physics
from surgical_marl.scenes.timing import DECIMATION, TIMESTEP
from tests.helpers.actions import random_actions
from tests.helpers.commands import commander

SCENES = ("psm", "bimanual_psm")


@cache
def batched(scene: str = "bimanual_psm", num_envs: int = 4, max_steps: int = 25) -> BatchedEnv:
    return BatchedEnv("reach", scene, num_envs=num_envs, max_steps=max_steps)


def host_data(env: BatchedEnv, index: int = 0) -> mujoco.MjData:
    data = mujoco.MjData(env.scene.model)
    data.qpos[:] = env.qpos[index]
    mujoco.mj_forward(env.scene.model, data)
    return data


@pytest.mark.parametrize("scene", SCENES)
def test_observations_lie_in_their_space_over_whole_episodes(scene: str) -> None:
    env, rng = batched(scene), np.random.default_rng(0)
    observations, state, _ = env.reset(1)
    for _ in range(60):
        for i in range(env.num_envs):
            assert all(env.observation_space(a).contains(o[i]) for a, o in observations.items())
            assert env.state_space.contains(state[i])
        step = env.step(random_actions(env, rng))
        observations, state = step.observations, step.state
        for agent in env.agents:
            assert all(env.observation_space(agent).contains(o) for o in step.final_observations[agent])
            assert np.isfinite(step.rewards[agent]).all()


def test_tips_and_distances_are_of_the_new_state() -> None:
    """Against C MuJoCo at the very qpos that the step ended with."""
    env, rng = batched(), np.random.default_rng(2)
    env.reset(3)
    for _ in range(20):
        step = env.step(random_actions(env, rng))
    data = host_data(env)
    goal = env.goal.targets[0]
    least = min(
        mujoco.mj_geomDistance(env.scene.model, data, a, b, 1.0, None)
        for a, b in zip(env.scene.model.pair_geom1, env.scene.model.pair_geom2, strict=True)
    )
    for i, agent in enumerate(env.agents):
        mount = env.scene.mounts[agent]
        tip = mount.rotation.T @ (data.site(f"{agent}/tool_tip").xpos - mount.position)
        assert step.infos[agent]["tip_error"][0] == pytest.approx(np.linalg.norm(goal[i] - tip), abs=1e-6)
        assert step.infos[agent]["min_distance"][0] == pytest.approx(least, abs=1e-6)


def test_an_episode_is_cut_off_and_the_next_begins_in_the_same_step() -> None:
    env, rng = batched(), np.random.default_rng(0)
    first, *_ = env.reset(5)
    goals = [env.goal.targets]
    for _ in range(2):
        for i in range(env.max_steps):
            step = env.step(random_actions(env, rng))
            assert (step.truncated == (i == env.max_steps - 1)).all()
            assert not step.terminated.any()
            ended = i == env.max_steps - 1
            for agent in env.agents:
                same = np.array_equal(step.observations[agent], step.final_observations[agent])
                assert same != ended
        goals.append(env.goal.targets)
        assert (env.steps == 0).all()
        np.testing.assert_allclose(env.qpos, np.broadcast_to(env.scene.home, env.qpos.shape), atol=1e-6)
        joints = len(env.scene.mounts["psm_0"].arm.actuated)
        np.testing.assert_array_equal(step.observations["psm_0"][:, :joints], first["psm_0"][:, :joints])
    assert len({goal.tobytes() for goal in goals}) == 3


def test_environments_reset_one_by_one() -> None:
    env, rng = batched(), np.random.default_rng(0)
    env.reset(5)
    env.steps = np.array([0, env.max_steps - 1, 3, 0])
    before = env.goal.targets
    step = env.step(random_actions(env, rng))
    assert step.truncated.tolist() == [False, True, False, False]
    assert env.steps.tolist() == [1, 0, 4, 1]
    changed = (env.goal.targets != before).any(axis=(1, 2))
    assert changed.tolist() == [False, True, False, False]


@pytest.mark.parametrize(("scene", "num_envs"), [("psm", 64), ("bimanual_psm", 4)])
def test_episodes_do_not_depend_on_the_number_of_environments(scene: str, num_envs: int) -> None:
    """Goals exactly; numbers to what the order of float32 sums in a wider batch may change. 64 share the cores."""
    one, many = batched(scene, 1), batched(scene, num_envs)
    rng = np.random.default_rng(4)
    alone, *_ = one.reset(11)
    among, *_ = many.reset(11)
    for _ in range(2 * one.max_steps):
        np.testing.assert_array_equal(one.goal.targets[0], many.goal.targets[0])
        for agent in one.agents:
            np.testing.assert_allclose(alone[agent][0], among[agent][0], atol=2e-4, rtol=1e-4)
        actions = random_actions(many, rng)
        alone = one.step({agent: action[:1] for agent, action in actions.items()}).observations
        among = many.step(actions).observations


def test_one_seed_is_one_series_of_episodes() -> None:
    def play(seed: int) -> list[np.ndarray]:
        env, rng = batched(), np.random.default_rng(0)
        env.reset(seed)
        steps = [env.step(random_actions(env, rng)) for _ in range(60)]
        return [np.concatenate([step.state, *(r[:, None] for r in step.rewards.values())], 1) for step in steps]

    first, second, other = play(1), play(1), play(2)
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    assert not np.array_equal(first[0], other[0])


def test_reset_without_a_seed_goes_on_to_the_next_episode() -> None:
    env, rng = batched(), np.random.default_rng(0)
    env.reset(1)
    played = [env.goal.targets]
    for _ in range(2):
        for _ in range(env.max_steps):
            env.step(random_actions(env, rng))
        played.append(env.goal.targets)
    env.reset(1)
    env.reset()
    np.testing.assert_array_equal(env.goal.targets, played[1])
    env.reset()
    np.testing.assert_array_equal(env.goal.targets, played[2])


def test_carry_restores_exactly() -> None:
    env = batched()
    env.reset(7)
    rng = np.random.default_rng(1)
    for _ in range(10):
        env.step(random_actions(env, rng))
    saved, actions = env.carry(), random_actions(env, rng)
    expected = env.step(actions).state
    env.reset(8)
    env.set_carry(saved)
    np.testing.assert_array_equal(env.step(actions).state, expected)
    with pytest.raises(ValueError, match="does not fit"):
        batched(num_envs=1).set_carry(saved)


def test_goals_are_reachable_and_spread_as_in_the_paper() -> None:
    env = batched()
    table = env.task.tables["targets"]
    assert np.abs(table.std(axis=0) - 0.05).max() < 0.01  # a little less than 0.05: far draws are not reachable
    assert np.abs(table.mean(axis=0) - [0, 0, -0.11]).max() < 0.01
    from surgical_marl.robots.inverse_kinematics import inverse_kinematics

    arm = env.scene.mounts["psm_0"].arm
    q = inverse_kinematics(arm, table[:200, 0], arm.home)
    assert np.linalg.norm(arm.forward_kinematics(q)[:, :3, 3] - table[:200, 0], axis=-1).max() < 1.1e-4
    assert (q >= arm.lower).all() and (q <= arm.upper).all()


def test_jaw_opens_and_closes_on_one_command() -> None:
    env = batched("psm", 1)
    env.reset(0)
    action = np.zeros((1, 7), np.float32)
    for command, width in ((1e-3, 0.5), (0.0, 0.02)):
        action[0, 6] = command
        for _ in range(24):
            env.step({"psm_0": action})
            env.steps = np.zeros(1, np.int32)  # one long episode
        np.testing.assert_allclose(env.qpos[0, 6:8], width, atol=5e-3)


def settle(env: Any, data: mujoco.MjData, start: dict[str, np.ndarray]) -> Any:
    """Two arms pressed against each other by their controllers, once the force of the made-up overlap has settled in C
    MuJoCo; the same state for `Simulator`."""
    data.qpos[:] = env.scene.full_qpos(start)
    pressed = env.scene.full_qpos({**start, "psm_0": start["psm_0"] - [0, 0.04, 0, 0, 0, 0, 0]})
    data.ctrl[:] = env.scene.moment @ pressed
    mujoco.mj_step(env.scene.model, data, 10 * DECIMATION)
    arrays = (np.float32(a) for a in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl))
    return Physics({"arms": ArmState(*arrays)})  # type: ignore[arg-type]


@cache
def compiled(scene: str) -> tuple[Any, Any, Any]:
    """An `Env`, and commands and a control step of its physics by MJX, which take up to a minute to compile."""
    env = batched(scene).env
    return env, jax.jit(commander(env.simulator)), jax.jit(env.simulator.advance)


def rollout(scene: str, steps: int, model: Any = None, start: dict[str, np.ndarray] | None = None) -> tuple[Any, ...]:
    """The same random commands through `Env` (MJX, float32) and C MuJoCo: qpos of both after each control step."""
    env, command, advance = compiled(scene)
    rng = np.random.default_rng(0)
    physics = env.reset(jax.random.PRNGKey(0)).carry.physics
    data = mujoco.MjData(env.scene.model)
    data.qpos[:] = np.asarray(physics.qpos)
    if start is not None:
        physics = settle(env, data, start)
    ours, theirs, touched = [], [], []
    for _ in range(steps):
        actions = {agent: rng.uniform(-1, 1, env.num_actions(agent)).astype(np.float32) for agent in env.agents}
        if start is not None:
            actions = {agent: np.zeros_like(action) for agent, action in actions.items()}
        physics = command(physics, actions)
        data.ctrl[:] = np.asarray(physics.ctrl)
        physics, _, _ = advance(physics)
        for _ in range(DECIMATION):
            mujoco.mj_step(env.scene.model, data)
        ours.append(np.asarray(physics.qpos))
        theirs.append(data.qpos.copy())
        touched.append(data.ncon)
    return np.array(ours), np.array(theirs), np.array(touched)


# MJX takes up to a minute to compile for the others: `pytest -m slow` takes them
QUICK = ("psm", "ecm", "bimanual_psm")


@pytest.mark.parametrize(
    "scene", [scene if scene in QUICK else pytest.param(scene, marks=pytest.mark.slow) for scene in list_scenes()]
)
def test_mjx_agrees_with_c_mujoco_over_200_random_control_steps(scene: str) -> None:
    ours, theirs, _ = rollout(scene, 200)
    assert np.abs(ours - theirs).max() < 1e-3


def test_mjx_agrees_with_c_mujoco_in_contact() -> None:
    """Two tools pressed against each other by their controllers."""
    lean = np.array([0.0, 0.0, 0.16, 0.0, 0.0, 0.0, 0.0])
    aside = np.array([0.03, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0])
    start = {"psm_0": lean + aside, "psm_1": lean - aside * [1, 0, 0, 0, 0, 0, 0]}
    ours, theirs, touched = rollout("bimanual_psm", 50, start=start)
    assert np.mean(touched > 0) > 0.9
    assert np.abs(ours - theirs).max() < 1e-3


def test_every_pair_shows_its_distance_penetration_and_force() -> None:
    """Against C MuJoCo: forces and depths of its physics steps, distances where the control step ends."""
    env, _, advance = compiled("bimanual_psm")
    start = {"psm_0": np.array([0.03, 0.02, 0.16, 0, 0, 0, 0.0]), "psm_1": np.array([-0.03, 0.0, 0.16, 0, 0, 0, 0.0])}
    model, data = env.scene.model, mujoco.MjData(env.scene.model)
    physics, contacts, views = advance(settle(env, data, start))
    ids = [set(pair) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True)]
    assert [{model.geom(n).id for n in pair} for pair in env.scene.pairs] == ids
    depth, force, wrench = np.zeros(len(ids)), np.zeros(len(ids)), np.zeros(6)
    for step in range(DECIMATION + 1):
        mujoco.mj_step(model, data) if step < DECIMATION else mujoco.mj_forward(model, data)
        for i, contact in enumerate(data.contact):  # of the state that the step began with
            pair = ids.index({int(g) for g in contact.geom})
            depth[pair] = max(depth[pair], -contact.dist)
            if step < DECIMATION:
                mujoco.mj_contactForce(model, data, i, wrench)
                force[pair] = max(force[pair], wrench[0])
    assert depth.max() > 2e-5 and force.max() > 1
    np.testing.assert_allclose(contacts.penetration, depth, atol=2e-5)
    np.testing.assert_allclose(contacts.force, force, rtol=0.02, atol=0.02)
    data.qpos[:] = physics.qpos  # both roads' ends differ by some 1e-5 m by now
    mujoco.mj_kinematics(model, data)
    distance = [mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a, b in zip(
        model.pair_geom1, model.pair_geom2, strict=True)]  # fmt: skip
    np.testing.assert_allclose(contacts.distance, distance, atol=5e-6)
    for agent, view in views.items():
        own = [agent in "".join(pair) for pair in env.scene.pairs]
        assert view.collision and view.contact_force == pytest.approx(force[own].max(), rel=0.02)


def test_contacts_that_are_left_out_are_counted() -> None:
    """Two wrists inside each other, in so many pairs that not all become rows; then apart."""
    env, q = batched(), {
        "psm_0": np.array([-0.006, 0.102, 0.131, 3.189, -1.363, -0.372, 0.403]),
        "psm_1": np.array([-0.287, -0.021, 0.165, -0.227, 1.396, -0.422, 0.611]),
    }  # fmt: skip
    env.reset(0)
    model, data = env.scene.model, host_data(env)
    qpos = env.qpos.copy()
    qpos[1] = data.qpos[:] = env.scene.full_qpos(q)
    mujoco.mj_kinematics(model, data)
    ids = zip(model.pair_geom1, model.pair_geom2, strict=True)
    overlapping = sum(mujoco.mj_geomDistance(model, data, a, b, 1.0, None) < 0 for a, b in ids)
    assert overlapping > SLOTS
    env.engine.write(".physics.arms.qpos", qpos.astype(np.float32))
    infos = env.step(random_actions(env, np.random.default_rng(0))).infos
    for agent in env.agents:
        left_out = infos[agent]["contact_overflow"]
        assert left_out.dtype == np.int32 and left_out[1] >= overlapping - SLOTS
        assert not left_out[[0, 2, 3]].any()


@pytest.mark.parametrize("scene", SCENES)
def test_no_limit_is_passed_and_nothing_breaks_at_full_effort(scene: str) -> None:
    """Actions that push every joint to a limit and back: limits give at most 1 % of their range."""
    env = batched(scene)
    env.reset(0)
    lower = env.scene.model.jnt_range[:, 0]
    upper = env.scene.model.jnt_range[:, 1]
    for direction in (1.0, -1.0):
        for _ in range(150):
            env.step({agent: np.full((4, 7), direction, np.float32) for agent in env.agents})
            env.steps = np.zeros(4, np.int32)
            passed = np.maximum(env.qpos - upper, lower - env.qpos) / (upper - lower)
            assert np.isfinite(env.qpos).all() and passed.max() < 0.01
    assert env.control_dt == TIMESTEP * DECIMATION


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"task": "reech"}, "unknown task 'reech', did you mean 'reach'"),
        ({"scene": "bimanual"}, "unknown scene 'bimanual'"),
        ({"control": "force"}, r"unknown control 'force' \(choose from cartesian, position, torque, velocity\)"),
        ({"engine": "warp"}, "unknown engine 'warp'"),
        ({"device": "tpu"}, "unknown device 'tpu'"),
        ({"num_envs": 0}, "num_envs must be a whole number of at least 1, not 0"),
        ({"max_steps": 0}, "max_steps must be"),
        ({"arrays": "tf"}, "unknown arrays 'tf'"),
    ],
)
def test_bad_options_are_one_sentence(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        BatchedEnv(**options)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda actions: actions.pop("psm_1"), "no action for agent 'psm_1'"),
        (lambda actions: actions.update(ecm_0=actions["psm_0"]), "'ecm_0', which is not an agent"),
        (lambda actions: actions.update(psm_0=actions["psm_0"][:, :6]), "has shape"),
        (lambda actions: actions["psm_0"].__setitem__((0, 0), np.nan), "not finite"),
    ],
)
def test_bad_actions_are_one_sentence(change: Any, words: str) -> None:
    env = batched()
    env.reset(0)
    actions = random_actions(env, np.random.default_rng(0))
    change(actions)
    with pytest.raises(ValueError, match=words):
        env.step(actions)
