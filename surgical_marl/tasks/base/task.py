"""What a task is: goals that move, observations, named reward terms.

A task is a module of `surgical_marl/tasks/` with a class `Task(scene, difficulty, reward)` of pure functions, derived
from the one here. It gives `levels`, `max_steps` and `start`; where goals move also `advance`; and overrides the rest
where it differs. Its docstring is its page.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.content import unknown

if TYPE_CHECKING:
    from surgical_marl.physics.simulator import ArmView
    from surgical_marl.scenes.scene import Scene

PRECISION = 0.005
"""Distance in m over which the term for precision falls to a third."""
APPROACH = 0.025
"""Another arm nearer than this, m, counts in the term for clearance: two or three control steps before a touch, as arms
come at each other at 8 mm a step, and some at twice that."""
FAR = 2.0
"""Bound in m of everything observed in space; no arm reaches that far."""

Views = Mapping[str, "ArmView"]
"""What is seen of each agent's arm."""


class Goal(NamedTuple):
    """What every task's goal holds. A task of its own may carry more fields."""

    targets: Array
    """Where the tool tips should be now, [arms, 3], m, each in its arm's base frame."""


class Level(NamedTuple):
    """How hard a task is."""

    extent: float
    """How far targets stray from the point in front of each arm, m."""
    crossing: float
    """Share of episodes, 0 to 1, in which the ways of two arms' tool tips cross; nothing for one arm."""
    speed: float = 0.0
    """The fastest that a target moves, m/s."""


class Task:
    """The pure functions of a task. `views` and results are keyed by agent, for one environment.

    Args:
        scene: the arms.
        difficulty: "easy", "default" or "hard": a key of `levels`.
        reward: weights of reward terms that replace those of `weights`.

    Raises:
        ValueError: an unknown difficulty or reward term, or a weight that is no finite number.
    """

    max_steps: int = 100
    success: float = 0.002
    levels: ClassVar[Mapping[str, Level]] = {}
    weights: Mapping[str, float] = {"distance": -10.0, "precision": 1.0, "clearance": -1.0, "collision": -2.0}
    """Of each term of `terms`."""
    camera: str | None = None
    """The agent whose endoscope's pictures are part of its observation (`envs/pictures.py`). Its goal then has
    a `row` of `table`, `qpos` [rows, nq] that target pictures are taken from, and `weights` a term `image`."""

    def __init__(self, scene: Scene, difficulty: str = "default", reward: Mapping[str, float] | None = None) -> None:
        if difficulty not in self.levels:
            raise unknown("difficulty", difficulty, list(self.levels))
        self.scene, self.level = scene, self.levels[difficulty]
        self.weights = {**self.weights, **{name: self._weight(name, value) for name, value in (reward or {}).items()}}

    def start(self, key: Array) -> Any:
        """The goal at the start of an episode; `key` is the episode's."""
        raise NotImplementedError

    def advance(self, goal: Any, dt: float) -> Any:
        """The goal `dt` seconds later."""
        return goal

    def tip_errors(self, views: Views, goal: Any) -> dict[str, Array]:
        """Distance of tool tip and target in m."""
        return {
            agent: jnp.linalg.norm(goal.targets[i] - view.tool_tip) for i, (agent, view) in enumerate(views.items())
        }

    def observations(self, views: Views, goal: Any) -> dict[str, Array]:
        """[d] each: joint positions and velocities, tool tip, commands, target, target minus tip; with other arms also
        the way to the nearest other tip and the least distance to any other arm."""
        found = {}
        for i, (agent, view) in enumerate(views.items()):
            target = goal.targets[i]
            parts = [view.qpos, view.qvel, view.tool_tip, view.command, target, target - view.tool_tip]
            if len(views) > 1:
                parts += [view.nearest_tip, view.min_distance[None]]
            found[agent] = jnp.concatenate(parts)
        return found

    def bounds(self, agent: str) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest observation of an agent, [d] each."""
        joints = self.scene.mounts[agent].arm.actuated
        slack = np.array([0.1 * (joint.upper - joint.lower) for joint in joints])
        low = np.array([joint.lower for joint in joints]) - slack
        high = np.array([joint.upper for joint in joints]) + slack
        speed = 2 * np.array([joint.velocity for joint in joints])
        if self.scene.control == "position":
            command_low, command_high = low, high
        else:
            command_high = np.array([max(joint.velocity, joint.effort, joint.upper) for joint in joints])
            command_low = -command_high
        space = np.full(3, FAR)
        lows = [low, -speed, -space, command_low, -space, -2 * space]
        highs = [high, speed, space, command_high, space, 2 * space]
        if len(self.scene.agents) > 1:
            lows += [-2 * space, -space[:1]]
            highs += [2 * space, 2 * space[:1]]
        return np.concatenate(lows), np.concatenate(highs)

    def privileged(self, goal: Any) -> Array:
        """[p]: what the state holds besides all observations: what no agent is told of the goal."""
        return jnp.zeros(0, jnp.float32)

    @property
    def privileged_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest of `privileged`, [p] each."""
        return np.zeros(0), np.zeros(0)

    def terms(self, views: Views, goal: Any) -> dict[str, dict[str, Array]]:
        """agent -> reward term -> its value before weighting, for the step that led here. `distance` of tip and target
        in m; `precision`, 1 at the target; `clearance`, up to 1 as another arm comes nearer than `APPROACH`;
        `collision`, 0 or 1."""
        errors = self.tip_errors(views, goal)
        return {
            agent: {
                "distance": errors[agent],
                "precision": jnp.exp(-errors[agent] / PRECISION),
                "clearance": jnp.clip(1.0 - view.min_distance / APPROACH, 0.0, 1.0),
                "collision": view.collision.astype(jnp.float32),
            }
            for agent, view in views.items()
        }

    def metrics(self, views: Views, goal: Any) -> dict[str, dict[str, Array]]:
        """agent -> what its `infos` hold besides what those of all tasks do."""
        return {agent: {} for agent in views}

    def rewards(self, views: Views, goal: Any) -> dict[str, dict[str, Array]]:
        """agent -> reward term -> its weighted value. Their sum is the agent's reward."""
        return {
            agent: {name: np.float32(self.weights[name]) * value for name, value in terms.items()}
            for agent, terms in self.terms(views, goal).items()
        }

    def terminated(self, views: Views, goal: Any) -> Array:
        """Never: arms go on holding or following their targets."""
        return jnp.bool_(False)

    def _weight(self, name: str, value: Any) -> float:
        if name not in self.weights:
            raise unknown("reward term", name, list(self.weights))
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError(f"the weight of reward term {name!r} must be a finite number, not {value!r}")
        return float(value)
