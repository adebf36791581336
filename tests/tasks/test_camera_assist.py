"""Camera assistance: what is in view, what the tools see of it, and what good and bad cameras are worth."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import mujoco
import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.evaluation.evaluate import evaluate
from surgical_marl.physics.outputs import Handled, ObjectView
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.policy import load_policy, zero_policy
from surgical_marl.tasks.base.grasp_poses import frames
from surgical_marl.tasks.base.workspace import CLEARANCE
from surgical_marl.tasks.base.world import World
from surgical_marl.tasks.camera_assist.eye import CLOSE, FARTHEST, FILL, NEAREST, Eye
from surgical_marl.tasks.camera_assist.task import SEARCH, ViewGoal
from tests.helpers.actions import random_actions

TASK, SCENE, CAMERA, TOOLS = "camera_assist", "trimanual_psm_ecm", "ecm_0", ("psm_0", "psm_1")
SCENES = (SCENE, "trimanual_psm_ecm_needle", "trimanual_psm_ecm_pegs")


@cache
def env(difficulty: str = "default", goals: str = "training") -> Env:
    return Env(TASK, SCENE, difficulty=difficulty, goals=goals)


@cache
def batched(num_envs: int = 64, engine: str = "fused", max_steps: int | None = None) -> BatchedEnv:
    options = {"engine": engine, "device": "cpu", "goals": "held_out"}
    return BatchedEnv(TASK, SCENE, num_envs=num_envs, max_steps=max_steps, **options)


def eye() -> Eye:
    return Eye(env().scene.mounts[CAMERA])


def pixels(q: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Where places [k, 3] are in the pictures of both eyes, [2, k, 3]: right and up, from -1 to 1, and their depth.

    By hand from MuJoCo's cameras, which look along -z.
    """
    scene = env().scene
    data, found = mujoco.MjData(scene.model), []
    data.qpos[:] = scene.full_qpos({CAMERA: q})
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_camlight(scene.model, data)
    for side in ("left", "right"):
        camera = scene.model.camera(f"{CAMERA}/{side}").id
        local = (places - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3)
        depth = -local[:, 2]
        edge = depth * np.tan(np.radians(scene.model.cam_fovy[camera] / 2))
        found.append(np.stack([local[:, 0] / edge, local[:, 1] / edge, depth], -1))
    return np.array(found)


def test_in_view_is_within_both_eyes_pictures() -> None:
    rng, arm = np.random.default_rng(0), env().scene.mounts[CAMERA].arm
    kinds = set()
    for _ in range(20):
        q = rng.uniform(arm.lower, arm.upper)
        axes, origin = eye().pose(q)
        places = origin + (rng.normal(0, 0.1, (200, 3)) + np.array([0.0, 0.0, 0.1])) @ axes.T
        found = pixels(q, places)
        depth = found[0, :, 2]
        inside = (np.abs(found[..., :2]) < 1).all((0, 2)) & (depth > NEAREST) & (depth < FARTHEST)
        np.testing.assert_array_equal(eye().sees((places - origin) @ axes), inside)
        kinds |= {*zip(inside, depth > 0, depth > NEAREST, strict=True)}
    assert len(kinds) == 4  # in view; beside; behind; too near


@pytest.mark.parametrize(("depth", "seen"), [(0.01, False), (0.03, True), (0.29, True), (0.31, False), (-0.1, False)])
def test_what_is_too_near_or_too_far_is_not_in_view(depth: float, seen: bool) -> None:
    assert bool(eye().sees(np.array([0.0, 0.0, depth]))) == seen


def test_a_good_view_is_centred_and_as_near_as_all_that_is_to_be_seen_allows() -> None:
    """Of postures that look at it: the middle is on the axis, and the outermost place at `FILL` of the picture."""
    rng = np.random.default_rng(1)
    middle = rng.normal(0, 0.01, (50, 1, 3)) + np.array([0.0, 0.0, 0.05])
    places = middle + rng.uniform(-0.05, 0.05, (50, 4, 3))
    known = eye()
    q = known.look_at(places, np.tile(known.mount.arm.home, (50, 1)), 40)
    axes, origin = known.pose(q)
    local = (places - origin[:, None]) @ axes
    fill = np.abs(local[..., :2]).max(-1) / local[..., 2] / np.tan(known.half)
    away = np.linalg.norm(local[..., :2], axis=-1)
    angles = np.arctan2(away, local[..., 2])[..., None] * local[..., :2] / away[..., None]
    np.testing.assert_allclose((angles.max(1) + angles.min(1)) / 2, 0, atol=0.01)
    nearest = local[..., 2].min(1)
    assert ((np.abs(fill.max(1) - FILL) < 0.01) | (np.abs(nearest - CLOSE) < 1e-3)).all()
    assert (fill.max(1) < FILL + 0.01).all() and (nearest > CLOSE - 1e-3).all()
    off, depth = known.aim(local)
    np.testing.assert_allclose(np.linalg.norm(off, axis=-1), 0, atol=0.02)
    np.testing.assert_allclose(depth, 0, atol=0.02)


