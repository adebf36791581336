"""The task match_image: hidden poses, and pictures beside what the arms feel."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
import torch
from gymnasium import spaces

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.vision.endoscope import SIZE, Endoscope
from tests.helpers.actions import random_actions
from tests.helpers.devices import needs_cuda, skip_where_warp_lacks
from tests.helpers.scenes import WATCHED

SCENES = ("ecm", pytest.param(WATCHED, marks=pytest.mark.slow))
COUNT, STEPS = 3, 4


@cache
def batched(scene: str = "ecm", arrays: str = "numpy", engine: str = "fused") -> BatchedEnv:
    return BatchedEnv("match_image", scene, num_envs=COUNT, max_steps=STEPS, arrays=arrays, engine=engine)


def hidden(env: BatchedEnv) -> np.ndarray:
    """The postures [N, nq] that the target pictures are taken from now."""
    return env.task.postures["hidden"][env.goal.row]


@pytest.mark.parametrize("scene", SCENES)
def test_pictures_are_of_the_arms_and_of_the_hidden_posture(scene: str) -> None:
    """Over an episode's end: what is seen is the new state, the next episode begins at home with the next target."""
    env, rng = batched(scene), np.random.default_rng(0)
    eye = Endoscope(env.scene, COUNT, env.device)
    observations, state, infos = env.reset(5)
    first = observations["ecm_0"]
    difference = np.abs(first["image"].astype(float) - first["target"]).mean((1, 2, 3))
    np.testing.assert_allclose(infos["ecm_0"]["image_error"], difference, rtol=1e-5)
    camera = env.scene.qpos_index("ecm_0")
    for step in range(STEPS + 1):
        seen = observations["ecm_0"]
        np.testing.assert_array_equal(seen["image"], eye.render(env.qpos).rgb[:, 0])
        np.testing.assert_array_equal(seen["target"], eye.render(hidden(env)).rgb[:, 0])
        np.testing.assert_array_equal(state[:, -len(camera) :], hidden(env)[:, camera].astype(np.float32))
        before = env.goal.row
        outcome = env.step(random_actions(env, rng))
        final, info = outcome.final_observations["ecm_0"], outcome.infos["ecm_0"]
        ended = step == STEPS - 1
        assert outcome.truncated.all() == ended == (not np.array_equal(before, env.goal.row))
        np.testing.assert_array_equal(final["target"], seen["target"])
        assert np.array_equal(final["image"], outcome.observations["ecm_0"]["image"]) != ended
        difference = np.abs(final["image"].astype(float) - final["target"]).mean((1, 2, 3))
        np.testing.assert_allclose(info["image_error"], difference, rtol=1e-5)
        np.testing.assert_allclose(info["reward_image"], -10 / 255 * difference, rtol=1e-5)
        for agent in env.agents:
            terms = [value for name, value in outcome.infos[agent].items() if name.startswith("reward_")]
            np.testing.assert_allclose(outcome.rewards[agent], np.sum(terms, axis=0), rtol=1e-5, atol=1e-6)
        observations, state = outcome.observations, outcome.state


@pytest.mark.parametrize("scene", SCENES)
def test_errors_are_of_the_camera_and_zero_at_the_hidden_posture(scene: str) -> None:
    """Against C MuJoCo's camera: where it is at the state and at the hidden posture."""
    env = batched(scene)
    env.reset(1)
    outcome = env.step(random_actions(env, np.random.default_rng(1)))
    model, data = env.scene.model, mujoco.MjData(env.scene.model)
    for i in range(COUNT):
        poses = []
        for qpos in (env.qpos[i], hidden(env)[i]):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            eyes = [data.cam(f"ecm_0/{side}").xpos.copy() for side in ("left", "right")]
            poses.append((np.mean(eyes, axis=0), data.cam("ecm_0/left").xmat.reshape(3, 3).copy()))
        (here, turn), (there, wanted) = poses
        angle = np.arccos((np.trace(turn.T @ wanted) - 1) / 2)
        assert outcome.infos["ecm_0"]["tip_error"][i] == pytest.approx(np.linalg.norm(here - there), abs=1e-5)
        assert outcome.infos["ecm_0"]["angle_error"][i] == pytest.approx(angle, abs=1e-4)
    env.engine.write(".physics.arms.qpos", hidden(env).astype(np.float32))
    env.engine.write(".physics.arms.qvel", np.zeros((COUNT, model.nv), np.float32))
    env.engine.write(".physics.arms.ctrl", (hidden(env) @ env.scene.moment.T).astype(np.float32))
    still = {a: np.zeros_like(action) for a, action in random_actions(env, np.random.default_rng(0)).items()}
    there = env.step(still).infos["ecm_0"]
    assert there["tip_error"].max() < 1e-4 and there["angle_error"].max() < 2e-3 and there["success"].all()
    assert there["image_error"].max() < 1


