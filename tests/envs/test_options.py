"""What an environment can be asked for: starts, goals, observed terms; and what of it compiles nothing."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.scenes.load import load_scene
from surgical_marl.tasks.base.options import Options, make_options
from surgical_marl.tasks.base.workspace import PATH_POINTS, _stay_apart, start_table
from surgical_marl.vision.endoscope import Endoscope
from tests.helpers.scenes import PAIR


def play(env: Any, steps: int = 5, seed: int = 0) -> list[Any]:
    rng = np.random.default_rng(seed)
    shape = lambda agent: (env.num_envs, *env.action_space(agent).shape)  # noqa: E731
    return [env.step({a: np.float32(rng.uniform(-1, 1, shape(a))) for a in env.agents}) for _ in range(steps)]


def same(one: Any, other: Any) -> bool:
    return all(
        np.array_equal(one.observations[a], other.observations[a]) and np.array_equal(one.rewards[a], other.rewards[a])
        for a in one.rewards
    )


@pytest.fixture(scope="module")
def usual() -> BatchedEnv:
    return BatchedEnv("reach", "psm", num_envs=8)


@pytest.mark.parametrize(
    "options",
    [{"max_steps": 3}, {"reward": {"collision": -7, "distance": -3}}, {"difficulty": "hard"}, {"goals": "held_out"}],
    ids=lambda options: next(iter(options)),
)
def test_a_setting_is_an_input_of_the_kernel(options: dict[str, Any], usual: BatchedEnv) -> None:
    other = BatchedEnv("reach", "psm", num_envs=8, **options)
    assert other.engine.source.bodies == usual.engine.source.bodies  # type: ignore[attr-defined]
    usual.reset(seed=1)
    other.reset(seed=1)
    before, after = play(usual)[-1], play(other)[-1]
    if "max_steps" in options:
        assert other.steps.tolist() == [2] * 8 and not before.truncated.any()
    elif "reward" in options:
        error = after.infos["psm_0"]["tip_error"]
        assert np.allclose(after.infos["psm_0"]["reward_distance"], -3 * error)
        assert np.allclose(before.infos["psm_0"]["reward_distance"], -10 * before.infos["psm_0"]["tip_error"])
    else:
        assert not np.isclose(usual.goal.targets, other.goal.targets).any(-1).any()


@pytest.mark.parametrize(
    ("task", "scene", "name"),
    [
        ("reach", "bimanual_psm", "targets"),
        ("track", "psm", "paths"),
        ("follow_path", "ecm", "paths"),
        ("match_image", "ecm", "joints"),
    ],
)
def test_held_out_goals_are_none_of_training(task: str, scene: str, name: str) -> None:
    tables = [Env(task, scene, goals=goals).task.tables for goals in ("training", "held_out")]
    trained, held_out = ({row.tobytes() for row in np.round(table[name], 6)} for table in tables)
    assert len(held_out) > 1000 and not trained & held_out


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["fused", "mjx"])
def test_random_starts_are_collision_free_postures(engine: str) -> None:
    env = BatchedEnv("reach", "bimanual_psm", num_envs=64, engine=engine, start="random", max_steps=2)
    observations, _, infos = env.reset(seed=0)
    q = {agent: env.qpos[:, env.scene.qpos_index(agent)] for agent in env.agents}
    terms = env.observation_terms("psm_0")
    assert np.allclose(observations["psm_0"][:, terms["qpos"]], q["psm_0"], atol=1e-6)
    assert np.allclose(observations["psm_0"][:, terms["command"]], q["psm_0"], atol=1e-5)  # nothing pulls them away
    apart = env.scene.clearance(q)
    assert (apart > 0.009).all() and (env.scene.clearance(q, within=True) > 0).all()
    assert np.allclose(infos["psm_0"]["min_distance"], apart, atol=1e-5)
    arm = env.scene.mounts["psm_1"].arm
    away = np.abs(q["psm_1"] - arm.home).max(0)
    assert (away > 0.1 * (arm.upper - arm.lower))[:3].all()
    first = env.qpos.copy()
    still = {agent: np.zeros((64, *env.action_space(agent).shape), np.float32) for agent in env.agents}
    step = env.step(still)
    moved = np.abs(env.qpos - first).max(-1)
    assert np.median(moved) < 1e-4 and not step.infos["psm_0"]["collision"].any()
    env.step(still)  # the next episode begins elsewhere
    assert (np.abs(env.qpos - first).max(-1) > 0.01).mean() > 0.95


def test_more_starts_are_drawn_to_learn_from_and_those_of_evaluations_stay() -> None:
    """From 4,096 starts three arms learned to know the rows: 99.6 % succeeded from them, 96.7 % from others."""
    tables = {goals: Env("reach", "ecm", start="random", goals=goals).task.tables for goals in ("training", "held_out")}
    assert {goals: len(table["targets"]) for goals, table in tables.items()} == {"training": 32768, "held_out": 4096}
    paths = {goals: Env("track", "ecm", start="random", goals=goals).task.tables for goals in tables}
    assert {goals: len(table["postures"]) for goals, table in paths.items()} == {"training": 16384, "held_out": 1024}
    scene = load_scene("ecm")
    ways, targets = start_table(scene, 0.05, rows=100)
    for longer, shorter in zip([*start_table(scene, 0.05, rows=200)[0].values()], ways.values(), strict=True):
        assert np.array_equal(longer[:, :100], shorter)
    assert np.allclose(tables["training"]["targets"][:100], targets, atol=1e-6)
    away = np.concatenate([way[0] - way[1] for way in ways.values()], -1)
    assert len(np.unique(away.round(6), axis=0)) == 100


def test_arms_that_meet_between_two_points_of_a_path_are_seen_to_meet() -> None:
    """Of 4,096 random starts of two STARs 27 had a straight way on which they met, by up to 46 mm."""
    scene = load_scene("bimanual_star")
    starts, goals = (
        {agent: np.tile(mount.arm.home, (2, 1)) for agent, mount in scene.mounts.items()} for _ in range(2)
    )
    for ends, second in ((starts, 0.8), (goals, -1.4)):
        ends["star_0"][0, 0], ends["star_1"][0, 1] = -0.1, second
    goals["star_0"][1, 4] += 0.2

    def least(points: int) -> np.ndarray:
        ways = [{a: (1 - s) * q + s * goals[a] for a, q in starts.items()} for s in np.linspace(0, 1, points + 1)]
        found: np.ndarray = np.min([scene.clearance(way) for way in ways], 0)
        return found

    assert (least(PATH_POINTS) > 0.01).all() and least(80)[0] < 0 < least(80)[1]
    assert _stay_apart(scene, starts, goals, np.arange(2)).tolist() == [1]


def test_both_engines_begin_at_the_same_postures() -> None:
    envs = [BatchedEnv("reach", PAIR, num_envs=4, engine=e, start="random") for e in ("fused", "mjx")]
    found = [env.reset(seed=3)[0] for env in envs]
    for agent in envs[0].agents:
        assert np.allclose(found[0][agent], found[1][agent], atol=1e-5)


@pytest.mark.parametrize(("task", "scene"), [("reach", "bimanual_psm"), ("track", "ecm")])
def test_the_oracle_reaches_its_goals_from_any_start(task: str, scene: str) -> None:
    from surgical_marl.policies.oracle import oracle

    env = BatchedEnv(task, scene, num_envs=64, start="random", goals="held_out")
    observations, *_ = env.reset(seed=0)
    act = oracle(env)
    for _ in range(99):
        observations, step = (found := env.step(act(observations))).observations, found
    errors = np.concatenate([step.infos[agent]["tip_error"] for agent in env.agents])
    assert errors.max() < 0.002


def test_terms_can_be_left_out_and_added() -> None:
    chosen = ["tool_tip", "contact_force", "to_target"]
    usual, env = (
        BatchedEnv("reach", "bimanual_psm", num_envs=2, engine="mjx", observe=observe)  # whose reset compiles no step
        for observe in ({}, {"psm_1": chosen})
    )
    full, state, _ = usual.reset(seed=0)
    less, more, _ = env.reset(seed=0)
    assert list(env.observation_terms("psm_1")) == chosen and less["psm_1"].shape == (2, 7)
    assert np.array_equal(less["psm_0"], full["psm_0"])
    for name in ("tool_tip", "to_target"):
        there, here = usual.observation_terms("psm_1")[name], env.observation_terms("psm_1")[name]
        assert np.array_equal(less["psm_1"][:, here], full["psm_1"][:, there])
    # critics still see what the agent is not shown, and what it is shown in addition
    assert env.state_space.shape == (usual.state_space.shape[0] + 1,) == more.shape[1:]
    assert set(np.round(state[0], 5)) <= set(np.round(more[0], 5))
    assert env.types == {"psm": ["psm_0"], "psm-seeing-2": ["psm_1"]}


@pytest.mark.parametrize("start", ["home", "random"])
def test_pictures_are_terms_of_any_task(start: str) -> None:
    """Over an episode's end, against an endoscope of its own: the next episode's pictures, and the last of this one."""
    pictures = ["image_right", "ecm_0/depth"]
    env = BatchedEnv("reach", "ecm", num_envs=3, start=start, max_steps=2, observe={"ecm_0": ["qpos", *pictures]})
    eye = Endoscope(env.scene, 3, env.device, stereo=True, channels=("rgb", "depth"))
    space = env.observation_space("ecm_0")
    assert list(env.observation_terms("ecm_0")) == ["qpos"] and set(space) == {"proprioception", *pictures}
    found, *_ = env.reset(seed=0)
    for k in range(4):
        view, seen = eye.render(env.qpos), found["ecm_0"]
        assert all(space.contains({name: value[i] for name, value in seen.items()}) for i in range(3))
        np.testing.assert_array_equal(seen["image_right"], view.rgb[:, 1])
        np.testing.assert_array_equal(seen["ecm_0/depth"], view.depth[:, 0, ..., None])
        step = play(env, 1, seed=k)[0]
        found, final = step.observations, step.final_observations["ecm_0"]
        ended = bool(step.truncated.all())
        assert ended == bool(step.truncated.any()) == (k % 2 == 1)
        assert np.array_equal(final["ecm_0/depth"], found["ecm_0"]["ecm_0/depth"]) != ended
        assert not np.array_equal(final["ecm_0/depth"], seen["ecm_0/depth"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observe": {"psm_7": ["qpos"]}}, r"'psm_7', which is not an agent of the scene \(psm_0\)"),
        ({"observe": {"psm_0": ["qpso"]}}, r"unknown observation term of 'psm_0' 'qpso', did you mean 'qpos'"),
        ({"observe": {"psm_0": ["image"]}}, "unknown observation term of 'psm_0' 'image'"),
        ({"observe": {"psm_0": "qpos"}}, "must be a list of names"),
        ({"observe": {"psm_0": []}}, "needs a term that is a vector"),
        ({"observe": {"psm_0": ["qpos", "qpos"]}}, "given 'qpos' twice"),
        ({"start": "anywhere"}, "start must be one of home, random, not 'anywhere'"),
        (
            {"start": "random", "task": "match_image", "scene": "ecm"},
            r"unknown start of task 'match_image' 'random'.*choose from home",
        ),
        ({"goals": "new"}, "goals must be one of training, held_out, not 'new'"),
        ({"control": "psition"}, "unknown control 'psition', did you mean 'position'"),
        ({"difficulty": "hrad"}, "unknown difficulty 'hrad', did you mean 'hard'"),
        ({"reward": {"colision": 1}}, "unknown reward term 'colision', did you mean 'collision'"),
        ({"reward": {"collision": float("nan")}}, "reward.collision must be a number"),
        ({"max_steps": 0}, "max_steps must be a whole number from 1"),
        ({"decimation": 0}, "decimation must be a whole number from 1"),
        ({"dificulty": "hard"}, r"unexpected keyword argument 'dificulty', did you mean 'difficulty'"),
    ],
)
def test_bad_options_are_one_sentence(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        sm.parallel_env(**{"task": "reach", "scene": "psm", **options})
    assert "\n" not in str(caught.value)


def test_an_unknown_option_is_a_type_error_too_as_for_any_function() -> None:
    """TorchRL's GymEnv tries `frameskip`, and goes without it where these words come back."""
    with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
        gymnasium.make("surgical_marl/Reach-v0", scene="psm", frameskip=1)


