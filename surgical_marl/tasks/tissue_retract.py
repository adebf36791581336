"""Tissue retraction: one arm pinches a flap of tissue and folds it back, and another one touches the lesion under it.

The first arm holds the flap by friction alone, and has to hold it until the second one is done.

Agents        the arms of the scene. The first one with a jaw retracts the flap, the second such one touches the lesion.
Observation   joint positions and velocities, tool tip, position targets, contact force; of the flap eight places, five
              along its free edge and three along its middle; the way from the tool tip to the place of the edge beside
              the lesion; whether the flap is pinched, the room, and the force on the tissue; the lesion, the way there;
              the way to the nearest tip, and the least distance between the arms. Base frame, SI units.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        the same for all arms, but for `clearance` and `collision`; weights in brackets. Progress over the best of
              the episode so far: `reach`, first tool to the edge (20 / m); `pinch`, first hold, half of it for an edge
              between the fingers (2); `lift`, the angle by which the pinched edge is turned up about the side at which
              the flap hangs (2 / rad). Changes of a potential, which are lost again with the hold: `clear`, from 0 to
              1 as the flap is 8 mm off the straight line from the target to where the second arm comes in, its remote
              center, while it is pinched (4); `touch`, that times by how much the second tool is nearer to the target
              than 100 mm (40 / m). Of each step: `precision`, while the way is clear, 1 at the target and a third at 5
              mm (0.1); `success` (0.5), `overload`, more than 8 N on tissue (-0.1), `collision` (-2), `clearance` (0).
Success       for 0.2 s the flap is pinched, the second tool's way is clear, its tip is within 2 mm of the target on the
              lesion's upper face, and no shape presses on tissue by more than 8 N. The way leads straight from the
              target to the second tool's wrist, and from there along its shaft. It is clear where the room, the least
              distance of the flap from it, is more than 8 mm: then neither that tool nor its shaft bears the flap.
Termination   when the tissue is torn; an episode is truncated after 300 control steps (6 s).
Randomisation the target is anywhere in a part of the lesion's upper face, and joints begin off their home; kept only if
              the arms can do it, off their joints' limits, and are apart at the start.
Difficulty    half the size of that part, and how far joints are off: easy 4 x 1.5 mm and not at all, default 10 x 3 mm
              and up to 0.1 rad or 10 mm, hard 14 x 4.5 mm and twice that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.plugins.task_file import label
from surgical_marl.runtime import jax, jnp
from surgical_marl.scenes.tissue_file import OVERLOAD
from surgical_marl.tasks.base.grasp_poses import joints_at, moved, tool_of, tool_poses
from surgical_marl.tasks.base.object_task import NEAR, as_float, known
from surgical_marl.tasks.base.oracle_script import EARLY, Snapshot, Step, Wish
from surgical_marl.tasks.base.task import PRECISION, Start
from surgical_marl.tasks.base.task import Task as BaseTask
from surgical_marl.tasks.base.terms import STRONGEST, Picture, Term
from surgical_marl.tasks.base.workspace import CLEARANCE, SHIFTED, TURNED, about_home, choose

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.physics.systems.tissue import Tissue
    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.options import Options
    from surgical_marl.tasks.base.world import World

ROWS = 2048
CLEAR = 0.008
"""The way to the lesion is clear where the flap is further from it than this, m: a shaft has a radius of 4 mm, and a
flap that hangs is nearer than this to any tool that slips in under it."""
TOUCH = 0.002
"""The second tool touches the lesion where its tip is nearer to it than this, m."""
HOLD, SHORT = 0.2, 0.005
"""Time for which it has to, s, and by how much less it may be, as single steps are added up."""
FELT = 0.3
"""Least force on tissue that is pinched, N."""
BETWEEN = np.array([[-0.005, -0.004, -0.010], [0.005, 0.004, 0.001]])
"""Box in the tool's frame in which a place of the edge is between the fingers, m: a jaw that closes and folds it
back moves it to a side and towards the tip."""
LIFTED = 0.3
"""Angle about its side by which the edge is turned up once it is lifted, rad."""
HIGHEST = 2.4
"""Angle about its side by which the edge is turned up at most, rad: further counts as this."""
WRIST = 0.0102
"""Distance of the tool tip from the wrist, m."""
BESIDE = 0.010
"""Distance from the lesion along the edge at which the flap is pinched, towards the second arm, m: the tool of that
one leans to its own side, over this part of the flap."""
SAG = 0.0065
"""Distance by which the edge hangs below where it is without weight, m: to find out what arms can reach."""
LEAN, DEEP, BEFORE = np.radians(55.0), 0.003, 0.012
"""Angle between the vertical and the tool that pinches the edge; how far its tip goes past the edge, and how far before
it it waits, m. Deeper in a closed jaw presses harder."""
FOLD, TURN = np.radians(4 * [35.0]), 0.3
"""Angles by which the oracle folds the flap in each of its steps, and the share of them by which it turns the tool."""
BACK, WAITS, TOP = 0.025, 0.07, 0.0005
"""Distances from the lesion, along its way, at which the second tool comes in, waits, and ends, m."""
MARKS = 8
"""Places of the flap that agents observe."""
WIDE = 0.1
"""Bound of the observed room, m."""
FAR = 0.1
"""Distance of the second tool from the lesion at which `touch` begins to be rewarded, m."""
OPPOSITE = {"left": "right", "right": "left", "front": "back", "back": "front"}
"""Sides of tissue, and those across from them."""


class RetractLevel(NamedTuple):
    """A level of difficulty."""

    extent: tuple[float, float]
    """Half the size of the part in which the lesion is, along the edge and across it, m."""
    off: float
    """Distance of joints from home at the start, in units of `TURNED` and `SHIFTED`."""


class Progress(NamedTuple):
    """Progress of an episode: the best so far of the first three, and of the others how it is now; [] float32 each."""

    reach: Array
    """Least distance of the first tool from the edge, m; below 0 before the start."""
    pinch: Array
    """1 once the flap was pinched, 0.5 once its edge was between the fingers, before that 0."""
    lift: Array
    """Largest angle by which the pinched edge was turned up, rad; `HIGHEST` at most."""
    clear: Array
    """How far a pinched flap is off the second arm's line, from 0 to 1 at `CLEAR`."""
    touch: Array
    """By how much the second tool is nearer to the lesion than `FAR`, m, times `clear`."""


