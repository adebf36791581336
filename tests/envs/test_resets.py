"""Resets of some environments while the others go on, and seeds for each of them."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from surgical_marl.envs.batch import BatchedEnv

STEPS = 6
ENGINES = ("fused", "mjx")


def make(num_envs: int = 3, **options: Any) -> BatchedEnv:
    return BatchedEnv("reach", "psm", num_envs=num_envs, device="cpu", max_steps=STEPS, **options)


def act(env: BatchedEnv, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {"psm_0": rng.uniform(-1, 1, (env.num_envs, 7)).astype(np.float32)}


@pytest.mark.parametrize("engine", ENGINES)
def test_a_mask_resets_some_environments_and_leaves_the_others_as_they_are(engine: str) -> None:
    env, untouched = make(engine=engine), make(engine=engine)
    mask = np.array([False, True, False])
    for each in (env, untouched):
        each.reset(seed=4)
        each.step(act(each, np.random.default_rng(0)))
    observations, state, infos = env.reset(mask=mask)
    assert observations["psm_0"].shape == (1, 30) and state.shape == (1, 30)
    assert infos["psm_0"]["tip_error"].shape == (1,)
    assert env.steps.tolist() == [1, 0, 1]
    one, other = (each.step(act(each, np.random.default_rng(1))) for each in (env, untouched))
    np.testing.assert_array_equal(one.observations["psm_0"][~mask], other.observations["psm_0"][~mask])
    np.testing.assert_array_equal(one.rewards["psm_0"][~mask], other.rewards["psm_0"][~mask])
    assert not np.array_equal(one.observations["psm_0"][mask], other.observations["psm_0"][mask])


def test_a_masked_reset_goes_on_to_the_episode_that_a_whole_one_goes_on_to() -> None:
    env, whole = make(), make()
    for each in (env, whole):
        each.reset(seed=4)
        each.step(act(each, np.random.default_rng(0)))
    second, *_ = whole.reset()
    third, *_ = whole.reset()
    for expected in (second, third):
        found, *_ = env.reset(mask=np.array([True, False, True]))
        np.testing.assert_array_equal(found["psm_0"], expected["psm_0"][[0, 2]])


def copied(env: BatchedEnv) -> BatchedEnv:
    other = make(engine=env.engine.name)
    other.set_carry(env.carry())
    return other


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("steps", [0, 1, STEPS, STEPS + 1])
@pytest.mark.parametrize("copy", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env)), copied])
def test_a_copy_goes_on_to_the_episodes_that_the_original_goes_on_to(
    engine: str, steps: int, copy: Callable[[BatchedEnv], BatchedEnv]
) -> None:
    env, rng = make(engine=engine), np.random.default_rng(0)
    played = [env.reset(seed=4)[0]["psm_0"]]
    for _ in range(steps):
        played.append(env.step(act(env, rng)).observations["psm_0"])
    other = copy(env)
    for mask in (None, np.array([True, False, True]), None):
        rows = slice(None) if mask is None else mask
        one, two = (each.reset(mask=mask)[0]["psm_0"] for each in (env, other))
        np.testing.assert_array_equal(one, two)
        goals = [np.round(before[rows][:, 24:27], 7) for before in played]
        assert not any((np.round(one[:, 24:27], 7) == goal).all(1).any() for goal in goals)  # none is played twice
        played += [] if mask is not None else [one]


@pytest.mark.parametrize("engine", ENGINES)
def test_without_autoreset_an_environment_stays_where_its_episode_ended(engine: str) -> None:
    env, usual = make(engine=engine), make(engine=engine)
    env.autoreset = False
    for each in (env, usual):
        each.reset(seed=4)
    for number in range(STEPS):
        one, other = (each.step(act(each, np.random.default_rng(number))) for each in (env, usual))
    assert one.truncated.all() and other.truncated.all()
    np.testing.assert_array_equal(one.observations["psm_0"], other.final_observations["psm_0"])
    assert env.steps.tolist() == [STEPS] * 3 and usual.steps.tolist() == [0] * 3
    np.testing.assert_array_equal(env.reset()[0]["psm_0"], other.observations["psm_0"])  # the episode that follows
    assert not pickle.loads(pickle.dumps(env)).autoreset


@pytest.mark.parametrize("engine", ENGINES)
def test_seeds_of_all_63_bits_lead_to_episodes_of_their_own(engine: str) -> None:
    env = make(engine=engine)
    seeds = [5, 5 + 2**32, 5 + 2**62, 0, 2**32, 2**63 - 1, 2**31 - 1]
    goals = [env.reset(seed=seed)[0]["psm_0"][:, 24:27].tobytes() for seed in seeds]
    assert len(set(goals)) == len(seeds)


@pytest.mark.parametrize("engine", ENGINES)
def test_each_environment_plays_what_one_alone_plays_with_its_seed(engine: str) -> None:
    env, alone = make(engine=engine), make(num_envs=1, engine=engine)
    observations, *_ = env.reset(seed=[7, 11, 7])
    for index, seed in enumerate((7, 11, 7)):
        np.testing.assert_allclose(observations["psm_0"][index], alone.reset(seed=seed)[0]["psm_0"][0], atol=1e-6)
    before = env.steps
    env.step(act(env, np.random.default_rng(0)))
    again, *_ = env.reset(seed=[None, 5, None], mask=np.array([False, True, True]))
    np.testing.assert_allclose(again["psm_0"][0], alone.reset(seed=5)[0]["psm_0"][0], atol=1e-6)
    alone.reset(seed=7)
    np.testing.assert_allclose(again["psm_0"][1], alone.reset()[0]["psm_0"][0], atol=1e-6)
    assert before.tolist() == [0, 0, 0] and env.steps.tolist() == [1, 0, 0]


def test_pictures_of_a_masked_reset_are_of_the_environments_in_the_mask() -> None:
    env = BatchedEnv("match_image", "ecm", num_envs=2, device="cpu")
    first, *_ = env.reset(seed=[3, 4])
    again, *_ = env.reset(seed=[0, 4], mask=np.array([False, True]))
    for name in ("proprioception", "image", "target"):
        np.testing.assert_array_equal(again["ecm_0"][name], first["ecm_0"][name][1:])
    assert not np.array_equal(first["ecm_0"]["target"][0], first["ecm_0"]["target"][1])


def test_bad_seeds_and_masks_are_one_sentence() -> None:
    env = make()
    with pytest.raises(ValueError, match="mask before the first reset"):
        env.reset(mask=np.array([True, False, True]))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="a list of 2 seeds does not fit 3 environments"):
        env.reset(seed=[1, 2])
    with pytest.raises(ValueError, match=r"seed must be a whole number from 0 to .*, not -1"):
        env.reset(seed=[1, 2, -1])
    for mask in (np.array([True, False]), np.array([1, 0, 1])):
        with pytest.raises(ValueError, match=r"mask of shape .* must be \[3\] bool"):
            env.reset(mask=mask)
    env.step(act(env, np.random.default_rng(0)))
