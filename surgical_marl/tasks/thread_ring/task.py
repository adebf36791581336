"""Threading an eyelet: an arm brings the end of a thread through it, and another one takes it there and pulls.

Both hold the thread by friction alone. A closed jaw does not fit through the hole, so the thread changes hands there.
An arm alone could let go and take the thread again on the other side: the task asks for both.

Agents        the two arms of the scene. The first one with a jaw brings the thread, the second such one takes it.
Observation   joint positions and velocities, tool tip, position targets, contact force; of the thread six places, from
              its end to 60 mm behind it; the ways from the tool tip to where this arm should take the thread, and from
              the thread's end to the middle of the hole; whether this arm and whether the other one holds the thread;
              its tension, the length of it that is through the hole, and how long that should be; the way to the
              nearest tip, and the least distance between the arms. Base frame, SI units.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        the same for all arms, but for `clearance` and `collision`; weights in brackets. Progress over the best of
              the episode so far: `reach`, first tool to the place 18 mm behind the end (20 / m); `grip`, its first hold
              (2); `thread`, while it holds, the way of the end to the hole and on until 12 mm are through (40 / m);
              `meet`, then, second tool to the place 4 mm behind the end (20 / m); `take`, its first hold past the hole
              (2); `release`, the first time that it alone holds (1); `pull`, while it does, of the length that is
              through towards what it should be (40 / m). Of each step: `precision`, while the second arm alone holds,
              1 at that length and a third at 5 mm off (0.1); `success` (0.5); `overload`, more than 9.4 N in the thread
              (-0.1), `drop` (-2), `collision` (-2), `clearance` (0).
Success       the first arm held the thread as 8 mm of it were through; now it goes through the hole once, from the
              first arm's side, the second arm holds it past the hole, the first does not, and the length past the hole
              is within the tolerance of what it should be. The thread has not been pulled with more than 9.4 N, the
              knot-pull strength of USP 3-0.
Termination   when the thread's end has fallen by 20 mm; an episode is truncated after 250 control steps (5 s).
Randomisation the thread is shifted and turned about its end, joints begin off their home, and the length is from 25 to
              40 mm; kept only if the arms can do it, off their joints' limits, and are apart at the start.
Difficulty    largest shift and turn of the thread, how far joints are off, and the tolerance: easy 1 mm, 3 degrees, not
              at all, 5 mm; default 4 mm, 10 degrees, up to 0.1 rad or 10 mm, 3 mm; hard 7 mm, 20 degrees, twice that,
              1.5 mm.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.plugins.task_file import label
from surgical_marl.runtime import jax, jnp
from surgical_marl.tasks.base.object_task import NEAR, as_float, known
from surgical_marl.tasks.base.task import PRECISION, Start
from surgical_marl.tasks.base.task import Task as BaseTask
from surgical_marl.tasks.base.terms import STRONGEST, Picture, Term
from surgical_marl.tasks.suture.task import STRENGTH
from surgical_marl.tasks.thread_ring.eyelet import Eyelet
from surgical_marl.tasks.thread_ring.script import GRIPS, OUT, Threader

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.options import Options
    from surgical_marl.tasks.base.oracle_script import Step
    from surgical_marl.tasks.base.world import World

ROWS = 2048
MARKS = 0.0, 0.006, 0.012, 0.020, 0.035, 0.060
"""Lengths between the thread's end and its places that agents observe, m."""
READY = 0.008
"""Length through the hole from which the second arm may take the thread, m."""
LENGTHS = 0.025, 0.040
"""Least and greatest length that should be through the hole in the end, m."""
CLOSED = 0.06
"""Angle of a jaw beyond that at which it is empty, up to which it is closed, rad: the thread holds it open by less."""
LOST = 0.020
"""The thread is lost where its end is this far below its start, m."""


class RingLevel(NamedTuple):
    """A level of difficulty."""

    shift: float
    """Largest distance of the thread's end along x and y from where the scene places it, m."""
    turn: float
    """Largest angle by which it is turned about its end, rad."""
    off: float
    """Distance of joints from home at the start, in units of `about_home`."""
    tolerance: float
    """Greatest difference of the length through the hole from what it should be, m."""


class Progress(NamedTuple):
    """The best of an episode so far, [] float32 each. Distances are below 0 before they count."""

    reach: Array
    """Least distance of the first tool from where it should take the thread, m."""
    grip: Array
    """1 once the first arm held the thread, before that 0."""
    thread: Array
    """Least length that the end had still to go while the first arm held it, m."""
    meet: Array
    """Least distance of the second tool from where it should take the thread, while that was through the hole, m."""
    take: Array
    """1 once the second arm held the thread past the hole."""
    release: Array
    """1 once it alone held it."""
    pull: Array
    """Least difference of the length through the hole from what it should be while it alone held it, m."""
    tension: Array
    """Greatest tension of the thread, N."""


