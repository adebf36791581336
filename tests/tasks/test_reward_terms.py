"""Rewards, success and observations of the base classes of tasks, in random worlds, against plain numpy."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surgical_marl.envs import infos as safety
from surgical_marl.physics.outputs import ObjectView
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.robots.arm import load_arm
from surgical_marl.scenes.load import load_scene
from surgical_marl.tasks.base import object_task
from surgical_marl.tasks.base.object_task import ObjectTask
from surgical_marl.tasks.base.options import Options
from surgical_marl.tasks.base.task import Goal, Level, Start, Task, TipTask
from surgical_marl.tasks.base.terms import arm_terms, picture_terms, read_vector, slices
from surgical_marl.tasks.base.world import World
from surgical_marl.tasks.peg_transfer.blocks import grasp_terms
from tests.helpers.random_worlds import NEEDLE, ONE, THREE, TWO, WORLDS, Bring, bars_of, bring, drawn, tool


@pytest.mark.parametrize("scene", [ONE, TWO])
def test_what_is_rewarded_of_an_object_is_what_the_documentation_says(scene: str) -> None:
    task, seen = bring(scene), set()
    for seed in WORLDS:
        world, _, row = drawn(task, seed)
        body, best, sites = world.objects[NEEDLE], world.goal.best, task.scene.objects[NEEDLE].object.sites
        at = lambda site: body.position + body.size * body.rotation @ site  # noqa: B023, E731
        start = task.tables["starts"][row]
        begin = Rotation.from_quat(start[3:], scalar_first=True).as_matrix()
        floor = min((start[:3] + begin @ site)[2] for site, _ in sites.values())
        lowest = min(at(site)[2] for site, _ in sites.values()) - floor
        error = np.linalg.norm(
            at(sites["tip"][0]) - (task.goals[row, :3, 3] + task.goals[row, :3, :3] @ sites["tip"][0])
        )
        angle = (Rotation.from_matrix(body.rotation) * Rotation.from_matrix(task.goals[row, :3, :3]).inv()).magnitude()
        agents = list(world.arms)
        handled = [world.arms[agent].handles[NEEDLE] for agent in agents]
        others = any(h.force > 0 for h in handled[:-1])
        presents = bool(handled[-1].holding) and not others
        dropped = (best.lift >= 1 and not any(h.force > 0 for h in handled)) or lowest < -0.02
        ways = {agent: np.linalg.norm(bars_of(task.scene, body) - tool(task.scene, agent, world.arms[agent]), axis=1)
                for agent in agents}  # fmt: skip
        lift = min(max(lowest / 0.01, 0), 1)
        held = any(h.holding for h in handled)
        told = [bool(v) for v in task.success(world).values()]
        good = presents and error < 0.002 and angle < np.radians(10)
        assert told == [good] * len(agents)
        assert [bool(v) for v in bring(scene, "easy").success(world).values()] == [presents and error < 0.002] * len(
            told
        )
        seen |= {
            ("good", good),
            ("dropped", bool(dropped)),
            ("presents", presents),
            ("near", error < 0.002 and not good),
        }
        progress = lambda before, now: 0.0 if before < 0 else max(before - now, 0) if presents else 0.0  # noqa: B023, E731
        first = lambda before, now: before - now if before < 0 else progress(before, now)  # noqa: B023, E731
        expected = {
            "reach": max(best.reach - ways[agents[0]].min(), 0),
            "grasp": max(float(handled[0].holding) - best.grasp, 0),
            "lift": max(lift - best.lift, 0) if held else 0,
            "carry": first(best.carry, error),
            "turn": first(best.turn, angle),
            "precision": np.exp(-error / 0.005) if presents else 0,
            "success": float(good),
            "drop": float(dropped),
        }
        plain, weighted = task.reward_terms(world), task.rewards(world)
        for agent in agents:
            own = {
                "clearance": np.clip(1 - world.arms[agent].min_distance / 0.025, 0, 1),
                "collision": float(world.arms[agent].collision),
                "action_change": np.sum(world.changes[agent] ** 2),
            }
            found = {name: float(value) for name, value in plain[agent].items()}
            assert found == pytest.approx({**expected, **own}, abs=2e-5, rel=1e-4), seed
            shares = {"reach": 20, "grasp": 2, "lift": 2, "carry": 40, "turn": 2, "precision": 0.1, "success": 0.2,
                      "drop": -2, "clearance": -1, "collision": -2, "action_change": 0}  # fmt: skip
            assert {n: float(v) for n, v in weighted[agent].items()} == pytest.approx(
                {name: shares[name] * value for name, value in found.items()}, abs=1e-6, rel=1e-5
            )
            measures = {name: float(value) for name, value in task.metrics(world)[agent].items()}
            assert measures == pytest.approx(
                {"goal_error": error, "drop": float(dropped), "goal_angle": angle}, abs=2e-5
            )
            assert int(task.now(world).part[agent]) == ways[agent].argmin()
            assert set(bring(scene, "easy").metrics(world)[agent]) == {"goal_error", "drop"}
        assert bool(task.terminated(world)) == dropped
        assert float(bring(scene, "easy").reward_terms(world)[agents[0]]["turn"]) == 0
        kept = task.remember(world).best
        assert float(kept.reach) == pytest.approx(min(best.reach, ways[agents[0]].min()), abs=1e-5)
        assert float(kept.carry) == pytest.approx(error if best.carry < 0 else best.carry - expected["carry"], abs=1e-5)
    assert seen >= {("good", True), ("dropped", True), ("dropped", False), ("presents", True), ("presents", False)}


@pytest.mark.parametrize("scene", [ONE, TWO])
def test_what_an_arm_observes_of_an_object_leads_to_it(scene: str) -> None:
    """Terms are in the arm's base frame: carried to the world, they end where object, bar, goal and point are."""
    task = bring(scene)
    for seed in WORLDS[:12]:
        world, _, row = drawn(task, seed)
        body, site = world.objects[NEEDLE], task.scene.objects[NEEDLE].object.sites["tip"][0]
        for agent, view in world.arms.items():
            mount, terms = task.scene.mounts[agent], task.terms(agent)
            read = {name: np.asarray(term.read(world), float) for name, term in terms.items() if hasattr(term, "read")}
            away = lambda name: mount.rotation @ read[name]  # noqa: B023, E731
            place = lambda name: mount.position + away(name)  # noqa: B023, E731
            tip, point = tool(task.scene, agent, view), body.position + body.size * body.rotation @ site
            bars = bars_of(task.scene, body)
            nearest = bars[np.linalg.norm(bars - tip, axis=1).argmin()]
            np.testing.assert_allclose(tip + away("to_object"), nearest, atol=1e-6)
            np.testing.assert_allclose(tip + mount.rotation @ np.asarray(task.way_to_bars(world, agent, np.array([1]))),
                                       bars[1], atol=1e-6)  # fmt: skip
            np.testing.assert_allclose(place("target"), task.tables["points"][row], atol=1e-6)
            np.testing.assert_allclose(point + away("to_target"), task.tables["points"][row], atol=1e-6)
            for name, turn in (("target_rotation", task.goals[row, :3, :3]), (f"{NEEDLE}_rotation", body.rotation)):
                np.testing.assert_allclose(mount.rotation @ read[name].reshape(2, 3).T, turn[:, :2], atol=1e-6)
            np.testing.assert_allclose(place(f"{NEEDLE}_position"), body.position, atol=1e-6)
            speeds = read[f"{NEEDLE}_velocity"].reshape(2, 3) @ mount.rotation.T
            np.testing.assert_allclose(speeds.ravel(), body.velocity, atol=1e-5)
            handled = view.handles[NEEDLE]
            np.testing.assert_allclose(read[f"{NEEDLE}_grip"], [float(part) for part in handled], atol=1e-6)
            assert read["best_lift"].tolist() == [world.goal.best.lift]
            if scene == TWO:
                (other,) = (view for name, view in world.arms.items() if name != agent)
                assert read["others_hold"].tolist() == [float(other.handles[NEEDLE].holding)]
            else:
                assert "others_hold" not in read
            for name, part in (("qpos", view.qpos), ("qvel", view.qvel), ("tool_tip", view.tool_tip),
                               ("command", view.command), ("contact_force", [view.contact_force])):  # fmt: skip
                np.testing.assert_allclose(read[name], part, rtol=1e-6)
            for name, term in terms.items():
                assert not hasattr(term, "low") or (term.low.shape == term.high.shape == read[name].shape), name


