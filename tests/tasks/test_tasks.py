"""Every task on every scene: faces, determinism, rewards, costs, difficulty, and the oracle that says they are fair."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.content import content_dir
from surgical_marl.envs import infos as safety
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.plugins.tasks import TASKS as KNOWN
from surgical_marl.plugins.tasks import scene_of
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.policy import load_policy, zero_policy
from surgical_marl.robots.arm import load_arm
from surgical_marl.tasks.base import spline
from surgical_marl.tasks.base.paths import KNOT, SEGMENTS
from surgical_marl.tasks.base.task import APPROACH, PRECISION
from surgical_marl.tasks.base.world import World
from tests.helpers.actions import random_actions
from tests.helpers.devices import needs_cuda

# match_image, whose observations are pictures, and tasks with objects have tests of their own
TASKS, SCENES = [task for task in sm.list_tasks() if KNOWN.load(task).scenes is None], sm.list_scenes()
# Scenes of several arms compile for up to a minute: `pytest -m slow` takes them.
QUICK = [("reach", "psm"), ("track", "psm"), ("follow_path", "psm")]
CASES = [
    (task, scene) if (task, scene) in QUICK else pytest.param(task, scene, marks=pytest.mark.slow)
    for task in TASKS
    for scene in SCENES
]


@cache
def batched(task: str, scene: str, num_envs: int = 50) -> BatchedEnv:
    return BatchedEnv(task, scene, num_envs=num_envs)


@pytest.mark.parametrize(("task", "scene"), CASES)
def test_a_seed_is_a_series_of_episodes_whatever_the_number_of_environments(task: str, scene: str) -> None:
    """Two episodes and a bit, over 10,000 random steps: goals of one environment are those of the first of many,
    observations lie in their space, everything is finite."""
    many, one, rng = batched(task, scene), batched(task, scene, 1), np.random.default_rng(0)
    many.reset(3), one.reset(3)
    goals = []
    for step in range(2 * many.max_steps + 5):
        actions = random_actions(many, rng)
        taken = many.step(actions)
        one.step({agent: action[:1] for agent, action in actions.items()})
        np.testing.assert_array_equal(many.goal.targets[0], one.goal.targets[0])
        goals.append(many.goal.targets)
        assert np.isfinite(taken.state).all() and all(np.isfinite(value).all() for value in taken.rewards.values())
        if step % 20 == 0:
            assert all(many.state_space.contains(state) for state in taken.state)
    many.reset(3)
    again = [many.step(random_actions(many, rng)) and many.goal.targets for _ in range(3)]
    np.testing.assert_array_equal(again, goals[:3])
    moves = np.abs(goals[1] - goals[0]).max()
    assert (moves > 0) == (task != "reach")
    assert len({goal.tobytes() for goal in goals[:: many.max_steps]}) == 3


def play(env: BatchedEnv, policy: Any, seed: int = 0) -> SimpleNamespace:
    """Errors [steps, N, arms] in m, and whether an environment saw a collision [N], over first episodes."""
    observations, *_ = env.reset(seed)
    errors, collided = [], np.zeros(env.num_envs, bool)
    for _ in range(env.max_steps):
        step = env.step(policy(observations))
        observations = step.observations
        errors.append(np.stack([step.infos[agent]["tip_error"] for agent in env.agents], -1))
        collided |= np.any([step.infos[agent]["collision"] for agent in env.agents], axis=0)
    return SimpleNamespace(errors=np.array(errors), collided=collided)


@pytest.mark.parametrize(("task", "scene"), CASES)
def test_the_oracle_shows_that_a_task_is_fair(task: str, scene: str) -> None:
    """At least 98 % of arms end within 2 mm and stay there for 0.2 s; a moving target is followed to 2 mm RMSE."""
    env = batched(task, scene)
    played = play(env, load_policy("oracle", env))
    assert (played.errors[-10:].max(0) < 0.002).mean() >= 0.98
    assert played.collided.mean() <= 0.02
    if task != "reach":
        assert np.sqrt(np.mean(played.errors**2, axis=0)).max() < 0.002


def test_an_oracle_that_is_pushed_stays_on_a_moving_target() -> None:
    """Every joint's command is pushed to and fro by a tenth of what an action can do."""
    env, rng = batched("track", "star"), np.random.default_rng(0)
    follow = load_policy("oracle", env)

    def pushed(observations: Any) -> dict[str, Any]:
        return {agent: move + 0.1 * rng.normal(size=move.shape) for agent, move in follow(observations).items()}

    errors = play(env, pushed).errors
    assert (errors.max(0) < 0.002).mean() > 0.95 and np.sqrt(np.mean(errors**2)) < 0.0005


