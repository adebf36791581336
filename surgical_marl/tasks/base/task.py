"""The base classes of tasks: the start of an episode, observations, named reward terms, and success.

A task is a class with pure functions, derived from `Task`, or from `TipTask` where every tool tip has a target. A
shipped task is the class `Task` of a module in `surgical_marl/tasks/`. A task of another package is named by an entry
point (docs/your_own_task.md). The docstring of the class, or of the module of a shipped task, describes the task.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from surgical_marl.content import unknown
from surgical_marl.plugins.task_file import label
from surgical_marl.runtime import jax, jnp
from surgical_marl.scenes.poses import Pose
from surgical_marl.tasks.base.object_terms import object_terms
from surgical_marl.tasks.base.options import Options
from surgical_marl.tasks.base.oracle_script import Snapshot, Step, Wish
from surgical_marl.tasks.base.terms import Picture, Term, arm_terms, picture_terms
from surgical_marl.tasks.base.world import World

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene

PRECISION = 0.005
"""Distance in m over which the reward term `precision` falls to a third."""
APPROACH = 0.025
"""Distance of another arm, m, below which the reward term `clearance` grows. It is two or three control steps before a
touch, because arms approach each other at 8 mm per step, and some at twice that."""


SEEDS = {"training": 0, "held_out": 1}
"""Seeds of the tables that goals are drawn from."""


class Start(NamedTuple):
    """The start of an episode."""

    goal: Any
    """The goal of the episode, a named tuple of arrays that the task defines."""
    qpos: Array | None = None
    """Joint positions of the whole scene, [nq]; None if every episode starts at home."""
    poses: Mapping[str, Pose] = {}
    """Poses of free objects at rest, by name, without overlaps. Others begin where the scene places them."""
    threads: Mapping[str, Array] = {}
    """Places of the nodes of loose threads, by name, m, [n, 3], as far apart as edges are long. Others lie as the scene
    says."""


class Level(NamedTuple):
    """A level of difficulty."""

    extent: float
    """Extent of the targets about the point in front of each arm, m."""
    crossing: float
    """Share of episodes, 0 to 1, in which the paths of two arms' tool tips cross; unused with one arm."""
    speed: float = 0.0
    """Greatest speed of a target, m/s."""
    own_starts: bool = False
    """True if arms begin where the level says, which leaves no choice of a start."""