def test_bounds_and_choices_of_terms() -> None:
    task, alone = bring(TWO), bring(ONE)
    terms = task.terms("psm_0")
    arm = task.scene.mounts["psm_0"].arm
    bounds = {
        f"{NEEDLE}_position": [1.0] * 3, f"{NEEDLE}_rotation": [1.0] * 6, f"{NEEDLE}_velocity": [5.0] * 3 + [500.0] * 3,
        "to_object": [0.5] * 3, "to_target": [0.5] * 3, "target_rotation": [1.0] * 6,
        "qvel": [2 * joint.velocity for joint in arm.actuated],
    }  # fmt: skip
    for name, most in bounds.items():
        assert terms[name].high.tolist() == most and terms[name].low.tolist() == [-value for value in most], name
    for name, most in {"contact_force": [100.0], f"{NEEDLE}_grip": [100.0, 1.0, 0.1], "best_lift": [1.0],
                       "others_hold": [1.0]}.items():  # fmt: skip
        assert terms[name].high.tolist() == most and terms[name].low.tolist() == [0.0] * len(most), name
    about = {name: term.about for name, term in terms.items() if hasattr(term, "read")}
    assert {name for name, what in about.items() if what == "others"} == {
        "to_nearest_tip",
        "min_distance",
        "others_hold",
    }
    assert {name for name, what in about.items() if what == "team_goal"} == {"target", "to_target", "target_rotation"}
    own = ("qpos", "qvel", "tool_tip", "command", "contact_force")
    object_ = tuple(f"{NEEDLE}_{part}" for part in ("position", "rotation", "velocity", "grip"))
    goal = ("to_object", "target", "to_target", "target_rotation", "best_lift")
    assert alone.observes("psm_0") == own + object_ + goal
    assert task.observes("psm_1") == own + object_ + goal + ("others_hold", "to_nearest_tip", "min_distance")
    assert "target_rotation" not in bring(ONE, "easy").observes("psm_0")
    assert (task.picker, task.presenter, task.informed, alone.presenter) == ("psm_0", "psm_1", "psm_0", "psm_0")
    every = tuple(task.scene.objects[NEEDLE].object.sites)
    assert object_task.find_object(task.scene, "needle_pick", every) == NEEDLE
    with pytest.raises(ValueError, match="the sites tip and knob; 'psm_needle' has none"):
        object_task.find_object(alone.scene, "needle_pick", ("tip", "knob"))
    goals = SimpleNamespace(row=np.array([2, 0]))
    np.testing.assert_array_equal(task.marks(goals)[:, 0], task.tables["points"][[2, 0]])
    assert [len(part) for part in task.goal_content(goals)] == [2, 2, 2]
    assert len(bring(ONE, "easy").goal_content(goals)) == 2
    nothing = task.nothing
    assert np.isinf(nothing.reach) and [float(x) for x in nothing[1:]] == [0, 0, -1, -1]
    assert task.constants == (True, "psm_0", "psm_1")
    assert (task.tolerance, task.angle, object_task.NEAR) == (0.002, pytest.approx(np.pi / 18), 0.01)
    hold = lambda value: float(object_task.known(np.float32(value)))  # noqa: E731
    assert [hold(9.9), hold(10.1), hold(np.nan)] == pytest.approx([9.9, 10.0, 10.0])
    with pytest.raises(ValueError, match="needs a scene with 2 arms whose jaws have pads; 'psm_needle' has 1"):
        type(
            "Both",
            (Bring,),
            {"__init__": lambda self, s, o: (setattr(self, "hands", 2), ObjectTask.__init__(self, s, o))[0]},
        )(load_scene(ONE), Options("needle_pick", ONE))
    torques = arm_terms(load_scene("psm", control="torque"), "psm_0")["command"]
    furthest = [max(joint.velocity, joint.effort, joint.upper) for joint in arm.actuated]
    assert torques.high.tolist() == furthest and torques.low.tolist() == [-value for value in furthest]
    np.testing.assert_array_equal(terms["command"].high, arm.joint_box.high)