def test_the_oracle_is_not_what_any_policy_gets() -> None:
    env = batched("track", "psm")
    assert np.sqrt(np.mean(play(env, load_policy("zero", env)).errors ** 2)) > 0.005


def test_the_oracle_moves_one_arm_without_waiting_for_others() -> None:
    """The other never comes to its goal, and an oracle that moved both would slow down for it."""
    env = batched("reach", "bimanual_psm")
    rest, one = zero_policy(env), oracle(env, ["psm_1"])
    assert set(one(env.reset(0)[0])) == {"psm_1"}
    errors = play(env, lambda observations: {**rest(observations), **one(observations)}).errors[-1]
    assert (errors[:, 1] < 0.002).mean() >= 0.98 and np.median(errors[:, 0]) > 0.01


@needs_cuda
def test_the_oracle_takes_tensors_on_a_gpu() -> None:
    env = BatchedEnv("reach", "psm", num_envs=50, device="cuda", arrays="torch")
    observations, *_ = env.reset(0)
    policy = load_policy("oracle", env)
    for _ in range(env.max_steps):
        step = env.step(policy(observations))
        observations = step.observations
    assert float((step.infos["psm_0"]["tip_error"] < 0.002).float().mean()) >= 0.98


def test_the_oracle_needs_position_targets() -> None:
    env = SimpleNamespace(control="torque", task=SimpleNamespace(has_targets=True))
    with pytest.raises(ValueError, match="control must be cartesian or position, not 'torque'"):
        load_policy("oracle", env)  # type: ignore[arg-type]


@pytest.mark.parametrize("task", ["track", "follow_path"])
def test_targets_move_along_the_paths_of_the_table(task: str) -> None:
    """Against the host's own evaluation of the spline, from the arms' tips on; velocities are those of the targets."""
    env = batched(task, "psm")
    env.reset(7)
    rows = env.carry()[".goal.row"]
    known, terms = env.task, env.observation_terms("psm_0")
    table = np.asarray(known.tables["paths"], float)[rows, :, 0]
    home = env.scene.mounts["psm_0"].arm
    np.testing.assert_allclose(
        env.goal.targets[:, 0], np.tile(home.forward_kinematics(home.home)[:3, 3], (env.num_envs, 1)), atol=1e-6
    )
    still = {"psm_0": np.zeros((env.num_envs, 7), np.float32)}
    for step in range(1, 61):
        seen = env.step(still).observations["psm_0"]
        expected = spline.evaluate(table, np.array([step * env.control_dt / KNOT]))[:, 0]
        np.testing.assert_allclose(env.goal.targets[:, 0], expected, atol=2e-6)
    if task == "track":
        further = env.step(still) and env.goal.targets[:, 0]
        np.testing.assert_allclose(seen[:, terms["target_velocity"]], (further - expected) / env.control_dt, atol=2e-3)
    else:
        ahead = spline.evaluate(table, np.array([(60 * env.control_dt + 0.2) / KNOT]))[:, 0]
        tip = seen[:, terms["tool_tip"]]
        np.testing.assert_allclose(seen[:, terms["to_path_ahead"]][:, 3:6], ahead - tip, atol=4e-6)


