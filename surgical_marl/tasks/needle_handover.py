"""Needle handover: one arm picks a needle up, hands it to another one in mid-air, and that brings its point to a goal.

The needle lies where only the first arm reaches, and the goal is where only the second one does.

Agents        the arms of the scene. The first one whose jaw has pads picks, the second such one presents.
Observation   as in `needle_pick`, and the way to the nearest part of the needle's middle half, whether the other arm
              holds the needle, the way to the other tool tip, and the least distance between the arms.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        the same for all arms, but for `clearance` and `collision`; weights in brackets. Progress over the best
              of the episode so far: `reach` (20 / m), `grasp` (2) and `lift` (2) of the first arm; `meet`, from the
              second tool to the middle half of the held needle (10 / m); `receive`, when both hold it (4), and
              `passed`, when the second holds it alone (4), there; then `carry` (10 / m), and `turn` (2 / rad, where the
              goal has an orientation).
              `precision` (0.1), `success` (0.2), `drop` (-2), `clearance` (-1), `collision` (-2).
Success       the second arm alone holds the needle, in its middle half; its point is within 2 mm of the goal, and it is
              turned within 10 degrees of it, if the goal has an orientation.
Termination   when the needle, once lifted, is touched by no finger, or falls off the pad; an episode is truncated after
              500 control steps (10 s).
Randomisation the needle lies anywhere at the first arm's end of the pad, turned at random, on either side, and the goal
              is at the second arm's end, 12 to 50 mm above the pad: each 20 mm or more out of the other arm's reach.
              They are kept only if there are grips with which the arms can do it. Arms start at home.
Difficulty    distance of needle and goal from the middle of these ends: easy 8 mm, default and hard 15 mm; hard: the
              goal has an orientation too.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.rotation import quaternion
from surgical_marl.runtime import jax, jnp
from surgical_marl.scenes.poses import Pose
from surgical_marl.tasks.base.grasp_poses import (
    bar,
    bars,
    drawn_about,
    frames,
    from_above,
    joints_at,
    leaning,
    lowest_bar,
    moved,
    tool_of,
    tool_poses,
)
from surgical_marl.tasks.base.object_task import FAR, NEAR, Best, Now, ObjectTask, as_float, known
from surgical_marl.tasks.base.oracle_script import EARLY, Snapshot, Step, Wish
from surgical_marl.tasks.base.resting_poses import resting_poses
from surgical_marl.tasks.base.task import Start
from surgical_marl.tasks.base.terms import Picture, Term
from surgical_marl.tasks.base.workspace import choose
from surgical_marl.tasks.needle_pick import ABOVE, HIGH, LOW, PRESS, RAISE, SAFE, PickLevel

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Mount, Scene
    from surgical_marl.tasks.base.options import Options
    from surgical_marl.tasks.base.world import World

ROWS = 2048
"""Number of starts and goals."""
END = 0.155
"""Distances of the middles of the two ends from the middle between the arms, m."""
OUT = 0.02
"""Least distance of starts and goals from the other arm's reach, m: more than a needle is wide."""
HEIGHT = 0.06
"""Height of the exchange above the pad, m."""
BACK, DEEP, AWAY = 0.015, 0.003, 0.025
"""Distances from which the second tool comes, by which its tip passes the wire, and by which the first leaves, m."""
THERE = 0.01
"""The second tool comes once the needle is nearer than this to where it is handed over, m."""


class Team(NamedTuple):
    """The best that both arms did so far, [] float32 each."""

    meet: Array
    """Least distance of the second tool from the needle's middle half while the needle was held, m."""
    receive: Array
    """1 once both arms held the needle, the second one in its middle half; before that 0."""
    passed: Array
    """1 once the second arm alone held the needle, in its middle half; before that 0."""


class HandoverGoal(NamedTuple):
    """The goal of an episode, and the progress towards it."""

    row: Array
    """Row of the tables."""
    best: Best
    team: Team


