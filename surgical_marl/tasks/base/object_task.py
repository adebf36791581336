"""The base class of tasks in which arms bring an object to a goal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from surgical_marl.plugins.task_file import label
from surgical_marl.runtime import jnp
from surgical_marl.tasks.base.grasp_poses import bars, frames
from surgical_marl.tasks.base.object_terms import PARTS
from surgical_marl.tasks.base.task import PRECISION, Task
from surgical_marl.tasks.base.terms import Picture, Term

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.options import Options
    from surgical_marl.tasks.base.world import World

NEAR = 0.01
"""A tool nearer to a bar of the object than this has reached it, m."""
LIFT = 0.01
"""An object is lifted where all of its sites are this far above the lowest one at the start, m."""
LOST = 0.02
"""An object is lost this far below its start, m."""
FAR = 0.5
"""Greatest distance between a tool and an object, or an object and its goal, that is observed, m."""

UNKNOWN = 10.0
"""A distance or an angle that is not known, or larger than this, counts as this, m or rad."""


class Best(NamedTuple):
    """The best of an episode so far, [] float32 each."""

    reach: Array
    """Least distance of a tool from the object, m."""
    grasp: Array
    """1 once the object was held, before that 0."""
    lift: Array
    """Greatest height to which it was lifted, from 0 to 1 at `LIFT`."""
    carry: Array
    """Least distance of the object from its goal while it was held, m; below 0 before the start."""
    turn: Array
    """Least angle between the object and its goal while it was held, rad; below 0 before the start."""


class ObjectGoal(NamedTuple):
    """The goal of an episode, and the progress towards it."""

    row: Array
    """Row of the tables."""
    best: Best


class Now(NamedTuple):
    """Measurements of an object task in a world, [] each."""

    reach: dict[str, Array]
    """Distance of each tool tip from the object's nearest bar, m."""
    part: dict[str, Array]
    """Number of the bar that is nearest to each tool tip."""
    held: dict[str, Array]
    """True if each arm holds the object."""
    touched: dict[str, Array]
    """True if fingers of each arm touch it."""
    lift: Array
    """Height of the object, from 0 to 1 at `LIFT`."""
    error: Array
    """Distance of the object's point from the goal, m."""
    angle: Array
    """Angle by which the object is turned away from the goal, rad."""
    dropped: Array
    """True if the object was lifted before and no finger touches it now, or if it is lost."""


