"""What a task is: how an episode begins, what each agent observes, named reward terms, and what success is.

A task is a class with pure functions, derived from `Task`, or from `TipTask` where every tool tip has a target. One
that ships is the class `Task` of a module in `surgical_marl/tasks/`; one of another package is named by its entry point
(docs/your_own_task.md). Its docstring, or its module's, is its page.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from surgical_marl.content import unknown
from surgical_marl.runtime import jax, jnp
from surgical_marl.tasks.base.options import Options
from surgical_marl.tasks.base.terms import FAR, Picture, Term, arm_terms, picture_terms
from surgical_marl.tasks.base.world import World

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene

PRECISION = 0.005
"""Distance in m over which the term for precision falls to a third."""
APPROACH = 0.025
"""Another arm nearer than this, m, counts in the term for clearance: two or three control steps before a touch, as arms
come at each other at 8 mm a step, and some at twice that."""


SEEDS = {"training": 0, "held_out": 1}
"""Seeds of the tables that goals are drawn from."""


class Start(NamedTuple):
    """How an episode begins."""

    goal: Any
    """What the episode is after, as a named tuple of arrays: the task's own."""
    qpos: Array | None = None
    """Joint positions of the whole scene, [nq]; None where every episode begins at home."""


class Level(NamedTuple):
    """How hard a task is."""

    extent: float
    """How far targets stray from the point in front of each arm, m."""
    crossing: float
    """Share of episodes, 0 to 1, in which the ways of two arms' tool tips cross; nothing for one arm."""
    speed: float = 0.0
    """The fastest that a target moves, m/s."""


class Task:
    """The pure functions of a task. Results are keyed by agent, for one environment.

    What a function reads from `self.tables` and `self.weights` is an input of the kernel: another table or weight of
    the same shape compiles nothing. All else that it reads from `self` is a constant there.

    Args:
        scene: the arms.
        options: `difficulty`, `start` and `reward` concern a task.

    Raises:
        ValueError: an unknown difficulty, start or reward term.
    """

    levels: ClassVar[Mapping[str, Any]] = {"default": None}
    starts: ClassVar[tuple[str, ...]] = ("home",)
    """What episodes may begin with: see `Options.start`."""
    default_scene: ClassVar[str | None] = None
    """The scene of an environment that is made without one; None where any scene will do."""
    max_steps: int = 100
    weights: Mapping[str, float] = {}
    """Of each term of `reward_terms`."""
    senses: tuple[str, ...] = ()
    """Numbers that `sense` makes of an environment's pictures after each step, before reward is given."""
    stages: ClassVar[tuple[str, ...]] = ()
    """What is reached one after the other on the way to success."""
    follows: ClassVar[bool] = False
    """Whether goals move, so that every step of an episode counts in its evaluation, and not the last ones alone."""
    has_targets: ClassVar[bool] = False
    """Whether `targets` says where tool tips should be."""
    wanted: ClassVar[Mapping[str, tuple[str, float]]] = {}
    """What a trained policy should reach: metric -> ("below" or "at least", number)."""

    def __init__(self, scene: Scene, options: Options) -> None:
        if options.difficulty not in self.levels:
            raise unknown("difficulty", options.difficulty, list(self.levels))
        if options.start not in self.starts:
            raise unknown(f"start of task {options.task!r}", options.start, self.starts)
        self.scene, self.level, self.starts_at = scene, self.levels[options.difficulty], options.start
        self.seed = SEEDS[options.goals]
        """Of what the task draws on the host: held-out goals come from another seed than those of training."""
        for name in options.reward:
            if name not in self.weights:
                raise unknown("reward term", name, list(self.weights))
        self.weights = {**self.weights, **options.reward}
        self.tables: dict[str, np.ndarray] = {}
        self.postures: dict[str, np.ndarray] = {}
        """Tables of `qpos` of the whole scene, [rows, nq] each, that pictures to be matched are taken from."""
        self.watched: dict[str, tuple[str, ...]] = {}
        """Agent -> pictures that `sense` looks at, whether or not the agent observes them."""

    @classmethod
    def summary(cls) -> str:
        """Return the first line of the task's page: that of its module, or of the class."""
        page = sys.modules[cls.__module__].__doc__ if cls.__name__ == "Task" else cls.__doc__
        return (page or cls.__name__).splitlines()[0]

    def bound(self, weights: Mapping[str, Array], tables: Mapping[str, Array]) -> Any:
        """Return the task with other weights and tables, which may be traced."""
        task = copy.copy(self)
        task.weights, task.tables = weights, tables  # type: ignore[assignment]
        return task

    def start(self, key: Array) -> Start:
        """Return how an episode begins, drawn by its key."""
        raise NotImplementedError

    def advance(self, goal: Any, dt: float) -> Any:
        """Return the goal `dt` seconds later."""
        return goal

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return all that an agent may observe, by name."""
        return {**arm_terms(self.scene, agent), **picture_terms(self.scene, agent)}

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the names of what it does observe unless a scene or a call chooses others."""
        return tuple(name for name, term in arm_terms(self.scene, agent).items() if name != "contact_force")

    def privileged(self, goal: Any) -> Array:
        """Return what only critics see: what no agent is told of the goal, [p]."""
        return jnp.zeros(0, jnp.float32)

    @property
    def privileged_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest of `privileged`, [p] each."""
        return np.zeros(0), np.zeros(0)

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return agent -> reward term -> its value before weighting, for the step that led here.

        Those of every task: `clearance`, up to 1 as another arm comes nearer than `APPROACH`, and `collision`, 0 or 1.
        """
        return {
            agent: {
                "clearance": jnp.clip(1.0 - view.min_distance / APPROACH, 0.0, 1.0),
                "collision": view.collision.astype(jnp.float32),
            }
            for agent, view in world.arms.items()
        }

    def rewards(self, world: World) -> dict[str, dict[str, Array]]:
        """Return agent -> reward term -> its weighted value. Their sum is the agent's reward."""
        return {
            agent: {name: self.weights[name] * value for name, value in terms.items()}
            for agent, terms in self.reward_terms(world).items()
        }

    def success(self, world: World) -> dict[str, Array]:
        """Return whether each agent has reached what it is after, [] bool."""
        raise NotImplementedError

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return agent -> each of `stages` -> whether it is reached now, [] bool."""
        return {agent: {} for agent in world.arms}

    def metrics(self, world: World) -> dict[str, dict[str, Array]]:
        """Return agent -> what its `infos` hold besides what those of all tasks do."""
        return {agent: {} for agent in world.arms}

    def terminated(self, world: World) -> Array:
        """Return whether the episode ends here, [] bool. Never: arms go on holding or following their targets."""
        return jnp.bool_(False)

    def sense(self, pictures: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """Return what `senses` names, [N] float32, from the pictures that agents see after a reset or a step.

        A metric of the same name must be the number itself: a reset puts it into the infos as it is.

        Args:
            pictures: agent -> term -> torch tensor [N, H, W, C].
        """
        return {}

    # -- on the host, for N environments at once

    def targets(self, goal: Any) -> np.ndarray:
        """Return where tool tips should be, [N, arms, 3], each in its arm's base frame, m, if the task `has_targets`.

        Args:
            goal: fields of the goal, [N, ...] each.
        """
        raise NotImplementedError

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return the numbers that say what the goals of N episodes are, [N, ...] each.

        The hash of an evaluation is made from these numbers.
        """
        return [np.asarray(value) for _, value in sorted(vars(goal).items())]