def test_a_vector_of_terms_is_clipped_and_cut_where_the_slices_say() -> None:
    task, (world, _, _) = bring(TWO), drawn(bring(TWO), 3)
    terms, names = task.terms("psm_1"), ("qpos", "contact_force", "to_object", "min_distance")
    far = {**world.arms, "psm_1": world.arms["psm_1"]._replace(contact_force=np.float32(1e6), qpos=np.full(7, -1e3))}
    vector, cuts = np.asarray(read_vector(terms, names, world._replace(arms=far))), slices(terms, names)
    assert [(part.start, part.stop) for part in cuts.values()] == [(0, 7), (7, 8), (8, 11), (11, 12)]
    np.testing.assert_array_equal(vector[:7], terms["qpos"].low.astype(np.float32))
    assert vector[7] == 100 and vector.dtype == np.float32
    np.testing.assert_allclose(vector[8:11], terms["to_object"].read(world), rtol=1e-6)
    assert np.asarray(read_vector(terms, (), world)).shape == (0,)


def test_pictures_are_those_of_the_own_endoscope_or_the_first_one() -> None:
    scene = load_scene(THREE)
    for agent in scene.agents:
        found = picture_terms(scene, agent)
        assert {name: (p.camera, p.eye, p.channel) for name, p in found.items()} == {
            f"{prefix}{word}{end}": ("ecm_0", eye, channel)
            for prefix in ("", "ecm_0/")
            for word, channel in (("image", "rgb"), ("depth", "depth"))
            for end, eye in (("", "left"), ("_right", "right"))
        }
        assert {p.about for p in found.values()} == {"object"}
    assert next(iter(found.values()))._replace(table="goals").about == "goal"
    assert picture_terms(load_scene("psm"), "psm_0") == {}


