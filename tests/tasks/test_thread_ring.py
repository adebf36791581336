"""Threading an eyelet: what counts as through the hole and as held, how threads lie at the start, and the oracle."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.evaluation.evaluate import evaluate
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.policy import load_policy, zero_policy
from surgical_marl.tasks.base.grasp_poses import moved
from surgical_marl.tasks.base.world import World
from surgical_marl.tasks.thread_ring.script import DEEP, GRIPS
from surgical_marl.tasks.thread_ring.task import LENGTHS, LOST, Progress, RingGoal

TASK, SCENE, ROW = "thread_ring", "bimanual_psm_thread_ring", 3
SIDE = np.array([0.0, 1.0, 0.0])


@cache
def env(difficulty: str = "default") -> Env:
    return Env(TASK, SCENE, difficulty=difficulty)


@cache
def compiled(name: str) -> Any:
    """A function of the task, which takes seconds if JAX compiles its loops anew in each call."""
    task: Any = env()._bound(None)[0]
    return jax.jit(task.eyelet.through if name == "through" else getattr(task, name))


def along(corners: Any) -> np.ndarray:
    """A thread along a line through corners about the middle of the hole, mm, whose end is at the last one, [n, 3], m.

    Edges are straight and have their length, but for those that go round a corner.
    """
    eyelet: Any = env().task.eyelet  # type: ignore[attr-defined]
    corners = np.asarray(corners, float)[::-1] / 1000
    corners = np.vstack(
        [corners, corners[-1] + 0.2 * (corners[-1] - corners[-2]) / np.linalg.norm(corners[-1] - corners[-2])]
    )
    ends = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=-1)))
    at = eyelet.edge * np.arange(len(eyelet.path))
    places = np.stack([np.interp(at, ends, corners[:, axis]) for axis in range(3)], -1)[::-1]
    return np.asarray(eyelet.centre + places, np.float32)


def past(length: float) -> np.ndarray:
    """A straight thread of which so much is through the hole, m."""
    return along([[-20.0, 0.3, -0.2], [1000 * length, 0.3, -0.2]])


@pytest.mark.parametrize(
    ("corners", "turns", "length"),
    [
        ([[-20, 0, 0], [12, 0, 0]], 1, 0.012),
        ([[-20, 2, 1], [12, 2, 1]], 1, 0.012),
        ([[-20, 4, 0], [12, 4, 0]], 0, 0.0),  # beside the ring
        ([[-20, 0, 0], [-1, 0, 0]], 0, 0.0),  # before it
        ([[20, 0, 0], [-12, 0, 0]], -1, 0.012),  # from the other side
        ([[-20, 1, 0], [10, 1, 0], [10, -1, 0], [-10, -1, 0]], 0, 0.010),  # through and back
        ([[-20, 1, 0], [10, 1, 0], [10, 9, 0], [-10, 9, 0]], 1, 0.038),  # through, and back around the ring
        ([[-9, 1, 0], [6, 1, 0], [6, 9, 0], [-6, 9, 0], [-6, -1, 0], [8, -1, 0]], 2, 0.008),  # a whole turn
    ],
)
def test_turns_through_the_hole_and_the_length_past_it_are_counted(corners: Any, turns: int, length: float) -> None:
    found, past = compiled("through")(along(corners))
    assert int(found) == turns
    assert float(past) == pytest.approx(length, abs=2e-4)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(*[st.floats(-8.0, 8.0)] * 3), min_size=3, max_size=7))
def test_crossings_are_those_of_places_close_along_the_thread(corners: Any) -> None:
    """Against the sides of 4,000 places along each edge, those inside of the disc's cylinder alone."""
    eyelet: Any = env().task.eyelet  # type: ignore[attr-defined]
    rough = eyelet.centre + np.repeat(np.array(corners, float) / 1000, 2, axis=0)[: len(eyelet.path)]
    nodes = np.vstack([np.tile(rough[:1], (len(eyelet.path) - len(rough), 1)), rough]).astype(np.float32)
    share = np.linspace(0.0, 1.0, 4001)[:, None]
    turns = 0
    for start, end in zip(nodes[:-1] - eyelet.centre, nodes[1:] - eyelet.centre, strict=True):
        places = start + share * (end - start)
        beside = np.linalg.norm(places[:, 1:], axis=-1)
        if np.abs(beside - eyelet.radius).min() < 1e-5 or np.abs([start[0], end[0]]).min() < 1e-6:
            return  # too near to tell
        side = np.sign(places[:, 0])
        turns += int(np.sum(np.diff(side)[beside[1:] < eyelet.radius]) / 2)
    assert int(compiled("through")(nodes)[0]) == turns