def test_the_middle_is_off_by_its_angle_in_half_fields_of_view() -> None:
    angle = np.radians(45)
    off, depth = eye().aim(np.array([[0.0, 0.1 * np.sin(angle), 0.1 * np.cos(angle)]]))
    np.testing.assert_allclose(off, [0.0, 1.5], atol=1e-6)
    behind, _ = eye().aim(np.array([[0.01, 0.0, -0.1]]))
    assert behind[0] > 5 and depth < 0


def world(q: Any, targets: dict[str, Any], known: Env | None = None, handles: dict[str, Any] | None = None) -> World:
    """Tools at home, the endoscope at joint positions, targets in the world."""
    known = known or env()
    arms: dict[str, Any] = {}
    for agent, mount in known.scene.mounts.items():
        own = np.asarray(q if agent == CAMERA else mount.arm.home, np.float32)
        arms[agent] = SimpleNamespace(
            qpos=own, tool_tip=np.float32(mount.arm.forward_kinematics(own)[:3, 3]),
            min_distance=np.float32(0.1), collision=np.bool_(False), handles=handles or {},
        )  # fmt: skip
    local = [(targets.get(a, m.position) - m.position) @ m.rotation for a, m in known.scene.mounts.items()]
    work: Any = SimpleNamespace(targets=np.array(local, np.float32))
    zero: Any = np.float32(0.0)
    origin: Any = np.float32(Eye(known.scene.mounts[CAMERA]).pose(q)[1] + [0.003, 0.0, 0.004])
    return World(arms, ViewGoal(work, np.int32(0), zero, zero, origin))  # type: ignore[arg-type]


def tips() -> np.ndarray:
    """Tool tips at home in the world, [2, 3]."""
    mounts = [env().scene.mounts[agent] for agent in TOOLS]
    return np.array([m.rotation @ m.arm.forward_kinematics(m.arm.home)[:3, 3] + m.position for m in mounts])


def test_tools_see_what_is_in_view_and_nothing_else() -> None:
    """One tool is in view, the other one and its own target are not; against the hand-computed picture."""
    known = eye()
    first, second = tips()
    around = (first + np.array([[-0.035, 0.0, 0.0], [0.005, 0.0, 0.0]]))[None]
    q = known.look_at(around, known.mount.arm.home[None])[0]
    targets = {"psm_0": first + np.array([-0.02, 0.0, 0.01]), "psm_1": second + np.array([0.05, 0.0, 0.0])}
    inside = (np.abs(pixels(q, np.array([first, second, *targets.values()]))[..., :2]) < 1).all((0, 2))
    assert inside.tolist() == [True, False, True, False]
    seen = world(q, targets)
    task: Any = env().task
    read = lambda agent, name: np.asarray(task.terms(agent)[name].read(seen))  # noqa: E731
    axes, origin = known.pose(q)
    there = [np.append((place - origin) @ axes, 1.0) for place in (first, targets["psm_0"])]
    np.testing.assert_allclose(read("psm_0", "tip_seen"), there[0], atol=1e-6)
    np.testing.assert_allclose(read("psm_0", "target_seen"), there[1], atol=1e-6)
    np.testing.assert_allclose(read("psm_1", "other_tips_seen"), there[0], atol=1e-6)
    mount = env().scene.mounts["psm_0"]
    np.testing.assert_allclose(read("psm_0", "to_target"), (targets["psm_0"] - first) @ mount.rotation, atol=1e-6)
    np.testing.assert_allclose(
        read("psm_0", "endoscope_axes").reshape(2, 3).T, (mount.rotation.T @ axes)[:, :2], atol=1e-6
    )
    for agent, names in {
        "psm_0": ("other_tips_seen",), "psm_1": ("tip_seen", "target_seen", "target", "to_target")
    }.items():  # fmt: skip
        for name in names:
            assert not read(agent, name).any(), (agent, name)
    shown = read(CAMERA, "work_in_view").reshape(2, 4), read(CAMERA, "tips_in_view").reshape(2, 4)
    np.testing.assert_array_equal([part[:, 3] for part in shown], [[1, 0], [1, 0]])
    np.testing.assert_allclose(shown[0][1, :3], (targets["psm_1"] - origin) @ axes, atol=1e-6)


