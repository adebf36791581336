"""Messages between agents: who hears what and when, in every interface, policy and algorithm."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import onnxruntime
import pytest
import torch
from pettingzoo.test import parallel_api_test

import surgical_marl as sm
from surgical_marl import BatchedEnv
from surgical_marl.learning import train
from surgical_marl.learning.demonstrations import Demonstrations
from surgical_marl.policies.actor import load_actor
from surgical_marl.policies.layout import Layout
from surgical_marl.policies.onnx_file import write_onnx
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.team import check_fits
from surgical_marl.policies.weights import write_weights
from surgical_marl.runs.folder import read_settings
from surgical_marl.runs.settings import ImitationSettings, NetworkSettings, PPOSettings, Settings
from tests.helpers.runs import untrained_policy
from tests.helpers.scenes import PAIR

SCENE, K, JOINTS = PAIR, 2, 4
SMALL = Settings(
    scene=SCENE, knowledge="one", messages=K, num_envs=8, iterations=1, steps_per_iteration=4, device="cpu",
    engine="fused", network=NetworkSettings(hidden=(16,)), ppo=PPOSettings(epochs=1, mini_batches=1),
)  # fmt: skip


@cache
def made(num_envs: int = 3, scene: str = SCENE, **options: Any) -> BatchedEnv:
    return BatchedEnv("reach", scene, num_envs=num_envs, engine="fused", device="cpu", max_steps=4, **options)


def drawn(env: Any, rng: np.random.Generator, share: float = 1.0) -> dict[str, np.ndarray]:
    return {
        agent: rng.uniform(-share, share, (env.num_envs, *env.action_space(agent).shape)).astype(np.float32)
        for agent in env.agents
    }


def heard(env: BatchedEnv, observations: dict[str, Any], agent: str) -> np.ndarray:
    return np.array(observations[agent][:, env.observation_terms(agent)["messages"]])


def test_teammates_hear_after_the_step_what_an_agent_said_in_it() -> None:
    """Over the end of an episode: its last observation still has the messages, the first of the next one zeros."""
    env, rng = made(knowledge="one", messages=K), np.random.default_rng(0)
    observations, state, _ = env.reset(seed=0)
    assert not any(heard(env, observations, agent).any() for agent in env.agents)
    for number in range(1, 10):
        actions = drawn(env, rng, share=1.5)  # more than 1 is cut off
        step = env.step(actions)
        said = {agent: np.clip(action[:, JOINTS:], -1, 1) for agent, action in actions.items()}
        for agent, mate in (("ecm_0", "ecm_1"), ("ecm_1", "ecm_0")):
            np.testing.assert_array_equal(heard(env, step.final_observations, agent), said[mate])
            ended = number % 4 == 0
            np.testing.assert_array_equal(heard(env, step.observations, agent), 0 if ended else said[mate])
        np.testing.assert_array_equal(step.final_state[:, -2 * K :], np.concatenate(list(said.values()), 1))
    env.reset(seed=0)
    assert not env.carry()[".messages"].any() and not np.array_equal(state, step.state)


@pytest.mark.slow
def test_three_agents_hear_each_other_in_their_order() -> None:
    env, rng = made(scene="trimanual_psm_ecm", messages=K), np.random.default_rng(0)
    env.reset(seed=0)
    actions = drawn(env, rng)
    step = env.step(actions)
    for agent in env.agents:
        mates = [actions[mate][:, -K:] for mate in env.agents if mate != agent]
        np.testing.assert_array_equal(heard(env, step.observations, agent), np.concatenate(mates, 1))


def test_words_move_nothing() -> None:
    talking, silent = made(knowledge="one", messages=K), made(knowledge="one")
    rng, paths = np.random.default_rng(0), []
    for env in (talking, silent):
        env.reset(seed=0)
    for _ in range(6):
        actions = drawn(talking, rng)
        one = talking.step(actions)
        other = silent.step({agent: action[:, :JOINTS] for agent, action in actions.items()})
        paths.append(np.abs(talking.qpos - silent.qpos).max())
        for agent in talking.agents:
            np.testing.assert_allclose(one.rewards[agent], other.rewards[agent], atol=1e-6)
            parts = heard(talking, one.observations, agent).shape[1]
            np.testing.assert_allclose(one.observations[agent][:, :-parts], other.observations[agent], atol=1e-6)
    assert max(paths) < 1e-6


def test_every_face_has_them() -> None:
    options = {"scene": SCENE, "messages": K, "engine": "fused", "device": "cpu", "max_steps": 4}
    env = sm.parallel_env("reach", **options)
    assert env.action_space("ecm_0") == gymnasium.spaces.Box(-1, 1, (JOINTS + K,))
    seen = sm.parallel_env("reach", **{**options, "messages": 0}).observation_space("ecm_0").shape[0]
    assert env.observation_space("ecm_0").shape == (seen + K,)
    parallel_api_test(env, num_cycles=10)
    single, vector = (make("surgical_marl/Reach-v0", **options) for make in (gymnasium.make, make_vec))
    assert single.action_space.shape == (2 * (JOINTS + K),) and vector.action_space.shape == (2, 2 * (JOINTS + K))
    said = np.arange(1, 2 * (JOINTS + K) + 1, dtype=np.float32) / 100
    alone = gymnasium.make("surgical_marl/Reach-v0", agent="ecm_1", teammates={"ecm_0": mute}, **options)
    for face in (single, vector, alone):
        face.reset(seed=0)
    found, many = single.step(said)[0], vector.step(np.stack([said, said]))[0][0]
    np.testing.assert_allclose(found[seen : seen + K], said[-K:], atol=1e-6)  # ecm_0 hears ecm_1
    np.testing.assert_allclose(many[-K:], said[JOINTS : JOINTS + K], atol=1e-6)
    np.testing.assert_allclose(alone.step(said[: JOINTS + K])[0][-K:], MUTE)


MUTE = 0.25


def mute(seen: np.ndarray) -> np.ndarray:
    return np.full(JOINTS + K, MUTE, np.float32)


def make_vec(name: str, **options: Any) -> Any:
    return gymnasium.make_vec(name, num_envs=2, **options)


@pytest.mark.slow
def test_pure_functions_have_them() -> None:
    env = sm.jax_env("reach", scene=SCENE, messages=K, decimation=1)
    _, state = env.reset(jax.random.key(0))
    actions = {agent: env.action_space(agent).sample(jax.random.key(1)) for agent in env.agents}
    observations, *_ = env.step(None, state, actions)
    np.testing.assert_allclose(observations["ecm_0"][-K:], actions["ecm_1"][-K:], atol=1e-6)


def test_torchrl_has_them() -> None:
    pytest.importorskip("torchrl")
    from surgical_marl.interfaces.torchrl import TorchRLEnv

    env = TorchRLEnv(BatchedEnv("reach", SCENE, num_envs=2, messages=K, engine="fused", device="cpu", arrays="torch"))
    found = env.rollout(2)["ecm"]
    heard = found["observation"][:, 1, :, -K:]
    torch.testing.assert_close(heard, found["action"][:, 0, :, JOINTS:].flip(-2).clamp(-1, 1))


def test_the_oracle_says_nothing_and_needs_no_words() -> None:
    for scene, task, joints in ((SCENE, "reach", JOINTS), ("bimanual_psm_needle", "needle_handover", 7)):
        env = BatchedEnv(task, scene, num_envs=2, messages=K, engine="mjx", device="cpu")
        actions = oracle(env)(env.reset(seed=0)[0])
        for action in actions.values():
            assert action.shape == (2, joints + K) and action[:, :joints].any() and not action[:, joints:].any()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train.train(SMALL, out=tmp_path_factory.mktemp("runs") / "run")


@pytest.mark.slow
def test_a_run_remembers_them_and_its_policy_speaks(run: Path) -> None:
    assert read_settings(run) == SMALL
    env = made(knowledge="one", messages=K)
    actions = load_policy(run, env)(env.reset(seed=0)[0])
    assert {agent: action.shape for agent, action in actions.items()} == dict.fromkeys(env.agents, (3, JOINTS + K))
    assert all(action[:, JOINTS:].any() for action in actions.values())
    for other, message in (({"knowledge": "one"}, "of messages 2, not 0"), ({"messages": K}, "of knowledge 'one'")):
        with pytest.raises(ValueError, match=message):
            check_fits(str(run), made(**other))
    with pytest.raises(ValueError, match="of 33 observations and 6 actions"):
        load_policy(run, made(knowledge="one"))


def test_words_mean_something_before_anything_is_learned() -> None:
    """Arms begin near rest. Their words depend on what they observe: else nobody would learn to listen."""
    env = made(knowledge="one", messages=K)
    actions = untrained_policy(env, SMALL)(env.reset(seed=0)[0])
    for action in actions.values():
        assert np.abs(action[:, :JOINTS]).max() < 0.1 * np.abs(action[:, JOINTS:]).max()
    assert not np.isclose(actions["ecm_0"][0, JOINTS:], actions["ecm_0"][1, JOINTS:]).any()


@pytest.mark.slow
def test_onnx_speaks_too(run: Path, tmp_path: Path) -> None:
    env = made(knowledge="one", messages=K)
    actor, layout = load_actor(run, env)
    observations = env.reset(seed=0)[0]
    expected = load_policy(run, env)(observations)
    write_weights(tmp_path, actor)
    for name, model in actor.models.items():
        write_onnx(tmp_path / f"{name}.onnx", model, layout.pictures[name])
        session = onnxruntime.InferenceSession(tmp_path / f"{name}.onnx")
        (agent,) = layout.groups[name]
        (found,) = session.run(None, {"observation": observations[agent]})
        np.testing.assert_allclose(found, expected[agent], atol=1e-5)


@pytest.mark.slow
def test_imitation_learns_silence() -> None:
    settings = replace(SMALL, imitation=ImitationSettings(steps=1))
    env = made(knowledge="one", messages=K)
    shown = Demonstrations(settings, Layout(env), "cpu").actions
    widths = [JOINTS, K] * 2
    joints, words, more, others = shown.split(widths, -1)
    assert joints.any() and more.any() and not words.any() and not others.any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"messages": -1}, "messages must be a whole number from 0 to 64, not -1"),
        ({"messages": 1.5}, "messages must be a whole number"),
        ({"messages": 2, "scene": "psm"}, "messages must be 0 in a scene of one arm such as 'psm', not 2"),
        ({"observe": {"ecm_0": ["qpos", "messages"]}}, "unknown observation term of 'ecm_0' 'messages'"),
    ],
)
def test_bad_messages_are_one_sentence(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        sm.parallel_env("reach", **{"scene": SCENE, **options})
    assert "\n" not in str(caught.value)


def test_an_agent_can_be_deaf() -> None:
    env = BatchedEnv("reach", SCENE, num_envs=1, messages=K, observe={"ecm_0": ["qpos"]}, engine="mjx", device="cpu")
    assert "messages" not in env.observation_terms("ecm_0") and "messages" in env.observation_terms("ecm_1")