class Arm(NamedTuple):
    """Numbers that the task reads of an arm."""

    qpos: np.ndarray
    tool_tip: np.ndarray
    tool_axes: np.ndarray
    min_distance: Any = np.float32(0.03)
    collision: Any = np.bool_(False)


class Thread(NamedTuple):
    """Numbers that it reads of a thread."""

    position: np.ndarray
    tension: np.ndarray


def view(agent: str, pose: np.ndarray, jaw: float) -> Any:
    """An arm whose tool is at a pose [4, 4] of the world, and whose jaw is open by an angle, rad."""
    mount = env().scene.mounts[agent]
    qpos = np.float32(mount.arm.home)
    qpos[mount.arm.moves_jaw] = jaw
    tip, axes = (pose[:3, 3] - mount.position) @ mount.rotation, mount.rotation.T @ pose[:3, :3]
    return Arm(qpos, np.float32(tip), np.float32(axes))


def world(
    length: float | None = None, first: float = 0.5, second: float = 0.03, off: Any = (0.0, 0.0, 0.0),
    behind: float = GRIPS[1], tension: float = 0.1, pulled: float = 0.1, brought: float = 0.0, nodes: Any = None,
) -> World:  # fmt: skip
    """A thread through the hole, and both tools where the oracle takes it.

    Args:
        length: of it through the hole, m; that of the goal if None.
        first: opening of the first arm's jaw, rad.
        second: opening of the second arm's jaw, rad.
        off: by which the second tool is off the thread, m.
        behind: where the second tool takes it, from its end, m.
        tension: of the thread now, N.
        pulled: the greatest tension so far, N.
        brought: way that the first arm had left to bring the thread's end, m.
        nodes: other places of the thread, m, [n, 3].
    """
    task: Any = env().task
    nodes = past(float(task.tables["lengths"][ROW]) if length is None else length) if nodes is None else nodes
    arms = {}
    for agent, place, jaw, away in (("psm_0", GRIPS[0], first, 0.0), ("psm_1", behind, second, off)):
        at = np.asarray(task.eyelet.place(nodes, place), float)[None]
        ahead = np.asarray(task.eyelet.place(nodes, place - 0.002), float)[None]
        pose = task.threader.tools(agent, at, (ahead - at) / np.linalg.norm(ahead - at), DEEP)
        arms[agent] = view(agent, moved(pose, away)[0], jaw)
    thread = Thread(nodes, np.full(len(nodes) - 1, tension, np.float32))
    best = Progress(*map(np.float32, (0.03, 0.0, brought, -1.0, 0.0, 0.0, -1.0, pulled)))  # type: ignore[arg-type]
    goal = RingGoal(np.int32(ROW), best, np.zeros((5, 3), np.float32), np.float32(0), np.zeros(2, np.float32))  # type: ignore[arg-type]
    return World(arms, goal, systems={"thread": thread})


@pytest.mark.parametrize(
    ("change", "done"),
    [
        ({}, True),
        ({"first": 0.03}, False),  # the first arm holds it, too
        ({"second": 0.5}, False),  # the second jaw is open
        ({"off": (0.0, 0.002, 0.0)}, False),  # it closes beside the thread
        ({"off": (0.0, 0.0, 0.004)}, False),  # above it
        ({"length": 0.012}, False),
        ({"length": 0.060}, False),
        ({"behind": 0.060}, False),  # it holds the thread before the hole
        ({"tension": 10.0}, False),
        ({"pulled": 10.0}, False),  # a moment ago
        ({"brought": 0.005}, False),  # the first arm let it go before enough was through
    ],
)
def test_success_is_a_length_past_the_hole_that_the_second_arm_alone_holds(change: dict[str, Any], done: bool) -> None:
    succeeds = compiled("success")(world(**change))
    assert {agent: bool(value) for agent, value in succeeds.items()} == {"psm_0": done, "psm_1": done}


