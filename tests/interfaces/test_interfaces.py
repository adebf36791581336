"""The PettingZoo and Gymnasium faces: equal numbers behind both, ends of episodes, and copies."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
import torch
from gymnasium.vector import AutoresetMode

import surgical_marl as sm
from tests.helpers.scenes import APART

SCENES = ("psm", "bimanual_psm")
STEPS = 12


def make(scene: str = "bimanual_psm", **options: Any) -> Any:
    return sm.parallel_env("reach", scene=scene, max_steps=STEPS, **options)


def assert_same(one: Any, other: Any, **tolerance: float) -> None:
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key], **tolerance)
    else:
        np.testing.assert_allclose(one, other, **(tolerance or {"rtol": 0, "atol": 0}))


@pytest.mark.parametrize("scene", SCENES)
def test_every_observation_lies_in_its_space_and_every_info_keeps_the_contract(scene: str) -> None:
    env, rng = make(scene), np.random.default_rng(0)
    for episode in range(2):
        observations, infos = env.reset(seed=episode)
        for step in range(STEPS):
            assert env.state_space.contains(env.state())
            for agent in env.possible_agents:
                assert observations[agent].dtype == np.float32
                assert env.observation_space(agent).contains(observations[agent])
                info = infos[agent]
                assert [type(info[key]) for key in ("tip_error", "success", "collision", "min_distance")] == [
                    float, bool, bool, float]  # fmt: skip
            actions = {agent: rng.uniform(-1, 1, env.action_space(agent).shape) for agent in env.agents}
            observations, rewards, terminations, truncations, infos = env.step(actions)
            ended = step == STEPS - 1
            assert set(truncations.values()) == {ended} and set(terminations.values()) == {False}
            assert all(np.isfinite(reward) for reward in rewards.values())
        assert env.agents == []


def test_what_is_returned_stays_as_it_was() -> None:
    env = make()
    observations, _ = env.reset(seed=0)
    kept, before = observations["psm_0"], observations["psm_0"].copy()
    env.step({agent: np.ones(7) for agent in env.agents})
    np.testing.assert_array_equal(kept, before)
    kept[:] = 7.0
    again, _ = env.reset(seed=0)
    np.testing.assert_array_equal(again["psm_0"], before)


@pytest.mark.parametrize("arrays", ["numpy", "torch", "jax"])
def test_many_environments_are_the_same_dicts_with_a_leading_axis(arrays: str) -> None:
    """The first of three environments plays what one alone plays, and goes on where that one ends."""
    many, one, rng = make(num_envs=3, arrays=arrays), make(), np.random.default_rng(0)
    observations, infos = many.reset(seed=5)
    alone, alone_infos = one.reset(seed=5)
    close = {"atol": 2e-4, "rtol": 1e-4}
    for step in range(STEPS):
        for agent in one.possible_agents:
            assert observations[agent].shape == (3, *one.observation_space(agent).shape)
            assert_same(alone[agent], np.asarray(observations[agent][0]), **close)
            assert_same(alone_infos[agent]["tip_error"], float(infos[agent]["tip_error"][0]), **close)
        actions = {a: rng.uniform(-1, 1, (3, 7)).astype(np.float32) for a in many.agents}
        alone, alone_rewards, _, alone_truncations, alone_infos = one.step({a: v[0] for a, v in actions.items()})
        sent = {a: torch.from_numpy(v) if arrays == "torch" else v for a, v in actions.items()}
        observations, rewards, _, truncations, infos = many.step(sent)
        for agent in many.agents:
            assert_same(alone_rewards[agent], float(rewards[agent][0]), **close)
            assert alone_truncations[agent] == bool(truncations[agent][0]) == (step == STEPS - 1)
            final = infos[agent]["final_observation"]
            assert_same(alone[agent], np.asarray(final[0]), **close)
            if step < STEPS - 1:
                assert_same(np.asarray(final), np.asarray(observations[agent]))
    assert many.agents == many.possible_agents
    assert many.state().shape == (3, *many.state_space.shape)


def test_pettingzoo_makes_it_by_its_id() -> None:
    pytest.importorskip("pettingzoo.env_registry", reason="PettingZoo has ids since 1.27")
    env = pettingzoo.make("parallel", "surgical_marl/reach-v0", scene="psm", max_steps=STEPS)
    assert env.reset(seed=0)[0].keys() == {"psm_0"}


@pytest.mark.parametrize("scene", [*SCENES, APART])
def test_both_faces_show_the_same_numbers(scene: str) -> None:
    joint = gymnasium.make("surgical_marl/Reach-v0", scene=scene, max_steps=STEPS)
    team, rng = make(scene), np.random.default_rng(0)
    observation, _ = joint.reset(seed=9)
    team.reset(seed=9)
    for _ in range(STEPS):
        np.testing.assert_array_equal(observation, team.state())
        assert joint.observation_space.contains(observation)
        action = rng.uniform(-1, 1, joint.action_space.shape).astype(np.float32)
        ends = np.cumsum([team.action_space(agent).shape[0] for agent in team.possible_agents])[:-1]
        actions = dict(zip(team.possible_agents, np.split(action, ends), strict=True))
        observation, reward, terminated, truncated, info = joint.step(action)
        _, rewards, _, truncations, infos = team.step(actions)
        assert reward == pytest.approx(sum(rewards.values()), rel=1e-6)
        assert truncated == truncations["psm_0"] and not terminated
        assert info["tip_error"] == max(i["tip_error"] for i in infos.values())
        assert info["success"] == all(i["success"] for i in infos.values())


def test_a_vector_env_restarts_in_the_step_that_ends() -> None:
    envs = gymnasium.make_vec("surgical_marl/Reach-v0", scene="psm", num_envs=3, max_steps=STEPS)
    one = gymnasium.make("surgical_marl/Reach-v0", scene="psm", max_steps=STEPS)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    observations, _ = envs.reset(seed=2)
    alone, _ = one.reset(seed=2)
    rng = np.random.default_rng(0)
    for step in range(STEPS):
        assert envs.observation_space.contains(observations)
        np.testing.assert_allclose(alone, observations[0], atol=2e-4, rtol=1e-4)
        actions = rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        alone, *_ = one.step(actions[0])
        observations, _, terminated, truncated, infos = envs.step(actions)
        assert truncated.all() == (step == STEPS - 1) and not terminated.any()
    assert infos["_final_obs"].all()
    np.testing.assert_allclose(alone, infos["final_obs"][0], atol=2e-4, rtol=1e-4)
    assert not np.allclose(observations, np.stack(infos["final_obs"]))


def test_pictures_are_for_one_environment() -> None:
    env = make(render_mode="rgb_array", render_size=(64, 50))
    env.reset(seed=0)
    frame = env.render()
    assert frame.dtype == np.uint8 and frame.shape == (50, 64, 3) and frame.std() > 10
    assert make().render() is None
    with pytest.raises(ValueError, match="'rgb_array' is for one environment: leave num_envs 2 out"):
        make(num_envs=2, render_mode="rgb_array")
    with pytest.warns(UserWarning), pytest.raises(ValueError, match="unknown render_mode 'ansi'"):
        gymnasium.make("surgical_marl/Reach-v0", scene="psm", render_mode="ansi")
    with pytest.raises(ValueError, match="num_envs 4 is for many environments: use"):
        gymnasium.make("surgical_marl/Reach-v0", scene="psm", num_envs=4)


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        ({"psm_0": np.zeros(7)}, "no action for agent 'psm_1'"),
        ({"psm_0": np.zeros(7), "psm_1": np.zeros(6)}, "shape"),
        ({"psm_0": np.zeros(7), "psm_1": np.full(7, np.nan)}, "not finite"),
        ({"psm_0": np.zeros(7), "psm_1": np.zeros(7), "ecm_0": np.zeros(4)}, "'ecm_0'"),
    ],
)
def test_a_bad_action_is_one_sentence_and_changes_nothing(actions: dict[str, Any], words: str) -> None:
    env = make()
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ValueError, match=words) as caught:
        env.step(actions)
    assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(env.state(), before)
    env.step({agent: np.zeros(7) for agent in env.agents})


def test_steps_out_of_turn_are_refused() -> None:
    env, still = make(), {agent: np.zeros(7) for agent in ("psm_0", "psm_1")}
    with pytest.raises(ValueError, match=r"no episode is under way: call reset\(\)"):
        env.step(still)
    env.reset(seed=0)
    for _ in range(STEPS):
        env.step(still)
    with pytest.raises(ValueError, match="no episode is under way"):
        env.step(still)
    with pytest.raises(ValueError, match="arrays='torch' needs num_envs"):
        make(arrays="torch")
    for seed in (-1, 1.5, "x"):
        with pytest.raises(ValueError, match="seed must be a whole number"):
            env.reset(seed=seed)
    env.reset(seed=np.int64(3))


PICTURED: dict[str, Callable[..., Any]] = {
    "pettingzoo": lambda limit: sm.parallel_env("reach", "psm", max_steps=limit, render_mode="rgb_array"),
    "gymnasium": lambda limit: gymnasium.make(
        "surgical_marl/Reach-v0", scene="psm", max_steps=limit, render_mode="rgb_array"
    ),
    **{
        mode: lambda limit, mode=mode: gymnasium.make_vec(
            "surgical_marl/Reach-v0",
            scene="psm",
            num_envs=1,
            max_steps=limit,
            render_mode="rgb_array",
            autoreset_mode=mode,
        )
        for mode in ("NextStep", "Disabled")
    },
}


@pytest.mark.parametrize("face", PICTURED)
def test_the_picture_after_the_last_step_is_of_that_step(face: str) -> None:
    seen = []
    for limit in (STEPS, 2 * STEPS):
        env = PICTURED[face](limit)
        env.reset(seed=3)
        parallel = face == "pettingzoo"
        action = np.full((env.action_space("psm_0") if parallel else env.action_space).shape, 0.7)
        for _ in range(STEPS):
            env.step({"psm_0": action} if parallel else action)
        seen.append(np.asarray(env.render()))
        env.reset()
        assert (np.asarray(env.render()) != seen[-1]).any()
        env.close()
    np.testing.assert_array_equal(*seen)


@pytest.mark.parametrize("form", [{}, {"num_envs": 2}])
def test_a_copy_draws_the_same_from_its_spaces(form: dict[str, Any]) -> None:
    env = sm.parallel_env("reach", "psm", **form)
    env.action_space("psm_0").seed(5), env.observation_space("psm_0").seed(6)
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        for space in ("action_space", "observation_space"):
            one, two = (copy.deepcopy(getattr(each, space)("psm_0")).sample() for each in (env, other))
            np.testing.assert_array_equal(one, two)
        assert other.action_spaces["psm_0"] is other.action_space("psm_0")