class RingGoal(NamedTuple):
    """The goal of an episode, the progress towards it, and what the oracle needs to know."""

    row: Array
    """Row of the tables."""
    best: Progress
    places: Array
    """Places of the thread 0, 4, 18, 8 and 22 mm behind its end, world, m, [5, 3]."""
    length: Array
    """Length through the hole, m, []; 0 where the thread does not wind through it once."""
    held: Array
    """1 for each of both arms that holds the thread, the second past the hole, [2]."""


class Now(NamedTuple):
    """Measurements in a world, [] each."""

    reach: Array
    """Distance of the first tool from where it should take the thread, m."""
    meet: Array
    """Distance of the second tool from where it should take the thread, m."""
    first: Array
    """True if the first arm holds the thread."""
    second: Array
    """True if the second arm holds it past the hole."""
    threaded: Array
    """True if the thread winds through the hole once, from the first arm's side."""
    length: Array
    """Length through the hole, m; 0 where it is not threaded."""
    left: Array
    """Way of the end to the middle of the hole, and from there until `OUT` is through, m."""
    off: Array
    """Difference of the length through the hole from what it should be, m."""
    fallen: Array
    """Height by which the end is below its start, m."""
    tension: Array
    """Largest of the thread, N."""

    @property
    def alone(self) -> Array:
        """True if the second arm alone holds the thread, past the hole."""
        return self.second & ~self.first