def test_options_are_plain_data() -> None:
    options = make_options("track", "psm", {"difficulty": "hard", "max_steps": None, "reward": {"collision": -1e-1}})
    assert options == Options("track", "psm", difficulty="hard", reward={"collision": -0.1})


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
@pytest.mark.parametrize("engine", ["fused", "mjx"])
def test_a_copy_goes_on_where_the_original_stands(clone: Any, engine: str) -> None:
    env = BatchedEnv("reach", "psm", num_envs=2, engine=engine)
    fresh = clone(env)  # one that has not begun
    with pytest.raises(ValueError, match="reset"):
        play(fresh)
    env.reset(seed=5)
    play(env, 3)
    other = clone(env)
    one, two = play(env, 4, seed=1), play(other, 4, seed=1)
    assert all(same(a, b) for a, b in zip(one, two, strict=True))


def test_faces_can_be_pickled() -> None:
    env = sm.parallel_env("reach", scene="psm", render_mode="rgb_array")
    env.reset(seed=0)
    env.render()
    other = pickle.loads(pickle.dumps(env))
    actions = {"psm_0": np.full(7, 0.5, np.float32)}
    one, two = env.step(actions), other.step(actions)
    assert np.array_equal(one[0]["psm_0"], two[0]["psm_0"]) and one[1] == two[1]