class Task:
    """The pure functions of a task. Results are keyed by agent, for one environment.

    Values that a function reads from `self.tables` and `self.weights` are inputs of the kernel: another table or weight
    of the same shape compiles nothing. Everything else that it reads from `self` is a constant in the kernel.

    Args:
        scene: the arms.
        options: a task reads `difficulty`, `start`, `goals` and `reward`.

    Raises:
        ValueError: an unknown difficulty, start or reward term.
    """

    levels: ClassVar[Mapping[str, Any]] = {"default": None}
    starts: ClassVar[tuple[str, ...]] = ("home",)
    """Allowed values of `Options.start`."""
    starts_at: str = "home"
    """The one of them that was chosen."""
    scenes: ClassVar[tuple[str, ...] | None] = None
    """Shipped scenes that it is meant for; None for all without objects. Others may do, too."""
    default_scene: ClassVar[str | None] = None
    """The scene of an environment that is made without one; None where any scene will do."""
    max_steps: int = 100
    weights: Mapping[str, float] = {}
    """Weight of each term of `reward_terms`."""
    senses: tuple[str, ...] = ()
    """Names of the numbers that `sense` computes from an environment's pictures after each step, before the reward."""
    stages: ClassVar[tuple[str, ...]] = ()
    """Stages on the way to success, in order."""
    follows: ClassVar[bool] = False
    """True if goals move. If so, every step of an episode counts in its evaluation, and not only the last ones."""
    has_targets: ClassVar[bool] = False
    """True if `targets` gives places for tool tips."""
    attends: tuple[str, ...] = ()
    """Agents that follow the others by `attend`, and no script."""
    wanted: ClassVar[Mapping[str, tuple[str, float]]] = {}
    """Goals of a trained policy: metric -> ("below" or "at least", number)."""

    def __init__(self, scene: Scene, options: Options) -> None:
        self._check(options)
        self.scene, self.level, self.starts_at = scene, self.levels[options.difficulty], options.start
        self.seed = SEEDS[options.goals]
        """Seed of the draws on the host: held-out goals come from another seed than those of training."""
        own = {"action_change": 0.0, **self.weights}
        for name in options.reward:
            if name not in own:
                raise unknown("reward term", name, list(own))
        self.weights = {**own, **options.reward}
        self.tables: dict[str, np.ndarray] = {}
        self.postures: dict[str, np.ndarray] = {}
        """Tables of `qpos` of the whole scene, [rows, nq] each, for target pictures."""
        self.watched: dict[str, tuple[str, ...]] = {}
        """Agent -> pictures that `sense` reads, whether or not the agent observes them."""

    def _check(self, options: Options) -> None:
        """Raise a ValueError for a difficulty or a start that this task does not have."""
        if options.difficulty not in self.levels:
            raise unknown("difficulty", options.difficulty, list(self.levels))
        if options.start not in self.starts:
            raise unknown(f"start of task {label(options.task)!r}", options.start, self.starts)

    @property
    def constants(self) -> tuple[Any, ...]:
        """Values that the functions read from `self` beside `tables` and `weights`, if they differ between levels.

        A kernel that was compiled for other constants does not serve the task.
        """
        return ()

    @classmethod
    def summary(cls) -> str:
        """Return the first line of the task's description: the docstring of its module, or of the class."""
        page = sys.modules[cls.__module__].__doc__ if cls.__name__ == "Task" else cls.__doc__
        return (page or cls.__name__).splitlines()[0]

    def bound(self, weights: Mapping[str, Array], tables: Mapping[str, Array]) -> Any:
        """Return the task with other weights and tables, which may be traced."""
        task = copy.copy(self)
        task.weights, task.tables = weights, tables  # type: ignore[assignment]
        return task

    def start(self, key: Array) -> Start:
        """Return the start of an episode, drawn with its key."""
        raise NotImplementedError

    def advance(self, goal: Any, dt: float) -> Any:
        """Return the goal `dt` seconds later."""
        return goal

    def remember(self, world: World) -> Any:
        """Return the goal with values of this step that later steps need, such as the best distance so far.

        It is called after the reward of each step, and also at the start of an episode.
        """
        return world.goal

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return all terms that an agent may observe, by name."""
        return {**arm_terms(self.scene, agent), **object_terms(self.scene, agent), **picture_terms(self.scene, agent)}

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the names of the terms that an agent observes unless a scene or a call chooses others."""
        return tuple(name for name, term in arm_terms(self.scene, agent).items() if name != "contact_force")

    @property
    def informed(self) -> str:
        """The agent that knows the goals of all at knowledge "one"; the others don't."""
        return self.scene.agents[0]

    def privileged(self, goal: Any) -> Array:
        """Return numbers of the goal that critics see and no agent observes, [p]."""
        return jnp.zeros(0, jnp.float32)

    @property
    def privileged_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of `privileged`, [p] each."""
        return np.zeros(0), np.zeros(0)

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return agent -> reward term -> its value before weighting, for the step that led here.

        The terms of every task: `clearance`, up to 1 as another arm comes nearer than `APPROACH`; `collision`, 0 or 1;
        and `action_change`, the sum of squares of how the action differs from the last one, whose weight is 0 where a
        task says nothing of it.
        """
        return {
            agent: {
                "clearance": jnp.clip(1.0 - view.min_distance / APPROACH, 0.0, 1.0),
                "collision": view.collision.astype(jnp.float32),
                "action_change": jnp.sum(jnp.square(world.changes[agent])) if world.changes else jnp.float32(0.0),
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
        """Return whether each agent succeeds now, [] bool."""
        raise NotImplementedError

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return agent -> each of `stages` -> whether it is reached now, [] bool."""
        return {agent: {} for agent in world.arms}

    def metrics(self, world: World) -> dict[str, dict[str, Array]]:
        """Return agent -> entries of its `infos` in addition to those of all tasks."""
        return {agent: {} for agent in world.arms}

    def terminated(self, world: World) -> Array:
        """Return whether the episode ends here, [] bool.

        By default never: arms continue to hold or follow their targets.
        """
        return jnp.bool_(False)

    def sense(self, pictures: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """Compute the numbers of `senses`, [N] float32, from the pictures that agents see after a reset or a step.

        A metric of the same name must be the number itself: a reset puts it into the infos as it is.

        Args:
            pictures: agent -> term -> picture [N, H, W, C]: an array of numpy, or a tensor of torch on a GPU.
        """
        return {}

    # -- on the host, for N environments at once

    def script(self) -> tuple[Step, ...]:
        """Return how arms can do it, if they need more than to bring their tips to `targets`; the oracle follows it."""
        return ()

    def attend(self, seen: Snapshot) -> Mapping[str, Wish]:
        """Return the wishes of the agents of `attends` now; the oracle asks at every control step."""
        raise NotImplementedError

    def targets(self, goal: Any) -> np.ndarray:
        """Return where tool tips should be, [N, arms, 3], each in its arm's base frame, m, if the task `has_targets`.

        Args:
            goal: fields of the goal, [N, ...] each.
        """
        raise NotImplementedError

    def marks(self, goal: Any) -> np.ndarray:
        """Return places in the world that pictures of the scene mark as goals, [N, marks, 3], m.

        Args:
            goal: fields of the goal, [N, ...] each.
        """
        if not self.has_targets:
            return np.zeros((1, 0, 3))
        mounts, targets = self.scene.mounts.values(), self.targets(goal)
        own = [
            t @ mount.rotation.T + mount.position for t, mount in zip(np.moveaxis(targets, 1, 0), mounts, strict=True)
        ]
        return np.stack(own, 1)

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return numbers that tell the goals of N episodes apart, [N, ...] each.

        The hash of an evaluation is made from these numbers.
        """
        return [np.asarray(value) for _, value in sorted(vars(goal).items())]


class Goal(NamedTuple):
    """The goal of a `TipTask`. A subclass may use a goal with more fields."""

    targets: Array
    """Return the targets of the tool tips now, [arms, 3], m, each in its arm's base frame."""


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
        """Return the terms of every task, `target` [3], and `to_target` [3] from the tip."""
        i, tip = self.scene.agents.index(agent), self.scene.mounts[agent].arm.reach
        targets = {
            "target": Term(lambda world: world.goal.targets[i], *tip, "goal"),
            "to_target": Term(
                lambda world: world.goal.targets[i] - world.arms[agent].tool_tip, *tip.minus(tip), "goal"
            ),
        }
        return {**super().terms(agent), **targets}

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the terms of the agent itself, then its target, then the terms of the other arms."""
        own = super().observes(agent)
        return (*own[:4], "target", "to_target", *own[4:])

    def reward_terms(self, world: World) -> dict[str, dict[str, Array]]:
        """Return the terms of every task, `distance` of tip and target in m, and `precision`, 1 at the target."""
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
    """Return a function for the length of a vector [3], with derivative zero at zero, where it has none.

    That of `jnp.linalg.norm` is NaN there: one tip at its target would spoil the derivative of a whole episode.
    """
    length = jax.custom_jvp(lambda vector: jnp.linalg.norm(vector))
    length.defjvps(lambda change, length, vector: vector @ change / jnp.maximum(length, 1e-12))
    return length