class Reach(TipTask):
    """Tips at targets."""

    levels = {"default": Level(0.0, 0.0)}  # noqa: RUF012

    def start(self, key: Any) -> Start:
        return Start(Goal(key))


def test_tips_are_rewarded_by_distance_and_succeed_within_two_millimetres() -> None:
    scene = load_scene(TWO)
    task = Reach(scene, Options("reach", TWO, reward={"precision": 3.0}))
    assert task.weights == {
        "action_change": 0.0,
        "distance": -10.0,
        "precision": 3.0,
        "clearance": -1.0,
        "collision": -2.0,
    }
    assert task.tolerance == 0.002
    seen = set()
    for seed in WORLDS:
        world, rng, _ = drawn(bring(TWO), seed)
        targets = np.stack([view.tool_tip + rng.normal(0, 0.0013, 3) for view in world.arms.values()])
        world = world._replace(goal=Goal(targets))  # type: ignore[arg-type]
        for i, (agent, view) in enumerate(world.arms.items()):
            error = np.sqrt(sum((targets[i] - view.tool_tip) ** 2))
            found = {name: float(value) for name, value in task.reward_terms(world)[agent].items()}
            assert found == pytest.approx({
                "distance": error, "precision": np.exp(-error / 0.005),
                "clearance": np.clip(1 - view.min_distance / 0.025, 0, 1), "collision": float(view.collision),
                "action_change": np.sum(world.changes[agent] ** 2),
            }, rel=1e-4)  # fmt: skip
            still = task.reward_terms(world._replace(changes={}))[agent]
            assert float(still["action_change"]) == 0
            assert float(task.rewards(world)[agent]["distance"]) == pytest.approx(-10 * error, rel=1e-4)
            assert bool(task.success(world)[agent]) == (error < 0.002)
            assert float(task.metrics(world)[agent]["tip_error"]) == pytest.approx(error, rel=1e-4)
            terms = task.terms(agent)
            np.testing.assert_array_equal(terms["target"].read(world), targets[i])
            np.testing.assert_allclose(terms["to_target"].read(world), targets[i] - view.tool_tip)
            reach = scene.mounts[agent].arm.reach
            np.testing.assert_allclose(terms["to_target"].high, reach.high - reach.low)
            np.testing.assert_allclose(terms["to_target"].low, reach.low - reach.high)
            seen.add(error < 0.002)
        marks = task.marks(Goal(targets[None]))  # type: ignore[arg-type]
        np.testing.assert_allclose(
            marks[0], [m.position + m.rotation @ t for m, t in zip(scene.mounts.values(), targets, strict=True)]
        )
    assert seen == {True, False}
    assert task.observes("psm_0") == (
        "qpos",
        "qvel",
        "tool_tip",
        "command",
        "target",
        "to_target",
        "to_nearest_tip",
        "min_distance",
    )
    [content] = task.goal_content(SimpleNamespace(targets=targets))
    np.testing.assert_array_equal(content, targets)


