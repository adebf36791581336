"""Needle drive: starts and marks, success, reward, and the oracle that shows it can be done."""

from __future__ import annotations

import re
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
from surgical_marl.physics.systems.channel_state import ChannelView
from surgical_marl.policies.policy import load_policy
from surgical_marl.scenes.load import load_scene
from surgical_marl.tasks.base.grasp_poses import frames, joints_at
from surgical_marl.tasks.base.world import World
from surgical_marl.tasks.needle_drive.path import axis_of, driven, entry_poses, held_at, reaching
from surgical_marl.tasks.needle_drive.starts import BEFORE, BEYOND, LOOSE
from surgical_marl.tasks.needle_drive.task import SHARP, Best, DriveGoal

TASK, SCENE, ROW = "needle_drive", "psm_suture", 5


@cache
def env(difficulty: str = "default", goals: str = "training") -> Env:
    return Env(TASK, SCENE, difficulty=difficulty, goals=goals)


def tips(needle: Any, poses: np.ndarray) -> np.ndarray:
    return np.asarray(poses[:, :3, :3] @ needle.tip + poses[:, :3, 3])


def test_a_needle_that_is_turned_about_its_arc_goes_from_mark_to_mark() -> None:
    needle = env().task.needle  # type: ignore[attr-defined]
    radius = 1 / needle.bend
    entry, exit_ = np.array([[0.01, -0.006, 0.02]]), np.array([[0.011, 0.0065, 0.02]])
    poses = entry_poses(needle, entry, exit_, np.array([[0.9, 0.0, -0.4]]))
    np.testing.assert_allclose(tips(needle, poses), entry, atol=1e-9)
    half = np.linalg.norm(exit_ - entry) / 2
    sweep = 2 * np.arcsin(half / radius)
    np.testing.assert_allclose(tips(needle, driven(needle, poses, sweep)), exit_, atol=1e-9)
    found, there = reaching(needle, poses, np.array([0.0, 0.0, 0.02]), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(found, sweep, atol=1e-6)
    np.testing.assert_allclose(there, exit_, atol=1e-7)
    lowest = tips(needle, driven(needle, poses, sweep / 2))
    assert np.linalg.norm(lowest - (entry + exit_) / 2) == pytest.approx(radius - np.sqrt(radius**2 - half**2))
    assert lowest[0, 2] < 0.02 - 0.002
    turn = poses[0, :3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    ahead = tips(needle, driven(needle, poses, 1e-6)) - tips(needle, poses)
    np.testing.assert_allclose(ahead[0] / np.linalg.norm(ahead), turn @ needle.along, atol=1e-5)
    held = held_at(needle, np.array([0.0]), np.zeros(1), 0.0)[0]
    np.testing.assert_allclose(held[:3, 3], needle.tip, atol=1e-12)
    np.testing.assert_allclose(held[:3, :3], np.stack([needle.along, needle.inward, axis_of(needle)], 1), atol=1e-12)


@pytest.mark.parametrize("difficulty", ["easy", "default", pytest.param("hard", marks=pytest.mark.slow)])
def test_marks_are_on_both_edges_and_the_arm_can_make_the_whole_way(difficulty: str) -> None:
    task: Any = env(difficulty).task
    marks, wound, some = task.tables["marks"], task.wound, np.arange(0, 2048, 64)
    off = (marks - wound.middle) @ wound.across
    assert ((off[:, 0] < -0.0059) & (off[:, 0] > -0.0071)).all()
    if difficulty == "easy":  # out of the first edge, on the wall of the slit, below its rim
        np.testing.assert_allclose(off[:, 1], -wound.width, atol=1e-6)
        assert (marks[:, 1, 2] < wound.middle[2] - 1e-3).all() and (marks[:, 1, 2] > 1e-3).all()
    else:
        assert ((off[:, 1] > 0.0059) & (off[:, 1] < 0.0071)).all()
        np.testing.assert_allclose(marks[:, 1, 2], wound.middle[2], atol=1e-6)
    end = driven(task.needle, task.entries, task.sweep)
    np.testing.assert_allclose(tips(task.needle, end), wound.in_world(marks[:, 1]), atol=1e-6)
    mount = task.scene.mounts["psm_0"]
    starts = frames(task.tables["starts"][:, :3], task.tables["starts"][:, 3:])
    q, reached = joints_at(mount, starts[some] @ task.held[some])
    assert reached.all()
    for angle in (-BEFORE + 0 * task.sweep, task.sweep / 3, task.sweep + BEYOND):
        q, reached = joints_at(mount, driven(task.needle, task.entries, angle)[some] @ task.held[some], q)
        assert reached.all()
    if difficulty != "hard":  # the needle begins in the jaw, above the tissue
        posture = task.tables["postures"][:, task.scene.qpos_index("psm_0")][some]
        first, _ = joints_at(mount, starts[some] @ task.held[some])
        np.testing.assert_allclose(posture[:, ~mount.arm.moves_jaw], first[:, ~mount.arm.moves_jaw], atol=1e-3)
        assert (task.tables["lowest"] > wound.in_world(wound.middle)[2] + 0.002).all()
    else:  # its thread, which lies straight, is not across the needle
        first, second = np.array(task.scene.systems["thread"].path[:2])
        tails = starts @ np.append(task._three[2], 1.0)
        assert ((starts[:, :3, 3] - tails[:, :3]) @ (second - first) < 1e-9).all()


@pytest.mark.parametrize("name", ["psm_suture", "bimanual_psm_suture"])
def test_a_needle_that_lies_on_its_pad_is_off_the_wound(name: str) -> None:
    """Else it begins across the gap between pad and wound, with its tip in the tissue."""
    scene = load_scene(name)
    needle, wound = scene.objects["needle"], scene.systems["wound"]
    radius = max(np.linalg.norm(place) for place, _ in needle.object.sites.values())
    off = np.abs(needle.position[1]) - np.abs(wound.rest[:, 1]).max()  # the wound's middle is at y = 0
    assert off > radius + LOOSE + 0.002


def test_held_out_marks_are_others() -> None:
    one, other = (env(goals=goals).task.tables["marks"] for goals in ("training", "held_out"))
    assert not set(one[:, 0, 0]) & set(other[:, 0, 0])


def channels(*bites: tuple[Any, Any, bool, int]) -> ChannelView:
    """Channels with entry and exit in the tissue's frame at rest, whether they go through, and the needle in them."""
    entry, exit_, through, needle = (np.array(part) for part in zip(*bites, strict=True))
    place = env().task.wound.in_world  # type: ignore[attr-defined]
    there, depth = needle > -2, np.full(len(bites), 0.0025)
    ends, none = (place(entry), place(exit_), entry, exit_), 0 * depth
    return ChannelView(*ends, depth, none, there, through, needle, needle * 0 - 1, none)  # type: ignore[arg-type]


def world(view: Any, angle: float, best: Best, touched: bool = True, **off: Any) -> World:
    """The needle where it is driven by an angle from the entry, and these channels."""
    task: Any = env().task
    pose = driven(task.needle, task.entries[ROW : ROW + 1], angle)[0]
    row: Any = np.int32(ROW)
    grip: Any = np.float32(5.0 * touched), np.bool_(touched), np.float32(0.0)
    arm: Any = SimpleNamespace(
        tool_tip=np.zeros(3),
        handles={"needle": Handled(*grip)},
        min_distance=np.float32(np.inf),
        collision=np.bool_(False),
    )
    rest = task.scene.systems["wound"].rest
    tissue = SimpleNamespace(position=rest, tissue_force=np.float32(2.5), channels=view)
    where: Any = pose[:3, 3] + off.get("moved", 0.0), pose[:3, :3], np.zeros(6)
    return World(
        {"psm_0": arm},
        DriveGoal(row, best),
        objects={"needle": ObjectView(*where)},
        systems={"wound": tissue},
    )


def best(**known: float) -> Best:
    start = {"reach": 1.0, "grasp": 1.0, "lift": 1.0, "align": 0.05, "entry": 0.0, "exit": 0.0, "travel": 0.0}
    return Best(**{name: np.float32(value) for name, value in {**start, **known}.items()})  # type: ignore[arg-type]


def through(entry_off: float = 0.0, exit_off: float = 0.0, both: bool = True) -> ChannelView:
    """Channels in both edges of the marks' row, with entry and exit off along the slit."""
    task: Any = env().task
    marks, along = task.tables["marks"][ROW], np.array([1.0, 0.0, 0.0])
    inner = task.wound.middle - [0.0, 0.0, 0.002]
    walls = inner - task.wound.width * task.wound.across, inner + task.wound.width * task.wound.across
    none = (np.zeros(3), np.zeros(3), False, -2)
    first = (marks[0] + entry_off * along, walls[0], True, 0)
    second = (walls[1], marks[1] + exit_off * along, both, 0)
    return channels(first, second, none, none)


@pytest.mark.parametrize(
    ("entry", "exit_", "both", "beyond", "succeeds"),
    [
        (0.0, 0.0, True, 30.0, True),
        (0.0024, 0.0024, True, 30.0, True),
        (0.0026, 0.0, True, 30.0, False),
        (0.0, -0.0026, True, 30.0, False),
        (0.0, 0.0, True, 18.0, False),  # out by 2.6 mm
        (0.0, 0.0, False, 30.0, False),
    ],
)
def test_success_is_to_go_in_and_out_at_the_marks_and_far_enough_out(
    entry: float, exit_: float, both: bool, beyond: float, succeeds: bool
) -> None:
    task: Any = env().task
    now = world(through(entry, exit_, both), task.sweep[ROW] + np.radians(beyond), best())
    assert bool(task.success(now)["psm_0"]) == succeeds
    stages = {name: bool(value) for name, value in task.reached(now)["psm_0"].items()}
    good = abs(entry) < 0.0025
    came = good and both and abs(exit_) < 0.0025
    assert stages == {
        "at_entry": good, "entered": good, "first_edge": good, "exited": came, "driven": succeeds
    }  # fmt: skip
    found = {name: float(value) for name, value in task.metrics(now)["psm_0"].items()}
    assert found["entry_error"] == pytest.approx(abs(entry), abs=1e-6)
    assert not both or found["exit_error"] == pytest.approx(abs(exit_), abs=1e-6)
    assert found["bite_depth"] == pytest.approx(0.0025) and found["drop"] == 0
    length = np.asarray(task.terms("psm_0")["through"].read(now))
    past = np.radians(beyond)
    for got, angle, off in ((length[0], task.sweep[ROW] + past, entry), (length[1], past, exit_)):
        if off == 0 and both:  # on the arc
            assert got == pytest.approx(angle / task.needle.bend, abs=1e-5)


def test_rewards_are_progress_over_the_best() -> None:
    task: Any = env().task
    empty = channels(*[(np.zeros(3), np.zeros(3), False, -2)] * 4)
    before = world(empty, -0.5, best(align=0.02))
    terms = {name: float(value) for name, value in task.reward_terms(before)["psm_0"].items()}
    off = np.linalg.norm(
        driven(task.needle, task.entries[ROW : ROW + 1], -0.5)[0, :3, :] @ np.append(task._three, np.ones((3, 1)), 1).T
        - task.tables["enters"][ROW].T, axis=0,
    ).max()  # fmt: skip
    assert terms["align"] == pytest.approx(0.02 - off, abs=1e-6) and terms["force"] == pytest.approx(0.5)
    assert [terms[name] for name in ("entry", "exit", "travel", "success", "drop")] == [0] * 5
    loose = task.reward_terms(world(empty, -0.5, best(align=0.02), touched=False))["psm_0"]
    assert float(loose["align"]) == 0 and float(loose["drop"]) == 1
    after = world(through(0.001, -0.001), task.sweep[ROW] + np.radians(24.0), best(entry=0.1))
    terms = {name: float(value) for name, value in task.reward_terms(after)["psm_0"].items()}
    quality = np.exp(-0.001 / SHARP)
    assert terms["entry"] == pytest.approx(quality - 0.1, abs=1e-5) and terms["exit"] == pytest.approx(
        quality, abs=1e-5
    )
    assert terms["travel"] == pytest.approx(1.0, abs=1e-5) and terms["success"] == 1
    again = task.remember(after)
    paid = task.reward_terms(after._replace(goal=again))["psm_0"]
    assert all(abs(float(paid[name])) < 1e-6 for name in ("align", "entry", "exit", "travel", "grasp", "lift"))


def test_a_needle_in_tissue_may_be_let_go_and_one_in_the_air_may_not() -> None:
    task: Any = env().task
    empty = channels(*[(np.zeros(3), np.zeros(3), False, -2)] * 4)

    def ends(view: Any, angle: float, best: Best, **how: Any) -> bool:
        return bool(task.terminated(world(view, angle, best, **how)))

    assert ends(empty, 0.0, best(), touched=False) and not ends(empty, 0.0, best())
    assert not ends(through(), 1.0, best(), touched=False)
    assert ends(through(), 1.0, best(), moved=np.array([0.0, 0.0, -0.2]))
    assert ends(through(), 1.0, best(), moved=np.full(3, np.nan))


def test_a_scene_without_a_wound_is_named() -> None:
    words = (
        "needle_drive needs a scene with a wound: tissue with a slit and `channels`; 'psm_needle' has none (choose "
        "from psm_suture, bimanual_psm_suture, or a file)"
    )
    with pytest.raises(ValueError, match=re.escape(words)):
        sm.parallel_env(TASK, scene="psm_needle")


@pytest.mark.slow
@pytest.mark.parametrize("difficulty", ["easy", "default", "hard"])
def test_the_oracle_drives_needles(difficulty: str) -> None:
    """At least 95 % of 200 held-out starts."""
    many = BatchedEnv(TASK, SCENE, num_envs=200, engine="fused", device="cpu", goals="held_out", difficulty=difficulty)
    found = evaluate(many, load_policy("oracle", many), 200, 0)
    assert found["success_rate"] >= 0.95 and found["drop_rate"] <= 0.02
    assert list(found["stages"]) == ["at_entry", "entered", "first_edge", "exited", "driven"]
    assert found["entry_error_mm"] < 1 and found["exit_error_mm"] < 1 and found["max_tissue_force_n"] < 3