class RetractGoal(NamedTuple):
    """The goal of an episode, and the progress towards it."""

    row: Array
    """Row of the tables."""
    progress: Progress
    touched: Array
    """Time for which the lesion has been touched now, s."""
    pinched: Array
    """1 if the flap is pinched now, otherwise 0."""
    edge: Array
    """The place of the edge beside the lesion, world, m, [3]."""


class Now(NamedTuple):
    """Measurements in a world, [] each."""

    reach: Array
    """Distance of the first tool from the place of the edge beside the lesion, m."""
    between: Array
    """True if a place of the edge is between the fingers of the first tool."""
    pinched: Array
    """True if it is, and something presses on the tissue."""
    lift: Array
    """Angle of the place of the edge that is nearest to the first tool, about the side at which the flap hangs, rad: 0
    where it hangs in the plane of that side, positive above."""
    room: Array
    """Least distance of the flap from the second tool's way, m."""
    beside: Array
    """Least distance of the flap from the straight line from the lesion to the second arm's remote center, m: the way
    that it will have, wherever its tool is now."""
    away: Array
    """Distance of the second tool's tip from the lesion, m."""
    force: Array
    """On the tissue, N."""
    edge: Array
    """The place of the edge beside the lesion, world, m, [3]."""

    @property
    def clear(self) -> Array:
        """True if the flap is pinched, and out of the second tool's way."""
        return self.pinched & (self.room > CLEAR)

    @property
    def touching(self) -> Array:
        """True if the second tool touches the lesion in a clear way, and no more force is on the tissue than may be."""
        return self.clear & (self.away < TOUCH) & (self.force < OVERLOAD)