@pytest.mark.parametrize("off", [0.004, -0.002])
def test_a_thread_beside_the_ring_or_from_behind_is_no_success(off: float) -> None:
    task: Any = env().task
    length = 1000 * float(task.tables["lengths"][ROW])
    beside = along([[-20.0, 1000 * off, 0.0], [length, 1000 * off, 0.0]])
    assert bool(compiled("success")(world(nodes=beside))["psm_1"]) == (off == -0.002)
    assert not bool(compiled("success")(world(nodes=along([[20.0, 0.0, 0.0], [-length, 0.0, 0.0]])))["psm_1"])


def paid(seen: World) -> dict[str, float]:
    """Reward terms of the second arm, before weights."""
    return {name: float(value) for name, value in compiled("reward_terms")(seen)["psm_1"].items()}


def test_progress_is_rewarded_once_and_only_by_the_arm_whose_turn_it_is() -> None:
    empty = world(0.002, first=0.5, second=0.5, brought=0.03)
    assert [paid(empty)[name] for name in ("grip", "thread", "take", "release", "pull", "precision")] == [0] * 6
    brought = world(0.012, first=0.03, second=0.5, brought=0.03)
    first = paid(brought)
    assert first["grip"] == 1 and first["thread"] == pytest.approx(0.03, abs=1e-5)
    taken = brought._replace(goal=compiled("remember")(brought))
    assert [paid(taken)[name] for name in ("reach", "grip", "thread", "meet")] == pytest.approx([0] * 4, abs=1e-6)
    both = world(0.012, first=0.03)._replace(goal=taken.goal)
    assert paid(both)["take"] == 1 and paid(both)["release"] == 0 and paid(both)["precision"] == 0
    alone = world(0.012)._replace(goal=compiled("remember")(both))
    assert paid(alone)["take"] == 0 and paid(alone)["release"] == 1 and paid(alone)["pull"] == 0
    further = world(0.017)._replace(goal=compiled("remember")(alone))
    assert paid(further)["pull"] == pytest.approx(0.005, abs=2e-4) and paid(further)["release"] == 0
    assert paid(world())["success"] == 1 and paid(world())["precision"] == pytest.approx(1.0, abs=0.05)
    assert paid(world(tension=10.0))["overload"] == 1 and paid(world())["overload"] == 0


def test_each_step_of_the_end_on_its_way_through_the_hole_pays() -> None:
    goals: list[Any] = []
    for ahead in np.linspace(-9.0, 12.0, 22):
        seen = world(
            first=0.03, second=0.5, brought=0.03, nodes=along([[-30.0, 0.0, 0.0], [ahead, 0.0, min(0.0, 0.6 * ahead)]])
        )
        assert all(paid(seen._replace(goal=goal))["thread"] > 5e-4 for goal in goals[-1:])
        goals.append(compiled("remember")(seen))


def test_a_thread_that_falls_is_lost() -> None:
    low = world(nodes=past(0.03) - np.float32([0.0, 0.0, LOST + 0.007]))
    assert bool(compiled("terminated")(low)) and paid(low)["drop"] == 1
    assert bool(compiled("terminated")(world(nodes=past(0.03) * np.float32("nan"))))
    assert not bool(compiled("terminated")(world())) and paid(world())["drop"] == 0


