"""One arm as a plain environment while teammates move the others: who they may be, and that they act as they should."""

from __future__ import annotations

import copy
import pickle
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import surgical_marl as sm
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.policy import load_policy
from tests.helpers.scenes import APART

REACH = "surgical_marl/Reach-v0"
SHIPPED = "reach-bimanual_psm"
STEPS = 8


def make(teammates: Any = None, agent: str | None = "psm_1", scene: str = "bimanual_psm", **options: Any) -> Any:
    chosen = {"scene": scene, "agent": agent, "teammates": teammates, "max_steps": STEPS, "device": "cpu"}
    return gymnasium.make(REACH, **chosen | options)


def make_vec(teammates: Any, **options: Any) -> Any:
    chosen = {"scene": "bimanual_psm", "agent": "psm_1", "max_steps": STEPS, "device": "cpu", "num_envs": 2}
    return gymnasium.make_vec(REACH, teammates=teammates, **chosen | options)


def shove(observation: np.ndarray) -> np.ndarray:
    """A function of what an arm observes, of one environment or of many."""
    return np.tanh(5 * observation[..., -7:]).astype(np.float32)


class Counting:
    """A teammate that remembers how long an episode has lasted."""

    def __init__(self) -> None:
        self.steps = np.zeros(2, np.float32)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        self.steps += 1
        return np.repeat(self.steps[:, None] / 100, 7, 1)

    def reset(self, ended: Any = None) -> None:
        self.steps = np.where(True if ended is None else ended, 0, self.steps).astype(np.float32)


@pytest.mark.parametrize("who", [SHIPPED, "oracle", "frozen", "zero", shove])
def test_the_numbers_are_those_of_the_parallel_face_with_the_same_actions(who: Any) -> None:
    env = make({"psm_0": who})
    team = sm.parallel_env("reach", scene="bimanual_psm", max_steps=STEPS, device="cpu")
    known = load_policy("zero" if who == "frozen" else who, team.batch) if isinstance(who, str) else None
    assert env.observation_space == team.observation_space("psm_1")
    assert env.action_space == team.action_space("psm_1")
    rng = np.random.default_rng(0)
    observation, observations = env.reset(seed=3)[0], team.reset(seed=3)[0]
    moved = []
    for _ in range(STEPS):
        np.testing.assert_array_equal(observation, observations["psm_1"])
        action = rng.uniform(-1, 1, 7).astype(np.float32)
        seen = {agent: own[None] for agent, own in observations.items()}
        mate = shove(observations["psm_0"]) if known is None else _alone(who, known, team, seen)
        observation, reward, _, truncated, info = env.step(action)
        observations, rewards, _, truncations, infos = team.step({"psm_0": mate, "psm_1": action})
        assert reward == rewards["psm_1"] and truncated == truncations["psm_1"]
        assert info == {**infos["psm_1"], "agents": infos}
        moved.append(mate)
    assert np.any(moved) == (who not in ("frozen", "zero"))


def _alone(who: str, policy: Any, team: Any, seen: dict[str, Any]) -> np.ndarray:
    if who != "oracle":
        return policy(seen)["psm_0"][0]
    team.guide = getattr(team, "guide", None) or oracle(team.batch, ["psm_0"])
    return team.guide(seen)["psm_0"][0]


def test_a_shipped_teammate_and_the_oracle_reach_their_goals() -> None:
    for who in (SHIPPED, "oracle"):
        env = make({"psm_0": who}, max_steps=100)
        env.reset(seed=0)
        for _ in range(100):
            info = env.step(np.zeros(7, np.float32))[-1]
        assert info["agents"]["psm_0"]["tip_error"] < 2e-3 < info["agents"]["psm_1"]["tip_error"]


def test_many_environments_have_the_same_teammates() -> None:
    for who in (SHIPPED, "oracle", "frozen", shove):
        own, sync = make_vec({"psm_0": who}), make_vec({"psm_0": who}, vectorization_mode="sync")
        seeds, rng = [4, 8], np.random.default_rng(0)
        one, other = own.reset(seed=seeds)[0], sync.reset(seed=seeds)[0]
        for _ in range(STEPS - 1):
            np.testing.assert_allclose(one, other, atol=2e-4, rtol=1e-4)
            actions = rng.uniform(-1, 1, (2, 7)).astype(np.float32)
            one, other = own.step(actions)[0], sync.step(actions)[0]


def test_teammates_forget_where_episodes_begin() -> None:
    mate = Counting()
    for mode in ("SameStep", "NextStep", "Disabled"):
        envs = make_vec({"psm_0": mate}, autoreset_mode=mode)
        envs.reset(seed=0)
        actions = np.zeros((2, 7), np.float32)
        for _ in range(3):
            envs.step(actions)
        envs.reset(options={"reset_mask": np.array([True, False])})
        assert mate.steps.tolist() == [0, 3]
        for _ in range(STEPS - 3 + (mode == "NextStep")):
            envs.step(actions)
        if mode == "Disabled":
            envs.reset(options={"reset_mask": np.array([False, True])})
        assert mate.steps.tolist() == [STEPS - 3 + (mode == "NextStep"), 0], mode


