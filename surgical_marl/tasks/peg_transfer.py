"""Peg transfer: a block is lifted off its peg and put on another one, handed over above the wall on the way.

The first task of the Fundamentals of Laparoscopic Surgery, on the board of the ICRA 2026 challenge.

Agents        the arms of the scene. The first two whose jaws have pads move the block; if `easy` the first one alone.
Observation   as in `needle_handover`; the goal is where the middle of the block's underside should be.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        the same for all arms, but for `clearance` and `collision`; weights in brackets. Progress over the best of
              the episode so far: `reach`, first tool to block (20 / m); `grasp` (2); `lift`, over 10 mm of height (2);
              if it is handed over `receive`, when both arms hold it (4), and `passed`, when the second one holds it
              alone (4); `over`, when it is held over its goal, clear of the pegs (4); `carry`, block to goal while the
              arm that places it holds it alone (20 / m). Then `precision`, exp(-error / 5 mm) while held (0.1);
              `success` (0.5); `drop` (-2); `clearance` (0), `collision` (-2).
Success       the block stands on its goal peg, less than 2 mm above the plate, and no finger touches it.
Termination   when the block, once lifted, is touched by no finger and is on no peg, or falls off the board; an episode
              is truncated after 600 control steps (12 s), if `easy` after 300.
Randomisation the block stands on any peg of the first arm's side of the wall, turned and shifted at random as far as
              the peg lets it. Its goal is a free peg of the other side, if `easy` of the same side. Kept only if the
              arms reach their grips, off their joints' limits. Arms start at home.
Difficulty    easy: one arm moves the block to one of the nearest pegs, 20 or 30 mm away. default: over the wall.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.rotation import quaternion, turned
from surgical_marl.runtime import jax, jnp
from surgical_marl.scenes.poses import Pose
from surgical_marl.tasks.base.blocks import OUT, find_pegs, gripping, upright
from surgical_marl.tasks.base.grips import frames, joints_at, moved, tool_of
from surgical_marl.tasks.base.object_task import NEAR, Best, Now, ObjectTask
from surgical_marl.tasks.base.script import Snapshot, Step, Wish
from surgical_marl.tasks.base.task import Start
from surgical_marl.tasks.base.workspace import choose

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Mount, Scene
    from surgical_marl.tasks.base.options import Options
    from surgical_marl.tasks.base.world import World

ROWS = 2048
ABOVE_WALL = 0.09
"""Height of the block's middle in the exchange, m in the world: its underside is 12 mm above the wall."""
AROUND = 0.0035
"""A block is around a peg where the axes of its hole and of the peg are nearer than this, m. Up to 2.7 mm are free."""
STANDS = 0.002
"""Greatest height of a block's underside above the plate where it stands there, m."""
SHIFT = 0.0015
"""Greatest distance of a block from its peg's axis at the start, m."""
CLEAR = 0.024
"""Height of a block's underside above the plate from which on it is clear of the pegs, m: these are 20 mm high."""
PAST, WIDE = 0.0025, 0.45
"""How far the oracle's tool tip goes past the bar, m, and the share by which its jaw opens: one finger goes between bar
and peg."""
OVER, RAISE, AWAY = 0.012, 0.030, 0.035
"""How far the tool tip stops above the bar, how far it lifts the block, and how far an arm is from the wall before and
after the exchange, m."""
SIDE = 150.0
"""In the exchange the first tool grips the bar that is this way from the block's axis, degrees about z; the second tool
grips the next one clockwise, at 30 degrees."""


class PegLevel(NamedTuple):
    """A level of difficulty."""

    distance: float
    """Greatest distance of the goal from the start, m."""
    handover: bool
    """Whether the goal is on the other side of the wall."""
    oriented: bool = False
    """Whether the goal has an orientation."""


class Team(NamedTuple):
    """The best that the arms did so far, [] float32 each."""

    receive: Array
    """1 once both held it, lifted."""
    passed: Array
    """1 once the second arm held it alone."""
    over: Array
    """1 once it was held over its goal."""


class PegGoal(NamedTuple):
    """The goal of an episode, and what was reached of it."""

    row: Array
    """Row of the tables."""
    best: Best
    team: Team