def test_a_way_is_hidden_if_its_own_tool_is_out_of_view() -> None:
    known = eye()
    first, _ = tips()
    q = known.look_at((first + np.array([[-0.10, 0.0, 0.0], [-0.08, 0.0, 0.0]]))[None], known.mount.arm.home[None])[0]
    seen = world(q, {"psm_0": first + np.array([-0.09, 0.0, 0.0])})
    terms: Any = env().task.terms("psm_0")
    value = {name: np.asarray(terms[name].read(seen)) for name in ("tip_seen", "target_seen", "to_target")}
    assert value["target_seen"][3] == 1 and value["tip_seen"][3] == 0 and not value["to_target"].any()


@cache
def over_a_needle() -> Env:
    return Env(TASK, SCENES[1])


@pytest.mark.parametrize(("looks_at", "shown"), [("needle", True), ("goal", False)])
def test_an_object_is_hidden_out_of_view_and_so_is_its_goal(looks_at: str, shown: bool) -> None:
    """Needle and goal are 0.3 m apart, so a near view shows one of them; the camera knows of both."""
    scene, task = over_a_needle().scene, cast("Any", over_a_needle().task)
    known, work = Eye(scene.mounts[CAMERA]), task.work
    start = np.asarray(work.tables["starts"][3], float)
    goal = np.asarray(work.tables["points"][3], float)
    pose = frames(start[None, :3], start[None, 3:])[0]
    there = pose[:3, 3] if shown else goal
    around = there + np.array([[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]])
    q = known.look_at(around[None], known.mount.arm.home[None], 40)[0]
    work_goal: Any = SimpleNamespace(row=np.int32(3), best=SimpleNamespace(lift=np.float32(0.0)))
    handled = Handled(np.float32(1.0), np.bool_(True), np.float32(0.0))  # type: ignore[arg-type]
    seen = world(q, {}, over_a_needle(), {"needle": handled})
    body: Any = ObjectView(np.float32(pose[:3, 3]), np.float32(pose[:3, :3]), np.ones(6, np.float32))  # type: ignore[arg-type]
    seen = seen._replace(goal=seen.goal._replace(work=work_goal), objects={"needle": body})
    terms: Any = task.terms("psm_1")
    read = lambda name: np.asarray(terms[name].read(seen))  # noqa: E731
    for name in ("needle_position", "needle_rotation", "needle_velocity", "needle_seen", "others_hold"):
        assert read(name).any() == shown, name
    for name in ("target", "target_rotation", "target_seen"):
        assert read(name).any() != shown, name
    assert not read("to_target").any() and not read("to_object").any() and read("needle_grip").any()
    axes, origin = known.pose(q)
    both = np.asarray(task.terms(CAMERA)["work_in_view"].read(seen)).reshape(2, 4)
    middle = pose[:3, 3] + pose[:3, :3] @ task._middle
    np.testing.assert_allclose(both[:, :3], (np.array([middle, goal]) - origin) @ axes, atol=1e-5)
    assert both[:, 3].tolist() == [shown, not shown]


def test_the_camera_knows_which_tools_hold_the_object() -> None:
    """It looks at the goal once the second tool holds: that does not go there unseen, so it can't be waited for."""
    task: Any = over_a_needle().task
    held = Handled(np.float32(1.0), np.bool_(True), np.float32(0.0))  # type: ignore[arg-type]
    seen = world(over_a_needle().scene.mounts[CAMERA].arm.home, {}, over_a_needle(), {"needle": held})
    free = {"needle": held._replace(holding=np.bool_(False))}  # type: ignore[arg-type]
    assert "tools_hold" in task.observes(CAMERA) and "tools_hold" not in env().task.observes(CAMERA)
    term = task.terms(CAMERA)["tools_hold"]
    assert np.asarray(term.read(seen)).tolist() == [1, 1]
    vars(seen.arms["psm_0"])["handles"] = free
    assert np.asarray(term.read(seen)).tolist() == [0, 1]