@needs_cuda
def test_a_step_in_a_cuda_graph_is_a_step() -> None:
    """Two environments alike, one of them stepped by a graph's replays, over an episode's end."""
    eager, captured = (
        BatchedEnv("match_image", "ecm", num_envs=COUNT, max_steps=STEPS, arrays="torch", engine="fused", device="cuda")
        for _ in range(2)
    )
    for env in (eager, captured):
        env.reset(0)
    actions = {a: torch.from_numpy(rows).cuda() for a, rows in random_actions(eager, np.random.default_rng(0)).items()}
    eager.step(actions)
    captured.step(actions)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=torch.cuda.Stream()):
        found = captured.step(actions)
    for _ in range(STEPS):
        wanted = eager.step(actions)
        graph.replay()
        for part in ("image", "target", "proprioception"):
            assert torch.equal(found.observations["ecm_0"][part], wanted.observations["ecm_0"][part])
        assert torch.equal(found.final_state, wanted.final_state)
        assert torch.equal(found.rewards["ecm_0"], wanted.rewards["ecm_0"])


def test_nothing_observed_but_the_target_picture_depends_on_the_hidden_pose() -> None:
    env = batched(WATCHED)
    env.reset(0)
    carry, actions = env.carry(), random_actions(env, np.random.default_rng(0))
    seen = []
    for shift in (0, 1):
        rows = (carry[".goal.row"] + shift) % len(env.task.postures["hidden"])
        targets = env.task.tables["tips"][rows]
        env.set_carry({**carry, ".goal.row": rows, ".goal.targets": targets})
        seen.append(env.step(actions))
    (one, other) = seen
    assert (one.infos["ecm_0"]["tip_error"] != other.infos["ecm_0"]["tip_error"]).all()
    assert not np.array_equal(one.observations["ecm_0"]["target"], other.observations["ecm_0"]["target"])
    for part in ("image", "proprioception"):
        np.testing.assert_array_equal(one.observations["ecm_0"][part], other.observations["ecm_0"][part])
    known = len(env.scene.qpos_index("ecm_0"))
    np.testing.assert_array_equal(one.state[:, :-known], other.state[:, :-known])
    assert (one.state[:, -known:] != other.state[:, -known:]).all()
    np.testing.assert_array_equal(one.observations["psm_0"], other.observations["psm_0"])


def test_observations_lose_the_targets_and_nothing_else() -> None:
    env = Env("match_image", WATCHED)
    for agent in env.agents:
        n = env.num_actions(agent)
        box = env.observation_space(agent)
        assert box.shape == (3 * n + 3 + 4,)
        low, high = env.scene.mounts[agent].arm.reach
        np.testing.assert_allclose(box.low[2 * n : 2 * n + 3], low, rtol=1e-6)
        np.testing.assert_allclose(box.high[2 * n : 2 * n + 3], high, rtol=1e-6)


@pytest.mark.parametrize("arrays", ["torch", "jax"])
def test_every_library_and_engine_shows_the_same(arrays: str) -> None:
    skip_where_warp_lacks(jax.default_backend())
    env, other, rng = batched(), batched(arrays=arrays, engine="mjx"), np.random.default_rng(0)
    one, *_ = env.reset(2)
    two, *_ = other.reset(2)
    for _ in range(2):
        for part in ("image", "target"):  # not quite the same on a GPU and a CPU
            picture, same = one["ecm_0"][part].astype(int), np.asarray(two["ecm_0"][part]).astype(int)
            assert (np.abs(picture - same) <= 1).mean() > 0.999  # physics agrees to 1e-5
        if env.device == other.device:
            np.testing.assert_array_equal(picture, same)  # no physics moves the target
        assert type(two["ecm_0"]["image"]).__module__.startswith(arrays if arrays == "torch" else "jax")
        actions = random_actions(env, rng)
        one = env.step(actions).observations
        two = other.step({a: torch.from_numpy(v) if arrays == "torch" else v for a, v in actions.items()}).observations


def test_a_picture_is_a_part_of_the_space() -> None:
    space = sm.parallel_env("match_image", scene="ecm").observation_space("ecm_0")
    assert isinstance(space, spaces.Dict) and space["image"] == spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scene": "bimanual_psm"}, "scene 'bimanual_psm' has no endoscope"),
        ({"scene": "psm"}, "is meant for the scenes ecm, trimanual_psm_ecm"),
        ({"scene": "ecm", "difficulty": "harder"}, "unknown difficulty 'harder'"),
        ({"scene": "ecm", "reward": {"pixels": 1}}, "unknown reward term 'pixels'"),
    ],
)
def test_bad_options_are_one_sentence(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        BatchedEnv("match_image", **options)
    assert "\n" not in str(caught.value)


def test_a_scene_without_tissue_is_named(tmp_path: Any) -> None:
    (tmp_path / "bare.yaml").write_text("arms: {ecm_0: {arm: ecm, position: [0, 0, 0.15]}}")
    with pytest.raises(ValueError, match="scene 'bare' has no tissue for its endoscope to look at"):
        BatchedEnv("match_image", str(tmp_path / "bare.yaml"))
