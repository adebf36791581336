"""Needle drive: an arm drives a needle into tissue at one mark and out of it at another, through both edges of a wound.

Agents        the arms of the scene. The first one whose jaw has pads drives; others, if any, may help or stay away.
Observation   joint positions and velocities, tool tip, position targets, contact force; the needle's place, orientation
              and velocity, how the arm grips it, the way to its nearest part; its tip, both marks and the ways from the
              tip to them, as the tissue moves; how far it is through: the length of needle in and past the entry, that
              past the exit, and whether it entered and came out. Base frame, SI units.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        the same for all arms, but for `clearance` and `collision`; weights in brackets. Progress over the best
              of the episode so far: `reach`, tool to needle (20 / m), `grasp` (2) and `lift` (2); while it is held
              `align`, how far its tip, middle and tail are at most from where they should be as it enters (40 / m);
              `entry` and `exit`, exp(-error / 2 mm) where the tip went in and came out (4 each); `travel`, the share of
              the way from the entry to the end, while the entry is within the tolerance (10). Of each step: `success`
              (0.5); `force`, by how much the tissue is loaded by more than 2 N (-0.1 / N); `drop` (-2), `clearance`
              (-1), `collision` (-2).
Success       the needle went in and came out within the tolerance of both marks, and its tip is out by 3 mm, so that
              another jaw could take it: easy 4 mm, default 2.5 mm, which is the limit of the AccelNet surgical robotics
              challenge, hard 1 mm.
Termination   when the needle, once lifted, is neither touched by a finger nor in tissue, or falls; an episode is
              truncated after 300 control steps (6 s), hard 500.
Randomisation marks are 6 to 7 mm from the middle of the slit, anywhere along its middle 20 mm. The jaw holds the needle
              2 to 4 mm from its tail, leans by up to 6 degrees, and begins 8 to 23 mm from where it is driven from,
              turned by up to 17 degrees. Kept only if the arm can make the whole way.
Difficulty    easy: through the first edge alone: the exit is on the wall of the slit; default: both edges; hard: the
              needle lies on a pad, and must be picked up first.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.plugins.task_file import label
from surgical_marl.runtime import jax, jnp
from surgical_marl.scenes.poses import Pose
from surgical_marl.tasks.base.grasp_poses import bars, frames, moved
from surgical_marl.tasks.base.object_task import FAR, LIFT, LOST, as_float, find_object, known
from surgical_marl.tasks.base.object_terms import PARTS
from surgical_marl.tasks.base.oracle_script import EARLY, Snapshot, Step, Wish
from surgical_marl.tasks.base.task import Start
from surgical_marl.tasks.base.task import Task as Base
from surgical_marl.tasks.base.terms import Picture, Term
from surgical_marl.tasks.needle_drive.path import driven
from surgical_marl.tasks.needle_drive.starts import BEFORE, BEYOND, LEAN, Starts, Wound, draw_starts

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.physics.systems.channel_state import ChannelView
    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.options import Options
    from surgical_marl.tasks.base.world import World

ROWS = 2048
"""Number of starts."""
ABOVE, RAISE = 0.01, 0.02
"""Distances by which the oracle's tool tip stops above the wire, and lifts it, m."""
SHARP = 0.002
"""Distance of the entry or the exit from its mark over which its reward falls to a third, m."""
GENTLE = 2.0
"""Force on the tissue that costs nothing, N."""
TURN = np.radians(8.0)
"""Angle by which the oracle turns the needle at a time."""
GENEROUS, CALM, PRESSED = 0.002, 0.1, 0.0015
"""Where the tolerance is smaller than the first, m, the oracle waits for so long before each turn up to the entry, s,
and presses the tip straight down by the last, m."""


class DriveLevel(NamedTuple):
    """A level of difficulty."""

    edges: int
    """Edges of the wound that the needle goes through."""
    tolerance: float
    """Greatest distance of entry and exit from their marks, m."""
    out: float
    """Least length of the needle past the exit, m."""
    picks: bool
    """True if the needle has to be picked up first."""