def test_rewards_are_the_teams_and_say_what_is_in_view() -> None:
    known, task = eye(), env().task
    first, second = tips()
    targets = {"psm_0": first + np.array([0.0, 0.0, 0.02]), "psm_1": second + np.array([0.0, 0.0, -0.01])}
    q = known.look_at(np.array([[first, second, *targets.values()]]), known.mount.arm.home[None])[0]
    seen = world(q, targets)
    terms = task.reward_terms(seen)
    assert all(
        terms[agent][name] == terms[CAMERA][name] for agent in TOOLS for name in terms[CAMERA] if name != "clearance"
    )
    value = {name: float(term) for name, term in terms[CAMERA].items()}
    assert value["in_view"] == 1 and value["centring"] < 0.02 and value["depth"] < 0.05
    assert value["distance"] == pytest.approx(0.015, abs=1e-6) and value["travel"] == pytest.approx(0.005, abs=1e-6)
    assert float(task.metrics(seen)[CAMERA]["tip_error"]) == pytest.approx(0.02, abs=1e-6)
    away = world(q + np.array([1.0, 0.0, 0.0, 0.0]), targets)
    value = {name: float(term) for name, term in task.reward_terms(away)[CAMERA].items()}
    assert value["in_view"] == 0 and value["centring"] > 1.5
    for view, found, searching in ((seen, 0.0, 0), (away, 0.0, 1), (away, 1.0, 0)):
        own = view._replace(goal=view.goal._replace(found=np.float32(found)))
        assert all(float(task.metrics(own)[agent]["searching"]) == searching for agent in env().agents)
        assert bool(task.reached(own)[CAMERA]["found"]) == (not searching)
    late = away._replace(goal=away.goal._replace(time=np.float32(SEARCH)))
    assert float(task.metrics(late)[CAMERA]["searching"]) == 0


def test_the_camera_succeeds_only_with_the_tools_and_a_view_of_them() -> None:
    known, task = eye(), env().task
    places = dict(zip(TOOLS, tips(), strict=True))
    q = known.look_at(tips()[None], known.mount.arm.home[None])[0]
    succeeds = lambda seen: [bool(task.success(seen)[agent]) for agent in (*TOOLS, CAMERA)]  # noqa: E731
    assert succeeds(world(q, places)) == [True, True, True]
    assert succeeds(world(q + np.array([1.0, 0.0, 0.0, 0.0]), places)) == [True, True, False]
    assert succeeds(world(q, {**places, "psm_1": places["psm_1"] + 0.005})) == [True, False, False]


@pytest.mark.parametrize("difficulty", ["easy", "default", pytest.param("hard", marks=pytest.mark.slow)])
def test_endoscopes_start_anywhere_clear_of_tools_and_mostly_without_a_view(difficulty: str) -> None:
    known, scene = env(difficulty), env(difficulty).scene
    postures = np.asarray(known.task.tables["postures"], float)
    q = {agent: postures[:, scene.qpos_index(agent)] for agent in scene.agents}
    assert scene.clearance(q).min() > CLEARANCE
    for agent in TOOLS:
        assert (q[agent] == scene.mounts[agent].arm.home).all()
    axes, origin = eye().pose(q[CAMERA])
    seen = eye().sees((tips() - origin[:, None]) @ axes).all(-1).mean()
    low, high = {"easy": (1.0, 1.0), "default": (0.05, 0.5), "hard": (0.0, 0.2)}[difficulty]
    assert low <= seen <= high
    assert len(np.unique(q[CAMERA], axis=0)) == len(q[CAMERA])


def test_held_out_goals_are_others() -> None:
    """Targets and starts of the endoscope both; targets can be seen at once."""
    ours, theirs = (env(goals=goals).task for goals in ("training", "held_out"))
    for name in ("postures", "work_targets"):
        one, other = (set(map(bytes, np.asarray(task.tables[name]).reshape(2048, -1))) for task in (ours, theirs))
        assert not one & other
    goals = SimpleNamespace(**{"work.targets": ours.tables["work_targets"], "row": np.arange(2048)})
    marks = ours.marks(goals)
    assert marks.shape == (2048, 2, 3)
    known = eye()
    q = known.look_at(marks, np.tile(known.mount.arm.home, (2048, 1)))
    axes, origin = known.pose(q)
    assert known.sees((marks - origin[:, None]) @ axes).all(-1).mean() > 0.99
    assert [content.shape for content in ours.goal_content(goals)] == [(2048, 3, 3), (2048, 4)]


def test_what_is_hidden_is_within_its_bounds() -> None:
    """Zeros, which stand for what is out of view, must not be clipped to something else."""
    for agent in TOOLS:
        low, high = env().observed[agent].bounds()
        own = env().observed[agent].slices
        for name in ("target", "to_target", "tip_seen", "other_tips_seen", "target_seen"):
            assert (low[own[name]] <= 0).all() and (high[own[name]] >= 0).all()


