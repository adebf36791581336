"""Needle handover: starts and goals that one arm alone can't do, what counts as handed over, and the oracle."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.evaluation.evaluate import evaluate
from surgical_marl.physics.outputs import Handled, ObjectView
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.policy import load_policy, zero_policy
from surgical_marl.scenes.object_contacts import RESTING, distances
from surgical_marl.scenes.poses import Pose
from surgical_marl.tasks.base.grasp_poses import bar
from surgical_marl.tasks.base.object_task import Best
from surgical_marl.tasks.base.resting_poses import LOOSE
from surgical_marl.tasks.base.world import World
from surgical_marl.tasks.needle_handover import END, OUT, HandoverGoal, Team

TASK, SCENE = "needle_handover", "bimanual_psm_needle"
ROW = 5


@cache
def env(difficulty: str = "default") -> Env:
    return Env(TASK, SCENE, difficulty=difficulty)


@pytest.mark.parametrize("difficulty", ["default", pytest.param("hard", marks=pytest.mark.slow)])
def test_starts_and_goals_are_out_of_the_other_arms_reach(difficulty: str) -> None:
    """Against the tips of many postures with the insertion at its limit, and the wrist in the middle."""
    task: Any = env(difficulty).task
    first, second = (task.scene.mounts[agent] for agent in ("psm_0", "psm_1"))
    starts, points = task.tables["starts"][:, :3], task.tables["points"]
    rng, arm = np.random.default_rng(0), first.arm
    q = rng.uniform(0.7 * arm.lower, 0.7 * arm.upper, (4000, 7))
    q[:, 2], q[:2000, 4:6] = arm.upper[2], 0.0
    tips = arm.forward_kinematics(q)[:, :3, 3]
    for mount, places in ((second, starts), (first, points)):
        local = (places[::16] - mount.position) @ mount.rotation
        assert np.linalg.norm(local[:, None] - tips, axis=-1).min() > OUT - 1e-6
    for mount, places in ((first, starts), (second, points)):
        assert np.linalg.norm(places - mount.position, axis=-1).max() < np.linalg.norm(tips, axis=-1).max()
    assert np.abs(starts[:, 0] + END).max() < task.level.spread and np.abs(points[:, 0] - END).max() < task.level.spread
    some = np.arange(0, len(starts), 32)
    poses = task.tables["starts"][some]
    least = distances(task.scene, {"needle": Pose(poses[:, :3], poses[:, 3:])}).min(1)
    assert (least > -RESTING).all() and (least < LOOSE).all()


def test_the_exchange_has_one_tool_on_the_needles_plane_and_the_other_one_in_it() -> None:
    task: Any = env().task
    held = np.tile(np.eye(4), (6, 1, 1))
    held[::2, :3, :3] = np.diag([1.0, -1.0, -1.0])  # a tool on either side of the needle
    needle = task._exchange(held)
    taken = task._taken(needle)
    _, giver, taker = task._ways()
    assert abs(giver @ taker) < 1e-9 and giver[2] < 0 and taker[2] < 0
    np.testing.assert_allclose((needle @ held)[:, :3, 2], np.tile(giver, (6, 1)), atol=1e-9)
    np.testing.assert_allclose(taken[:, :3, 2], np.tile(taker, (6, 1)), atol=1e-9)
    one, other = (bar(needle, task._item, number)[0] for number in task.grips)
    np.testing.assert_allclose((one + other) / 2, np.tile([0.0, 0.0, 0.08033], (6, 1)), atol=1e-6)
    np.testing.assert_allclose(taken[:, :3, 3], other, atol=1e-9)


def world(
    known: Env, held: tuple[bool, bool], touched: tuple[bool, bool], number: int = 2, best: Best | None = None
) -> World:
    """The needle at the goal of a row; which arms hold and touch it; the second tool is at a bar of the needle."""
    task: Any = known.task
    needle = task.goals[ROW]
    arms: dict[str, Any] = {}
    for agent, holds, touches, at in zip(("psm_0", "psm_1"), held, touched, (6, number), strict=True):
        mount = known.scene.mounts[agent]
        place = bar(needle[None], task._item, at)[0][0]
        handled = Handled(np.float32(touches), np.bool_(holds), np.float32(0.0))
        arms[agent] = SimpleNamespace(
            tool_tip=(place - mount.position) @ mount.rotation, handles={"needle": handled},
            min_distance=np.float32(0.01), collision=np.bool_(False),
        )  # fmt: skip
    single = best or Best(*map(np.float32, (0.03, 0.0, 0.0, 0.05, 1.0)))  # type: ignore[arg-type]
    team = Team(*map(np.float32, (0.02, 0.0, 0.0)))  # type: ignore[arg-type]
    body: Any = ObjectView(needle[:3, 3], needle[:3, :3], np.zeros(6))  # type: ignore[arg-type]
    return World(arms, HandoverGoal(np.int32(ROW), single, team), objects={"needle": body})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("held", "touched", "number", "done"),
    [
        ((False, True), (False, True), 2, True),
        ((False, True), (False, True), 1, False),  # too near the tail
        ((False, True), (False, True), 6, False),
        ((False, True), (True, True), 2, False),  # the first arm still touches it
        ((True, True), (True, True), 2, False),
        ((True, False), (True, False), 2, False),
    ],
)
def test_success_is_the_second_arm_alone_at_a_useful_place(
    held: tuple[bool, bool], touched: tuple[bool, bool], number: int, done: bool
) -> None:
    task = env().task
    succeeds = task.success(world(env(), held, touched, number))
    assert {agent: bool(value) for agent, value in succeeds.items()} == {"psm_0": done, "psm_1": done}


def test_rewards_are_of_the_team_and_of_each_stage_once() -> None:
    task: Any = env().task
    both = world(env(), (True, True), (True, True))
    terms = task.reward_terms(both)
    value = lambda agent, name: float(terms[agent][name])  # noqa: E731
    for agent in ("psm_0", "psm_1"):
        assert [value(agent, name) for name in ("receive", "passed", "carry", "grasp")] == [1, 0, 0, 1]
        assert value(agent, "meet") == pytest.approx(0.02, abs=1e-6) and value(agent, "clearance") > 0
    after = task.remember(both)
    alone = world(env(), (False, True), (False, True))._replace(goal=after)
    terms = task.reward_terms(alone)
    assert [value("psm_0", name) for name in ("receive", "passed", "meet", "grasp")] == [0, 1, 0, 0]
    assert value("psm_1", "carry") == pytest.approx(0.05, abs=1e-5)
    done = {name: bool(reached) for name, reached in task.reached(alone)["psm_0"].items()}
    assert done == {
        "reached": True, "grasped": False, "lifted": False, "received": False, "passed": True, "at_goal": True
    }  # fmt: skip
    terms = task.reward_terms(alone._replace(goal=task.remember(alone)))
    assert [value("psm_0", name) for name in ("receive", "passed", "meet", "grasp", "carry")] == [0] * 5


@pytest.mark.parametrize(("number", "counts"), [(2, True), (1, False), (6, False)])
def test_only_a_useful_grip_is_rewarded(number: int, counts: bool) -> None:
    """The tools are at another bar each time; the way to the middle half is what `meet` and `to_useful` measure."""
    task: Any = env().task
    for held in ((True, True), (False, True)):
        seen = world(env(), held, held, number)
        terms = task.reward_terms(seen)["psm_0"]
        assert float(terms["receive"] + terms["passed"]) == counts
    away = np.linalg.norm(task.terms("psm_1")["to_useful"].read(seen))
    assert (away < 1e-6) == counts and 0.02 - float(terms["meet"]) == pytest.approx(away, abs=1e-6)


def test_a_scene_with_one_jaw_does_not_do() -> None:
    with pytest.raises(ValueError, match=r"'psm_needle' has 1 \(choose from bimanual_psm_needle, trimanual"):
        sm.parallel_env(TASK, scene="psm_needle")


@cache
def batched(num_envs: int = 1000, difficulty: str = "default") -> BatchedEnv:
    options = {"engine": "fused", "device": "cpu", "goals": "held_out"}
    return BatchedEnv(TASK, SCENE, num_envs=num_envs, difficulty=difficulty, **options)


@pytest.mark.slow
@pytest.mark.parametrize("difficulty", ["easy", "default", "hard"])
def test_the_oracle_hands_needles_over(difficulty: str) -> None:
    """At least 98 % of 1,000 held-out starts, in less than 8 s on average."""
    many = batched(1000, difficulty)
    found = evaluate(many, load_policy("oracle", many), 1000, 0)
    assert found["success_rate"] >= 0.98 and found["drop_rate"] <= 0.01 and found["collision_rate"] <= 0.02
    assert list(found["stages"])[3:5] == ["received", "passed"] and found["stages"]["passed"] >= 0.98
    assert found["time_to_success_s"] < 8 and found["median_error_mm"] < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("frozen", ["psm_0", "psm_1"])
def test_neither_arm_does_it_alone(frozen: str) -> None:
    many = batched()
    rest = zero_policy(many)
    moved = oracle(many, [agent for agent in many.agents if agent != frozen])
    found = evaluate(many, lambda seen: {**rest(seen), **moved(seen)}, 1000, 0)
    assert found["success_rate"] == 0 and found["stages"]["received"] == 0
    assert (found["stages"]["lifted"] > 0.9) == (frozen == "psm_1")


@pytest.mark.slow
def test_an_arm_observes_whether_the_other_one_holds() -> None:
    many = batched()
    policy, (observed, *_) = oracle(many), many.reset(seed=1)
    seen = []
    for _ in range(320):
        observed = many.step(policy(observed)).observations
        terms = {agent: many.observation_terms(agent)["others_hold"] for agent in many.agents}
        other = {agent: observed[agent][:, term][:, 0] > 0 for agent, term in terms.items()}
        np.testing.assert_array_equal(other["psm_0"], many.held[:, 0, 1])
        np.testing.assert_array_equal(other["psm_1"], many.held[:, 0, 0])
        seen.append(many.held[:, 0].mean(0))
    assert np.max(seen, 0).min() > 0.9
