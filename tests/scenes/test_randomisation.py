"""Scenes whose arms differ from their models: what is drawn, what it does, what policies see of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from surgical_marl.content import find
from surgical_marl.control.controller import Controller
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.physics.plant import Plant
from surgical_marl.physics.simulator import Simulator
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.timing import DECIMATION
from tests.helpers import ROOT
from tests.helpers.rollouts import read_state, roll_out

ALL = (
    "{offset_angle: 0.05, offset_slide: 0.003, backlash_angle: 0.02, backlash_slide: 0.001, noise_angle: 0.001, "
    "noise_slide: 0.0002, stiffness: 0.1, damping: 0.1, friction: 0.5, payload: 0.02, latency: 2}"
)
STEPS = 4
"""Of episodes, where they have to end: the same number everywhere, so that one kernel serves."""


def scene_file(folder: Path, randomisation: str, name: str = "psm") -> str:
    """A shipped scene with a randomisation of its own."""
    path = folder / f"{name}.yaml"
    path.write_text(find("scenes", name).read_text() + f"\nrandomisation: {randomisation}\n")
    return str(path)


def plant_of(path: str, control: str = "position") -> Plant:
    simulator = Simulator(load_scene(path, control))
    return Plant(simulator, Controller(simulator.scene, control, dt=simulator.control_dt))


def drawn(plant: Plant, count: int = 500) -> Any:
    keys = jax.vmap(jax.random.PRNGKey)(jnp.arange(count))
    return jax.jit(jax.vmap(plant.start))(keys)


def test_draws_fill_their_ranges_and_nothing_else(tmp_path: Path) -> None:
    plant = plant_of(scene_file(tmp_path, ALL))
    hidden, model = drawn(plant), plant._simulator.scene.model
    slides = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    jaws = np.array(["jaw" in model.joint(i).name for i in range(model.njnt)])
    for values, angle, slide, low in ((hidden.offset, 0.05, 0.003, -1), (hidden.backlash, 0.02, 0.001, 0)):
        bound = np.where(jaws, 0.0, np.where(slides, slide, angle))
        assert (np.abs(values) <= bound * 1.0001).all() and (values >= low * bound * 1.0001).all()
        np.testing.assert_allclose(np.max(values, 0), bound, rtol=0.03)
        np.testing.assert_allclose(np.min(values, 0), low * bound, atol=0.03 * 0.05)
    for factor, share in ((hidden.stiffness, 0.1), (hidden.damping, 0.1), (hidden.friction, 0.5)):
        np.testing.assert_allclose([np.min(factor), np.max(factor)], [1 - share, 1 + share], rtol=0.01)
        assert np.abs(np.corrcoef(np.asarray(factor).T) - np.eye(factor.shape[1])).max() < 0.25  # each its own
    assert set(np.asarray(hidden.latency)) == {0, 1, 2}
    assert 0 <= np.min(hidden.payload) < 0.001 < 0.019 < np.max(hidden.payload) <= 0.02


def test_without_randomisation_nothing_is_drawn() -> None:
    assert plant_of("psm").start(jax.random.PRNGKey(0)) is None
    assert Env("reach", "psm").reset(jax.random.PRNGKey(0)).carry.hidden is None


def test_a_varied_simulator_is_a_varied_model(tmp_path: Path) -> None:
    """A second of motion with other gains, friction, payload and offsets, against C MuJoCo with the model's fields set
    by hand."""
    path = scene_file(tmp_path, ALL)
    scene, other = load_scene(path), load_scene(path)
    simulator, plant = Simulator(scene), plant_of(path)
    hidden = plant.start(jax.random.PRNGKey(3))
    model, data = other.model, mujoco.MjData(other.model)
    model.actuator_gainprm[:, 0] *= hidden.stiffness
    model.actuator_biasprm[:, 1] *= hidden.stiffness
    model.actuator_biasprm[:, 2] *= hidden.damping
    model.dof_frictionloss[:] *= hidden.friction
    model.dof_damping[:] *= hidden.friction
    model.body_mass[model.body("psm_0/payload").id] = hidden.payload[0]
    data.qpos[:] = scene.home
    rng = np.random.default_rng(0)
    varied = simulator.varied(hidden.stiffness, hidden.damping, hidden.friction, hidden.payload, hidden.offset)
    advance, physics = jax.jit(varied.advance), simulator.home
    nominal, straight = jax.jit(simulator.advance), simulator.home
    commands = []
    for _ in range(50):
        posture = scene.home + rng.uniform(-0.02, 0.02, model.nq) * [1, 1, 0.2, 1, 1, 1, 0, 0]
        ctrl = scene.moment @ posture
        physics, straight = (p.with_arms(ctrl=jnp.asarray(ctrl, jnp.float32)) for p in (physics, straight))
        physics, straight = advance(physics)[0], nominal(straight)[0]
        commands += [ctrl - scene.moment @ np.asarray(hidden.offset)] * DECIMATION  # by joints that are misread
    _, qpos, _ = roll_out(model, data, read_state(model, data)[None], np.array([commands]))
    np.testing.assert_allclose(physics.qpos, qpos[0, -1], atol=2e-5)
    assert np.abs(np.asarray(straight.qpos) - qpos[0, -1]).max() > 1e-3


def test_readings_are_off_by_the_offset_and_the_noise(tmp_path: Path) -> None:
    """What is observed at home; arms stay where they are, as they believe to be where they are told to."""
    path = scene_file(tmp_path, "{offset_angle: 0.05, offset_slide: 0.003, noise_angle: 0.001, noise_slide: 0.0002}")
    env = BatchedEnv("reach", path, num_envs=400)
    observations, *_ = env.reset(0)
    arm = env.scene.mounts["psm_0"].arm
    offset = env.carry()[".hidden.offset"][:, env.scene.qpos_index("psm_0")]
    noise = observations["psm_0"][:, :7] - arm.home - offset
    np.testing.assert_allclose(noise[:, :6].std(0), [1e-3, 1e-3, 2e-4, 1e-3, 1e-3, 1e-3], rtol=0.15)
    assert np.abs(noise[:, 6]).max() < 1e-6
    # the tip that is observed is that of the joints that are read
    tip = arm.forward_kinematics(observations["psm_0"][:, :7].astype(float))[:, :3, 3]
    np.testing.assert_allclose(observations["psm_0"][:, 14:17], tip, atol=1e-6)
    before = env.qpos
    for _ in range(3):
        step = env.step({"psm_0": np.zeros((400, 7), np.float32)})
    np.testing.assert_allclose(env.qpos, before, atol=1e-5)
    # while errors are those of the arms as they are
    tip = arm.forward_kinematics(env.qpos[:, env.scene.qpos_index("psm_0")].astype(float))[:, :3, 3]
    error = np.linalg.norm(env.carry()[".goal.targets"][:, 0] - tip, axis=-1)
    np.testing.assert_allclose(step.infos["psm_0"]["tip_error"], error, atol=1e-6)


def test_actions_come_late(tmp_path: Path) -> None:
    """By whole control steps: what a late environment does, a punctual one did so many steps before."""
    late = BatchedEnv("reach", scene_file(tmp_path, "{latency: 3}"), num_envs=64)
    punctual = BatchedEnv("reach", "psm", num_envs=64)
    late.reset(0)
    punctual.reset(0)
    latency, rng = late.carry()[".hidden.latency"], np.random.default_rng(0)
    assert set(latency) == {0, 1, 2, 3}
    paths: tuple[list[Any], list[Any]] = ([], [])
    for _ in range(12):
        action = {"psm_0": rng.uniform(-1, 1, (64, 7)).astype(np.float32)}
        for env, path in zip((late, punctual), paths, strict=True):
            env.step(action)
            path.append(env.qpos)
    for i, k in enumerate(latency):
        np.testing.assert_allclose(np.array(paths[0])[k:, i, :6], np.array(paths[1])[: 12 - k, i, :6], atol=1e-5)


def test_a_joint_follows_its_motor_across_the_play(tmp_path: Path) -> None:
    """To and fro: the joint's target lags half the play behind the motor each way; the encoder sees the motor."""
    env = BatchedEnv("reach", scene_file(tmp_path, "{backlash_angle: 0.04}"), num_envs=32)
    env.reset(0)
    gap = env.carry()[".hidden.backlash"]
    for direction in (1.0, -1.0):
        for _ in range(6):
            action = np.zeros((32, 7), np.float32)
            action[:, 0] = 0.4 * direction
            step = env.step({"psm_0": action})
        carry = env.carry()
        ahead = carry[".hidden.motor"][:, 0] - carry[".physics.arms.ctrl"][:, 0]
        np.testing.assert_allclose(ahead, direction * gap[:, 0] / 2, atol=1e-6)
        np.testing.assert_allclose(step.observations["psm_0"][:, 0], env.qpos[:, 0] + ahead, atol=1e-6)