@pytest.mark.parametrize(
    ("difficulty", "shift", "turn"), [("easy", 0.001, 3), ("default", 0.004, 10), ("hard", 0.007, 20)]
)
def test_threads_lie_where_the_level_says(difficulty: str, shift: float, turn: float) -> None:
    task: Any = env(difficulty).task
    eyelet, lays = task.eyelet, task.tables["lays"]
    assert np.abs(lays).max(0) == pytest.approx([shift, shift, np.radians(turn)], rel=0.05)
    assert task.tables["lengths"].min() >= LENGTHS[0] and task.tables["lengths"].max() <= LENGTHS[1]
    pad = env().scene.objects["pad"]
    for lay in lays[:50]:
        nodes = np.asarray(eyelet.laid(np.float32(lay[:2]), np.float32(lay[2])))
        np.testing.assert_allclose(np.linalg.norm(np.diff(nodes, axis=0), axis=-1), eyelet.edge, rtol=1e-5)
        np.testing.assert_allclose(nodes[-1], eyelet.path[-1] + [*lay[:2], 0.0], atol=1e-7)
        over = np.abs(nodes[:, :2] - pad.position[:2]) < pad.object.shapes[0].size[:2]
        assert over.all(-1)[:20].all() and not over.all(-1)[-10:].any()  # its end reaches over the edge


def test_no_other_system_than_a_loose_thread_is_laid_elsewhere() -> None:
    thread: Any = env().scene.systems["thread"]
    nodes = past(0.02)
    laid = thread.laid(thread.start(np.zeros((0, 3))), nodes)
    np.testing.assert_array_equal(thread.view(laid).position, nodes)
    for name, why in (("thread", "one that is tied"), ("wound", "a Tissue")):
        system = sm.load_scene("bimanual_psm_suture").systems[name]
        with pytest.raises(
            ValueError, match=f"only loose threads can be laid elsewhere than the scene says, not {why}"
        ):
            system.laid(None, nodes)
    simulator = Env("reach", "psm").simulator
    with pytest.raises(ValueError, match="unknown thread of scene 'psm' 'string'"):
        simulator.at(simulator.scene.home, threads={"string": nodes})


@pytest.mark.parametrize(
    ("left_out", "message"),
    [
        ("eyelet", "needs a scene with a fixed object that has the site eye; 'mine' has none"),
        ("thread", "needs a scene with a thread that is not tied; 'mine' has none"),
    ],
)
def test_a_scene_without_eyelet_or_thread_is_refused(tmp_path: Path, left_out: str, message: str) -> None:
    content = yaml.safe_load((Path(sm.__file__).parents[1] / f"scenes/{SCENE}.yaml").read_text())
    del content["objects"][left_out]
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=message) as caught:
        sm.parallel_env(TASK, scene=str(path))
    assert "\n" not in str(caught.value)


def test_a_scene_with_one_jaw_does_not_do() -> None:
    with pytest.raises(ValueError, match=r"2 arms whose jaws have pads; 'psm_needle' has 1 \(choose from bimanual"):
        sm.parallel_env(TASK, scene="psm_needle")


def test_an_arm_that_is_told_nothing_does_not_know_the_length() -> None:
    known = Env(TASK, SCENE, knowledge="one")
    assert "length" in known.observed["psm_0"].names and "length" not in known.observed["psm_1"].names


@cache
def batched(difficulty: str = "default") -> BatchedEnv:
    options = {"engine": "fused", "device": "cpu", "goals": "held_out"}
    return BatchedEnv(TASK, SCENE, num_envs=200, difficulty=difficulty, **options)


@pytest.mark.slow
@pytest.mark.parametrize("difficulty", ["easy", "default", "hard"])
def test_the_oracle_threads_and_pulls(difficulty: str) -> None:
    """At least 95 % of 200 held-out starts, without a collision."""
    many = batched(difficulty)
    found = evaluate(many, load_policy("oracle", many), 200, 0)
    assert found["success_rate"] >= 0.95 and found["collision_rate"] <= 0.02
    assert list(found["stages"])[1:4] == ["gripped", "threaded", "taken"] and found["time_to_success_s"] < 4


@pytest.mark.slow
@pytest.mark.parametrize("frozen", ["psm_0", "psm_1"])
def test_neither_arm_does_it_alone(frozen: str) -> None:
    many = batched()
    rest = zero_policy(many)
    moves = oracle(many, [agent for agent in many.agents if agent != frozen])
    found = evaluate(many, lambda seen: {**rest(seen), **moves(seen)}, 200, 0)
    assert found["success_rate"] == 0
    assert (found["stages"]["threaded"] > 0.9) == (frozen == "psm_1")