class Task(ObjectTask):
    """Moving a block from peg to peg."""

    levels = {"easy": PegLevel(0.032, False), "default": PegLevel(1.0, True)}  # noqa: RUF012
    weights = {  # noqa: RUF012
        **ObjectTask.weights, "carry": 20.0, "receive": 4.0, "passed": 4.0, "over": 4.0, "success": 0.5,
        "clearance": 0.0,
    }  # fmt: skip
    default_scene = "bimanual_psm_pegs"
    scenes = ("bimanual_psm_pegs", "trimanual_psm_ecm_pegs")
    hands = 2
    point = "base"
    max_steps = 600
    stages = ("reached", "grasped", "lifted", "received", "passed", "over", "at_goal")
    wanted = {"success_rate": ("at least", 0.95), "drop_rate": ("below", 0.02)}  # noqa: RUF012

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        if not self.level.handover:
            self.presenter, self.max_steps = self.picker, 300
        self._item = scene.objects[self.object].object
        self._pegs = find_pegs(scene, options.task).astype(np.float32)
        self._grasps = np.array([i for i, name in enumerate(self._item.sites) if name.startswith("grasp_")])
        about = repr((self.object, self.level, self.seed, SHIFT, PAST, OUT, OVER, RAISE, CLEAR, ABOVE_WALL, SIDE))
        table = cached("peg_transfer", lambda: self._draw(scene), about, scene.fingerprint, self._item.content)
        self._set_tables(table[:, :7], frames(table[:, 7:10], table[:, 10:14]))
        self.grips = table[:, 14].astype(int)
        """Of the oracle: the number of the site that the first arm grips."""

    @property
    def constants(self) -> tuple[Any, ...]:
        """Those of every such task, and whether the block is handed over."""
        return *super().constants, self.level.handover

    def start(self, key: Array) -> Start:
        """Return where the block stands, and the goal."""
        row = jax.random.randint(key, (), 0, ROWS)
        place = self.tables["starts"][row]
        goal = PegGoal(row, self.nothing, Team(*[jnp.float32(0.0)] * 3))
        return Start(goal, poses={self.object: Pose(place[:3], place[3:])})

    # -- what is measured

    def now(self, world: World) -> Now:
        """Return what is measured in a world; a block that is around a peg is not dropped."""
        now = super().now(world)
        away = self._base(world)[:2] - self._pegs[:, :2]
        around = jnp.min(jnp.sum(away * away, -1)) < AROUND**2
        return now._replace(dropped=now.dropped & ~(around & (self._height(world) > -STANDS)))

    def further(self, world: World, now: Now) -> Team:
        """Return what the arms have done by now, and whether this was the first time or not."""
        team, lifted = world.goal.team, now.lift >= 1.0
        both = jnp.stack(list(now.held.values())).sum() >= 2
        alone = self.presents(now) & lifted & self.level.handover
        away = (self._base(world) - self.tables["points"][world.goal.row])[:2]
        over = self.presents(now) & (jnp.sum(away * away) < AROUND**2) & (self._height(world) > CLEAR - STANDS)
        found = (both & lifted, alone, over)
        return Team(*(jnp.maximum(best, new.astype(jnp.float32)) for best, new in zip(team, found, strict=True)))

    def stands(self, world: World) -> Array:
        """Return whether the block stands on its goal peg and no finger touches it, [] bool."""
        away = (self._base(world) - self.tables["points"][world.goal.row])[:2]
        loose = jnp.stack([view.handles[self.object].force <= 0 for view in world.arms.values()]).all()
        return loose & (jnp.sum(away * away) < AROUND**2) & (jnp.abs(self._height(world)) < STANDS)

    def remember(self, world: World) -> Any:
        """Return the goal with the best so far."""
        return super().remember(world)._replace(team=self.further(world, self.now(world)))

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the terms of every task that brings an object to a goal, and `receive`, `passed` and `over`."""
        new = self.further(world, self.now(world))
        more = {name: value - best for name, value, best in zip(Team._fields, new, world.goal.team, strict=True)}
        more["success"] = self.stands(world).astype(jnp.float32)
        return {agent: {**terms, **more} for agent, terms in super().reward_terms(world).items()}

    def success(self, world: World) -> dict[str, Array]:
        """Return whether the block stands on its goal peg, for all agents."""
        return dict.fromkeys(world.arms, self.stands(world))

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return which stages are reached now, for all arms; of one arm `received` and `passed` are those of a hold."""
        now, team = self.now(world), self.further(world, self.now(world))
        held, lifted = now.held[self.picker], now.lift >= 1.0
        found = {
            "reached": now.reach[self.picker] < NEAR,
            "grasped": held,
            "lifted": held & lifted,
            "received": (team.receive > 0) | (not self.level.handover) & held,
            "passed": (team.passed > 0) | (not self.level.handover) & held,
            "over": team.over > 0,
            "at_goal": self.stands(world),
        }
        return dict.fromkeys(world.arms, found)

    def _base(self, world: World) -> Array:
        """Return the middle of the block's underside in the world, [3], m."""
        body = world.objects[self.object]
        return body.position + body.rotation @ self._point

    def _height(self, world: World) -> Array:
        """Return its height above the plate, [] m."""
        return self._base(world)[2] - self._pegs[0, 2]

    # -- the oracle

    def script(self) -> tuple[Step, ...]:
        """Return how the arms do it: lift the block, hand it over above the wall if needed, lower it on the peg."""
        agent = self.presenter
        over = lambda seen, height: self.goals[seen.goal.row][:, :3, 3] + np.array([0.0, 0.0, height])  # noqa: E731
        place = (
            Step(lambda seen: self._carry(seen, over(seen, RAISE)), wait=0.1, pace=0.5),
            Step(lambda seen: self._carry(seen, over(seen, RAISE / 2)), pace=0.3),
            Step(lambda seen: self._carry(seen, over(seen, 0.0005)), wait=0.1, pace=0.3),
            Step(lambda seen: {agent: Wish(opens=WIDE)}, wait=0.2),
            Step(lambda seen: _shifted(seen, agent, [0, 0, RAISE / 2], WIDE), pace=0.3),
            Step(lambda seen: {agent: Wish(opens=WIDE)}),
        )
        return (*self._pick(), *(self._pass_on() if self.level.handover else ()), *place)

    def _pick(self) -> tuple[Step, ...]:
        """Return how the first arm lifts the block off its peg."""
        agent, number = self.picker, lambda seen: self.grips[seen.goal.row]
        holds = lambda seen: seen.held[agent][:, self._number]  # noqa: E731
        return (
            Step(lambda seen: self._grip(seen, agent, number(seen), -OVER), wait=0.1),
            Step(lambda seen: self._grip(seen, agent, number(seen), PAST), wait=0.1, pace=0.3),
            Step(lambda seen: {agent: Wish()}, wait=0.3, good=holds),
            Step(lambda seen: _shifted(seen, agent, [0, 0, RAISE / 2]), pace=0.3, good=holds),
            Step(lambda seen: _shifted(seen, agent, [0, 0, RAISE / 2]), wait=0.1, pace=0.4),
        )

    def _pass_on(self) -> tuple[Step, ...]:
        """Return how the first arm hands the block over above the wall, and the second one takes it aside."""
        giver, taker = self.picker, self.presenter
        across = _across(self.scene, giver, taker)

        def offer(seen: Snapshot, way: Any) -> dict[str, Wish]:
            grip = self.grips[seen.goal.row]
            there = self._exchange(grip)
            held = np.linalg.inv(seen.objects[self.object]) @ seen.tools[giver]
            taken = gripping(self.scene.mounts[taker], there, self._sites[self._next(grip)], 0.0)
            waits = moved(taken, AWAY * across + [0.0, 0.0, OVER])
            return {giver: Wish(moved(there, way) @ held), taker: Wish(waits, opens=WIDE)}

        def take(seen: Snapshot, beyond: float) -> dict[str, Wish]:
            return self._grip(seen, taker, self._next(self.grips[seen.goal.row]), beyond)

        def aside(seen: Snapshot) -> dict[str, Wish]:
            return self._carry(seen, self._place + AWAY * across)

        return (
            Step(lambda seen: offer(seen, [0.0, 0.0, 0.01] - AWAY * across), pace=0.6),
            Step(lambda seen: offer(seen, [0.0, 0.0, 0.0]), wait=0.2, pace=0.5),
            Step(lambda seen: take(seen, -OVER), wait=0.1, pace=0.6),
            Step(lambda seen: take(seen, PAST), wait=0.1, pace=0.3),
            Step(lambda seen: {taker: Wish()}, wait=0.3, good=lambda s: s.held[taker][:, self._number], back=7),
            Step(lambda seen: {giver: Wish(opens=WIDE)}, wait=0.2),
            Step(lambda seen: _shifted(seen, giver, [0, 0, RAISE / 2], WIDE), pace=0.3),
            Step(lambda seen: _shifted(seen, giver, -AWAY * across, WIDE), pace=0.6),
            Step(aside, pace=0.5),
        )

    def _grip(self, seen: Snapshot, agent: str, number: np.ndarray, beyond: float) -> dict[str, Wish]:
        tool = gripping(self.scene.mounts[agent], seen.objects[self.object], self._sites[number], beyond)
        return {agent: Wish(tool, opens=WIDE)}

    def _carry(self, seen: Snapshot, place: np.ndarray) -> dict[str, Wish]:
        """Return the wish that the held block is upright at a place [n, 3], turned so that the tool turns least."""
        agent = self.presenter
        held = np.linalg.inv(seen.objects[self.object]) @ seen.tools[agent]
        home = tool_of(self.scene.mounts[agent], self.scene.mounts[agent].arm.home)[:3, 0]
        yaw = np.arctan2(home[1], home[0]) - np.arctan2(held[:, 1, 0], held[:, 0, 0])
        if agent == self.picker:  # nothing turns it on the way
            yaw = np.arctan2(self.goals[seen.goal.row][:, 1, 0], self.goals[seen.goal.row][:, 0, 0])
        return {agent: Wish(upright(np.broadcast_to(place, (len(held), 3)), np.degrees(yaw)) @ held)}

    @property
    def _place(self) -> np.ndarray:
        """Where the block's middle is in the exchange, [3], m."""
        first, second = (self.scene.mounts[agent].position for agent in (self.picker, self.presenter))
        return np.array([*((first + second) / 2)[:2], ABOVE_WALL])

    def _exchange(self, number: np.ndarray) -> np.ndarray:
        """Return poses [n, 4, 4] of the block in the exchange, whose site of these numbers [n] the first tool grips."""
        site = self._sites[number]
        return upright(np.tile(self._place, (len(site), 1)), SIDE - np.degrees(np.arctan2(site[:, 1], site[:, 0])))

    def _next(self, number: np.ndarray) -> np.ndarray:
        """Return the numbers of the sites next to some, clockwise."""
        first = self._grasps[0]
        return np.asarray(first + (number - first - 1) % len(self._grasps))

    def _draw(self, scene: Scene) -> np.ndarray:
        """Return starts [ROWS, 7] and goals [ROWS, 7] of the block, and the site that the first arm grips [ROWS, 1]."""
        rng, first, last = np.random.default_rng(self.seed), scene.mounts[self.picker], scene.mounts[self.presenter]
        from_pegs, to_pegs = (self._side(scene, agent) for agent in (self.picker, self.presenter))
        base, home = self._item.sites[self.point][0], tool_of(first, first.arm.home)[:3, 0]

        def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
            one, other = (
                from_pegs[rng.integers(len(from_pegs), size=ROWS)],
                to_pegs[rng.integers(len(to_pegs), size=ROWS)],
            )
            far = np.linalg.norm(one - other, axis=-1)
            good = (far > 0) & (far < self.level.distance)
            shift, yaw = SHIFT * np.sqrt(rng.random(ROWS)), rng.uniform(-180.0, 180.0, ROWS)
            bearing = rng.uniform(-np.pi, np.pi, ROWS)
            place = one - base + np.stack([shift * np.cos(bearing), shift * np.sin(bearing), 0 * yaw], -1)
            starts, goals = upright(place, yaw), upright(other - base, yaw)
            along = [np.abs(gripping(first, starts, self._sites[i], 0.0)[:, :3, 0] @ home) for i in self._grasps]
            number = self._grasps[np.argmax(along, 0)]
            good &= self._reaches(first, starts, number)
            if self.level.handover:
                there = self._exchange(number)
                good &= self._reaches(first, there, number) & self._reaches(last, there, self._next(number))
            else:
                good &= self._reaches(last, goals, number)
            turn = np.stack([quaternion(turned(np.array([0.0, 0.0, own]))) for own in yaw])
            rows = np.concatenate([place, turn, goals[:, :3, 3], turn, number[:, None]], -1)[good]
            return rows, np.zeros(len(rows), bool)

        return choose(scene, batch, ROWS, 0.0)

    def _side(self, scene: Scene, agent: str) -> np.ndarray:
        """Return the pegs [n, 3] that are nearer to an arm than to others with a jaw, and free of other blocks."""
        pegs = find_pegs(scene, "peg_transfer")
        away = lambda place: np.linalg.norm((pegs - place)[:, :2], axis=-1)  # noqa: E731
        mount, jaws = scene.mounts[agent], [own for name, own in scene.mounts.items() if name != agent and own.arm.jaw]
        taken = [place.position for name, place in scene.free_objects.items() if name != self.object]
        good = [away(mount.position) < away(other.position) for other in jaws]
        return pegs[np.all([*good, *(away(place) > 0.01 for place in taken)], axis=0)]

    def _reaches(self, mount: Mount, body: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Return whether an arm reaches its grip on blocks at poses [n, 4, 4], and `RAISE` / 2 above, [n] bool."""
        tools = gripping(mount, body, self._sites[number], PAST)
        q, good = joints_at(mount, tools)
        return good & joints_at(mount, moved(tools, [0.0, 0.0, RAISE / 2]), q)[1]


def _shifted(seen: Snapshot, agent: str, way: Any, opens: float = 0.0) -> dict[str, Wish]:
    """Return the wish that a tool goes some way in the world, [3], m."""
    return {agent: Wish(moved(seen.tools[agent], way), opens)}


def _across(scene: Scene, one: str, other: str) -> np.ndarray:
    """Return the horizontal direction from an arm to another one, [3]."""
    way = (scene.mounts[other].position - scene.mounts[one].position) * [1.0, 1.0, 0.0]
    return np.asarray(way / np.linalg.norm(way))
