"""Tissue retraction: what counts as clear and as touched, that no tool gets under a flap that hangs, and the oracle."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.evaluation.evaluate import evaluate
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.policy import load_policy, zero_policy
from surgical_marl.scenes.tissue_file import OVERLOAD
from surgical_marl.tasks.base.grasp_poses import moved
from surgical_marl.tasks.base.world import World
from surgical_marl.tasks.tissue_retract import CLEAR, DEEP, HOLD, WRIST, Progress, RetractGoal, turn_about

TASK, SCENE = "tissue_retract", "bimanual_psm_tissue"
ROW = 7
HANGS, FOLDED = -15.0, 140.0
"""Angles of a flap that hangs, as one of the shipped stiffness does, and of one that is folded back, degrees."""


@cache
def env(difficulty: str = "default") -> Env:
    return Env(TASK, SCENE, difficulty=difficulty)


def turned(degrees: float) -> np.ndarray:
    """Nodes of a stiff flap that is turned up by an angle about the side at which it hangs, [n, 3]."""
    flap: Any = env().task.flap  # type: ignore[attr-defined]
    turn = turn_about(np.cross(flap.outward, [0.0, 0.0, 1.0]), np.radians(degrees))
    return np.asarray(flap.hinge + (flap.rest - flap.hinge) @ turn.T, np.float32)


def view(agent: str, pose: np.ndarray) -> Any:
    """An arm whose tool is at a pose [4, 4] of the world."""
    mount = env().scene.mounts[agent]
    return SimpleNamespace(
        tool_tip=np.float32((pose[:3, 3] - mount.position) @ mount.rotation),
        tool_axes=np.float32(mount.rotation.T @ pose[:3, :3]), min_distance=np.float32(0.03),
        collision=np.bool_(False),
    )  # fmt: skip


def world(
    degrees: float = FOLDED, away: Any = (0.0, 0.0, 0.0), beside: float = 0.0, force: float = 5.0, time: float = HOLD,
    deep: float = DEEP,
) -> World:  # fmt: skip
    """Both tools where the oracle brings them, and the flap turned up by an angle.

    Args:
        degrees: the flap's angle.
        away: by which the second tool is off the lesion, m.
        beside: by which the first tool is off the edge along the way in which its jaw opens, m.
        force: on the tissue, N.
        time: for which the lesion has been touched, s.
        deep: how far the first tool's tip is past the edge, m.
    """
    task: Any = env().task
    flap, nodes = task.flap, turned(degrees)
    point, grip = task.tables["points"][ROW], int(task.tables["grips"][ROW])
    first = flap.pinching(flap.edge_of(flap.rest)[[grip]], deep)
    first = moved(first, beside * first[:, :3, 1])[0]
    turn = turn_about(np.cross(flap.outward, [0.0, 0.0, 1.0]), np.radians(degrees))
    first[:3] = np.column_stack([turn @ first[:3, :3], flap.hinge + turn @ (first[:3, 3] - flap.hinge)])
    arms = {"psm_0": view("psm_0", first),
            "psm_1": view("psm_1", moved(task._touching(point[None], 0.0005), away)[0])}  # fmt: skip
    tissue = SimpleNamespace(position=nodes, tissue_force=np.float32(force), torn=np.bool_(False))
    none = Progress(*map(np.float32, (0.03, 0.0, 0.0, 0.0, 0.0)))  # type: ignore[arg-type]
    numbers: Any = np.float32(time), np.float32(0.0), np.zeros(3, np.float32)
    return World(arms, RetractGoal(np.int32(ROW), none, *numbers), systems={flap.name: tissue})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "done"),
    [
        ({}, True),
        ({"time": 0.1}, False),  # not for long enough
        ({"degrees": HANGS}, False),  # the flap is pinched, but hangs
        ({"degrees": 60.0}, False),  # lifted, but in the way
        ({"beside": 0.02}, False),  # nobody holds it
        ({"deep": -0.002}, False),  # the jaw closes before its edge
        ({"beside": 0.006}, False),  # a finger bears its edge from below
        ({"away": (0.0, 0.0, 0.003)}, False),  # the tip is above the lesion
        ({"away": (0.003, 0.0, 0.0)}, False),
        ({"force": OVERLOAD + 1}, False),
    ],
)
def test_success_is_a_touch_under_a_flap_that_the_other_arm_holds_back(change: dict[str, Any], done: bool) -> None:
    succeeds = env().task.success(world(**change))
    assert {agent: bool(value) for agent, value in succeeds.items()} == {"psm_0": done, "psm_1": done}


def test_room_is_the_distance_of_the_flap_from_the_way() -> None:
    """Against 4,000 points along the way, for flaps at eight angles."""
    task: Any = env().task
    point, mount = task.tables["points"][ROW], env().scene.mounts["psm_1"]
    pose = moved(task._touching(point[None], 0.03), [0.01, -0.02, 0.0])[0]
    wrist = pose[:3, 3] - WRIST * pose[:3, 2]
    share = np.linspace(0.0, 1.0, 2000)[:, None]
    way = np.concatenate([point + share * (wrist - point), wrist + share * (mount.position - wrist)])
    for degrees in np.linspace(HANGS, FOLDED, 8):
        seen = world(degrees, moved(pose[None], -task._touching(point[None], 0.0005)[:, :3, 3])[0, :3, 3])
        least = np.linalg.norm(turned(degrees)[:, None] - way, axis=-1).min()
        assert float(task.now(seen).room) == pytest.approx(least, abs=1e-4)


@pytest.mark.parametrize("difficulty", ["default", "hard"])
def test_no_tool_gets_under_a_flap_that_hangs(difficulty: str) -> None:
    """Whichever way a tool points at the lesion, from above the pad: it has no room."""
    task: Any = env(difficulty).task
    rng, nodes = np.random.default_rng(0), turned(HANGS)
    for row in range(0, len(task.tables["points"]), 8):
        point = task.tables["points"][row]
        back = rng.normal(size=3) * [1.0, 1.0, rng.uniform(0.0, 1.0)]
        back[2] = abs(back[2])
        pose = np.eye(4)
        pose[:3, 2], pose[:3, 3] = -back / np.linalg.norm(back), point
        pose[:3, 0] = np.cross(pose[:3, 2], [0.0, 0.0, 1.0])
        known = world()
        arms = {**known.arms, "psm_1": view("psm_1", pose)}
        goal = known.goal._replace(row=np.int32(row))
        tissue = SimpleNamespace(position=nodes, tissue_force=np.float32(1.0), torn=np.bool_(False))
        assert float(task.now(World(arms, goal, systems={"flap": tissue})).room) < CLEAR


def paid(seen: World) -> dict[str, float]:
    """Reward terms of the second arm, before weights."""
    return {name: float(value) for name, value in env().task.reward_terms(seen)["psm_1"].items()}


def test_progress_is_rewarded_once_and_only_while_the_flap_is_held() -> None:
    task: Any = env().task
    terms = ("pinch", "lift", "clear", "touch", "precision", "success")
    loose = world(beside=0.02)
    assert [paid(loose)[name] for name in terms] == [0] * 6
    seen = world()
    first = paid(seen)
    assert first["pinch"] == 1 and first["clear"] == 1 and first["success"] == 1
    assert first["lift"] == pytest.approx(2.4, abs=0.1) and first["touch"] == pytest.approx(0.1, abs=0.001)
    assert first["precision"] == pytest.approx(1.0, abs=0.15)
    held = task.remember(seen)
    again = paid(seen._replace(goal=held))
    assert [again[name] for name in ("reach", "pinch", "lift", "clear", "touch")] == pytest.approx([0] * 5, abs=1e-6)
    dropped = paid(loose._replace(goal=held))  # what is lost again, and what is not
    assert [dropped["clear"], dropped["touch"]] == pytest.approx([-first["clear"], -first["touch"]])
    assert dropped["pinch"] == dropped["lift"] == dropped["precision"] == 0
    assert paid(world(force=OVERLOAD + 1))["overload"] == 1 and first["overload"] == 0


def test_each_step_of_the_way_to_the_lesion_pays() -> None:
    """Also while the second tool leans towards the flap, so that it has no room yet."""
    task: Any = env().task
    point, seen = task.tables["points"][ROW], world()
    goals: list[Any] = []
    rooms: list[float] = []
    for share in np.linspace(1.0, 0.0, 20):
        pose = moved(task._touching(point[None], 0.0005), share * np.array([-0.03, 0.02, 0.05]))[0]
        pose[:3, :3] = turn_about(np.array([-1.0, 0.0, 0.0]), share) @ pose[:3, :3]
        seen = seen._replace(arms={**seen.arms, "psm_1": view("psm_1", pose)})
        rooms.append(float(task.now(seen).room))
        assert all(paid(seen._replace(goal=goal))["touch"] > 0.001 for goal in goals[-1:])
        goals.append(task.remember(seen))
    assert rooms[0] < CLEAR < rooms[-1]


def test_a_touch_that_is_broken_begins_anew() -> None:
    task: Any = env().task
    for off, left in ((0.0, 0.12), (0.01, 0.0)):
        seen = world(away=(0.0, 0.0, off), time=0.1)
        seen = seen._replace(goal=task.advance(seen.goal, 0.02))
        assert float(task.remember(seen).touched) == pytest.approx(left, abs=1e-6)


def test_an_arm_that_is_told_nothing_cannot_tell_where_the_lesion_is() -> None:
    known = Env(TASK, SCENE, knowledge="one")
    task: Any = known.task
    seen, terms = world(HANGS), task.terms("psm_1")
    others = [seen._replace(goal=seen.goal._replace(row=np.int32(row))) for row in range(0, 2048, 128)]
    own = task.observes("psm_1")[5:12]  # those of the task
    told = [len(np.unique([terms[name].read(one) for one in others], axis=0)) > 1 for name in own]
    hidden = [name not in known.observed["psm_1"].names for name in own]
    assert told == hidden and sum(hidden) == 4


@pytest.mark.parametrize(("difficulty", "off"), [("easy", 0.0), ("default", 1.0), ("hard", 2.0)])
def test_starts_are_where_the_level_says(difficulty: str, off: float) -> None:
    known = env(difficulty)
    task: Any = known.task
    scene, points = known.scene, task.tables["points"]
    patch = scene.objects["lesion"]
    size = patch.object.shapes[0].size
    assert (np.abs(points[:, :2] - patch.position[:2]) < np.array(size)[:2]).all()
    np.testing.assert_allclose(points[:, 2], patch.position[2] + 0.003, atol=1e-7)
    assert np.ptp(points[:, :2], axis=0) == pytest.approx(2 * np.array(task.level.extent), rel=0.05)
    for agent, mount in scene.mounts.items():
        moves = task.tables["starts"][:, scene.qpos_index(agent)] - mount.arm.home
        widest = off * np.where([joint.slides for joint in mount.arm.actuated], 0.01, 0.1) * ~mount.arm.moves_jaw
        np.testing.assert_allclose(np.abs(moves).max(0), widest, rtol=0.05, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"flap": None}, "needs a scene with tissue that is held at one of left, right, front, back; 'mine' has none"),
        ({"lesion": None}, "needs a scene with an object that has the site lesion; 'mine' has none"),
    ],
)
def test_a_scene_without_flap_or_lesion_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    content = yaml.safe_load((Path(sm.__file__).parents[1] / f"scenes/{SCENE}.yaml").read_text())
    for name in change:
        del content["objects"][name]
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=message) as caught:
        sm.parallel_env(TASK, scene=str(path))
    assert "\n" not in str(caught.value)


def test_a_scene_with_one_jaw_does_not_do() -> None:
    with pytest.raises(ValueError, match=r"2 arms whose jaws have pads; 'psm_needle' has 1 \(choose from bimanual"):
        sm.parallel_env(TASK, scene="psm_needle")


@cache
def batched(difficulty: str = "default") -> BatchedEnv:
    options = {"engine": "fused", "device": "cpu", "goals": "held_out"}
    return BatchedEnv(TASK, SCENE, num_envs=200, difficulty=difficulty, **options)


@pytest.mark.slow
@pytest.mark.parametrize("difficulty", ["easy", "default", "hard"])
def test_the_oracle_retracts_and_touches(difficulty: str) -> None:
    """At least 95 % of 200 held-out starts, without a collision."""
    many = batched(difficulty)
    found = evaluate(many, load_policy("oracle", many), 200, 0)
    assert found["success_rate"] >= 0.95 and found["collision_rate"] <= 0.02
    assert list(found["stages"])[1:4] == ["pinched", "lifted", "cleared"] and found["time_to_success_s"] < 4


@pytest.mark.slow
@pytest.mark.parametrize("frozen", ["psm_0", "psm_1"])
def test_neither_arm_does_it_alone(frozen: str) -> None:
    many = batched()
    rest = zero_policy(many)
    moves = oracle(many, [agent for agent in many.agents if agent != frozen])
    found = evaluate(many, lambda seen: {**rest(seen), **moves(seen)}, 200, 0)
    assert found["success_rate"] == 0
    assert (found["stages"]["lifted"] > 0.9) == (frozen == "psm_1")