class Best(NamedTuple):
    """The best of an episode so far, [] float32 each."""

    reach: Array
    """Least distance of the tool from the needle, m."""
    grasp: Array
    """1 once it was held."""
    lift: Array
    """Greatest height to which it was lifted, from 0 to 1 at `LIFT`."""
    align: Array
    """Least distance from how it should enter, while it was held, m; below 0 before the start."""
    entry: Array
    """Best `exp(-error / SHARP)` of where the tip went in."""
    exit: Array
    """Likewise, of where it came out."""
    travel: Array
    """Greatest share of the way."""


class DriveGoal(NamedTuple):
    """The goal of an episode, and the progress towards it."""

    row: Array
    """Row of the tables."""
    best: Best


class Now(NamedTuple):
    """Measurements in a world, [] each."""

    reach: Array
    """Distance of the tool tip from the needle's nearest bar, m."""
    held: Array
    """True if the arm holds it."""
    lift: Array
    """Its height, from 0 to 1 at `LIFT`."""
    align: Array
    """Largest distance of its tip, middle and tail from where they should be as it enters, m."""
    entry: Array
    """Distance of where it went in from the mark, at rest; before that of its tip from there, m."""
    exit: Array
    """Likewise, of where it came out."""
    entered: Array
    """True if it is in tissue."""
    edge: Array
    """True if it has come out of the edge that it entered."""
    came: Array
    """True if it has come out of any edge."""
    came_out: Array
    """True if it has come out within the tolerance of the exit's mark."""
    depth: Array
    """Of the bite, m."""
    inside: Array
    """Length of needle past the entry, m."""
    out: Array
    """Length of needle past the exit, m."""
    dropped: Array
    """True if it was lifted, and now neither finger nor tissue holds it, or if it is lost."""


