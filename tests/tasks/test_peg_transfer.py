"""Peg transfer: where blocks and goals are, what counts as placed, and the oracle."""

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
from surgical_marl.tasks.base.grasp_poses import tool_of
from surgical_marl.tasks.base.object_task import Best
from surgical_marl.tasks.base.world import World
from surgical_marl.tasks.peg_transfer.blocks import find_pegs, gripping, upright
from surgical_marl.tasks.peg_transfer.script import ABOVE_WALL, PAST
from surgical_marl.tasks.peg_transfer.task import CLEAR, SHIFT, PegGoal, Team

TASK, SCENE = "peg_transfer", "bimanual_psm_pegs"
ROW = 5
TURN = upright(np.array([[0.01, 0.02, 0.03]]), np.array([75.0]))[0]
"""A jaw that holds a block goes and turns like this."""


@cache
def env(difficulty: str = "default") -> Env:
    return Env(TASK, SCENE, difficulty=difficulty)


@pytest.mark.parametrize("difficulty, side", [("easy", -1), ("default", 1)])
def test_blocks_and_goals_are_on_pegs_of_their_sides(difficulty: str, side: int) -> None:
    task: Any = env(difficulty).task
    pegs, starts, points = find_pegs(task.scene, TASK), task.tables["starts"], task.tables["points"]
    assert len(pegs) == 18
    away = np.linalg.norm(starts[:, None, :2] - pegs[:, :2], axis=-1)
    assert away.min(1).max() < SHIFT + 1e-9 and (starts[:, 0] < 0).all()
    goals = np.linalg.norm(points[:, None] - pegs, axis=-1)
    assert goals.min(1).max() < 1e-9 and (side * points[:, 0] > 0).all()
    assert (goals.argmin(1) != away.argmin(1)).all()
    if difficulty == "easy":
        assert set(np.linalg.norm(pegs[goals.argmin(1)] - pegs[away.argmin(1)], axis=-1).round(4)) == {0.02, 0.03}
    else:  # the red block stands on one
        red = task.scene.objects["block_red"].position
        assert np.linalg.norm(points[:, :2] - red[:2], axis=-1).min() > 0.019 and len(np.unique(points, axis=0)) == 8
    some = np.arange(0, len(starts), 32)
    least = distances(task.scene, {task.object: Pose(starts[some, :3], starts[some, 3:])}).min(1)
    assert (least > -RESTING).all()


def test_a_kernel_of_one_level_does_not_serve_another_one() -> None:
    """One arm or two move the block: what is compiled differs, though tables have the same shapes."""
    easy, default = env("easy"), env("default")
    assert easy.task.tables.keys() == default.task.tables.keys() and easy.content != default.content
    needles = [Env("needle_pick", "psm_needle", difficulty=d, observe={"psm_0": ["qpos"]}) for d in ("default", "hard")]
    assert needles[0].content != needles[1].content


@pytest.mark.parametrize("turn, left, right", [(0, "psm_0", "psm_1"), (2, "psm_1", "psm_0")])
def test_in_the_exchange_both_tools_grip_bars_of_their_sides_clear_of_the_wall(
    turn: int, left: str, right: str
) -> None:
    """Of the giver on its own side and the taker on its own, there and back."""
    task: Any = env("hard").task
    way, number = task._transfers[turn], np.arange(3)
    assert (way.giver, way.taker) == (left, right)
    block = way.exchange(number)
    np.testing.assert_allclose(block[:, :3, 3], np.tile([0.0, 0.0, ABOVE_WALL], (3, 1)), atol=1e-9)
    tips = {}
    for agent, grip in ((way.giver, number), (way.taker, way.taken(number))):
        mount = task.scene.mounts[agent]
        assert way.reaches(agent, block, grip).all()
        tips[agent] = gripping(mount, block, way.sites[grip], 0.0)[:, :3, 3]
    assert (tips["psm_0"][:, 0] < -0.004).all() and (tips["psm_1"][:, 0] > 0.004).all()
    assert ABOVE_WALL - 0.0075 > 0.07 + 0.01  # underside of the block, top of the wall


def world(height: float, shift: float, held: tuple[bool, bool], touched: tuple[bool, bool], lift: float = 1.0) -> World:
    """The block so far above its goal and beside the peg's axis; which arms hold and touch it."""
    task: Any = env().task
    block = upright(task.tables["points"][ROW][None] + [shift, 0.0, height + 0.0075], np.zeros(1))[0]
    arms: dict[str, Any] = {}
    for agent, holds, touches in zip(("psm_0", "psm_1"), held, touched, strict=True):
        mount = task.scene.mounts[agent]
        handled = Handled(np.float32(touches), np.bool_(holds), np.float32(0.0))  # type: ignore[arg-type]
        arms[agent] = SimpleNamespace(
            tool_tip=(block[:3, 3] - mount.position) @ mount.rotation, handles={task.object: handled},
            min_distance=np.float32(0.05), collision=np.bool_(False),
        )  # fmt: skip
    best = Best(*map(np.float32, (0.03, 1.0, lift, 0.05, 1.0)))  # type: ignore[arg-type]
    goal = PegGoal(np.int32(ROW), best, Team(*map(np.float32, (0.0, 0.0, 0.0))))  # type: ignore[arg-type]
    body: Any = ObjectView(block[:3, 3], block[:3, :3], np.zeros(6))  # type: ignore[arg-type]
    return World(arms, goal, objects={task.object: body})