def test_what_a_task_says_where_it_says_nothing() -> None:
    task = Task(load_scene("psm"), Options("reach", "psm", goals="held_out"))
    world = World({"psm_0": SimpleNamespace()}, Goal(np.ones(3)))  # type: ignore[dict-item,arg-type]
    assert not task.terminated(world) and task.advance(world.goal, 0.1) is world.goal is task.remember(world)
    assert task.reached(world) == task.metrics(world) == {"psm_0": {}} and task.sense({}) == {} and task.script() == ()
    assert (
        task.privileged(world.goal).shape == task.privileged_bounds[0].shape == task.privileged_bounds[1].shape == (0,)
    )
    assert task.marks(world.goal).shape == (1, 0, 3) and task.constants == () and task.informed == "psm_0"
    assert (task.seed, Task(task.scene, Options("reach", "psm")).seed) == (1, 0)
    assert (Task.max_steps, ObjectTask.hands, Level(0.1, 0.2).speed) == (100, 1, 0.0)
    assert TASKS.load("reach").summary().startswith("Target reaching: ") and Reach.summary() == "Tips at targets."
    other = task.bound({"action_change": 5.0}, {"a": np.ones(1)})
    assert other.weights == {"action_change": 5.0} and task.weights == {"action_change": 0.0} and not task.tables
    for wrong, words in (({"difficulty": "odd"}, "difficulty"), ({"start": "random"}, "start of task"),
                         ({"reward": {"odd": 1.0}}, "reward term")):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            Task(task.scene, Options("reach", "psm", **wrong))  # type: ignore[arg-type]


def test_a_length_has_a_derivative_everywhere() -> None:
    import jax

    task = Reach(load_scene(TWO), Options("reach", TWO))
    world, _, _ = drawn(bring(TWO), 0)
    tips = np.stack([np.float32(view.tool_tip) for view in world.arms.values()])
    far = lambda targets: task.tip_errors(world._replace(goal=Goal(targets)))["psm_1"]  # noqa: E731
    assert np.abs(jax.grad(far)(tips)).max() < 1e-3  # at the target
    slope = np.asarray(jax.grad(far)(tips + np.float32([0.003, 0.004, 0.0])))
    np.testing.assert_allclose(slope, [[0, 0, 0], [0.6, 0.8, 0]], atol=1e-3)