def test_same_seed_same_draw_whatever_the_number(tmp_path: Path) -> None:
    path = scene_file(tmp_path, ALL)
    few, many = (BatchedEnv("reach", path, num_envs=count, max_steps=STEPS) for count in (2, 5))
    first = []
    for episode in range(2):
        for env in (few, many):
            if episode == 0:
                env.reset(7)
            else:
                for _ in range(STEPS):
                    env.step({"psm_0": np.zeros((env.num_envs, 7), np.float32)})
        draws = [env.carry()[".hidden.offset"] for env in (few, many)]
        np.testing.assert_array_equal(draws[0], draws[1][:2])
        first.append(draws[1])
    assert (np.abs(first[0] - first[1])[:, :6] > 0).all(), "every episode draws anew"


@pytest.mark.parametrize("scene", ["psm", pytest.param("bimanual_psm", marks=pytest.mark.slow)])
def test_both_engines_draw_and_do_the_same(tmp_path: Path, scene: str) -> None:
    path, rng = scene_file(tmp_path, ALL, scene), np.random.default_rng(0)
    fused, mjx = (BatchedEnv("reach", path, num_envs=32, engine=engine, max_steps=STEPS) for engine in ("fused", "mjx"))
    for env in (fused, mjx):
        env.reset(1)
    for _ in range(6):
        action = {a: rng.uniform(-1, 1, (32, env.action_space(a).shape[0])).astype(np.float32) for a in fused.agents}
        one, other = fused.step(action), mjx.step(action)
        for agent in fused.agents:
            np.testing.assert_allclose(one.observations[agent], other.observations[agent], atol=1e-4)
            assert fused.observation_space(agent).contains(one.observations[agent][0])
    np.testing.assert_allclose(fused.carry()[".hidden.offset"], mjx.carry()[".hidden.offset"], atol=1e-7)