class ObjectTask(Task):
    """A task in which arms bring a point of a free object to a goal.

    A subclass draws `tables`, all in the world: `starts` [rows, 7], where the object begins, `points` [rows, 3], where
    the point should be, `turns` [rows, 3, 3], how the object should be turned, and `lowest` [rows], the height of its
    lowest site at the start.
    """

    weights: Mapping[str, float] = {
        "reach": 20.0, "grasp": 2.0, "lift": 2.0, "carry": 40.0, "turn": 2.0, "precision": 0.1, "success": 0.2,
        "drop": -2.0, "clearance": -1.0, "collision": -2.0,
    }  # fmt: skip
    tolerance: ClassVar[float] = 0.002
    """Greatest distance of the point from its goal that is a success, m."""
    angle: ClassVar[float] = np.radians(10.0)
    """Greatest angle between object and goal that is a success, where the goal has an orientation, rad."""
    hands: ClassVar[int] = 1
    """Arms with jaws that can hold something, in a scene of the task."""
    point: ClassVar[str] = "tip"
    """The object's site that is brought to the goal."""

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        self.object = find_object(scene, label(options.task), (self.point,), self.scenes or ())
        self.called = self.object
        """Beginning of the names of the observation terms about it."""
        holders = scene.holders
        if len(holders) != self.hands:
            raise ValueError(
                f"{label(options.task)} needs a scene with {self.hands} arm{'s' * (self.hands > 1)} "
                f"whose jaws have pads; {scene.name!r} has {len(holders)}{_such_as(self.scenes or ())}"
            )
        self.picker, self.presenter = holders[0], holders[-1]
        """The arm that picks the object up, and the one that brings it to the goal: the same if there is one."""
        self._number = list(scene.free_objects).index(self.object)
        item = scene.objects[self.object].object
        self._middles = bars(item)[0].astype(np.float32)
        self._point = item.sites[self.point][0].astype(np.float32)
        self._sites = np.array([place for place, _ in item.sites.values()], np.float32)
        self.oriented = bool(self.level.oriented)
        """True if the goal has an orientation."""

    @property
    def constants(self) -> tuple[Any, ...]:
        """True if the goal has an orientation, and the arms that pick and present."""
        return self.oriented, self.picker, self.presenter

    def _set_tables(self, starts: np.ndarray, goals: np.ndarray) -> None:
        """Set the tables from starts [rows, 7] and from poses [rows, 4, 4] of the object at its goals."""
        item = self.scene.objects[self.object].object
        sites, begin = np.array([place for place, _ in item.sites.values()]), frames(starts[:, :3], starts[:, 3:])
        self.goals = goals
        """Poses of the object at the goals of all rows."""
        self.tables |= {
            "starts": starts,
            "points": goals[:, :3, 3] + goals[:, :3, :3] @ item.sites[self.point][0],
            "turns": goals[:, :3, :3],
            "lowest": (begin[:, None, 2, 3] + np.einsum("nj,sj->ns", begin[:, 2, :3], sites)).min(1),
        }

    # -- what is measured

    def at_hand(self, world: World) -> World:
        """Return the world in which the object to be moved now has the name `self.object`.

        It is the same world, unless a task moves several objects alike, one after the other.
        """
        return world

    def now(self, world: World) -> Now:
        """Return the measurements in a world."""
        world = self.at_hand(world)
        body, goal = world.objects[self.object], world.goal

        def place(points: np.ndarray) -> Array:
            return body.position + body.size * points @ body.rotation.T

        reach, part, held, touched = {}, {}, {}, {}
        for agent, view in world.arms.items():
            mount, handled = self.scene.mounts[agent], view.handles[self.object]
            tip = view.tool_tip @ mount.rotation.T.astype(np.float32) + mount.position.astype(np.float32)
            away = place(self._middles) - tip
            square = jnp.sum(away * away, -1)
            reach[agent], part[agent] = known(jnp.sqrt(jnp.min(square))), jnp.argmin(square)
            held[agent], touched[agent] = handled.holding, handled.force > 0
        lowest = jnp.min(place(self._sites)[:, 2]) - self.tables["lowest"][goal.row]
        off = place(self._point) - self.tables["points"][goal.row]
        chord = body.rotation - self.tables["turns"][goal.row]
        half = jnp.sqrt(jnp.sum(chord * chord)) / np.float32(np.sqrt(8))  # of rotations: sine of half the angle
        dropped = ((goal.best.lift >= 1.0) & ~_any(touched)) | ~(lowest >= -LOST)  # lost, too, if it is not a number
        error, angle = known(jnp.sqrt(jnp.sum(off * off))), known(2 * jnp.arcsin(jnp.minimum(half, 1.0)))
        lift = jnp.where(lowest > 0, jnp.minimum(lowest / LIFT, 1.0), 0.0)
        return Now(reach, part, held, touched, lift, error, angle, dropped)

    def remember(self, world: World) -> Any:
        """Return the goal with the best so far."""
        return world.goal._replace(best=self.better(world.goal.best, self.now(world)))

    def better(self, best: Best, now: Now) -> Best:
        """Return the best so far, with the measurements of this step."""
        presents = self.presents(now)

        def least(value: Array, before: Array) -> Array:
            return jnp.where(presents, jnp.minimum(value, before), before)

        return Best(
            jnp.minimum(best.reach, now.reach[self.picker]),
            jnp.maximum(best.grasp, as_float(now.held[self.picker])),
            jnp.where(_any(now.held), jnp.maximum(best.lift, now.lift), best.lift),
            jnp.where(best.carry < 0, now.error, least(now.error, best.carry)),
            jnp.where(best.turn < 0, now.angle, least(now.angle, best.turn)),
        )

    def presents(self, now: Now) -> Array:
        """Return whether the arm that brings the object to the goal holds it, and no other arm touches it."""
        others = [touches for agent, touches in now.touched.items() if agent != self.presenter]
        held = now.held[self.presenter]
        return held & ~jnp.stack(others).any() if others else held

    @property
    def nothing(self) -> Best:
        """The best before an episode: `remember` sets distances at the start, where they are below 0."""
        zero = jnp.float32(0.0)
        return Best(jnp.float32(np.inf), zero, zero, jnp.float32(-1.0), jnp.float32(-1.0))

    # -- what agents get

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the terms of every task, and the team's terms, which each agent gets.

        Progress over the best of the episode so far: `reach` (m) of the arm that picks it up, `grasp` (1 when that
        first holds it), `lift` (up to 1 at `LIFT`) while it is held; `carry` (m) and `turn` (rad, where the goal has an
        orientation) while it is presented. Of each step: `precision`, 1 at the goal, and `success`. And `drop`, 1 as
        the object is dropped or lost.
        """
        now, best, safety = self.now(world), world.goal.best, super().reward_terms(world)
        new, presents = self.better(best, now), self.presents(now)
        team = {
            "reach": best.reach - new.reach,
            "grasp": new.grasp - best.grasp,
            "lift": new.lift - best.lift,
            "carry": best.carry - new.carry,
            "turn": jnp.float32(self.oriented) * (best.turn - new.turn),
            "precision": jnp.where(presents, jnp.exp(-now.error / PRECISION), 0.0),
            "success": as_float(self.at_goal(now)),
            "drop": as_float(now.dropped),
        }
        return {agent: {**team, **safety[agent]} for agent in world.arms}

    def at_goal(self, now: Now) -> Array:
        """Return whether the object is at its goal, and presented there."""
        near = (now.error < self.tolerance) & self.presents(now)
        return near & (now.angle < self.angle) if self.oriented else near

    def success(self, world: World) -> dict[str, Array]:
        """Return whether the object is at its goal, for all agents."""
        return dict.fromkeys(world.arms, self.at_goal(self.now(world)))

    def metrics(self, world: World) -> dict[str, dict[str, Array]]:
        """Return `goal_error`, m, `drop`, and `goal_angle`, rad, where the goal has an orientation."""
        now = self.now(world)
        found = {"goal_error": now.error, "drop": now.dropped}
        return dict.fromkeys(world.arms, {**found, "goal_angle": now.angle} if self.oriented else found)

    def terminated(self, world: World) -> Array:
        """Return whether the object has been dropped or lost."""
        return self.now(world).dropped

    # -- what agents observe

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return the terms of every task, and terms of the object's goal in the base frame.

        `to_object` [3] from the tool tip to the object's nearest bar; `target` [3] of its point, `to_target` [3] from
        that point, `target_rotation` [6], the first two columns of how it should be turned; `best_lift` [1]; with
        other arms `others_hold` [1], whether one of them holds it.
        """
        mount, name = self.scene.mounts[agent], self.object
        turn, origin = mount.rotation.astype(np.float32), mount.position.astype(np.float32)

        def local(point: Array) -> Array:
            return (point - origin) @ turn

        def target(world: World) -> Array:
            return local(self.tables["points"][world.goal.row])

        def to_target(world: World) -> Array:
            body = self.at_hand(world).objects[name]
            return target(world) - local(body.position + body.size * body.rotation @ self._point)

        def target_rotation(world: World) -> Array:
            return (turn.T @ self.tables["turns"][world.goal.row])[:, :2].T.ravel()

        def others_hold(world: World) -> Array:
            arms = self.at_hand(world).arms
            held = [view.handles[name].holding for other, view in arms.items() if other != agent]
            return as_float(jnp.stack(held).any())[None]

        far, reach, one, every = np.full(3, FAR), mount.arm.reach, np.ones(1), np.arange(len(self._middles))
        others = {"others_hold": Term(others_hold, 0 * one, one, "others")} if len(self.scene.agents) > 1 else {}
        return {
            **super().terms(agent),
            "to_object": Term(lambda world: self.way_to_bars(world, agent, every), -far, far, "object"),
            "target": Term(target, *reach, "team_goal"),
            "to_target": Term(to_target, -far, far, "team_goal"),
            "target_rotation": Term(target_rotation, -np.ones(6), np.ones(6), "team_goal"),
            "best_lift": Term(lambda world: world.goal.best.lift[None], 0 * one, one, "object"),
            **others,
        }

    def way_to_bars(self, world: World, agent: str, bars: np.ndarray) -> Array:
        """Return the way from a tool tip to the nearest of some bars of the object, in the arm's base frame, m, [3].

        Args:
            world: where arms and objects are.
            agent: the arm.
            bars: numbers of bars.
        """
        mount, body = self.scene.mounts[agent], self.at_hand(world).objects[self.object]
        places = body.position + body.size * self._middles[bars] @ body.rotation.T - mount.position.astype(np.float32)
        away = places @ mount.rotation.astype(np.float32) - world.arms[agent].tool_tip
        return away[jnp.argmin(jnp.sum(away * away, -1))]

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the terms of the agent itself, of the object and of the goal, then those of the other arms."""
        own, name = super().observes(agent), self.called
        seen = tuple(f"{name}_{part}" for part in PARTS)
        goal = ("target", "to_target", *(("target_rotation",) if self.oriented else ()))
        others = ("others_hold",) if len(self.scene.agents) > 1 else ()
        return (*own[:4], "contact_force", *seen, "to_object", *goal, "best_lift", *others, *own[4:])

    @property
    def informed(self) -> str:
        """The arm that picks the object up: it knows where the other one has to bring it."""
        return self.picker

    def marks(self, goal: Any) -> np.ndarray:
        """Return where the point should be, [N, 1, 3]."""
        return np.asarray(self.tables["points"], float)[goal.row][:, None]

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return where the object begins and where it should be."""
        names = ("starts", "points", *(("turns",) if self.oriented else ()))
        return [np.asarray(self.tables[name], float)[goal.row] for name in names]


def find_object(scene: Scene, task: str, sites: tuple[str, ...], meant: Sequence[str] = ()) -> str:
    """Return the name of the first free object of a scene that has these sites and bars to grip.

    ValueError, which names the scenes that the task is meant for, if there is none.
    """
    for name, place in scene.free_objects.items():
        if set(sites) <= set(place.object.sites) and any(shape.kind == "capsule" for shape in place.object.shapes):
            return name
    raise ValueError(
        f"{task} needs a scene with a free object that has bars to grip and the "
        f"site{'s' * (len(sites) > 1)} {' and '.join(sites)}; {scene.name!r} has none{_such_as(meant)}"
    )


def _such_as(scenes: Sequence[str]) -> str:
    return f" (choose from {', '.join(scenes)}, or a file)" if scenes else ""


def _any(of: dict[str, Array]) -> Array:
    return jnp.stack(list(of.values())).any()


def as_float(flag: Array) -> Array:
    """Return a flag as 0 or 1, float32."""
    return flag.astype(jnp.float32)


def known(value: Array) -> Array:
    """Return a distance or an angle; a large one where the physics has failed, so that no reward is lost with it."""
    return jnp.where(value < UNKNOWN, value, UNKNOWN)
