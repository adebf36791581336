"""Camera assistance: the endoscope shows the tools their work, and the tools see nothing else.

The scene says what the tools work at: `reach` where there is no free object, `needle_handover` if it is a needle,
`peg_transfer` if it is a block.

Agents        the arms of the scene: one endoscope, the camera, and two tools.
Observation   of a tool: what it observes at its work, but what depends on a place is 0 unless that place, and its own
              tip where that counts, is in view. Instead of the way to the nearest tip it observes, in the endoscope's
              frame, `tip_seen`, `other_tips_seen`, `target_seen` and that of the object: each a position and 1, or
              zeros out of view. And the endoscope's axes in its own base frame, which the joints of both arms say. Of
              the camera: its joints, and all these places in its frame, whether or not they are in view, with a flag;
              beside an object which of the tools hold it, as that says where to look next.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        the team's; weights in brackets, beside work with objects a tenth of them. The terms of the work, the mean
              of both tools. `in_view`, the share of what is to be seen that is in view (1); `centring`, the angle
              between the view's axis and the middle of that, in half fields of view, at most 3 (-0.5); `depth`, how far
              all that is from a good distance, as a share of it, at most 1 (-0.5); `travel` of the endoscope's tip
              (-10 / m). And for each agent its own `clearance` and `collision`, as in the work. To be seen are the
              tools' tips and the object; in `reach` instead of an object the targets.
Success       of a tool that of its work; of the camera that both tools succeed and all is in view.
Termination   as in the work; an episode is truncated after the work's control steps and 100 more (2 s).
Randomisation the endoscope starts in a posture drawn about one that looks at the tools' home, clear of the tools on
              the straight way there. Goals are those of the work; in `reach` those at which the endoscope can see the
              tools at home, their targets and so all between at once. Tools start at home.
Difficulty    that of the work; and how far the endoscope is turned away at the start, at most, about each of yaw, pitch
              and roll: easy 12 degrees, so that all is in view, default 35, hard 60.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.runtime import jax, jnp
from surgical_marl.tasks import reach
from surgical_marl.tasks.base.grasp_poses import bars
from surgical_marl.tasks.base.object_task import FAR, ObjectTask, as_float
from surgical_marl.tasks.base.options import Options
from surgical_marl.tasks.base.oracle_script import Snapshot, Step, Wish
from surgical_marl.tasks.base.task import Start
from surgical_marl.tasks.base.task import Task as BaseTask
from surgical_marl.tasks.base.terms import Picture, Term
from surgical_marl.tasks.base.workspace import TIME
from surgical_marl.tasks.camera_assist.eye import Eye
from surgical_marl.tasks.camera_assist.starts import ROWS, draw_postures, find_roles, visible_targets, work_in
from surgical_marl.tasks.camera_assist.terms import GOAL, Shown, Sights

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.world import World


SEARCH = TIME
"""Time in which the endoscope may look for the tools, s, unless it sees all before: as arms may take in `reach`."""
LATER = 100
"""Control steps of an episode after the work's own."""
FOLLOWING = 6
"""Steps of `Eye.look_at` from the last posture."""
FURTHEST_OFF, WORST_DEPTH = 3.0, 1.0
"""Greatest values of the terms `centring` and `depth`."""
VIEW = {"in_view": 1.0, "centring": -0.5, "depth": -0.5, "travel": -10.0}
"""Weights of the terms of the view, which count in each step, as the terms of `reach` do."""
BESIDE_OBJECTS = 0.1
"""Factor of the weights `VIEW` beside the work with objects, whose progress counts once."""
SELF = ("clearance", "collision", "action_change")
"""Terms of each arm for itself."""


class Level(NamedTuple):
    """A level of difficulty."""

    turn: float
    """Largest angle by which the endoscope is turned away at the start, rad."""
    sees: bool
    """True if it sees both tools at the start."""


class ViewGoal(NamedTuple):
    """The goal of an episode, and the endoscope's progress."""

    work: Any
    """Goal of the tools' work."""
    row: Array
    """Row of the table of postures."""
    time: Array
    """Time since the start, s, []."""
    found: Array
    """1 once everything was in view at the same time, before that 0, []."""
    origin: Array
    """Place of the endoscope's tip after the last step, world, m, [3]."""