def test_the_grip_that_is_observed_is_the_one_that_turns_the_tool_least() -> None:
    """At home that of the oracle; and it stays the same one on the way there, and as the block is lifted and turned."""
    task: Any = env().task
    way = task._transfers[0]
    mount, here = task.scene.mounts[way.giver], world(0.0, 0.0, NO, NO)
    read = {name: task.terms(way.giver)[name].read for name in ("to_grasp", "grasp_axis")}

    def seen(tool: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The place in the world that `to_grasp` leads to, and `grasp_axis` in the world."""
        tip, axes = (tool[:3, 3] - mount.position) @ mount.rotation, mount.rotation.T @ tool[:3, :3]
        arms = {way.giver: SimpleNamespace(tool_tip=tip, tool_axes=axes)}
        body: Any = ObjectView(block[:3, 3], block[:3, :3], np.zeros(6))  # type: ignore[arg-type]
        place, axis = (read[name](World(arms, here.goal, objects={task.object: body})) for name in read)
        return tool[:3, 3] + mount.rotation @ np.asarray(place), mount.rotation @ np.asarray(axis)

    home = tool_of(mount, mount.arm.home)
    blocks = upright(np.tile([-0.03, 0.0, 0.02], (24, 1)), np.linspace(-180, 180, 24, endpoint=False) + 3.0)
    grips = gripping(mount, blocks, way.sites[way.aligned(blocks)], PAST)
    for block, grip, number in zip(blocks, grips, way.aligned(blocks), strict=True):
        bar = block[:3, 3] + block[:3, :3] @ way.sites[number]
        for tool, body in ((home, block), (grip, block), (TURN @ grip, TURN @ block)):
            place, axis = seen(tool, body)
            turn = body @ np.linalg.inv(block)
            np.testing.assert_allclose(place, turn[:3, :3] @ bar + turn[:3, 3], atol=1e-6)
            np.testing.assert_allclose(axis, turn[:3, :3] @ grip[:3, 0], atol=1e-5)


NO, SECOND, BOTH = (False, False), (False, True), (True, True)


@pytest.mark.parametrize(
    ("height", "shift", "touched", "done", "dropped"),
    [
        (0.0, 0.0, NO, True, False),
        (0.0, 0.0026, NO, True, False),
        (0.0, 0.0, SECOND, False, False),  # still touched
        (0.01, 0.0, NO, False, False),  # it falls along its peg
        (0.0, 0.01, NO, False, True),  # beside the peg
        (0.0, 0.01, SECOND, False, False),
    ],
)
def test_success_is_a_block_on_its_peg_that_nobody_touches(
    height: float, shift: float, touched: tuple[bool, bool], done: bool, dropped: bool
) -> None:
    task, here = env().task, world(height, shift, NO, touched)
    assert {bool(value) for value in task.success(here).values()} == {done}
    assert bool(task.terminated(here)) == dropped


def test_rewards_are_of_each_stage_once() -> None:
    task: Any = env().task
    both = world(CLEAR + 0.01, 0.0, BOTH, BOTH)
    terms = task.reward_terms(both)["psm_0"]
    assert [float(terms[name]) for name in ("receive", "passed", "over", "carry")] == [1, 0, 0, 0]
    alone = world(CLEAR + 0.01, 0.0, SECOND, SECOND)._replace(goal=task.remember(both))
    terms = task.reward_terms(alone)["psm_1"]
    assert [float(terms[name]) for name in ("receive", "passed", "over", "success")] == [0, 1, 1, 0]
    assert float(terms["carry"]) == pytest.approx(0.05 - CLEAR - 0.01, abs=1e-6)
    again = alone._replace(goal=task.remember(alone))
    terms = task.reward_terms(again)["psm_1"]
    assert [float(terms[name]) for name in ("receive", "passed", "over", "carry")] == [0, 0, 0, 0]
    assert {name for name, done in task.reached(again)["psm_0"].items() if done} >= {"received", "passed", "over"}
    low = world(0.0, 0.0, SECOND, SECOND)
    assert not task.reached(low)["psm_0"]["over"]


def test_a_scene_without_pegs_does_not_do() -> None:
    with pytest.raises(ValueError, match="needs a scene with a free object"):
        sm.parallel_env(TASK, scene="bimanual_psm")


@cache
def batched(difficulty: str) -> BatchedEnv:
    options = {"engine": "fused", "device": "cpu", "goals": "held_out"}
    return BatchedEnv(TASK, SCENE, num_envs=1000, difficulty=difficulty, **options)


@pytest.mark.slow
@pytest.mark.parametrize("difficulty", ["easy", "default"])
def test_the_oracle_places_blocks(difficulty: str) -> None:
    """At least 98 % of 1,000 held-out starts."""
    many = batched(difficulty)
    found = evaluate(many, load_policy("oracle", many), 1000, 0)
    assert found["success_rate"] >= 0.98 and found["collision_rate"] <= 0.01


@pytest.mark.slow
@pytest.mark.parametrize("frozen", ["psm_0", "psm_1"])
def test_neither_arm_does_it_alone(frozen: str) -> None:
    many = batched("default")
    rest, moved = zero_policy(many), oracle(many, [agent for agent in many.agents if agent != frozen])
    found = evaluate(many, lambda seen: {**rest(seen), **moved(seen)}, 1000, 0)
    assert found["success_rate"] == 0
