"""Suture: what counts as a stitch, progress, the partner's grips, and the oracle that shows it can be done."""

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
from surgical_marl.tasks.base.grasp_poses import joints_at, moved
from surgical_marl.tasks.base.world import World
from surgical_marl.tasks.needle_drive.path import driven
from surgical_marl.tasks.needle_drive.task import Best
from surgical_marl.tasks.suture.script import APART, FIRST, HALFWAY, SECOND, Stitcher
from surgical_marl.tasks.suture.task import Stitch, SutureGoal

TASK, SCENE, ROW = "suture", "bimanual_psm_suture", 5


@cache
def env(difficulty: str = "default", goals: str = "held_out") -> Env:
    return Env(TASK, SCENE, difficulty=difficulty, goals=goals)


def stitch(**known: float) -> Stitch:
    start = {"meet": -1.0, "take": 0.0, "draw": 0.0, "pull": -1.0, "back": 0.0, "force": 0.0, "tension": 0.0}
    return Stitch(**{name: np.float32(value) for name, value in {**start, **known}.items()})  # type: ignore[arg-type]


def world(
    task: Any, needle: int, tail: float = 0.1, held: str = "psm_0", force: float = 1.0, tension: float = 0.2,
    exit_off: float = 0.0, best: Stitch | None = None, turned: float = 0.5, lifted: float = 0.0,
) -> World:  # fmt: skip
    """Two bites at the marks with the needle (0) or its thread alone (-1) in them, and arms that hold the needle."""
    marks, wound, along = task.tables["marks"][ROW], task.wound, np.array([1.0, 0.0, 0.0])
    inner = wound.middle - [0.0, 0.0, 0.002]
    walls = inner - wound.width * wound.across, inner + wound.width * wound.across
    entries, exits = np.stack([marks[0], walls[1]]), np.stack([walls[0], marks[1] + exit_off * along])
    flag, number = np.ones(2, bool), np.full(2, needle)
    thread, drawn = np.full(2, -1 if tail == 0.1 else 0), np.full(2, 0.1 - tail)
    parts: Any = (
        wound.in_world(entries),
        wound.in_world(exits),
        entries,
        exits,
        drawn * 0 + 0.0025,
        0 * drawn,
        flag,
        flag,
    )
    pose = moved(driven(task.needle, task.entries[ROW : ROW + 1], task.sweep[ROW] + turned), [0.0, 0.0, lifted])[0]

    def arm(agent: str) -> Any:
        holds = agent in held
        grip: Any = np.float32(5.0 * holds), np.bool_(holds), np.float32(0.0)
        mount, tip = task.scene.mounts[agent], pose[:3, :3] @ task.needle.tip + pose[:3, 3]
        return SimpleNamespace(
            tool_tip=(tip - mount.position) @ mount.rotation, handles={"needle": Handled(*grip)},
            min_distance=np.float32(0.01), collision=np.bool_(False),
        )  # fmt: skip

    tissue = SimpleNamespace(
        position=task.scene.systems["wound"].rest,
        tissue_force=np.float32(force),
        channels=ChannelView(*parts, number, thread, drawn),
    )
    line = SimpleNamespace(tension=np.full(39, tension, np.float32), broken=np.bool_(False))
    drive = Best(*(np.float32(x) for x in (0, 1, 1, 0, 0, 0, 0)))  # type: ignore[arg-type]
    goal: Any = SutureGoal(np.int32(ROW), drive, best or stitch(), np.float32(0.1))  # type: ignore[arg-type]
    where: Any = pose[:3, 3], pose[:3, :3], np.zeros(6)
    arms = {agent: arm(agent) for agent in task.scene.agents}
    return World(arms, goal, objects={"needle": ObjectView(*where)}, systems={"wound": tissue, "thread": line})


def tail_of(task: Any, more: float = 0.0) -> float:
    return float(task.tables["tails"][ROW]) + more


@pytest.mark.parametrize(
    ("how", "succeeds"),
    [
        ({}, True),
        ({"tail_off": 0.0049}, True),
        ({"tail_off": -0.0051}, False),
        ({"exit_off": 0.0026}, False),
        ({"held": "psm_1"}, False),
        ({"held": "psm_0 psm_1"}, False),
        ({"needle": 0}, False),
        ({"force": 8.1}, False),
        ({"tension": 9.5}, False),
        ({"best": stitch(force=8.1)}, False),
    ],
)
def test_a_stitch_is_done_as_the_driver_has_the_needle_and_the_tail_is_right(
    how: dict[str, Any], succeeds: bool
) -> None:
    task: Any = env().task
    tail = tail_of(task, how.pop("tail_off", 0.0))
    now = world(task, **{"needle": -1, "tail": tail, "lifted": 0.05, **how})
    assert bool(task.success(now)["psm_1"]) == succeeds
    assert float(task.reward_terms(now)["psm_0"]["success"]) == succeeds


def test_easy_ends_as_the_partner_has_the_needle_that_is_out() -> None:
    task: Any = env("easy").task
    for needle, held, succeeds in ((-1, "psm_1", True), (-1, "psm_0", False), (0, "psm_1", False)):
        now = world(task, needle, tail=0.08, held=held, exit_off=0.0039)
        assert bool(task.success(now)["psm_0"]) == succeeds


def test_stages_follow_the_needle() -> None:
    task: Any = env().task

    def reached(*args: Any, **how: Any) -> list[str]:
        return [name for name, there in task.reached(world(task, *args, **how))["psm_0"].items() if there]

    through = ["entered", "first_edge", "exited"]
    assert reached(0) == through
    assert reached(0, held="psm_0 psm_1") == [*through, "taken"]
    assert reached(-1, tail=0.08, held="psm_1") == [*through, "taken", "drawn"]
    assert reached(-1, tail=tail_of(task), held="psm_1") == [*through, "taken", "drawn", "pulled"]
    assert reached(-1, tail=tail_of(task), held="psm_0") == [*through, "handed_back"]
    assert tuple(task.reached(world(task, 0))["psm_0"]) == task.stages