class Task(ObjectTask):
    """Handing a needle over and presenting its point."""

    levels = {  # noqa: RUF012
        "easy": PickLevel(0.008, 0.3, False),
        "default": PickLevel(0.015, 0.3, False),
        "hard": PickLevel(0.015, 0.3, True),
    }
    weights = {**ObjectTask.weights, "meet": 10.0, "receive": 4.0, "passed": 4.0, "carry": 10.0, "clearance": 0.0}  # noqa: RUF012
    default_scene = "bimanual_psm_needle"
    scenes = ("bimanual_psm_needle", "trimanual_psm_ecm_needle")
    hands = 2
    max_steps = 500
    stages = ("reached", "grasped", "lifted", "received", "passed", "at_goal")
    wanted = {"success_rate": ("at least", 0.97), "drop_rate": ("below", 0.02)}  # noqa: RUF012

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        self._item = scene.objects[self.object].object
        count = len(bars(self._item)[0])
        self._useful = np.arange(count // 4, -(-3 * count // 4))
        self.grips = count - count // 4, count // 4
        """Bars that the first and the second arm of the oracle grip, near the point and a third from the tail."""
        about = repr((self.object, self.level, self.seed))
        table = cached("needle_handover", lambda: self._draw(scene), about, scene.fingerprint, self._item.content)
        self._set_tables(table[:, :7], frames(table[:, 7:10], table[:, 10:14]))

    def start(self, key: Array) -> Start:
        """Return where the needle lies, and the goal."""
        row, zero = jax.random.randint(key, (), 0, ROWS), jnp.float32(0.0)
        place = self.tables["starts"][row]
        goal = HandoverGoal(row, self.nothing, Team(jnp.float32(-1.0), zero, zero))
        return Start(goal, poses={self.object: Pose(place[:3], place[3:])})

    # -- what is measured

    def further(self, world: World, now: Now) -> Team:
        """Return the best that both arms did so far, with the measurements of this step."""
        team, first, second = world.goal.team, now.held[self.picker], now.held[self.presenter]
        away, there = self._to_useful(world, self.presenter), self._usefully(now) & (now.lift >= 1.0)
        way = known(jnp.sqrt(jnp.sum(away * away)))

        return Team(
            jnp.where(team.meet < 0, way, jnp.where(first | second, jnp.minimum(team.meet, way), team.meet)),
            jnp.maximum(team.receive, as_float(first & second & there)),
            jnp.maximum(team.passed, as_float(self.presents(now) & there)),
        )

    def remember(self, world: World) -> Any:
        """Return the goal with the best so far."""
        return super().remember(world)._replace(team=self.further(world, self.now(world)))

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the terms of every task that brings an object to a goal, and `meet` (m), `receive` and `passed`."""
        team, new = world.goal.team, self.further(world, self.now(world))
        more = {"meet": team.meet - new.meet, "receive": new.receive - team.receive, "passed": new.passed - team.passed}
        return {agent: {**terms, **more} for agent, terms in super().reward_terms(world).items()}

    def at_goal(self, now: Now) -> Array:
        """Return whether the needle is at its goal, and the second arm alone holds it there, in its middle half."""
        return super().at_goal(now) & self._usefully(now)

    def _usefully(self, now: Now) -> Array:
        """Return whether the second tool is at the needle's middle half."""
        return jnp.any(now.part[self.presenter] == self._useful)

    # -- what agents observe

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return the terms of every such task, and `to_useful` [3], from the tool tip to the needle's middle half."""
        far = np.full(3, FAR)
        useful = Term(lambda world: self._to_useful(world, agent), -far, far, "object")
        return {**super().terms(agent), "to_useful": useful}

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the terms of every such task, and `to_useful` after `to_object`."""
        names = super().observes(agent)
        after = names.index("to_object") + 1
        return (*names[:after], "to_useful", *names[after:])

    def _to_useful(self, world: World, agent: str) -> Array:
        """Return the way from a tool tip to the needle's middle half, in the arm's base frame, m, [3]."""
        return self.way_to_bars(world, agent, self._useful)

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return which stages are reached now, for both arms."""
        now, lifted = self.now(world), self.now(world).lift >= 1.0
        first, second = now.held[self.picker], now.held[self.presenter]
        found = {
            "reached": now.reach[self.picker] < NEAR,
            "grasped": first,
            "lifted": first & lifted,
            "received": first & second & lifted,
            "passed": self.presents(now) & lifted,
            "at_goal": self.at_goal(now),
        }
        return dict.fromkeys(world.arms, found)

    # -- the oracle

    def script(self) -> tuple[Step, ...]:
        """Return how both arms do it: as in `needle_pick`, then to the exchange, where the second arm grips."""
        giver, taker = self.picker, self.presenter
        first = self.scene.mounts[giver]

        def grip(seen: Snapshot, beyond: float) -> dict[str, Wish]:
            wire = bar(seen.objects[self.object], self._item, self.grips[0])
            return {giver: Wish(from_above(first, *wire, beyond), opens=True)}

        def raised(seen: Snapshot) -> dict[str, Wish]:
            return {giver: Wish(moved(seen.tools[giver], [0.0, 0.0, RAISE]))}

        def offer(seen: Snapshot) -> dict[str, Wish]:
            needle = seen.objects[self.object]
            held = np.linalg.inv(needle) @ seen.tools[giver]
            there = self._exchange(held)
            waits = moved(taken := self._taken(there), -2 * BACK * taken[:, :3, 2])
            return {giver: Wish(there @ held), taker: Wish(waits, opens=True)}

        def offered(seen: Snapshot) -> np.ndarray:
            """Return whether the needle is there: a giver with a policy of its own takes its own time."""
            needle = seen.objects[self.object]
            there = self._exchange(np.linalg.inv(needle) @ seen.tools[giver])
            return np.asarray(np.linalg.norm((there - needle)[:, :3, 3], axis=-1) < THERE)

        def take(seen: Snapshot, back: float) -> dict[str, Wish]:
            taken = self._taken(seen.objects[self.object])
            return {taker: Wish(moved(taken, -back * taken[:, :3, 2]), opens=True)}

        def leave(seen: Snapshot) -> dict[str, Wish]:
            tool = seen.tools[giver]
            return {giver: Wish(moved(tool, -AWAY * tool[:, :3, 2]), opens=True)}

        def present(seen: Snapshot, above: float) -> dict[str, Wish]:
            held = np.linalg.inv(seen.objects[self.object]) @ seen.tools[taker]
            return {taker: Wish(moved(self.goals[seen.goal.row] @ held, [0.0, 0.0, above]))}

        def holds(agent: str) -> Callable[[Snapshot], np.ndarray]:
            return lambda seen: seen.held[agent][:, self._number]

        return (
            Step(lambda seen: grip(seen, -ABOVE)),
            Step(lambda seen: grip(seen, PRESS), wait=EARLY, pace=0.3),
            Step(lambda seen: {giver: Wish()}, wait=0.4, pace=0.3, good=holds(giver)),
            Step(raised, wait=0.1, pace=0.3, good=holds(giver)),
            Step(offer, wait=0.3, pace=0.6, good=offered, back=4),
            Step(lambda seen: take(seen, BACK), wait=0.1),
            Step(lambda seen: take(seen, -DEEP), wait=EARLY, pace=0.3),
            Step(lambda seen: {taker: Wish()}, wait=0.4, pace=0.3, good=holds(taker), back=4),
            Step(lambda seen: {giver: Wish(opens=True)}, wait=0.3),
            Step(leave, wait=0.1, pace=0.5),
            Step(lambda seen: present(seen, RAISE), pace=0.8),
            Step(lambda seen: present(seen, 0.0), wait=0.3, pace=0.6),
        )

    def _ways(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the middle between the arms, [3], and where the first and the second tool point in the exchange."""
        first, second = self.scene.mounts[self.picker].position, self.scene.mounts[self.presenter].position
        across = (second - first) * [1.0, 1.0, 0.0]
        across /= np.linalg.norm(across)
        up = np.array([0.0, 0.0, 1.0])
        return (first + second) / 2, (across - up) / np.sqrt(2), (-across - up) / np.sqrt(2)

    def _exchange(self, held: np.ndarray) -> np.ndarray:
        """Return poses [n, 4, 4] of the needle in the exchange.

        The first tool stands on the needle's plane. The second one comes in that plane, from outside the arc.

        Args:
            held: poses of the first tool in the needle's frame, [n, 4, 4].
        """
        middle, pointing, coming = self._ways()
        (one, other), (middles, _) = self.grips, bars(self._item)
        outward = np.tile(middles[other] / np.linalg.norm(middles[other]), (len(held), 1))
        plane = np.array([0.0, 0.0, 1.0]) * np.where(held[:, 2, 2] < 0, -1.0, 1.0)[:, None]
        own = np.stack([outward, np.cross(plane, outward), plane], -1)
        there = np.stack([-coming, np.cross(pointing, -coming), pointing], -1)
        poses = np.tile(np.eye(4), (len(held), 1, 1))
        poses[:, :3, :3] = there @ np.swapaxes(own, -1, -2)
        height = self.scene.objects[self.object].position[2] + HEIGHT
        place = np.array([*middle[:2], height])
        poses[:, :3, 3] = place - poses[:, :3, :3] @ ((middles[one] + middles[other]) / 2)
        return poses

    def _taken(self, needle: np.ndarray) -> np.ndarray:
        """Return poses [n, 4, 4] of the second tool that grips a needle at poses [n, 4, 4] from outside the arc."""
        place, along = bar(needle, self._item, self.grips[1])
        inward = needle[:, :3, 3] - place
        mount = self.scene.mounts[self.presenter]
        turned = along @ tool_of(mount, mount.arm.home)[:3, 0] < 0
        along = np.where(turned[:, None], -along, along)
        return tool_poses(place, along, inward / np.linalg.norm(inward, axis=-1, keepdims=True), np.zeros(len(place)))

    # -- where needles and goals are drawn

    def _draw(self, scene: Scene) -> np.ndarray:
        """Return starts [ROWS, 7] and goals [ROWS, 7] of the needle."""
        rng, level = np.random.default_rng(self.seed), self.level
        first, second = scene.mounts[self.picker], scene.mounts[self.presenter]
        middle, pointing, _ = self._ways()
        end = END * pointing[:2] / np.linalg.norm(pointing[:2])

        def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
            place = resting_poses(scene, self.object, ROWS, middle[:2] - end, level.spread, rng)
            starts = frames(*place)
            tools = from_above(first, *bar(starts, self._item, self.grips[0]), 0.0)
            q, good = joints_at(first, tools)
            held = np.linalg.inv(starts) @ tools
            there = self._exchange(held)
            good &= joints_at(first, there @ held, q)[1]
            taken = self._taken(there)
            q, reaches = joints_at(second, taken)
            good &= reaches & joints_at(second, moved(taken, -BACK * taken[:, :3, 2]), q)[1]
            taken = np.linalg.inv(taken) @ there
            goals = leaning(rng, ROWS, level.lean) @ taken
            heights = place.position[:, 2] + [[LOW], [HIGH]]
            points = drawn_about(rng, middle[:2] + end, level.spread, ROWS, heights)
            goals[:, :3, 3] = points - goals[:, :3, :3] @ self._item.sites[self.point][0]
            good &= joints_at(second, goals @ np.linalg.inv(taken), q)[1]
            good &= lowest_bar(goals, self._item) > starts[:, 2, 3] + SAFE
            good &= _out_of_reach(second, place.position) & _out_of_reach(first, points)
            ends = np.stack([quaternion(goal[:3, :3]) for goal in goals])
            return np.concatenate([*place, goals[:, :3, 3], ends], -1)[good], np.zeros(good.sum(), bool)

        return choose(scene, batch, ROWS, 0.0)


def _out_of_reach(mount: Mount, places: np.ndarray) -> np.ndarray:
    """Return whether an arm's tool tip can't come within `OUT` of places [n, 3] in the world, [n] bool.

    Its tip is nowhere further from the base frame's origin than in a posture with all joints at home or at a limit.
    """
    arm = mount.arm
    postures = np.array(list(product(*zip(arm.lower, arm.home, arm.upper, strict=True))))
    furthest = np.linalg.norm(arm.forward_kinematics(postures)[:, :3, 3], axis=-1).max()
    return np.asarray(np.linalg.norm(places - mount.position, axis=-1) > furthest + OUT)