def test_the_bar_at_hand_is_the_one_along_the_tool() -> None:
    rng = np.random.default_rng(0)
    mount = load_scene(TWO).mounts["psm_1"]
    sites = {f"grasp_{k}": (rng.normal(0, 0.01, 3), Rotation.random(rng=rng).as_matrix()) for k in range(3)}
    item: Any = SimpleNamespace(sites={"tip": (np.ones(3), np.eye(3)), **sites})
    terms = grasp_terms(mount, "psm_1", item, lambda world: world.objects["thing"])
    signs = set()
    for _ in range(20):
        body = ObjectView(rng.normal(0, 0.1, 3), Rotation.random(rng=rng).as_matrix(), np.zeros(6), rng.uniform(0.5, 2))  # type: ignore[arg-type]
        view: Any = SimpleNamespace(tool_tip=rng.normal(0, 0.1, 3), tool_axes=Rotation.random(rng=rng).as_matrix())
        world = World({"psm_1": view}, None, objects={"thing": body})
        tool_x = mount.rotation @ view.tool_axes[:, 0]
        shares = [tool_x @ body.rotation @ axes[:, 0] for _, axes in sites.values()]
        best = int(np.argmax(np.abs(shares)))
        middle, axes = list(sites.values())[best]
        signs.add(np.sign(shares[best]))
        axis = np.sign(shares[best]) * body.rotation @ axes[:, 0]
        np.testing.assert_allclose(mount.rotation @ terms["grasp_axis"].read(world), axis, atol=1e-6)
        tip = mount.position + mount.rotation @ view.tool_tip
        end = tip + mount.rotation @ np.asarray(terms["to_grasp"].read(world))
        np.testing.assert_allclose(end, body.position + body.size * body.rotation @ middle, atol=1e-6)
    assert signs == {-1, 1}
    assert terms["to_grasp"].high.tolist() == [0.5] * 3 and terms["grasp_axis"].low.tolist() == [-1.0] * 3
    assert terms["to_grasp"].low.tolist() == [-0.5] * 3 and terms["grasp_axis"].high.tolist() == [1.0] * 3


@pytest.mark.parametrize("joint", range(7))
def test_a_cost_counts_from_its_limit_on(joint: int) -> None:
    arm = load_arm("psm")

    def broken(share: float = 0.5, speed: float = 0.0, distance: float = 1.0, force: float = 0.0) -> set[str]:
        q = arm.lower + 0.5 * (arm.upper - arm.lower)
        q[joint] = arm.lower[joint] + share * (arm.upper[joint] - arm.lower[joint])
        view: Any = SimpleNamespace(qpos=q, min_distance=distance, bump_force=force)
        return {name for name, cost in safety.costs(arm, view, np.float32(speed)).items() if cost}  # type: ignore[arg-type]

    is_jaw = bool(arm.moves_jaw[joint])
    for share, near in ((0.009, True), (0.011, False), (0.989, False), (0.991, True)):
        assert broken(share) == ({"limit"} if near and not is_jaw else set())
    assert (
        broken(speed=0.201) == {"speed"} and broken(distance=0.0049) == {"distance"} and broken(force=1.01) == {"force"}
    )
    assert broken(speed=0.199, distance=0.0051, force=0.99) == set()
    edge = 0.01 * (arm.upper - arm.lower)[joint]
    q = (arm.lower + arm.upper) / 2
    for at in (arm.lower[joint] + edge, arm.upper[joint] - edge):  # at the limit of the limit is not beyond it
        q = q.astype(np.float32)
        q[joint] = np.float32(at)
        view: Any = SimpleNamespace(qpos=q, min_distance=1.0, bump_force=0.0)
        assert not safety.costs(arm, view, np.float32(0))["limit"]  # type: ignore[arg-type]
    assert broken(speed=safety.SPEED, distance=safety.NEAR, force=safety.FORCE) == set()
