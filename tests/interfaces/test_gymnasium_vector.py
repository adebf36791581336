"""Many environments behind Gymnasium: in every autoreset mode the same as its own `SyncVectorEnv` of single ones."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import surgical_marl as sm

REACH = "surgical_marl/Reach-v0"
STEPS, N = 5, 3
MODES = list(AutoresetMode)


def make(**options: Any) -> Any:
    return gymnasium.make_vec(REACH, **{"num_envs": N, "scene": "psm", "max_steps": STEPS, "device": "cpu"} | options)


def make_sync(mode: AutoresetMode, **options: Any) -> Any:
    return make(vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **options)


def assert_same(one: Any, other: Any, where: str = "") -> None:
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one:
            assert_same(one[key], other[key], f"{where} {key}")
    elif isinstance(one, np.ndarray) and one.dtype == object:
        for own, its in zip(one, other, strict=True):
            assert (own is None) == (its is None), where
            if own is not None:
                assert_same(own, its, where)
    else:
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=2e-4, err_msg=where)


def play(envs: Any, steps: int, begin: Any = None, seed: Any = (5, 9, 5)) -> list[Any]:
    """What a reset, some steps that start at different times, and masked resets where `begin` says so return."""
    rng, seen = np.random.default_rng(0), [envs.reset(seed=list(seed))]
    for _ in range(steps):
        actions = rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        seen.append(envs.step(actions))
        ended = seen[-1][2] | seen[-1][3]
        mask = begin(ended) if begin else None
        if mask is not None and mask.any():
            seen.append(envs.reset(options={"reset_mask": mask}))
    return seen


def assert_all_same(one: list[Any], other: list[Any]) -> None:
    for number, (own, its) in enumerate(zip(one, other, strict=True)):
        for place, (mine, theirs) in enumerate(zip(own, its, strict=True)):
            assert_same(mine, theirs, f"{number}.{place}")


@pytest.mark.parametrize("scene", ["psm", "bimanual_psm"])
@pytest.mark.parametrize("mode", MODES)
def test_it_returns_what_gymnasiums_own_vector_environment_returns(mode: AutoresetMode, scene: str) -> None:
    """Environments are put out of step by a masked reset; then episodes end at different times, and all restart."""
    odd = np.array([False, True, False])
    masks = iter([None, odd, None, odd] + [None] * 40)

    def begin(ended: np.ndarray) -> Any:
        asked = next(masks)
        return ended if mode is AutoresetMode.DISABLED and ended.any() else asked

    own = play(make(scene=scene, autoreset_mode=mode), 3 * STEPS, begin)
    masks = iter([None, odd, None, odd] + [None] * 40)
    sync = play(make_sync(mode, scene=scene), 3 * STEPS, begin)
    assert_all_same(own, sync)
    ends = np.array([step[3] for step in own if len(step) == 5])
    assert ends.sum() >= 2 * N and (ends.any(1) & ~ends.all(1)).any()


@pytest.mark.parametrize("mode", MODES)
def test_resets_between_go_on_as_single_environments_do(mode: AutoresetMode) -> None:
    def sequence(envs: Any) -> list[Any]:
        rng, seen = np.random.default_rng(1), [envs.reset(seed=[1, 2, 3]), envs.reset()]
        for _ in range(STEPS):
            seen.append(envs.step(rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32)))
        return [*seen, envs.reset(), envs.reset(seed=[None, 4, None]), envs.reset(seed=[7, 8, 9])]

    assert_all_same(sequence(make(autoreset_mode=mode)), sequence(make_sync(mode)))


@pytest.mark.slow
def test_pictures_as_observations_follow_the_modes_too() -> None:
    options = {"num_envs": 2, "max_steps": 2, "device": "cpu"}
    match = "surgical_marl/MatchImage-v0"
    for mode in MODES[:2]:
        kwargs = {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": mode}}
        own = play(gymnasium.make_vec(match, autoreset_mode=mode, **options), 4, seed=(1, 2))
        assert_all_same(own, play(gymnasium.make_vec(match, **kwargs, **options), 4, seed=(1, 2)))


def test_an_episode_that_is_over_waits_for_its_reset_when_resets_are_off() -> None:
    envs = make(autoreset_mode="Disabled")
    envs.reset(seed=0)
    for _ in range(STEPS):
        last, _, _, truncated, _ = envs.step(np.ones((N, 7), np.float32))
    assert truncated.all()
    with pytest.raises(ValueError, match=r"episodes \[0, 1, 2\] are over"):
        envs.step(np.ones((N, 7), np.float32))
    mask = np.array([True, False, True])
    options = {"reset_mask": mask}
    first, info = envs.reset(options=options)
    np.testing.assert_array_equal(first[1], last[1])
    assert info["_tip_error"].tolist() == mask.tolist() and options == {"reset_mask": mask}
    with pytest.raises(ValueError, match=r"episodes \[1\] are over"):
        envs.step(np.ones((N, 7), np.float32))


@pytest.mark.parametrize("mask", [[True] * N, np.ones(2, bool), np.ones(N, int), np.zeros(N, bool)])
def test_a_bad_mask_is_one_sentence(mask: Any) -> None:
    envs = make()
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="mask") as caught:
        envs.reset(options={"reset_mask": mask})
    assert "\n" not in str(caught.value)


def test_a_number_is_the_seed_of_the_batch_as_in_the_parallel_face() -> None:
    envs, team = make(), sm.parallel_env("reach", scene="psm", num_envs=N, max_steps=STEPS, device="cpu")
    np.testing.assert_array_equal(envs.reset(seed=3)[0], team.reset(seed=3)[0]["psm_0"])
    np.testing.assert_array_equal(envs.reset()[0], team.reset()[0]["psm_0"])
    assert envs.np_random.random() == envs.np_random.__class__(np.random.PCG64(3)).random()
    with pytest.raises(ValueError, match="a list of 2 seeds does not fit 3 environments"):
        envs.reset(seed=[1, 2])


@pytest.mark.parametrize("scene", ["psm", "bimanual_psm"])
def test_one_seed_and_the_same_actions_are_the_same_numbers_through_every_face(scene: str) -> None:
    one = gymnasium.make(REACH, scene=scene, max_steps=STEPS, device="cpu")
    many = make(num_envs=1, scene=scene, autoreset_mode=AutoresetMode.DISABLED)
    team = sm.parallel_env("reach", scene=scene, max_steps=STEPS, device="cpu")
    rng = np.random.default_rng(0)
    for seed in (6, None):
        alone, vector, arms = one.reset(seed=seed)[0], many.reset(seed=seed)[0], team.reset(seed=seed)[0]
        for step in range(STEPS):
            np.testing.assert_array_equal(alone, vector[0])
            np.testing.assert_array_equal(alone, np.concatenate([arms[agent] for agent in team.possible_agents]))
            action = rng.uniform(-1, 1, one.action_space.shape).astype(np.float32)
            split = dict(zip(team.agents, np.split(action, len(team.agents)), strict=True))
            alone, reward, terminated, truncated, info = one.step(action)
            vector, rewards, _, truncations, infos = many.step(action[None])
            arms, earned, _, over, _ = team.step(split)
            assert infos["tip_error"][0] == pytest.approx(info["tip_error"], abs=0)
            assert reward == rewards[0] == pytest.approx(sum(earned.values()), rel=1e-6)
            assert truncated == truncations[0] == over["psm_0"] == (step == STEPS - 1) and not terminated
        np.testing.assert_array_equal(alone, vector[0])


def test_attributes_are_those_of_each_environment() -> None:
    envs = make(render_mode="rgb_array", render_size=(60, 40), autoreset_mode=AutoresetMode.NEXT_STEP)
    assert envs.metadata["autoreset_mode"] is envs.autoreset_mode is AutoresetMode.NEXT_STEP
    assert envs.spec.max_episode_steps == STEPS
    assert make(max_episode_steps=7).spec.max_episode_steps == 7
    envs.reset(seed=0)
    for name in ("observation_space", "action_space"):
        assert envs.get_attr(name) == (getattr(envs, f"single_{name}"),) * N
    assert envs.get_attr("max_steps") == (STEPS,) * N and envs.get_attr("render_mode") == ("rgb_array",) * N
    qpos = envs.call("qpos")
    assert len(qpos) == N and not np.array_equal(qpos[0], envs.batch.goal.targets[0])
    envs.set_attr("steps", [0, 2, 0])
    assert [int(steps) for steps in envs.get_attr("steps")] == [0, 2, 0]
    with pytest.raises(ValueError, match="'max_steps' is fixed when environments are made"):
        envs.set_attr("max_steps", 3)
    with pytest.raises(AttributeError):
        envs.get_attr("no_such_thing")
    frames = envs.render()
    assert isinstance(frames, tuple) and len(frames) == N and envs.call("render")[1].shape == frames[1].shape
    assert frames[0].shape == (40, 60, 3) and frames[0].dtype == np.uint8 and not np.array_equal(frames[0], frames[1])
    assert make().render() is None


def test_it_pickles_copies_and_closes() -> None:
    envs = make(autoreset_mode=AutoresetMode.NEXT_STEP)
    play(envs, STEPS)
    actions = np.full((N, 7), 0.3, np.float32)
    others = [pickle.loads(pickle.dumps(envs)), copy.deepcopy(envs)]
    for _ in range(3):
        expected = envs.step(actions)
        for other in others:
            assert_all_same([other.step(actions)], [expected])
    envs.close()
    envs.close()
    for call in (lambda: envs.step(actions), envs.reset, envs.render):
        with pytest.raises(ValueError, match="closed"):
            call()


def test_bad_arguments_are_one_sentence() -> None:
    with pytest.raises(ValueError, match="unknown autoreset_mode 'Never'; the modes are 'NextStep', 'SameStep', 'Dis"):
        make(autoreset_mode="Never")
    with pytest.raises(ValueError, match="unknown render_mode 'human'"):
        make(render_mode="human")
    with pytest.raises(ValueError, match="arrays 'torch': Gymnasium's faces speak numpy"):
        make(arrays="torch")
    envs = make()
    with pytest.raises(ValueError, match="reset"):
        envs.step(np.zeros((N, 7), np.float32))
    envs.reset(seed=0)
    for bad in (np.zeros((N, 6)), np.zeros((2, 7)), np.full((N, 7), np.nan), None):
        with pytest.raises(ValueError, match="action") as caught:
            envs.step(bad)
        assert "\n" not in str(caught.value)
    envs.step(np.zeros((N, 7)).tolist())