@pytest.mark.slow
def test_the_oracle_shows_all_and_does_the_work() -> None:
    many = batched(256)
    found = evaluate(many, load_policy("oracle", many), 256, 0)
    assert found["success_rate"] >= 0.99 and found["collision_rate"] <= 0.01
    assert found["in_view_rate"] >= 0.999 and found["object_in_view_rate"] >= 0.99
    assert found["centre_error"] < 0.1 and 10 < found["camera_travel_mm"] < 150
    assert found["stages"] == {"found": pytest.approx(1.0, abs=0.01), "at_goal": pytest.approx(1.0, abs=0.01)}
    assert found["agents"]["psm_0"]["centre_error"] is None and found["agents"][CAMERA]["centre_error"] is not None


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["frozen", "random"])
def test_a_bad_camera_hurts(kind: str) -> None:
    many, rng = batched(256), np.random.default_rng(0)
    tools, rest = oracle(many, list(TOOLS)), zero_policy(many)

    def policy(seen: Any) -> dict[str, Any]:
        bad = rest(seen) if kind == "frozen" else random_actions(many, rng)
        return {**tools(seen), CAMERA: bad[CAMERA]}

    found = evaluate(many, policy, 256, 0)
    assert found["in_view_rate"] < 0.7 and found["success_rate"] < 0.4
    assert (found["camera_travel_mm"] < 1) == (kind == "frozen")


@pytest.mark.slow
def test_the_oracle_moves_the_camera_alone() -> None:
    many = batched(256)
    rest, one = zero_policy(many), oracle(many, [CAMERA])
    found = evaluate(many, lambda seen: {**rest(seen), **one(seen)}, 256, 0)
    assert found["in_view_rate"] >= 0.99 and found["success_rate"] < 0.05 and found["stages"]["found"] >= 0.99


@pytest.mark.slow
def test_an_episode_is_that_of_the_mjx_engine() -> None:
    """Step by step to 1e-4 over a whole short episode and into the next; flags as the fused engine has them."""
    one, other = (batched(8, engine, 12) for engine in ("fused", "mjx"))
    rng = np.random.default_rng(0)
    for many in (one, other):
        many.reset(3)
    for _ in range(14):
        actions = random_actions(one, rng)
        found, expected = one.step(actions), other.step(actions)
        for agent in one.agents:
            np.testing.assert_allclose(found.observations[agent], expected.observations[agent], atol=1e-4)
            np.testing.assert_allclose(found.rewards[agent], expected.rewards[agent], atol=1e-4)
            for name in ("in_view", "searching", "success"):
                np.testing.assert_array_equal(found.infos[agent][name], expected.infos[agent][name])
        np.testing.assert_array_equal(found.truncated, expected.truncated)


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES[1:])
def test_the_oracle_shows_work_with_objects(scene: str) -> None:
    many = BatchedEnv(TASK, scene, num_envs=200, engine="fused", device="cpu", goals="held_out")
    found = evaluate(many, load_policy("oracle", many), 200, 0)
    assert found["success_rate"] >= 0.95 and found["in_view_rate"] >= 0.99 and found["object_in_view_rate"] >= 0.99


@pytest.mark.parametrize(
    ("scene", "options", "words"),
    [
        ("bimanual_psm", {}, "has no endoscope: no arm of psm_0, psm_1 has a camera"),
        ("ecm", {}, "camera_assist needs a scene with one endoscope and two other arms; 'ecm' has ecm_0"),
        (SCENE, {"difficulty": "crossing"}, "unknown difficulty 'crossing' .*easy, default, hard"),
        ("trimanual_psm_ecm_pegs", {"difficulty": "hard"}, "must be easy or default where the work is peg_transfer"),
        (SCENE, {"reward": {"in_vew": 1}}, "unknown reward term 'in_vew', did you mean 'in_view'"),
        (SCENE, {"start": "random"}, "unknown start of task 'camera_assist' 'random'"),
    ],
)
def test_bad_options_are_one_sentence(scene: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        sm.parallel_env(TASK, scene=scene, **options)
    assert "\n" not in str(caught.value)


def test_a_wrong_difficulty_is_refused_before_anything_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgical_marl.tasks.camera_assist.task.work_in", lambda scene: pytest.fail("the work begins"))
    with pytest.raises(ValueError, match="unknown difficulty 'crossing'"):
        Env(TASK, SCENE, difficulty="crossing")