class Task(BaseTask):
    """A camera and two tools."""

    levels = {  # noqa: RUF012
        "easy": Level(np.radians(12.0), True),
        "default": Level(np.radians(35.0), False),
        "hard": Level(np.radians(60.0), False),
    }
    default_scene = "trimanual_psm_ecm"
    scenes = ("trimanual_psm_ecm", "trimanual_psm_ecm_needle", "trimanual_psm_ecm_pegs")
    wanted = {"in_view_rate": ("at least", 0.999)}  # noqa: RUF012

    def __init__(self, scene: Scene, options: Options) -> None:
        self.camera, self.tools = find_roles(scene)
        self._check(options)  # before the work draws its tables
        name, work = work_in(scene)
        if getattr(work.levels.get(options.difficulty), "trial", False):
            raise ValueError(
                f"difficulty of camera_assist must be easy or default where the work is {name}, not 'hard'"
            )
        self.work: BaseTask = work(scene, replace(options, task=name, reward={}, start="home"))
        share = BESIDE_OBJECTS if scene.free_objects else 1.0
        self.weights = {**self.work.weights, **{name: share * weight for name, weight in VIEW.items()}}
        super().__init__(scene, options)
        self._eye = Eye(scene.mounts[self.camera])
        self.attends = (self.camera,)
        self.object = self.work.object if isinstance(self.work, ObjectTask) else None
        self.max_steps = (self.work.max_steps if self.object else reach.Task.max_steps) + LATER
        self.stages = ("found", *(self.work.stages or ("at_goal",)))  # type: ignore[misc]
        camera, tools, about = self.camera, self.tools, (repr((self.seed, self.level)), scene.fingerprint)
        if self.object is None:
            targets, level = self.work.tables["targets"], repr(self.work.level)
            seen = cached("camera_assist_goals", lambda: visible_targets(scene, camera, tools, targets), level, *about)
            self.work.tables["targets"] = seen
        else:
            self._middle = bars(scene.objects[self.object].object)[0].mean(0).astype(np.float32)

        def draw() -> np.ndarray:
            return draw_postures(scene, camera, tools, self.level.turn, self.level.sees, self.seed)

        tables = {f"work_{name}": table for name, table in self.work.tables.items()}
        self.tables = {"postures": cached("camera_assist", draw, camera, *about), **tables}

    @property
    def constants(self) -> tuple[Any, ...]:
        """Constants of the tools' task, and its module."""
        return type(self.work).__module__, *self.work.constants

    def bound(self, weights: Mapping[str, Array], tables: Mapping[str, Array]) -> Any:
        """Return the task, and its work, with other weights and tables."""
        task = super().bound(weights, tables)
        own = {name.removeprefix("work_"): table for name, table in tables.items() if name.startswith("work_")}
        task.work = self.work.bound(weights, own)
        return task

    def start(self, key: Array) -> Start:
        """Return how the work starts, with a posture of the endoscope."""
        begin = self.work.start(key)
        row = jax.random.randint(jax.random.fold_in(key, 1), (), 0, ROWS)
        zero = jnp.float32(0.0)
        goal = ViewGoal(begin.goal, row, zero, zero, jnp.zeros(3, jnp.float32))
        return Start(goal, self.tables["postures"][row], begin.poses)

    def advance(self, goal: Any, dt: float) -> Any:
        """Return the goal of the work, and the time, `dt` seconds later."""
        return goal._replace(work=self.work.advance(goal.work, dt), time=goal.time + np.float32(dt))

    # -- what is in view

    def places(self, world: World) -> dict[str, Array]:
        """Return places that can be seen, in the world, m, [3] each: tips by agent, free objects by name, goals.

        The goal of an object is called `GOAL`; the target of a tool in `reach` is `<agent>/target`.
        """
        found, goal = {agent: self._of(agent, world.arms[agent].tool_tip) for agent in self.tools}, world.goal.work
        if self.object is None:
            targets = {f"{a}/target": self._of(a, goal.targets[self.scene.agents.index(a)]) for a in self.tools}
            return found | targets
        for name, body in world.objects.items():
            own = name == self.object
            found[name] = body.position + (body.size * body.rotation @ self._middle if own else np.float32(0.0))
        return {**found, GOAL: self.work.tables["points"][goal.row]}

    @property
    def wanted_in_view(self) -> tuple[str, ...]:
        """The places that are to be seen: both tips and the object, or their targets."""
        return *self.tools, *([self.object] if self.object else [f"{agent}/target" for agent in self.tools])

    def sights(self, world: World) -> Sights:
        """Return the places in the endoscope's frame, and which are in view."""
        axes, origin = self._eye.pose(world.arms[self.camera].qpos)
        seen = {name: (place - origin) @ axes for name, place in self.places(world).items()}
        return Sights(seen, {name: self._eye.sees(place) for name, place in seen.items()}, origin)

    def _of(self, agent: str, point: Array) -> Array:
        """Return a point of an arm's base frame in the world, [3], m."""
        mount = self.scene.mounts[agent]
        return point @ mount.rotation.T.astype(np.float32) + mount.position.astype(np.float32)

    def _inside(self, world: World) -> World:
        """Return the world with the goal of the tools' work, for functions of the work."""
        return world._replace(goal=world.goal.work)

    def remember(self, world: World) -> Any:
        """Return the work's goal, whether all has been in view, and the place of the endoscope's tip."""
        _, visible, origin = self.sights(world)
        found = jnp.maximum(world.goal.found, as_float(self._all(visible)))
        return world.goal._replace(work=self.work.remember(self._inside(world)), found=found, origin=origin)

    def _all(self, visible: Mapping[str, Array]) -> Array:
        return jnp.stack([visible[name] for name in self.wanted_in_view]).all()

    # -- what agents get

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the team's terms, of the work and of the view, and the terms of each arm for itself."""
        work = self.work.reward_terms(self._inside(world))
        names = [name for name in work[self.tools[0]] if name not in SELF]
        team = {name: jnp.stack([work[agent][name] for agent in self.tools]).mean() for name in names}
        seen, visible, origin = self.sights(world)
        off, depth = self._eye.aim(jnp.stack([seen[name] for name in self.wanted_in_view]))
        shares = jnp.stack([visible[name] for name in self.wanted_in_view]).astype(jnp.float32)
        team |= {
            "in_view": shares.mean(),
            "centring": _at_most(jnp.sqrt(jnp.sum(off * off) + 1e-12), FURTHEST_OFF),
            "depth": _at_most(jnp.abs(depth), WORST_DEPTH),
            "travel": self._travel(world, origin),
        }
        return {agent: {**team, **{name: work[agent][name] for name in SELF}} for agent in world.arms}

    def _travel(self, world: World, origin: Array) -> Array:
        """Return how far the endoscope's tip has moved in this step, m, []."""
        way = origin - world.goal.origin
        return _at_most(jnp.sqrt(jnp.sum(way * way) + 1e-18), FAR)

    def success(self, world: World) -> dict[str, Array]:
        """Return whether each tool succeeds at its work; of the camera whether both do and all is in view."""
        work = self.work.success(self._inside(world))
        _, visible, _ = self.sights(world)
        both = jnp.stack([work[agent] for agent in self.tools]).all()
        return {agent: both & self._all(visible) if agent == self.camera else work[agent] for agent in world.arms}

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return whether all was in view by now, and the stages of the work, or whether the tools succeed."""
        _, visible, _ = self.sights(world)
        found = {"found": (world.goal.found > 0) | self._all(visible)}
        work, done = self.work.reached(self._inside(world)), self.success(world)
        return {agent: {**found, **(work[agent] or {"at_goal": done[agent]})} for agent in world.arms}

    def metrics(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the metrics of the work; `tip_error` of the camera is that of the tool with the larger error.

        `in_view`: whether the tool is in view; of the camera the share of the tools that are. Of the camera also
        `object_in_view`, likewise of the object or the targets; `centre_error`, the term `centring` without its bound,
        and `camera_travel`, m. `searching`: whether the endoscope may still look for the tools.
        """
        work = self.work.metrics(self._inside(world))
        if self.object is None:
            worst = jnp.stack([work[agent]["tip_error"] for agent in self.tools]).max()
            work = {**work, self.camera: {"tip_error": worst}}
        seen, visible, origin = self.sights(world)
        names = self.wanted_in_view
        off, _ = self._eye.aim(jnp.stack([seen[name] for name in names]))
        things = [as_float(visible[name]) for name in names if name not in self.tools]
        found = (world.goal.found > 0) | self._all(visible)
        view = {agent: {"in_view": as_float(visible[agent])} for agent in self.tools}
        view[self.camera] = {
            "in_view": jnp.stack([as_float(visible[agent]) for agent in self.tools]).mean(),
            "object_in_view": jnp.stack(things).mean(),
            "centre_error": jnp.sqrt(jnp.sum(off * off) + 1e-12),
            "camera_travel": self._travel(world, origin),
        }
        searching = as_float(~found & (world.goal.time < SEARCH))
        return {agent: {**work[agent], **view[agent], "searching": searching} for agent in world.arms}

    def terminated(self, world: World) -> Array:
        """Return whether the work ends here."""
        return self.work.terminated(self._inside(world))

    # -- what agents observe

    @property
    def _shown(self) -> Shown:
        """Observation terms of the endoscope's view."""
        return Shown(self.scene, self.camera, self.tools, self.object, self._eye, self.sights)

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return the terms of the work, hidden from tools out of view, and the terms of the view."""

        def inside(read: Callable[[World], Array]) -> Callable[[World], Array]:
            return lambda world: read(self._inside(world))

        terms = self.work.terms(agent)
        work = {n: t._replace(read=inside(t.read)) if isinstance(t, Term) else t for n, t in terms.items()}
        return self._shown.to_tool(agent, work) if agent in self.tools else {**work, **self._views()}

    def _views(self) -> dict[str, Term]:
        """Return the camera's own terms, beside the terms of the work."""
        return self._shown.to_camera(self._tools_hold)

    def _tools_hold(self, world: World) -> Array:
        """Return whether each tool holds the object of the work, [tools]."""
        arms = self.work.at_hand(self._inside(world)).arms  # type: ignore[attr-defined]
        return jnp.stack([arms[tool].handles[self.object].holding for tool in self.tools]).astype(jnp.float32)

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the terms of a tool at its work and in the view, or the joints and the view of the camera."""
        if agent == self.camera:
            return "qpos", "qvel", "tool_tip", "command", "min_distance", *self._views()
        work = (name for name in self.work.observes(agent) if name != "to_nearest_tip")
        things = (f"{self.object}_seen",) if self.object else ()
        return *work, "tip_seen", "other_tips_seen", "target_seen", *things, "endoscope_axes"

    @property
    def informed(self) -> str:
        """The camera: it shows where the goals are."""
        return self.camera

    def privileged(self, goal: Any) -> Array:
        """Return the privileged numbers of the work."""
        return self.work.privileged(goal.work)

    @property
    def privileged_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of `privileged`."""
        return self.work.privileged_bounds

    # -- on the host

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return the goal content of the work, and where the endoscope begins."""
        work, postures = self.work.goal_content(of_work(goal)), np.asarray(self.tables["postures"], float)
        return [*work, postures[goal.row][:, self.scene.qpos_index(self.camera)]]

    def marks(self, goal: Any) -> np.ndarray:
        """Return the marks of the work, without the camera's target."""
        marks = self.work.marks(of_work(goal))
        return marks if self.object else marks[:, [self.scene.agents.index(agent) for agent in self.tools]]

    def script(self) -> tuple[Step, ...]:
        """Return how the tools do their work, once all has been in view: they don't move unseen."""
        waiting = Step(lambda _: {}, good=lambda seen: np.asarray(seen.goal.found > 0))
        work = tuple(later(step) for step in self.work.script()) or (Step(self._to_targets),)
        return waiting, *work

    def _to_targets(self, seen: Snapshot) -> dict[str, Wish]:
        """Return the wishes that tools are at their targets, on the way that was checked: straight from home."""
        targets, found = self.work.targets(of_work(seen.goal)), {}
        for agent in self.tools:
            own = targets[:, self.scene.agents.index(agent)]
            found[agent] = Wish(joints=inverse_kinematics(self.scene.mounts[agent].arm, own, starts=1))
        return found

    def attend(self, seen: Snapshot) -> dict[str, Wish]:
        """Return the wish to look at tips and object or targets, and at the goal of an object on its way."""
        places = [seen.tools[agent][:, :3, 3] for agent in self.tools]
        if self.object is None:
            places += list(np.moveaxis(self.marks(seen.goal), 1, 0))
        else:
            work: Any = self.work
            body, held = seen.objects[self.object], seen.held[work.presenter]
            places.append(body[:, :3, 3] + body[:, :3, :3] @ self._middle.astype(float))
            brought = held[:, list(self.scene.free_objects).index(self.object)]
            places.append(np.where(brought[:, None], self.marks(seen.goal)[:, 0], places[-1]))
        return {self.camera: Wish(joints=self._eye.look_at(np.stack(places, 1), seen.qpos[self.camera], FOLLOWING))}


def _at_most(value: Array, limit: float) -> Array:
    """Return a value, and the limit where it is larger, or where the physics has failed."""
    return jnp.where(value < limit, value, limit)


def of_work(goal: Any) -> SimpleNamespace:
    """Return the goals of the work, from the fields of this task's goals."""
    own = {name.removeprefix("work."): value for name, value in vars(goal).items() if name.startswith("work.")}
    return SimpleNamespace(**own)


def later(step: Step) -> Step:
    """Return a step of the work as one of this task, which has another step before and goals of its own."""

    def inside(call: Any) -> Any:
        return lambda seen: call(seen._replace(goal=of_work(seen.goal)))

    good, before = None if step.good is None else inside(step.good), step.back
    back = (lambda seen: inside(before)(seen) + 1) if callable(before) else before + 1
    return step._replace(plan=inside(step.plan), good=good, back=back)