def test_progress_is_paid_once() -> None:
    task: Any = env().task

    def paid(now: World) -> dict[str, float]:
        terms = task.reward_terms(now)["psm_1"]
        return {name: float(terms[name]) for name in ("meet", "take", "draw", "pull", "back")}

    taken = world(task, 0, held="psm_0 psm_1", best=stitch(meet=0.05))
    terms, share = paid(taken), 0.5 / task.needle.bend / task.needle.length
    assert (
        terms["take"] == 1 and terms["draw"] == pytest.approx(share, abs=1e-4) and terms["pull"] == terms["back"] == 0
    )
    assert 0.045 < terms["meet"] < 0.05  # the tool is at the tip, and the nearest bar's middle half a bar from it
    again = taken._replace(goal=task.remember(taken))
    assert max(map(abs, paid(again).values())) < 1e-6
    pulled = paid(world(task, -1, tail=tail_of(task, 0.01), held="psm_1", best=stitch(pull=0.04, draw=1.0, take=1.0)))
    assert pulled["pull"] == pytest.approx(0.03, abs=1e-6)
    back = paid(world(task, -1, tail=tail_of(task), held="psm_0", best=stitch(draw=1.0, take=1.0)))
    assert back["back"] == 1 and back["pull"] == 0


def test_metrics_and_what_agents_see_are_of_the_stitch() -> None:
    task: Any = env().task
    now = world(task, -1, tail=tail_of(task, 0.003), held="psm_1", exit_off=0.001)
    found = {name: float(value) for name, value in task.metrics(now)["psm_0"].items()}
    assert found["tail_error"] == pytest.approx(0.003, abs=1e-6) and found["exit_error"] == pytest.approx(
        0.001, abs=1e-6
    )
    assert found["gap"] == pytest.approx(2 * task.wound.width, abs=1e-6) and not found["drop"]
    terms = task.terms("psm_0")
    np.testing.assert_allclose(terms["stitch"].read(now), [1.0, 1.0, tail_of(task, 0.003)], atol=1e-6)
    np.testing.assert_allclose(terms["tail"].read(now), [tail_of(task)], atol=1e-6)
    assert float(terms["others_hold"].read(now)[0]) == 1 and float(task.terms("psm_1")["others_hold"].read(now)[0]) == 0
    assert np.linalg.norm(task.terms("psm_1")["to_front"].read(now)) < 0.002
    assert set(task.observes("psm_0")) <= set(terms)


def test_a_needle_that_hangs_on_its_thread_is_dropped() -> None:
    task: Any = env().task
    for needle, held, ends in ((-1, "", True), (-1, "psm_1", False), (0, "", False)):
        assert bool(task.terminated(world(task, needle, tail=0.05, held=held))) == ends


def test_the_partner_grips_the_needle_where_it_stands_out_and_the_turn_is_known() -> None:
    task: Any = env().task
    stitcher = Stitcher(task.scene, task.driver, task.partner, task.object, task.needle, task.beyond)
    rows = slice(0, 64)
    entries, sweep = task.entries[rows], task.sweep[rows]
    assert stitcher.can_be_taken(entries, sweep).all()
    for grip, angle in ((FIRST, task.beyond), (SECOND, HALFWAY)):
        assert grip.behind < angle / task.needle.bend
    for angle in (-0.4, 0.3, 2.0, 5.0):
        np.testing.assert_allclose(stitcher.turned(driven(task.needle, entries, angle), entries), angle, atol=1e-9)


def test_the_partners_wrist_is_above_the_tissue_as_it_takes_the_needle() -> None:
    """The wrist is a capsule of 3.5 mm radius behind the jaw; an arm that comes down goes too far by a millimetre."""
    task: Any = env().task
    stitcher = Stitcher(task.scene, task.driver, task.partner, task.object, task.needle, task.beyond)
    there = driven(task.needle, task.entries[:64], task.sweep[:64] + task.beyond)
    tool, mount = stitcher.taken(there, FIRST), task.scene.mounts[task.partner]
    upper = task.wound.in_world(task.wound.middle)[2]
    for back in (APART, 0.0):
        q, reached = joints_at(mount, moved(tool, -back * tool[:, :3, 2]))
        assert reached.all()
        for pose in mount.arm.link_poses(q, ("wrist_pitch_link", "wrist_yaw_link")).values():
            height = pose[:, :3, 3] @ mount.rotation[2] + mount.position[2] - upper
            assert (height > 0.0035 + 0.001).all()


def test_scenes_without_a_partner_or_a_thread_are_named() -> None:
    words = (
        "suture needs two arms whose jaws have pads; 'psm_suture' has 1 (choose from bimanual_psm_suture, or a file)"
    )
    with pytest.raises(ValueError, match=re.escape(words)):
        sm.parallel_env(TASK, scene="psm_suture")


@pytest.mark.slow
@pytest.mark.parametrize(("difficulty", "share"), [("easy", 0.95), ("default", 0.9)])
def test_the_oracle_makes_stitches(difficulty: str, share: float) -> None:
    """At least 95 % of 200 held-out starts at easy, 90 % at default."""
    many = BatchedEnv(TASK, SCENE, num_envs=200, engine="fused", device="cpu", goals="held_out", difficulty=difficulty)
    found = evaluate(many, load_policy("oracle", many), 200, 0)
    assert found["success_rate"] >= share and found["drop_rate"] <= 1 - share
    assert found["entry_error_mm"] < 1 and found["exit_error_mm"] < 1.5