class Task(BaseTask):
    """Retracting a flap and touching what is under it."""

    levels = {  # noqa: RUF012
        "easy": RetractLevel((0.004, 0.0015), 0.0),
        "default": RetractLevel((0.010, 0.003), 1.0),
        "hard": RetractLevel((0.014, 0.0045), 2.0),
    }
    weights = {  # noqa: RUF012
        "reach": 20.0, "pinch": 2.0, "lift": 2.0, "clear": 4.0, "touch": 40.0, "precision": 0.1, "success": 0.5,
        "overload": -0.1, "clearance": 0.0, "collision": -2.0,
    }  # fmt: skip
    default_scene = "bimanual_psm_tissue"
    scenes = ("bimanual_psm_tissue",)
    max_steps = 300
    stages = ("reached", "pinched", "lifted", "cleared", "touched", "at_goal")
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
        """The arm that retracts the flap, and the one that touches the lesion."""
        self.flap = Flap(scene, self.first, self.second, options.task)
        self._middle = find_lesion(scene, options.task)
        drawn = repr((self.level, self.seed, ROWS, TURNED, SHIFTED, BESIDE, self._middle.tolist()))
        flap = repr(scene.systems[self.flap.name])
        table = cached("tissue_retract", self._draw, drawn, flap, scene.fingerprint)
        points, grips, postures = np.split(table, [3, 4], 1)
        self.tables |= {"points": points, "grips": grips[:, 0].astype(int), "starts": postures}

    @property
    def constants(self) -> tuple[Any, ...]:
        """The arms that retract and touch."""
        return self.first, self.second

    def start(self, key: Array) -> Start:
        """Return where the lesion is, and the postures."""
        row, zero = jax.random.randint(key, (), 0, ROWS), jnp.float32(0.0)
        none = Progress(jnp.float32(-1.0), zero, zero, zero, zero)
        goal = RetractGoal(row, none, zero, zero, jnp.zeros(3, jnp.float32))
        return Start(goal, self.tables["starts"][row])

    # -- what is measured

    def now(self, world: World) -> Now:
        """Return the measurements in a world."""
        seen, flap = world.systems[self.flap.name], self.flap
        edge = flap.edge_of(seen.position)
        point, grip = self.tables["points"][world.goal.row], self.tables["grips"][world.goal.row]
        tip, axes = self._tool(world, self.first)
        ways = edge - tip
        own = ways @ axes
        between = ((own > BETWEEN[0]) & (own < BETWEEN[1])).all(-1).any()
        nearest = edge[jnp.argmin(jnp.sum(ways * ways, -1))] - flap.hinge
        other, others = self._tool(world, self.second)
        wrist = other - np.float32(WRIST) * others[:, 2]
        center = _f32(self.scene.mounts[self.second].position)
        room = jnp.minimum(_gap(seen.position, point, wrist), _gap(seen.position, wrist, center))
        return Now(
            known(_length(ways[grip])),
            between,
            between & (seen.tissue_force > FELT),
            jnp.arctan2(nearest[2], nearest @ flap.outward),
            known(room),
            known(_gap(seen.position, point, center)),
            known(_length(other - point)),
            seen.tissue_force,
            edge[grip],
        )

    def _tool(self, world: World, agent: str) -> tuple[Any, Any]:
        """Return the place, m, [3], and the axes, [3, 3], of an arm's tool tip in the world."""
        mount, view = self.scene.mounts[agent], world.arms[agent]
        turn = _f32(mount.rotation)
        return turn @ view.tool_tip + _f32(mount.position), turn @ view.tool_axes

    def after(self, progress: Progress, now: Now) -> Progress:
        """Return the progress with the measurements of this step."""
        lift = jnp.clip(now.lift, 0.0, HIGHEST)
        clear = jnp.where(now.pinched & (now.lift > 0), jnp.clip(now.beside / CLEAR, 0.0, 1.0), 0.0)
        return Progress(
            jnp.where(progress.reach < 0, now.reach, jnp.minimum(progress.reach, now.reach)),
            jnp.maximum(progress.pinch, (as_float(now.between) + as_float(now.pinched)) / 2),
            jnp.where(now.pinched, jnp.maximum(progress.lift, lift), progress.lift),
            clear,
            clear * jnp.maximum(FAR - now.away, 0.0),
        )

    def advance(self, goal: Any, dt: float) -> Any:
        """Return the goal `dt` seconds later, as if the lesion were touched."""
        return goal._replace(touched=goal.touched + np.float32(dt))

    def remember(self, world: World) -> Any:
        """Return the goal with the progress, and how things are now."""
        now, goal = self.now(world), world.goal
        touched = jnp.where(now.touching, goal.touched, 0.0)
        return RetractGoal(goal.row, self.after(goal.progress, now), touched, as_float(now.pinched), now.edge)

    # -- what agents get

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the terms of every task, and the team's terms, which each agent gets.

        Progress over the best of the episode so far: `reach` (m), `pinch` (1 in all) and `lift` (rad). Changes of
        `clear` (1 at `CLEAR`) and `touch` (m), below 0 where the flap is let go or the tool draws back. Of each step:
        `precision`, from 0 to 1, `success` and `overload`, 0 or 1 each.
        """
        now, old, safety = self.now(world), world.goal.progress, super().reward_terms(world)
        new = self.after(old, now)
        team = {
            "reach": old.reach - new.reach,
            "pinch": new.pinch - old.pinch,
            "lift": new.lift - old.lift,
            "clear": new.clear - old.clear,
            "touch": new.touch - old.touch,
            "precision": jnp.where(now.clear, jnp.exp(-now.away / PRECISION), 0.0),
            "success": as_float(self._done(world, now)),
            "overload": as_float(now.force > OVERLOAD),
        }
        return {agent: {**team, **safety[agent]} for agent in world.arms}

    def _done(self, world: World, now: Now) -> Array:
        """Return whether the lesion has been touched for long enough."""
        return now.touching & (world.goal.touched > HOLD - SHORT)

    def success(self, world: World) -> dict[str, Array]:
        """Return whether the lesion has been touched for long enough, for all agents."""
        return dict.fromkeys(world.arms, self._done(world, self.now(world)))

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return which stages are reached now, for all agents."""
        now = self.now(world)
        found = {
            "reached": now.reach < NEAR,
            "pinched": now.pinched,
            "lifted": now.pinched & (now.lift > LIFTED),
            "cleared": now.clear,
            "touched": now.clear & (now.away < TOUCH),
            "at_goal": self._done(world, now),
        }
        return dict.fromkeys(world.arms, found)

    def metrics(self, world: World) -> dict[str, dict[str, Array]]:
        """Return `goal_error`, the distance of the second tool from the lesion, m, `room`, m, and `holding`."""
        now = self.now(world)
        found = {"goal_error": now.away, "room": now.room}
        return {agent: {**found, "holding": now.pinched & (agent == self.first)} for agent in world.arms}

    def terminated(self, world: World) -> Array:
        """Return whether the tissue is torn."""
        return world.systems[self.flap.name].torn

    # -- what agents observe

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return the terms of every task, and those of flap and lesion, in the arm's base frame.

        `<flap>_marks` [24], eight places of the flap; `to_edge` [3], from the tool tip to the place of the edge beside
        the lesion; `pinched` [1], `room` [1] and `tissue_force` [1]; `target` [3], the lesion, and `to_target` [3].
        """
        mount, name, flap = self.scene.mounts[agent], self.flap.name, self.flap
        turn, origin = _f32(mount.rotation), _f32(mount.position)

        def local(points: Array) -> Array:
            return (points - origin) @ turn

        def marks(world: World) -> Array:
            return local(flap.marks_of(world.systems[name].position)).ravel()

        def to_edge(world: World) -> Array:
            edge = flap.edge_of(world.systems[name].position)
            return local(edge[self.tables["grips"][world.goal.row]]) - world.arms[agent].tool_tip

        def target(world: World) -> Array:
            return local(self.tables["points"][world.goal.row])

        def single(of: str) -> Any:
            return lambda world: getattr(self.now(world), of).astype(jnp.float32)[None]

        reach, one = mount.arm.reach, np.ones(1)
        ways, low, high = reach.minus(reach), np.tile(reach.low, MARKS), np.tile(reach.high, MARKS)
        return {
            **super().terms(agent),
            f"{name}_marks": Term(marks, low, high, "object"),
            "to_edge": Term(to_edge, *ways, "team_goal"),  # both say where the lesion is
            "room": Term(single("room"), 0 * one, WIDE * one, "team_goal"),
            "pinched": Term(single("pinched"), 0 * one, one, "object"),
            "tissue_force": Term(single("force"), 0 * one, STRONGEST * one, "object"),
            "target": Term(target, *reach, "team_goal"),
            "to_target": Term(lambda world: target(world) - world.arms[agent].tool_tip, *ways, "team_goal"),
        }

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the terms of the agent itself, of the flap and of the lesion, then those of the other arms."""
        own = super().observes(agent)
        flap = f"{self.flap.name}_marks", "to_edge", "pinched", "room", "tissue_force"
        return (*own[:4], "contact_force", *flap, "target", "to_target", *own[4:])

    def marks(self, goal: Any) -> np.ndarray:
        """Return where the lesion is, [N, 1, 3]."""
        return np.asarray(self.tables["points"], float)[goal.row][:, None]

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return where the lesion is, and the postures at the start."""
        return [np.asarray(self.tables[name], float)[goal.row] for name in ("points", "starts")]

    # -- the oracle

    def script(self) -> tuple[Step, ...]:
        """Return how both arms do it: pinch the edge, fold the flap back, then touch the lesion."""
        first, second, flap = self.first, self.second, self.flap

        def pinch(seen: Snapshot, beyond: float) -> dict[str, Wish]:
            tools = flap.pinching(seen.goal.edge, beyond)
            return {first: Wish(tools, opens=1.0), second: Wish(self._touching(self._points(seen), WAITS))}

        def folded(seen: Snapshot, angle: float) -> dict[str, Wish]:
            return {first: Wish(flap.folded(seen.tools[first], angle))}

        def touch(seen: Snapshot, before: float) -> dict[str, Wish]:
            return {second: Wish(self._touching(self._points(seen), before))}

        def holds(seen: Snapshot) -> np.ndarray:
            return np.asarray(seen.goal.pinched) > 0

        def fold(angle: float) -> Step:
            return Step(lambda seen: folded(seen, angle), pace=0.4, good=holds)

        return (
            Step(lambda seen: pinch(seen, -BEFORE), wait=0.1),
            Step(lambda seen: pinch(seen, DEEP), wait=EARLY, pace=0.4),
            Step(lambda _: {first: Wish()}, wait=0.3, good=holds),
            *map(fold, FOLD),
            Step(lambda seen: touch(seen, BACK), wait=0.1, good=holds),
            Step(lambda seen: touch(seen, TOP), wait=0.1, pace=0.4, good=holds),
        )

    def _points(self, seen: Snapshot) -> np.ndarray:
        return np.asarray(self.tables["points"], float)[seen.goal.row]

    def _touching(self, points: np.ndarray, before: float) -> np.ndarray:
        """Return poses [n, 4, 4] of the second tool on its way to lesions at points [n, 3], `before` m from them."""
        mount = self.scene.mounts[self.second]
        pointing = points - mount.position
        pointing /= np.linalg.norm(pointing, axis=-1, keepdims=True)
        side = tool_of(mount, mount.arm.home)[:3, 0]
        side = side - np.sum(pointing * side, -1, keepdims=True) * pointing
        side /= np.linalg.norm(side, axis=-1, keepdims=True)
        return moved(tool_poses(points, side, pointing), -before * pointing)

    # -- where lesions and postures are drawn

    def _draw(self) -> np.ndarray:
        """Return lesions [ROWS, 3], the numbers of the edge's places to pinch, [ROWS, 1], and postures [ROWS, nq]."""
        rng, scene, flap = np.random.default_rng(self.seed), self.scene, self.flap
        first, second = scene.mounts[self.first], scene.mounts[self.second]

        def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
            shift = rng.uniform(-1.0, 1.0, (ROWS, 2)) * self.level.extent
            points = self._middle + shift @ np.stack([flap.along, flap.outward])
            grips = flap.beside(points)
            hangs = flap.edge_of(flap.rest)[grips] - [0.0, 0.0, SAG]
            tools = flap.pinching(hangs, DEEP)
            q, good = joints_at(first, flap.pinching(hangs, -BEFORE))
            for pose in (tools, *(tools := flap.folded(tools, angle) for angle in FOLD)):
                q, reached = joints_at(first, pose, q)
                good &= reached
            q, reached = joints_at(second, self._touching(points, WAITS))
            good &= reached & joints_at(second, self._touching(points, TOP), q)[1]
            starts = {agent: about_home(rng, mount.arm, self.level.off, ROWS) for agent, mount in scene.mounts.items()}
            good &= scene.clearance(starts) > CLEARANCE
            rows = np.concatenate([points, grips[:, None], scene.full_qpos(starts)], -1)
            return rows[good], np.zeros(good.sum(), bool)

        return choose(scene, batch, ROWS, 0.0)