class Goal(NamedTuple):
    """What the goal of a `TipTask` holds. A task of its own may carry more fields."""

    targets: Array
    """Where the tool tips should be now, [arms, 3], m, each in its arm's base frame."""


class TipTask(Task):
    """A task in which every tool tip has a target."""

    weights: Mapping[str, float] = {"distance": -10.0, "precision": 1.0, "clearance": -1.0, "collision": -2.0}
    has_targets = True
    tolerance: ClassVar[float] = 0.002
    """A tip nearer to its target than this is successful, m."""

    def tip_errors(self, world: World) -> dict[str, Array]:
        """Return the distance of tool tip and target in m."""
        targets = world.goal.targets
        return {agent: _length()(targets[i] - view.tool_tip) for i, (agent, view) in enumerate(world.arms.items())}

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return those of every task, `target` [3], and `to_target` [3] from the tip."""
        i, space = self.scene.agents.index(agent), np.full(3, FAR)
        targets = {
            "target": Term(lambda world: world.goal.targets[i], -space, space),
            "to_target": Term(lambda world: world.goal.targets[i] - world.arms[agent].tool_tip, -2 * space, 2 * space),
        }
        return {**super().terms(agent), **targets}

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return what the agent knows of itself, then its target, then what it knows of the others."""
        own = super().observes(agent)
        return (*own[:4], "target", "to_target", *own[4:])

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return those of every task, `distance` of tip and target in m, and `precision`, 1 at the target."""
        errors, safety = self.tip_errors(world), super().reward_terms(world)
        return {
            agent: {"distance": error, "precision": jnp.exp(-error / PRECISION), **safety[agent]}
            for agent, error in errors.items()
        }

    def success(self, world: World) -> dict[str, Array]:
        """Return whether each tip is at its target."""
        return {agent: error < self.tolerance for agent, error in self.tip_errors(world).items()}

    def metrics(self, world: World) -> dict[str, dict[str, Array]]:
        """Return `tip_error`, the distance of tip and target in m."""
        return {agent: {"tip_error": error} for agent, error in self.tip_errors(world).items()}

    def targets(self, goal: Any) -> np.ndarray:
        """Return where tool tips should be, [N, arms, 3], each in its arm's base frame, m."""
        return np.asarray(goal.targets)


@cache
def _length() -> Callable[[Array], Array]:
    """Return what computes the length of a vector [3], with derivative zero at zero, where it has none.

    That of `jnp.linalg.norm` is NaN there: one tip at its target would spoil the derivative of a whole episode.
    """
    length = jax.custom_jvp(lambda vector: jnp.linalg.norm(vector))
    length.defjvps(lambda change, length, vector: vector @ change / jnp.maximum(length, 1e-12))
    return length
