"""`reach` with difficulty `crossing`: two arms change places, and neither can do it while the other one stays."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.evaluation.evaluate import evaluate
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.policy import zero_policy
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.scenes.scene import Scene
from surgical_marl.tasks.base.crossing import APART, BEYOND, FARTHEST, NEAREST, PASS, crossing_table, shaft
from surgical_marl.tasks.base.grasp_poses import tool_of
from surgical_marl.tasks.base.oracle_script import Snapshot
from surgical_marl.tasks.base.workspace import CLEARANCE

PAIR = ("psm_0", "psm_1")
SCENES = ["bimanual_psm", pytest.param("trimanual_psm_ecm", marks=pytest.mark.slow)]


@cache
def known(scene: str, goals: str = "training") -> Any:
    return Env("reach", scene, difficulty="crossing", goals=goals).task


def beyond(scene: Scene, q: dict[str, np.ndarray]) -> np.ndarray:
    """How far each tool tip is past the place where the lines from remote center to tip are nearest, [2, rows], m."""
    mounts = [scene.mounts[agent] for agent in PAIR]
    ways = [
        mount.arm.forward_kinematics(q[agent])[:, :3, 3] @ mount.rotation.T
        for mount, agent in zip(mounts, PAIR, strict=True)
    ]
    # least squares: a + s u is nearest to b + t v
    columns = np.stack([ways[0], -ways[1]], -1)
    shares = np.linalg.pinv(columns) @ (mounts[1].position - mounts[0].position)
    return np.stack([(1 - shares[:, i]) * np.linalg.norm(ways[i], axis=-1) for i in range(2)])


@pytest.mark.parametrize("scene", SCENES)
def test_each_goal_is_inside_the_other_arms_shaft_at_the_start(scene: str) -> None:
    task = known(scene)
    begin = {agent: way[0] for agent, way in task.ways.items()}
    for i, agent in enumerate(PAIR):
        mount, other = task.scene.mounts[agent], task.scene.mounts[PAIR[1 - i]]
        goal = task.tables["targets"][:, i] @ mount.rotation.T + mount.position
        axis, along = shaft(other, begin[PAIR[1 - i]])
        way = goal - other.position
        height = (way * axis).sum(-1)
        assert np.linalg.norm(way - height[:, None] * axis, axis=-1).max() < 1e-6
        assert (along - height).min() > NEAREST - 1e-6 and (along - height).max() < FARTHEST + 1e-6


@pytest.mark.parametrize("scene", SCENES)
def test_arms_are_apart_at_both_ends_and_lines_to_their_tips_cross_at_the_goals_alone(scene: str) -> None:
    task = known(scene)
    ways = task.ways
    begin, end = ({agent: way[k] for agent, way in ways.items()} for k in (0, -1))
    assert task.scene.clearance(begin).min() > CLEARANCE and task.scene.clearance(end).min() > APART
    assert beyond(task.scene, end).min() > BEYOND
    assert beyond(task.scene, begin).min(0).max() < BEYOND + 1e-6
    for i, agent in enumerate(PAIR):
        tips = task.scene.mounts[agent].arm.forward_kinematics(end[agent])[:, :3, 3]
        np.testing.assert_allclose(tips, task.tables["targets"][:, i], atol=1e-4)


def test_no_posture_at_a_goal_is_free_while_the_other_arm_stays() -> None:
    """However the wrist is bent: inverse kinematics from postures all over the joints' ranges."""
    task, rng = known("bimanual_psm"), np.random.default_rng(0)
    rows = np.repeat(np.arange(0, 2048, 16), 16)
    begin = {agent: way[0, rows] for agent, way in task.ways.items()}
    for i, agent in enumerate(PAIR):
        arm, targets = task.scene.mounts[agent].arm, task.tables["targets"][rows, i]
        start = rng.uniform(arm.lower, arm.upper, (len(rows), 7))
        start[:, :3] = begin[agent][:, :3]
        start[:, 6] = arm.home[6]
        q = inverse_kinematics(arm, targets, start, starts=1)
        there = np.linalg.norm(arm.forward_kinematics(q)[:, :3, 3] - targets, axis=-1) < 1e-4
        assert there.mean() > 0.9 and np.ptp(q[there][:, 4]) > 2.0
        assert task.scene.clearance({**begin, agent: q})[there].max() < 0