def test_after_its_end_a_closed_path_begins_anew_and_an_open_one_rests() -> None:
    task: Any = batched("follow_path", "psm").task
    is_closed = task.tables["closed"]
    assert 0.4 < is_closed.mean() < 0.6
    closed, opened = int(np.flatnonzero(is_closed)[0]), int(np.flatnonzero(~is_closed)[0])
    end = np.float32(SEGMENTS * KNOT)
    at = lambda row, time: np.asarray(task.along(np.int32(row), np.float32(time)))  # noqa: E731
    np.testing.assert_allclose(at(closed, end + 0.73), at(closed, 0.73), atol=1e-6)
    np.testing.assert_allclose(at(closed, end), at(closed, 0), atol=1e-6)
    np.testing.assert_array_equal(at(opened, end + 0.73), at(opened, end))
    assert np.linalg.norm(at(opened, end) - at(opened, 0)) > 0.005


def test_rewards_are_the_sum_of_their_terms_and_reach_is_rewarded_as_documented() -> None:
    env, rng = batched("reach", "psm"), np.random.default_rng(0)
    env.reset(0)
    for _ in range(5):
        step = env.step(random_actions(env, rng))
        info, reward = step.infos["psm_0"], step.rewards["psm_0"]
        terms = [value for name, value in info.items() if name.startswith("reward_")]
        np.testing.assert_allclose(np.sum(terms, axis=0), reward, atol=1e-6)
        error = info["tip_error"]
        np.testing.assert_allclose(reward, -10 * error + np.exp(-error / PRECISION) - 2 * info["collision"], atol=1e-5)


def test_weights_replace_those_of_single_terms() -> None:
    env = Env("reach", "bimanual_psm", reward={"collision": -5, "precision": 0.5})
    error = np.array([0.0, 0.0, 0.003], np.float32)
    view = SimpleNamespace(tool_tip=error, min_distance=np.float32(APPROACH / 4), collision=np.bool_(True))
    goal = SimpleNamespace(targets=np.zeros((2, 3), np.float32))
    found = env.task.rewards(World({"psm_0": view}, goal))["psm_0"]
    expected = {"distance": -0.03, "precision": 0.5 * np.exp(-0.6), "clearance": -0.75, "collision": -5,
                "action_change": 0.0}  # fmt: skip
    assert {name: float(value) for name, value in found.items()} == pytest.approx(expected, rel=1e-5)


def test_an_action_is_compared_with_the_one_before_it_in_its_episode() -> None:
    env = BatchedEnv("reach", "bimanual_psm", num_envs=3, max_steps=4, reward={"action_change": -0.5})
    env.reset(0)
    env.steps = np.array([0, 1, 2])  # episodes end at different times
    rng, last = np.random.default_rng(0), {agent: np.zeros((3, 7), np.float32) for agent in env.agents}
    for _ in range(6):
        actions = {agent: action * 1.5 for agent, action in random_actions(env, rng).items()}  # beyond their bounds too
        step = env.step(actions)
        ended = (step.terminated | step.truncated)[:, None]
        for agent, action in actions.items():
            action = np.clip(action, -1.0, 1.0)
            change = np.square(action - last[agent]).sum(-1)
            np.testing.assert_allclose(step.infos[agent]["reward_action_change"], -0.5 * change, rtol=1e-5)
            last[agent] = np.where(ended, 0.0, action)


@pytest.mark.parametrize("task", sm.list_tasks())
def test_the_settings_list_every_weight_as_the_task_has_it(task: str) -> None:
    settings = yaml.safe_load((content_dir("configs") / f"{task}.yaml").read_text())
    if task == "camera_assist":  # some of its weights are those of the work in a scene
        own = {scene: found["reward"] for scene, found in settings["scenes"].items()}
    else:
        own = {"psm" if task in TASKS else scene_of(task): {}}
    for scene, reward in own.items():
        listed, weights = settings["reward"] | reward, dict(Env(task, scene).task.weights)
        if task == "match_image":  # the settings add terms that help learning to the paper's reward
            assert listed.keys() == weights.keys()
        else:
            assert listed == weights


