"""Bounds of observations: nothing is clipped by them, and they are tight enough to scale observations by."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import surgical_marl as sm
from surgical_marl import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.envs.observations import Scale
from surgical_marl.learning import train
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.teammates import Teammates
from surgical_marl.robots.reach import Box, box_of
from surgical_marl.runs.folder import read_settings
from surgical_marl.runs.settings import NetworkSettings, PPOSettings, Settings

SHIPPED = "reach-psm"
QUICK = [("reach", "psm"), ("reach", "bimanual_psm")]
TASKS = QUICK + [
    pytest.param(*case, marks=pytest.mark.slow)
    for case in [("track", "bimanual_psm"), ("follow_path", "trimanual_psm_ecm"), ("match_image", "ecm")]
    + [("reach", scene) for scene in sm.list_scenes()]
    if case not in QUICK
]


def wild(env: Any, steps: int, seed: int = 0) -> Any:
    """Yield steps of an environment whose joints go from one limit to the other."""
    rng = np.random.default_rng(seed)
    push = {agent: np.zeros((env.num_envs, *space.shape)) for agent, space in env.action_spaces.items()}
    for step in range(steps):
        if step % 20 == 0:
            push = {agent: rng.choice([-1.0, 0.0, 1.0], action.shape) for agent, action in push.items()}
        yield env.step({agent: action.astype(np.float32) for agent, action in push.items()})


@pytest.mark.parametrize("name", sm.list_arms())
@given(shares=st.lists(st.floats(0.0, 1.0), min_size=8, max_size=8))
@settings(max_examples=50, deadline=None)
def test_a_tip_stays_within_its_arms_reach(name: str, shares: list[float]) -> None:
    arm = ARMS.setdefault(name, sm.load_arm(name))
    q = arm.lower + np.array(shares[: len(arm.lower)]) * (arm.upper - arm.lower)
    tip = arm.forward_kinematics(q)[:3, 3]
    assert (arm.reach.low <= tip).all() and (tip <= arm.reach.high).all()


ARMS: dict[str, Any] = {}


@pytest.mark.parametrize("name", sm.list_arms())
def test_an_arms_reach_is_not_much_wider_than_where_its_tip_gets(name: str) -> None:
    arm = ARMS.setdefault(name, sm.load_arm(name))
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (20_000, len(arm.lower)))
    tips = arm.forward_kinematics(q)[:, :3, 3]
    width, seen = arm.reach.high - arm.reach.low, tips.max(0) - tips.min(0)
    assert (width < 1.5 * seen + 0.03).all()


def test_a_box_is_found_by_its_furthest_places() -> None:
    circle = lambda q: np.stack([np.cos(q[..., 0]), np.sin(q[..., 0])], -1)  # noqa: E731
    found = box_of(circle, Box(np.array([0.0]), np.array([np.pi])))
    np.testing.assert_allclose(found, [[-1, 0], [1, 1]], atol=1e-12)
    np.testing.assert_allclose(found.minus(found), [[-2, -1], [2, 1]], atol=1e-12)
    assert sorted(found.corners.round().tolist()) == [[-1, 0], [-1, 1], [1, 0], [1, 1]]


@pytest.mark.parametrize(("task", "scene"), TASKS)
def test_bounds_clip_no_place_that_an_episode_brings(task: str, scene: str) -> None:
    env = BatchedEnv(task, scene, num_envs=16, max_steps=100, engine="fused", device="cpu")
    env.reset(seed=0)
    for step in wild(env, 120):
        for agent, observation in step.observations.items():
            vector = observation["proprioception"] if isinstance(observation, dict) else observation
            low, high = env.env.observation_space(agent).low, env.env.observation_space(agent).high
            assert (low <= vector).all() and (vector <= high).all()
            for name, part in env.observation_terms(agent).items():
                if name not in ("qpos", "qvel", "command"):
                    assert (low[part] < vector[:, part]).all() and (vector[:, part] < high[part]).all(), name


@pytest.mark.parametrize(
    "scene",
    ["bimanual_psm", *(pytest.param(s, marks=pytest.mark.slow) for s in ("trimanual_psm_ecm", "bimanual_star"))],
)
def test_arms_of_a_kind_have_the_same_bounds(scene: str) -> None:
    env = Env("track", scene)
    for first, *others in env.scene.types.values():
        assert all(env.observation_space(other) == env.observation_space(first) for other in others)


@given(st.integers(0, 2**32 - 1))
def test_a_scale_is_undone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(-5, 5, 6)
    high = low + rng.uniform(0.01, 3, 6)
    low[0], high[1], high[2] = -np.inf, np.inf, low[2]
    scale, value = Scale(low, high), rng.uniform(low.clip(-9), high.clip(None, 9), (3, 6)).astype(np.float32)
    scaled = scale.apply(value)
    np.testing.assert_array_equal(scaled[:, :3], value[:, :3].clip(low[:3], high[:3]).astype(np.float32))
    assert scaled.dtype == np.float32 and np.abs(scaled[:, 3:]).max() <= 1
    np.testing.assert_allclose(scale.undo(scaled), value, atol=1e-5)
    ends = scale.apply(np.stack([low, high]).astype(np.float32))[:, 3:]
    np.testing.assert_allclose(ends, [[-1] * 3, [1] * 3], atol=1e-4)


@pytest.mark.parametrize("engine", ["fused", pytest.param("mjx", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("task", "scene", "options"),
    [
        ("reach", "psm", {}),
        pytest.param("reach", "psm", {"observe": {"psm_0": ["qpos", "target"]}}, marks=pytest.mark.slow),
        ("match_image", "ecm", {}),
    ],
)
def test_scaled_observations_mean_the_same(engine: str, task: str, scene: str, options: dict[str, Any]) -> None:
    chosen = {"num_envs": 2, "max_steps": 3, "engine": engine, "device": "cpu", **options}
    si, scaled = (BatchedEnv(task, scene, observations=how, **chosen) for how in ("si", "scaled"))
    np.testing.assert_allclose(scaled.reset(0)[1], Scale(*bounds(si.state_space)).apply(si.reset(0)[1]), atol=1e-6)
    for ours, theirs in zip(wild(scaled, 4), wild(si, 4), strict=True):
        for agent, seen in vectors(ours.observations).items():
            expected = vectors(si.restated(theirs.observations, "scaled"))[agent]
            np.testing.assert_allclose(seen, expected, atol=1e-6)
            back = vectors(scaled.restated(ours.observations, "si"))[agent]
            np.testing.assert_allclose(back, vectors(theirs.observations)[agent], atol=1e-4)
            np.testing.assert_allclose(ours.rewards[agent], theirs.rewards[agent], rtol=1e-5)
        np.testing.assert_allclose(ours.state, Scale(*bounds(si.state_space)).apply(theirs.state), atol=1e-6)
    assert set(np.unique(scaled.state_space.high)) == {1.0} == set(np.unique(-scaled.state_space.low))


def bounds(space: Any) -> tuple[np.ndarray, np.ndarray]:
    return space.low, space.high


def vectors(observations: dict[str, Any]) -> dict[str, np.ndarray]:
    return {a: own["proprioception"] if isinstance(own, dict) else own for a, own in observations.items()}


@pytest.mark.parametrize("options", [{"scene": "psm"}, {"scene": "psm", "observations": None}])
def test_every_face_for_learners_scales_alike_unless_it_is_asked_for_si_units(options: dict[str, Any]) -> None:
    alone, many = sm.parallel_env("reach", **options), sm.parallel_env("reach", num_envs=1, arrays="torch", **options)
    single = gymnasium.make("surgical_marl/Reach-v0", **options)
    vector = gymnasium.make_vec("surgical_marl/Reach-v0", num_envs=1, **options)
    functions = sm.jax_env("reach", **options)
    seen = alone.reset(seed=3)[0]["psm_0"]
    assert alone.observation_space("psm_0") == single.observation_space == gymnasium.spaces.Box(-1, 1, seen.shape)
    np.testing.assert_array_equal(many.reset(seed=3)[0]["psm_0"][0], seen)
    np.testing.assert_array_equal(single.reset(seed=3)[0], seen)
    np.testing.assert_array_equal(vector.reset(seed=[3])[0][0], seen)
    found = functions.reset(sm.runtime.jax.random.key(3))[0]["psm_0"]
    np.testing.assert_allclose(found, seen, atol=1e-6)
    assert bool(functions.observation_space("psm_0").contains(found))
    plain: Any = sm.parallel_env("reach", scene="psm", observations="si")
    np.testing.assert_allclose(plain.batch.restated(plain.reset(seed=3)[0], "scaled")["psm_0"], seen, atol=1e-6)
    assert plain.observation_space("psm_0") == BatchedEnv("reach", "psm").observation_space("psm_0")


def test_an_unknown_kind_of_observations_names_the_good_ones() -> None:
    with pytest.raises(ValueError, match="observations must be one of si, scaled, not 'metres'"):
        Env("reach", "psm", observations="metres")


@pytest.mark.parametrize("who", [SHIPPED, "oracle"])
def test_policies_act_alike_whatever_an_environment_shows(who: str) -> None:
    si, scaled = (BatchedEnv("reach", "psm", num_envs=3, observations=how, device="cpu") for how in ("si", "scaled"))
    ours, theirs = load_policy(who, scaled), load_policy(who, si)
    mates = Teammates(scaled, {"psm_0": who})
    observations, expected = scaled.reset(5)[0], si.reset(5)[0]
    for _ in range(3):
        actions, wanted = ours(observations), theirs(expected)
        np.testing.assert_allclose(actions["psm_0"], wanted["psm_0"], atol=2e-3)
        np.testing.assert_array_equal(mates.actions(observations)["psm_0"], actions["psm_0"])
        observations, expected = scaled.step(wanted).observations, si.step(wanted).observations


def test_a_run_remembers_what_its_policy_observes(tmp_path: Path) -> None:
    small = Settings(
        scene="psm", observations="scaled", num_envs=16, iterations=1, steps_per_iteration=8, device="cpu",
        network=NetworkSettings(hidden=(16,)), ppo=PPOSettings(epochs=1, mini_batches=1),
    )  # fmt: skip
    run = train.train(small, out=tmp_path / "run")
    assert read_settings(run).observations == "scaled"
    assert read_settings(run, ["observations=si"]) == replace(small, observations="si")
    si, scaled = (BatchedEnv("reach", "psm", num_envs=2, observations=how, device="cpu") for how in ("si", "scaled"))
    found = [load_policy(run, env)(env.reset(0)[0])["psm_0"] for env in (si, scaled)]
    np.testing.assert_allclose(*found, atol=1e-4)