def test_without_an_agent_the_arms_that_have_no_teammate_are_one() -> None:
    env = make({"ecm_0": "frozen"}, agent=None, scene=APART)
    team = sm.parallel_env("reach", scene=APART, max_steps=STEPS, device="cpu")
    assert env.action_space.shape == (14,)
    observation, observations = env.reset(seed=1)[0], team.reset(seed=1)[0]
    np.testing.assert_array_equal(observation, np.concatenate([observations["psm_0"], observations["psm_1"]]))
    assert env.step(np.zeros(14))[-1]["agents"].keys() == {"psm_0", "psm_1", "ecm_0"}


@pytest.mark.parametrize("who", [SHIPPED, "oracle", "frozen", "random", shove])
def test_it_pickles_and_copies_and_goes_on_where_it_stands(who: Any) -> None:
    env = make({"psm_0": who})
    env.reset(seed=2)
    for _ in range(3):
        env.step(np.full(7, 0.5, np.float32))
    copies = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    for _ in range(3):
        expected = env.step(np.full(7, -0.5, np.float32))
        for other in copies:
            found = other.step(np.full(7, -0.5, np.float32))
            np.testing.assert_array_equal(found[0], expected[0])
            assert found[1:] == expected[1:]


def test_gymnasium_accepts_it() -> None:
    env = make({"psm_0": SHIPPED}, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


@pytest.mark.parametrize(
    ("agent", "teammates", "words"),
    [
        ("psm_2", {"psm_0": "zero"}, r"unknown agent 'psm_2', did you mean .* \(choose from psm_0, psm_1\)"),
        ("psm_1", {"psm_2": "zero"}, r"unknown teammate 'psm_2'"),
        ("psm_1", {"psm_1": "zero"}, "'psm_1' is the agent and cannot be a teammate too"),
        ("psm_1", None, "no teammate moves 'psm_0': say who does, as in teammates={'psm_0': 'frozen'}"),
        (None, {"psm_0": "zero", "psm_1": "zero"}, "teammates move all arms"),
        ("psm_1", {"psm_0": "reach-ecm"}, "teammate 'psm_0': the policy in reach-ecm was trained in scene 'ecm'"),
        ("psm_1", {"psm_0": "reech"}, "teammate 'psm_0': 'reech' is not a run folder, nor zero, random, oracle or"),
        ("psm_1", {"psm_0": 3}, "teammate 'psm_0' must be .* not 3"),
    ],
)
def test_bad_teams_are_one_sentence(agent: str | None, teammates: Any, words: str) -> None:
    for build in (make, lambda *given: make_vec(given[0], agent=given[1])):
        with pytest.raises(ValueError, match=words) as caught:
            build(teammates, agent)
        assert "\n" not in str(caught.value)


def test_a_function_that_answers_wrongly_is_named() -> None:
    env = make({"psm_0": lambda observation: np.zeros(6)})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action of 'psm_0' has shape \(1, 6\), it must be \(1, 7\)"):
        env.step(np.zeros(7))


def test_masked_entries_are_no_actions() -> None:
    """Under a mask is no number that anybody gave, so neither an agent nor a teammate acts by it."""
    hidden = np.ma.masked_equal(np.ones(7, np.float32), 1)
    for env, shape in (
        (make({"psm_0": lambda _: hidden}), (7,)),
        (make_vec({"psm_0": lambda _: [hidden] * 2}), (2, 7)),
    ):
        env.reset(seed=0)
        with pytest.raises(ValueError, match="action of 'psm_0' has masked entries"):
            env.step(np.zeros(shape))
        with pytest.raises(ValueError, match="action of 'psm_1' has masked entries"):
            env.step(np.ma.masked_equal(np.ones(shape), 1))


def test_a_seed_of_reset_is_a_random_teammates_too() -> None:
    """Without one its actions go on, as episodes do."""
    env, played = make({"psm_0": "random"}), []
    for seed in (3, 3, None, 4):
        env.reset(seed=seed)
        played.append([env.step(np.zeros(7))[-1]["agents"]["psm_0"]["tip_error"] for _ in range(3)])
    assert played[0] == played[1]
    assert len({tuple(found) for found in played}) == 3
    for seeds in (3, [3, None], [3, 4]):
        envs, seen = make_vec({"psm_0": "random"}), []
        for _ in range(2):
            envs.reset(seed=[5, 6])
            envs.reset(seed=seeds)
            seen.append(envs.step(np.zeros((2, 7)))[-1]["agents"]["psm_0"]["tip_error"])
        np.testing.assert_array_equal(*seen)