def test_the_pages_ranges_put_the_tip_as_far_off_as_a_real_dvrks(tmp_path: Path) -> None:
    """docs/randomisation.md: 3.1 mm on average where 2.96 mm were measured."""
    page = (ROOT / "docs" / "randomisation.md").read_text()
    block = page.split("```yaml\n")[1].split("```")[0]
    path = tmp_path / "psm.yaml"
    path.write_text(find("scenes", "psm").read_text() + "\n" + block)
    hidden, arm = drawn(plant_of(str(path)), 2000), load_scene("psm").mounts["psm_0"].arm
    rng = np.random.default_rng(0)
    q = arm.home + rng.uniform(-0.3, 0.3, (2000, 7)) * [1, 1, 0.1, 1, 1, 1, 0]
    off = np.asarray(hidden.offset + hidden.backlash / 2 * rng.choice([-1, 1], hidden.backlash.shape))[:, :7]
    tip = lambda q: arm.forward_kinematics(q)[:, :3, 3]  # noqa: E731
    assert 2.9e-3 < np.linalg.norm(tip(q + off) - tip(q), axis=-1).mean() < 3.2e-3


@pytest.mark.parametrize(
    "wrong, words",
    [
        ("{offset: 0.1}", "unknown key 'offset'"),
        ("{stiffness: 1.0}", "stiffness must be a number from 0 to 0.999, not 1"),
        ("{payload: -0.1}", "payload must be a number from 0 to .*, not -0.1"),
        ("{payload: .nan}", "payload must be a number from 0 to .*, not nan"),
        ("{latency: 1.5}", "latency must be a whole number from 0 to 50 .control steps., not 1.5"),
        ("{latency: true}", "latency must be a whole number"),
        ("3", "must be a mapping"),
    ],
)
def test_a_wrong_range_is_one_sentence(tmp_path: Path, wrong: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as error:
        load_scene(scene_file(tmp_path, wrong))
    assert "\n" not in str(error.value)