def test_each_cost_counts_one_broken_limit() -> None:
    arm = load_arm("psm")
    fine = {"qpos": arm.home, "min_distance": np.inf, "bump_force": 0.0}

    def broken(speed: float = 0.0, **change: Any) -> set[str]:
        view: Any = SimpleNamespace(**{**fine, **change})
        return {name for name, cost in safety.costs(arm, view, np.float32(speed)).items() if cost}

    assert broken() == set()
    assert broken(min_distance=0.9 * safety.NEAR) == {"distance"}
    assert broken(bump_force=1.1 * safety.FORCE) == {"force"}
    assert broken(speed=1.1 * safety.SPEED) == {"speed"}
    for joint, value in ((0, arm.upper[0]), (2, arm.lower[2])):
        assert broken(qpos=np.where(np.arange(7) == joint, value, arm.home)) == {"limit"}
    assert broken(min_distance=0.0, bump_force=9.0) == {"distance", "force"}


def test_the_tips_speed_is_what_it_moved() -> None:
    env = batched("reach", "psm")
    env.reset(0)
    seen = []
    for _ in range(8):
        before = env.carry()[".tips"][:, 0]
        step = env.step({"psm_0": np.tile(np.float32([0, 0, 1, 0, 0, 0, 0]), (env.num_envs, 1))})
        tip = step.observations["psm_0"][:, env.observation_terms("psm_0")["tool_tip"]]
        too_fast = np.linalg.norm(tip - before, axis=-1) / env.control_dt > safety.SPEED
        np.testing.assert_array_equal(step.infos["psm_0"]["cost_speed"], too_fast)
        np.testing.assert_array_equal(step.infos["psm_0"]["cost"], too_fast)
        seen.append(tip[0, 2])
    assert np.all(np.diff(seen) < 0)


@pytest.mark.parametrize("task", TASKS)
def test_harder_levels_are_harder(task: str) -> None:
    levels = [Env(task, "psm").task.levels[name] for name in ("easy", "default", "hard")]
    for easier, harder in pairwise(levels):
        assert harder != easier and all(a <= b for a, b in zip(easier, harder, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("task", ["track", "follow_path"])
def test_hard_paths_cross_and_easy_ones_do_not(task: str) -> None:
    from surgical_marl.tasks.base.paths import _cross

    for difficulty, share in (("easy", 0.0), ("default", 0.1), ("hard", 0.5)):
        env = Env(task, "bimanual_psm", difficulty=difficulty)
        assert _cross(env.scene, np.asarray(env.task.tables["paths"], float)).mean() == pytest.approx(share, abs=0.01)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"difficulty": "heard"}, "unknown difficulty 'heard', did you mean 'hard' .*easy, default, hard"),
        ({"reward": {"colision": 1}}, "unknown reward term 'colision', did you mean 'collision' .*distance, precision"),
        ({"reward": {"collision": np.nan}}, "reward.collision must be a number from .*, not nan"),
        ({"reward": {"collision": "much"}}, "reward.collision must be a number from .*, not 'much'"),
    ],
)
@pytest.mark.parametrize("task", TASKS)
def test_bad_options_are_one_sentence(task: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        sm.parallel_env(task, scene="psm", **options)
    assert "\n" not in str(caught.value)


def test_gymnasium_sums_terms_and_costs() -> None:
    env = gymnasium.make("surgical_marl/FollowPath-v0", scene="psm")
    env.reset(seed=0)
    _, reward, *_, info = env.step(np.zeros(7, np.float32))
    assert info["cost"] == 0
    assert sum(value for name, value in info.items() if name.startswith("reward_")) == pytest.approx(reward, rel=1e-5)


def test_a_task_is_restored_where_it_was() -> None:
    env = batched("track", "psm")
    env.reset(1)
    rng = np.random.default_rng(0)
    for _ in range(10):
        env.step(random_actions(env, rng))
    saved, actions = env.carry(), random_actions(env, rng)
    expected = env.step(actions).state
    env.reset(2)
    env.set_carry(saved)
    np.testing.assert_array_equal(env.step(actions).state, expected)


def test_where_no_scene_is_named_a_task_has_its_own_or_psm() -> None:
    assert {task: scene_of(task) for task in ("reach", "needle_handover", "camera_assist")} == {
        "reach": "psm",
        "needle_handover": "bimanual_psm_needle",
        "camera_assist": "trimanual_psm_ecm",
    }