class Flap:
    """The geometry of a flap that hangs on one side, and how an arm takes it at the other one.

    Args:
        scene: the arms and the flap, the scene's only tissue that is held at one side.
        first: the arm that takes it.
        second: another one.
        task: the name of the task, for the message.

    Raises:
        ValueError: the scene has no such tissue.
    """

    def __init__(self, scene: Scene, first: str, second: str, task: str) -> None:
        self.name, tissue = find_flap(scene, task)
        grid, side = tissue.grid, tissue.fixed[0]
        free = grid.side(OPPOSITE[side])
        axis = 1 if side in ("front", "back") else 0
        self.rest: np.ndarray = tissue.rest.astype(float)
        self._edge = _rows_along(grid.places, free, 1 - axis)
        lines = np.linspace(0, len(self._edge) - 1, 5).round().astype(int)
        middle = _rows_along(grid.places, grid.places[:, axis] == grid.cells[axis] // 2, 1 - axis)
        self._marks = np.concatenate([self._edge[lines], middle[lines[1:4]]])
        ends = self.rest[grid.side(side)]
        self.hinge = ends.mean(0).astype(np.float32)
        """Middle of the side at which it hangs, m, [3]."""
        out = (self.rest[free].mean(0) - ends.mean(0)) * [1.0, 1.0, 0.0]
        self.outward = (out / np.linalg.norm(out)).astype(np.float32)
        """Horizontal direction from there to the free edge, [3]."""
        across = np.cross(self.outward, [0.0, 0.0, 1.0])
        away = scene.mounts[second].position - scene.mounts[first].position
        self.along = (across if across @ away > 0 else -across).astype(np.float32)
        """Direction of the edge from the first arm to the second, [3]."""
        self._mount = scene.mounts[first]

    def edge_of(self, position: Any) -> Any:
        """Return the places of the free edge, midway between its faces, from those of all nodes, [e, 3], m."""
        return position[self._edge].mean(1)

    def marks_of(self, position: Any) -> Any:
        """Return the places that agents observe, [8, 3], m."""
        return position[self._marks].mean(1)

    def beside(self, points: np.ndarray) -> np.ndarray:
        """Return the numbers [n] of the edge's places that are `BESIDE` from lesions at points [n, 3]."""
        off = (points - self.hinge) @ self.along + BESIDE
        return np.abs((self.edge_of(self.rest) - self.hinge) @ self.along - off[:, None]).argmin(1)

    def pinching(self, edge: np.ndarray, beyond: float) -> np.ndarray:
        """Return poses [n, 4, 4] of a tool that takes the edge at places [n, 3], its tip `beyond` m past them."""
        pointing = np.sin(LEAN) * -self.outward.astype(float) + np.cos(LEAN) * np.array([0.0, 0.0, -1.0])
        turned = self.along @ tool_of(self._mount, self._mount.arm.home)[:3, 0] < 0
        along = -self.along.astype(float) if turned else self.along.astype(float)
        return tool_poses(np.asarray(edge, float), along, pointing, np.full(len(edge), beyond))

    def folded(self, tools: np.ndarray, angle: float) -> np.ndarray:
        """Return poses [n, 4, 4] of tools that hold the edge, after the flap is folded further by an angle, rad."""
        axis = np.cross(self.outward.astype(float), [0.0, 0.0, 1.0])
        found = tools.copy()
        found[:, :3, 3] = self.hinge + (tools[:, :3, 3] - self.hinge) @ turn_about(axis, angle).T
        found[:, :3, :3] = turn_about(axis, TURN * angle) @ tools[:, :3, :3]
        return found


def turn_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation matrix [3, 3] about a unit vector by an angle, rad."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def find_flap(scene: Scene, task: str) -> tuple[str, Tissue]:
    """Return the name and the tissue of the first flap of a scene: tissue that is held at one side.

    ValueError if there is none.
    """
    for name, system in scene.systems.items():
        if len(getattr(system, "fixed", ())) == 1 and system.fixed[0] in OPPOSITE:
            return name, system
    raise ValueError(
        f"{label(task)} needs a scene with tissue that is held at one of {', '.join(OPPOSITE)}; {scene.name!r} has "
        f"none (choose from {', '.join(Task.scenes)}, or a file)"
    )


def find_lesion(scene: Scene, task: str) -> np.ndarray:
    """Return the middle of the lesion's upper face, [3], m: the first site of this name.

    ValueError if there is none.
    """
    for place in scene.objects.values():
        if "lesion" in place.object.sites:
            return place.position + place.rotation @ place.object.sites["lesion"][0]
    raise ValueError(
        f"{label(task)} needs a scene with an object that has the site lesion; {scene.name!r} has none (choose from "
        f"{', '.join(Task.scenes)}, or a file)"
    )


def _rows_along(places: np.ndarray, chosen: np.ndarray, axis: int) -> np.ndarray:
    """Return the numbers of chosen nodes, those of a place along an axis of the grid together, [places, levels]."""
    numbers = np.flatnonzero(chosen)
    numbers = numbers[np.lexsort((places[numbers, 2], places[numbers, axis]))]
    return numbers.reshape(places[:, axis].max() + 1, -1)


def _f32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32)


def _length(way: Array) -> Array:
    return jnp.sqrt(jnp.sum(way * way))


def _gap(points: Any, start: Any, end: Any) -> Array:
    """Return the least distance of points [n, 3] from a straight line between two others, m, []."""
    way, off = end - start, points - start
    share = jnp.clip(off @ way / (way @ way + 1e-12), 0.0, 1.0)
    beside = off - share[:, None] * way
    return jnp.sqrt(jnp.min(jnp.sum(beside * beside, -1)))