def test_straight_ways_collide_and_a_way_with_one_arm_drawn_back_is_free() -> None:
    task = known("bimanual_psm", "held_out")
    ways, shares = task.ways, np.linspace(0, 1, 33)[:, None, None]
    lines = lambda a, b: {agent: way[a] + shares * (way[b] - way[a]) for agent, way in ways.items()}  # noqa: E731
    assert task.scene.clearance(lines(0, 4)).min(0).max() < 0
    for move in range(4):
        assert task.scene.clearance(lines(move, move + 1)).min() > 0.9 * PASS
    assert 0.1 < crossing_table(task.scene, task.level.extent, task.seed).first.mean() < 0.9
    assert not np.isin(task.tables["targets"], known("bimanual_psm").tables["targets"]).any()


@pytest.fixture(scope="module")
def env() -> BatchedEnv:
    options = {"num_envs": 16, "engine": "mjx", "device": "cpu", "difficulty": "crossing", "goals": "held_out"}
    return BatchedEnv("reach", "bimanual_psm", **options)


def test_episodes_begin_at_the_tables_postures(env: BatchedEnv) -> None:
    env.reset(0)
    np.testing.assert_allclose(env.qpos, env.task.tables["postures"][env.goal.row], atol=1e-6)
    assert env.max_steps == 200


@pytest.mark.slow
def test_the_oracle_does_it_and_nobody_does_with_a_partner_who_stays(env: BatchedEnv) -> None:
    result = evaluate(env, oracle(env), 16, 0)
    assert result["team_success_2mm"] == 1.0 and result["collision_rate"] == 0.0
    for agent in PAIR:
        both, zero = oracle(env, [agent]), zero_policy(env)
        result = evaluate(env, lambda seen, both=both, zero=zero: {**zero(seen), **both(seen)}, 16, 0)  # type: ignore[misc]
        assert result["success_2mm"] == 0.0 and result["collision_rate"] == 0.0


def test_the_oracle_goes_on_beside_an_arm_that_is_ahead_of_the_script() -> None:
    task = known("bimanual_psm")
    first, script, ways = task.script()[0], task.script(), task.ways
    row = np.array([0])
    goes = next(agent for agent in PAIR if np.array_equal(ways[agent][0, 0], ways[agent][1, 0]))
    gives = next(agent for agent in PAIR if agent != goes)
    assert set(first.plan(seen(task, row, {})))  # both arms are told where to be

    def good(**shares: float) -> bool:
        """Whether the first move is over where `goes` is so far on the way to its goal, and `gives` makes way."""
        at = {goes: shares["goes"], gives: shares["gives"]}
        begin = {agent: ways[agent][0, 0] for agent in PAIR}
        end = {goes: ways[goes][4, 0], gives: ways[gives][1, 0]}
        q = {agent: (1 - at[agent]) * begin[agent] + at[agent] * end[agent] for agent in PAIR}
        return bool(script[0].good(seen(task, row, q))[0])

    assert good(goes=0.0, gives=1.0) and good(goes=1.0, gives=1.0)
    assert not good(goes=0.5, gives=1.0) and not good(goes=0.0, gives=0.5)


def seen(task: Any, row: np.ndarray, q: dict[str, np.ndarray]) -> Snapshot:
    """What a script sees in an episode of this row, with arms at joint positions [joints]."""
    tools = {agent: tool_of(task.scene.mounts[agent], posture[None]) for agent, posture in q.items()}
    return Snapshot(tools=tools, objects={}, held={}, goal=SimpleNamespace(row=row), qpos={})


@pytest.mark.parametrize("scene, count", [("psm", 1), ("bimanual_star", 0)])
def test_scenes_without_two_such_arms_are_refused(scene: str, count: int) -> None:
    with pytest.raises(ValueError, match=f"two arms that have a jaw and a remote center.*{scene}' has {count}"):
        Env("reach", scene, difficulty="crossing")


def test_other_starts_are_refused() -> None:
    with pytest.raises(ValueError, match="starts of its own: leave start 'random' out"):
        Env("reach", "bimanual_psm", difficulty="crossing", start="random")


def test_a_table_is_drawn_by_its_seed() -> None:
    task = known("bimanual_psm")
    again = crossing_table(task.scene, task.level.extent, task.seed)
    np.testing.assert_array_equal(again.targets, task.tables["targets"])