class Task(BaseTask):
    """Threading an eyelet."""

    levels = {  # noqa: RUF012
        "easy": RingLevel(0.001, np.radians(3.0), 0.0, 0.005),
        "default": RingLevel(0.004, np.radians(10.0), 1.0, 0.003),
        "hard": RingLevel(0.007, np.radians(20.0), 2.0, 0.0015),
    }
    weights = {  # noqa: RUF012
        "reach": 20.0, "grip": 2.0, "thread": 40.0, "meet": 20.0, "take": 2.0, "release": 1.0, "pull": 40.0,
        "precision": 0.1, "success": 0.5, "overload": -0.1, "drop": -2.0, "clearance": 0.0, "collision": -2.0,
    }  # fmt: skip
    default_scene = "bimanual_psm_thread_ring"
    scenes = ("bimanual_psm_thread_ring",)
    max_steps = 250
    stages = ("reached", "gripped", "threaded", "taken", "released", "at_goal")
    wanted = {"success_rate": ("at least", 0.95)}  # noqa: RUF012

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        holders = scene.holders
        if len(holders) != 2:
            raise ValueError(
                f"{label(options.task)} needs a scene with 2 arms whose jaws have pads; {scene.name!r} has "
                f"{len(holders)} (choose from {', '.join(self.scenes)}, or a file)"
            )
        self.first, self.second = holders
        """The arm that brings the thread, and the one that takes it."""
        self.eyelet = Eyelet(scene, self.first, self.second, options.task, self.scenes)
        self.threader = Threader(scene, self.first, self.second, self.eyelet)
        about = repr((self.level, self.seed, ROWS, scene.systems[self.eyelet.thread]))
        objects = [place.object.content for place in scene.objects.values()]
        table = cached("thread_ring", self._draw, about, scene.fingerprint, *objects)
        lays, postures = np.split(table, [3], 1)
        lengths = np.random.default_rng(self.seed).uniform(*LENGTHS, ROWS)
        tolerance = np.array([self.level.tolerance])  # as an input, one kernel serves all levels
        self.tables |= {"lays": lays, "starts": postures, "lengths": lengths, "tolerance": tolerance}

    @property
    def constants(self) -> tuple[Any, ...]:
        """The arms and the eyelet."""
        eyelet = self.eyelet
        return self.first, self.second, eyelet.thread, eyelet.centre.tolist(), eyelet.axis.tolist(), eyelet.radius

    def start(self, key: Array) -> Start:
        """Return where the thread lies, and the postures."""
        row, zero, before = jax.random.randint(key, (), 0, ROWS), jnp.float32(0.0), jnp.float32(-1.0)
        best = Progress(before, zero, before, before, zero, zero, before, zero)
        goal = RingGoal(row, best, jnp.zeros((5, 3), jnp.float32), zero, jnp.zeros(2, jnp.float32))
        lay = self.tables["lays"][row]
        return Start(goal, self.tables["starts"][row], threads={self.eyelet.thread: self.eyelet.laid(lay[:2], lay[2])})

    # -- what is measured

    def now(self, world: World) -> Now:
        """Return the measurements in a world."""
        view, eyelet, goal = world.systems[self.eyelet.thread], self.eyelet, world.goal
        nodes, end = view.position, view.position[-1]
        turns, length = eyelet.through(nodes)
        threaded = turns == 1
        length = jnp.where(threaded, length, 0.0)
        away = _length(end - _f32(eyelet.centre))
        least = {}
        for agent, behind in ((self.first, GRIPS[0]), (self.second, GRIPS[1])):
            least[agent] = known(_length(eyelet.place(nodes, behind) - self._tool(world, agent)[0]))
        past = self._pinched(world, self.second, nodes)
        return Now(
            least[self.first],
            least[self.second],
            self._pinched(world, self.first, nodes) >= 0,
            (past >= 0) & (past < length),
            threaded,
            length,
            known(OUT + jnp.where(threaded, -jnp.minimum(length, OUT), away)),
            known(jnp.abs(length - self.tables["lengths"][goal.row])),
            np.float32(eyelet.path[-1, 2]) - end[2],
            jnp.max(view.tension),
        )

    def _pinched(self, world: World, agent: str, nodes: Array) -> Array:
        """Return how far behind its end the foremost place is that an arm's jaw holds, m, []; -1 for none."""
        arm = self.scene.mounts[agent].arm
        assert arm.jaw
        angle = world.arms[agent].qpos[int(np.flatnonzero(arm.moves_jaw)[0])]
        held = self.eyelet.pinched(nodes, *self._tool(world, agent))
        return jnp.where(angle < np.float32(arm.jaw.closed + CLOSED), held, -1.0)

    def _tool(self, world: World, agent: str) -> tuple[Any, Any]:
        """Return the place, m, [3], and the axes, [3, 3], of an arm's tool tip in the world."""
        mount, view = self.scene.mounts[agent], world.arms[agent]
        turn = _f32(mount.rotation)
        return turn @ view.tool_tip + _f32(mount.position), turn @ view.tool_axes

    def after(self, best: Progress, now: Now) -> Progress:
        """Return the best so far, with the measurements of this step."""

        def least(value: Array, before: Array, counts: Any = True) -> Array:
            return jnp.where(counts, jnp.where(before < 0, value, jnp.minimum(value, before)), before)

        return Progress(
            least(now.reach, best.reach),
            jnp.maximum(best.grip, as_float(now.first)),
            least(now.left, best.thread, now.first | (best.thread < 0)),
            least(now.meet, best.meet, now.length > READY),
            jnp.maximum(best.take, as_float(now.second)),
            jnp.maximum(best.release, as_float(now.alone)),
            least(now.off, best.pull, now.alone),
            jnp.maximum(best.tension, now.tension),
        )

    def remember(self, world: World) -> Any:
        """Return the goal with the best so far, and how the thread is now."""
        now, goal, nodes = self.now(world), world.goal, world.systems[self.eyelet.thread].position
        first, second = GRIPS
        places = [self.eyelet.place(nodes, behind) for behind in (0.0, second, first, 2 * second, first + second)]
        held = jnp.stack([as_float(now.first), as_float(now.second)])
        return RingGoal(goal.row, self.after(goal.best, now), jnp.stack(places), now.length, held)

    def _done(self, world: World, now: Now) -> Array:
        """Return whether the thread was brought through, is long enough, and the second arm alone holds it."""
        best = self.after(world.goal.best, now)
        brought, unhurt = best.thread <= np.float32(OUT - READY), best.tension <= np.float32(STRENGTH)
        return brought & now.alone & (now.off < self.tables["tolerance"][0]) & unhurt

    # -- what agents get

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the terms of every task, and the team's terms, which each agent gets.

        Progress over the best of the episode so far: `reach`, `thread`, `meet` and `pull` (m), `grip`, `take` and
        `release` (1). Of each step: `precision`, from 0 to 1, `success`, `overload` and `drop`, 0 or 1 each.
        """
        now, old, safety = self.now(world), world.goal.best, super().reward_terms(world)
        new = self.after(old, now)

        def nearer(name: str) -> Array:
            before, after = getattr(old, name), getattr(new, name)
            return jnp.where(before < 0, 0.0, before - after)

        team = {
            **{name: nearer(name) for name in ("reach", "thread", "meet", "pull")},
            **{name: getattr(new, name) - getattr(old, name) for name in ("grip", "take", "release")},
            "precision": jnp.where(now.alone, jnp.exp(-now.off / PRECISION), 0.0),
            "success": as_float(self._done(world, now)),
            "overload": as_float(now.tension > STRENGTH),
            "drop": as_float(self._lost(now)),
        }
        return {agent: {**team, **safety[agent]} for agent in world.arms}

    def success(self, world: World) -> dict[str, Array]:
        """Return whether the thread has been pulled through to its length, for all agents."""
        return dict.fromkeys(world.arms, self._done(world, self.now(world)))

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return which stages are reached now, for all agents."""
        now = self.now(world)
        found = {
            "reached": now.reach < NEAR,
            "gripped": now.first,
            "threaded": now.length > READY,
            "taken": now.second,
            "released": now.alone,
            "at_goal": self._done(world, now),
        }
        return dict.fromkeys(world.arms, found)

    def metrics(self, world: World) -> dict[str, dict[str, Array]]:
        """Return `goal_error`, by how much the length through the hole is off, m, `drop`, and `holding`."""
        now = self.now(world)
        found = {"goal_error": now.off, "drop": self._lost(now)}
        return {agent: {**found, "holding": self._holding(now, agent)} for agent in world.arms}

    def _holding(self, now: Now, *agents: str) -> Array:
        """Return whether one of some arms holds the thread, the second one past the hole, [] bool."""
        held = {self.first: now.first, self.second: now.second}
        return jnp.stack([held.get(agent, jnp.bool_(False)) for agent in agents]).any()

    def _lost(self, now: Now) -> Array:
        """Return whether the thread has fallen, also where its place is not a number."""
        return ~(now.fallen < LOST)

    def terminated(self, world: World) -> Array:
        """Return whether the thread has fallen."""
        return self._lost(self.now(world))

    # -- what agents observe

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return the terms of every task, and those of thread and eyelet, in the arm's base frame.

        `<thread>_marks` [18], six places of the thread; `to_grip` [3], from the tool tip to where this arm should take
        it; `to_eyelet` [3], from its end to the middle of the hole; `holds` [1] and `others_hold` [1]; `tension` [1],
        N; `through` [1], the length through the hole, and `length` [1], how long that should be, m.
        """
        mount, eyelet, name = self.scene.mounts[agent], self.eyelet, self.eyelet.thread
        turn, origin, behind = _f32(mount.rotation), _f32(mount.position), GRIPS[agent == self.second]

        def local(points: Array) -> Array:
            return (points - origin) @ turn

        def nodes(world: World) -> Array:
            return world.systems[name].position

        def marks(world: World) -> Array:
            return jnp.concatenate([local(eyelet.place(nodes(world), behind)) for behind in MARKS])

        def to_grip(world: World) -> Array:
            return local(eyelet.place(nodes(world), behind)) - world.arms[agent].tool_tip

        def to_eyelet(world: World) -> Array:
            return (_f32(eyelet.centre) - nodes(world)[-1]) @ turn

        own = np.array([agent == one for one in (self.first, self.second)], np.float32)

        reach, one = mount.arm.reach, np.ones(1)
        ways, low, high = reach.minus(reach), np.tile(reach.low, len(MARKS)), np.tile(reach.high, len(MARKS))
        whole = float(eyelet.edge * len(eyelet.path)) * one
        return {
            **super().terms(agent),
            f"{name}_marks": Term(marks, low, high, "object"),
            "to_grip": Term(to_grip, *ways, "object"),
            "to_eyelet": Term(to_eyelet, *ways, "object"),
            "holds": Term(lambda world: (world.goal.held @ own)[None], 0 * one, one, "arm"),
            "others_hold": Term(
                lambda world: jnp.minimum(world.goal.held @ (1 - own), 1.0)[None], 0 * one, one, "others"
            ),
            "tension": Term(
                lambda world: jnp.max(world.systems[name].tension)[None], 0 * one, STRONGEST * one, "object"
            ),
            "through": Term(lambda world: world.goal.length[None], 0 * one, whole, "object"),
            "length": Term(
                lambda world: self.tables["lengths"][world.goal.row][None], 0 * one, LENGTHS[1] * one, "team_goal"
            ),
        }

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the terms of the agent itself, of thread, eyelet and goal, then those of the other arms."""
        own = super().observes(agent)
        thread = f"{self.eyelet.thread}_marks", "to_grip", "to_eyelet", "holds", "others_hold", "tension", "through"
        return (*own[:4], "contact_force", *thread, "length", *own[4:])

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return how the thread lies, the postures at the start, and the length that should be through the hole."""
        return [np.asarray(self.tables[name], float)[goal.row] for name in ("lays", "starts", "lengths")]

    # -- the oracle, and where it can do it

    def script(self) -> tuple[Step, ...]:
        """Return how both arms do it: take the thread, bring it through the hole, take it over, and pull."""
        return self.threader.script(self.tables["lengths"])

    def _draw(self) -> np.ndarray:
        """Return shifts and turns of the thread, [ROWS, 3], and postures [ROWS, nq]."""
        return self.threader.draw(self.level.shift, self.level.turn, self.level.off, LENGTHS[1], ROWS, self.seed)


def _f32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32)


def _length(way: Array) -> Array:
    return jnp.sqrt(jnp.sum(way * way))