class Task(Base):
    """Driving a needle through tissue."""

    levels = {  # noqa: RUF012
        "easy": DriveLevel(1, 0.004, 0.001, False),
        "default": DriveLevel(2, 0.0025, 0.003, False),
        "hard": DriveLevel(2, 0.001, 0.003, True),
    }
    weights = {  # noqa: RUF012
        "reach": 20.0, "grasp": 2.0, "lift": 2.0, "align": 40.0, "entry": 4.0, "exit": 4.0, "travel": 10.0,
        "success": 0.5, "force": -0.1, "drop": -2.0, "clearance": -1.0, "collision": -2.0,
    }  # fmt: skip
    default_scene = "psm_suture"
    scenes: ClassVar[tuple[str, ...]] = ("psm_suture", "bimanual_psm_suture")
    stages: ClassVar[tuple[str, ...]] = ("at_entry", "entered", "first_edge", "exited", "driven")
    wanted = {"success_rate": ("at least", 0.95), "drop_rate": ("below", 0.02)}  # noqa: RUF012
    lean: ClassVar[float] = LEAN
    """Angle by which the axis of the needle's turn points down, rad."""
    beyond: ClassVar[float] = BEYOND
    """Angle by which the needle is turned on past the exit, rad."""

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        self.max_steps = 500 if self.level.picks else 300
        self.object = find_object(scene, label(options.task), ("tip", "tail"), self.scenes)
        self.tissue, self._system = self._find_tissue(scene, options)
        self.driver = self._find_driver(scene, options)
        self._number = list(scene.free_objects).index(self.object)
        self._item = scene.objects[self.object].object
        names = [needle.body for needle in self._system.needles]
        self._mine = names.index(self.object)
        self.needle = self._system.needles[self._mine]
        """The needle's centre line."""
        sites, middles = self._item.sites, bars(self._item)[0]
        self._middles = middles.astype(np.float32)
        self._three = np.stack([sites["tip"][0], middles[len(middles) // 2], sites["tail"][0]]).astype(np.float32)
        self.wound = Wound.seen_from(self._system, scene.mounts[self.driver].position, self.lean)
        self._set_tables(self._drawn(scene))

    def _drawn(self, scene: Scene) -> Starts:
        """Return the starts, which are kept on disk."""
        about = repr((self.object, self.driver, self.level, self.seed, self._system))
        return Starts.of(
            cached("needle_drive", lambda: self._draw(scene), about, scene.fingerprint, self._item.content)
        )

    def _draw(self, scene: Scene, **more: Any) -> np.ndarray:
        """Return starts, a table for `Starts.of`; `more` as of `draw_starts`."""
        level = self.level.edges, self.level.picks
        return draw_starts(
            scene, self.driver, self.object, self.needle, self.wound, ROWS, self.seed, *level, self.beyond, **more
        )

    def _find_tissue(self, scene: Scene, options: Options) -> tuple[str, Any]:
        """Return the name of the first tissue that needles go through, and the tissue; ValueError if there is none."""
        for name, system in scene.systems.items():
            if getattr(system, "channel", None) and system.needles and not np.all(system.present):
                return name, system
        raise ValueError(
            f"{label(options.task)} needs a scene with a wound: tissue with a slit and `channels`; {scene.name!r} has "
            f"none (choose from {', '.join(self.scenes or ())}, or a file)"
        )

    def _find_driver(self, scene: Scene, options: Options) -> str:
        """Return the first arm whose jaw has pads; ValueError if there is none."""
        if not scene.holders:
            raise ValueError(f"{label(options.task)} needs an arm whose jaw has pads; {scene.name!r} has none")
        return scene.holders[0]

    @property
    def constants(self) -> tuple[Any, ...]:
        """The level, the arm that drives, the needle and the tissue."""
        return self.level, self.driver, self.object, self.tissue

    def _set_tables(self, drawn: Starts) -> None:
        self.entries, self.held = (frames(pose[:, :3], pose[:, 3:]) for pose in (drawn.entry, drawn.held))
        """Poses of the needle as it enters, and of the tool in the needle's frame, [rows, 4, 4]."""
        self.sweep = drawn.sweep
        """Angle of the needle's turn from the entry to the exit, rad, [rows]."""

        def places(poses: np.ndarray) -> np.ndarray:
            return np.asarray(self._three @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3])

        self.tables |= {
            "starts": drawn.needle,
            "lowest": places(frames(drawn.needle[:, :3], drawn.needle[:, 3:]))[..., 2].min(1),
            "marks": drawn.marks,
            "travel": self.sweep / self.needle.bend + self.level.out,
            "enters": places(self.entries),
            "postures": self.scene.full_qpos({self.driver: drawn.posture}),
        }

    def start(self, key: Array) -> Start:
        """Return where arm and needle begin, and the marks."""
        row = jax.random.randint(key, (), 0, ROWS)
        place, lies = self.tables["starts"][row], jnp.float32(0.0 if self.level.picks else 1.0)
        zero = jnp.float32(0.0)
        best = Best(jnp.float32(np.inf), lies, lies, jnp.float32(-1.0), zero, zero, zero)
        return Start(DriveGoal(row, best), self.tables["postures"][row], {self.object: Pose(place[:3], place[3:])})

    # -- what is measured

    def arc(self, world: World) -> Any:
        """Return the needle's centre line (`surgical_marl.physics.systems.needle.Arc`)."""
        body = world.objects[self.object]
        return self.needle.at(body.position, body.rotation, body.size)

    def mark(self, world: World, number: int) -> Array:
        """Return where the entry, 0, or the exit, 1, is as the tissue is now, in the world, m, [3]."""
        material = self._system.channels.material
        rest = self.tables["marks"][world.goal.row][number]
        found: Array = material.place(world.systems[self.tissue].position, rest / material.cell)
        return found

    def now(self, world: World) -> Now:
        """Return the measurements in a world."""
        body, view, row = world.objects[self.object], world.systems[self.tissue], world.goal.row
        arm, channels = world.arms[self.driver], view.channels
        arc = self.arc(world)

        def place(points: np.ndarray) -> Array:
            return body.position + body.size * points @ body.rotation.T

        def length(way: Array) -> Array:
            return jnp.sqrt(jnp.sum(way * way, -1))

        rest = self.tables["marks"][row]
        mine, in_tissue = self.bites(channels), channels.there & (channels.needle == self._mine)
        ends = mine & channels.through
        off_in = jnp.where(mine, length(channels.entry_at_rest - rest[0]), FAR)
        off_out = jnp.where(ends, length(channels.exit_at_rest - rest[1]), FAR)
        first, last = jnp.argmin(off_in), jnp.argmin(off_out)
        entered, came = mine.any(), ends.any()
        inside = jnp.where(entered, jnp.clip(arc.nearest(channels.entry[first]), 0.0, arc.length), 0.0)
        came_out = came & (off_out[last] < self.level.tolerance)
        out = jnp.where(came_out, jnp.clip(arc.nearest(channels.exit[last]), 0.0, arc.length), 0.0)
        handled = arm.handles[self.object]
        touched = jnp.stack([view.handles[self.object].force > 0 for view in world.arms.values()]).any()
        lowest = jnp.min(place(self._three)[:, 2]) - self.tables["lowest"][row]
        dropped = ((world.goal.best.lift >= 1.0) & ~touched & ~in_tissue.any()) | ~(lowest >= -self._deepest)
        tool = self.scene.mounts[self.driver]
        tip = arm.tool_tip @ tool.rotation.T.astype(np.float32) + tool.position.astype(np.float32)
        return Now(
            reach=known(jnp.min(length(place(self._middles) - tip))),
            held=handled.holding,
            lift=jnp.clip(lowest / LIFT, 0.0, 1.0),
            align=known(jnp.max(length(place(self._three) - self.tables["enters"][row]))),
            entry=known(jnp.where(entered, off_in[first], length(arc.tip - self.mark(world, 0)))),
            exit=known(jnp.where(came, off_out[last], length(arc.tip - self.mark(world, 1)))),
            entered=entered,
            edge=mine[first] & channels.through[first],
            came=came,
            came_out=came_out,
            depth=jnp.max(jnp.where(mine, channels.depth, 0.0)),
            inside=inside,
            out=out,
            dropped=dropped,
        )

    def bites(self, channels: ChannelView) -> Array:
        """Return which channels count as bites of the needle, [c] bool: those that it is in."""
        return channels.there & (channels.needle == self._mine)

    @property
    def _deepest(self) -> float:
        """Distance below its start that the needle may come, m."""
        return LOST if self.level.picks else 0.08

    def better(self, best: Best, now: Now) -> Best:
        """Return the best so far, with the measurements of this step."""
        good = now.entered & (now.entry < self.level.tolerance)

        def quality(there: Array, off: Array) -> Array:
            return jnp.where(there, jnp.exp(-off / SHARP), 0.0)

        aligned = jnp.where(now.held & ~now.entered, jnp.minimum(now.align, best.align), best.align)
        return Best(
            jnp.minimum(best.reach, now.reach),
            jnp.maximum(best.grasp, as_float(now.held)),
            jnp.where(now.held, jnp.maximum(best.lift, now.lift), best.lift),
            jnp.where(best.align < 0, now.align, aligned),
            jnp.maximum(best.entry, quality(now.entered, now.entry)),
            jnp.maximum(best.exit, quality(now.came, now.exit)),
            jnp.where(good, jnp.maximum(best.travel, now.inside), best.travel),
        )

    def remember(self, world: World) -> Any:
        """Return the goal with the best so far."""
        return world.goal._replace(best=self.better(world.goal.best, self.now(world)))

    def at_end(self, now: Now) -> Array:
        """Return whether the needle is through, as it should be."""
        return (now.entry < self.level.tolerance) & now.entered & now.came_out & (now.out >= self.level.out)

    # -- what agents get

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the terms of every task, and the team's terms, which each agent gets."""
        now, best, safety = self.now(world), world.goal.best, super().reward_terms(world)
        new = self.better(best, now)
        whole = self.tables["travel"][world.goal.row]
        force = world.systems[self.tissue].tissue_force
        team = {
            "reach": best.reach - new.reach,
            "grasp": new.grasp - best.grasp,
            "lift": new.lift - best.lift,
            "align": best.align - new.align,
            "entry": new.entry - best.entry,
            "exit": new.exit - best.exit,
            "travel": (jnp.minimum(new.travel, whole) - jnp.minimum(best.travel, whole)) / whole,
            "success": as_float(self.at_end(now)),
            "force": jnp.clip(force - GENTLE, 0.0, 10.0),
            "drop": as_float(now.dropped),
        }
        return {agent: {**team, **safety[agent]} for agent in world.arms}

    def success(self, world: World) -> dict[str, Array]:
        """Return whether the needle is through, for all agents."""
        return dict.fromkeys(world.arms, self.at_end(self.now(world)))

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return which stages are reached now, for all arms."""
        now = self.now(world)
        good = now.entered & (now.entry < self.level.tolerance)
        found = {
            "at_entry": good | (now.held & (now.entry < self.level.tolerance)),
            "entered": good,
            "first_edge": good & now.edge,
            "exited": good & now.came_out,
            "driven": self.at_end(now),
        }
        return dict.fromkeys(world.arms, found)

    def metrics(self, world: World) -> dict[str, dict[str, Array]]:
        """Return `entry_error`, `exit_error`, `bite_depth` and `swept`, m, and `drop`."""
        now, channels = self.now(world), world.systems[self.tissue].channels
        mine = self.bites(channels)
        found = {
            "entry_error": now.entry,
            "exit_error": now.exit,
            "bite_depth": now.depth,
            "swept": jnp.max(jnp.where(mine, channels.swept, 0.0)),
            "drop": now.dropped,
        }
        return dict.fromkeys(world.arms, found)

    def terminated(self, world: World) -> Array:
        """Return whether the needle has been dropped or lost."""
        return self.now(world).dropped

    # -- what agents observe

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return the terms of every task, and those of the drive in the base frame.

        `to_object` [3] from the tool tip to the needle's nearest bar; `needle_tip` [3]; `entry` [3] and `exit` [3] as
        the tissue moves, `to_entry` [3] and `to_exit` [3] from the needle's tip; `entry_axes` [6], the first two
        columns of how the needle should be turned as it enters; `through` [5]: the length of needle past the entry and
        past the exit, m, whether it is in tissue, has come out of the first edge, and near the exit's mark.
        """
        mount = self.scene.mounts[agent]
        turn, origin = mount.rotation.astype(np.float32), mount.position.astype(np.float32)

        def local(point: Array) -> Array:
            return (point - origin) @ turn

        def to_object(world: World) -> Array:
            body = world.objects[self.object]
            away = local(body.position + body.size * self._middles @ body.rotation.T) - world.arms[agent].tool_tip
            return away[jnp.argmin(jnp.sum(away * away, -1))]

        def mark(number: int, way: bool) -> Any:
            def read(world: World) -> Array:
                place = self.mark(world, number)
                return (place - self.arc(world).tip) @ turn if way else local(place)

            return read

        def entry_axes(world: World) -> Array:
            tip, middle, tail = self.tables["enters"][world.goal.row]
            chord = (tail - tip) / jnp.sqrt(jnp.sum((tail - tip) ** 2))
            rise = middle - tip
            rise -= (rise @ chord) * chord
            return jnp.concatenate([chord @ turn, rise / jnp.sqrt(jnp.sum(rise * rise)) @ turn])

        def through(world: World) -> Array:
            now = self.now(world)
            flags = [as_float(flag) for flag in (now.entered, now.edge, now.came_out)]
            return jnp.stack([now.inside, now.out, *flags])

        far, reach, length = np.full(3, FAR), mount.arm.reach, self.needle.length
        return {
            **super().terms(agent),
            "to_object": Term(to_object, -far, far, "object"),
            "needle_tip": Term(lambda world: local(self.arc(world).tip), *reach, "object"),
            "entry": Term(mark(0, False), *reach, "team_goal"),
            "exit": Term(mark(1, False), *reach, "team_goal"),
            "to_entry": Term(mark(0, True), -far, far, "team_goal"),
            "to_exit": Term(mark(1, True), -far, far, "team_goal"),
            "entry_axes": Term(entry_axes, -np.ones(6), np.ones(6), "team_goal"),
            "through": Term(through, np.zeros(5), np.array([length, length, 1.0, 1.0, 1.0]), "object"),
        }

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the terms of the agent itself, of the needle and of the drive, then those of the other arms."""
        own = super().observes(agent)
        seen = tuple(f"{self.object}_{part}" for part in PARTS)
        drive = ("to_object", "needle_tip", "to_entry", "to_exit", "entry_axes", "through")
        return (*own[:4], "contact_force", *seen, *drive, *own[4:])

    @property
    def informed(self) -> str:
        """The arm that drives."""
        return self.driver

    def marks(self, goal: Any) -> np.ndarray:
        """Return both marks where the tissue is at rest, [N, 2, 3]."""
        return self.wound.in_world(np.asarray(self.tables["marks"], float)[goal.row])

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return where the needle begins, and the marks."""
        return [np.asarray(self.tables[name], float)[goal.row] for name in ("starts", "marks")]

    # -- the oracle

    def script(self) -> tuple[Step, ...]:
        """Return how the arm does it: to the entry along the needle's arc, then on along it."""
        agent, needle = self.driver, self.needle

        def turn(seen: Snapshot, angle: float | None, lower: float = 0.0) -> dict[str, Wish]:
            row = seen.goal.row
            angles = self.sweep[row] + self.beyond
            angles = angles if angle is None else np.minimum(angle, angles)
            held = np.linalg.inv(seen.objects[self.object]) @ seen.tools[agent]
            return {agent: Wish(moved(driven(needle, self.entries[row], angles) @ held, [0.0, 0.0, -lower]))}

        def grip(seen: Snapshot, beyond: float) -> dict[str, Wish]:
            tool = seen.objects[self.object] @ self.held[seen.goal.row]
            return {agent: Wish(moved(tool, beyond * tool[:, :3, 2]), opens=True)}

        def holds(seen: Snapshot) -> np.ndarray:
            return seen.held[agent][:, self._number]

        picks = (
            Step(lambda seen: grip(seen, -ABOVE)),
            Step(lambda seen: grip(seen, 0.0), wait=EARLY, pace=0.3),
            Step(lambda seen: {agent: Wish()}, wait=0.4, pace=0.3, good=holds),
            Step(
                lambda seen: {agent: Wish(moved(seen.tools[agent], [0.0, 0.0, RAISE]))}, wait=0.1, pace=0.3, good=holds
            ),
        )
        most = float(self.sweep.max()) + self.beyond
        angles = np.arange(-BEFORE, most, TURN)
        drives = [Step(partial(turn, angle=float(angle)), pace=0.4) for angle in angles[1:]]
        if self.level.tolerance < GENEROUS:  # along the arc a tip slides over tissue by up to 1.7 mm before it enters
            before = [step._replace(wait=CALM) for step, angle in zip(drives, angles[1:], strict=True) if angle < 0]
            press = Step(partial(turn, angle=0.0, lower=PRESSED), wait=CALM, pace=0.2)
            drives = [*before, press, *drives[len(before) :]]
        return (
            *(picks if self.level.picks else (Step(lambda seen: {agent: Wish()}, wait=0.2),)),
            Step(lambda seen: turn(seen, -BEFORE), wait=0.2, pace=0.5),
            *drives,
            Step(lambda seen: turn(seen, None), wait=0.1, pace=0.4),
        )
