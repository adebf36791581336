"""The base class of tasks with moving targets: a row of a table of paths, and a time on the path."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from surgical_marl.runtime import jax, jnp
from surgical_marl.tasks.base import spline
from surgical_marl.tasks.base.options import Options
from surgical_marl.tasks.base.paths import KNOT, MANY_STARTS, ROWS, SEGMENTS, path_table
from surgical_marl.tasks.base.task import Level, Start, TipTask

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene


class PathGoal(NamedTuple):
    """The current targets, and the path that they follow."""

    targets: Array
    """[arms, 3], m, each in its arm's base frame."""
    row: Array
    """Row of the table of paths."""
    time: Array
    """Time since the start of the episode, s."""


class PathTask(TipTask):
    """A task whose targets move along paths of `surgical_marl/tasks/base/paths.py`, which `draw` draws."""

    max_steps = 250
    starts = ("home", "random")
    follows = True
    wanted: ClassVar = {"rmse_mm": ("below", 2.0)}

    @staticmethod
    def draw(rng: np.random.Generator, count: int, start: np.ndarray, level: Level) -> np.ndarray:
        """Draw paths: one of the functions for this in `surgical_marl/tasks/base/paths.py`."""
        raise NotImplementedError

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        many = self.starts_at == "random" and options.goals == "training"
        self.tables |= path_table(
            scene, self.draw, self.level, self.seed, self.starts_at, MANY_STARTS if many else ROWS
        )
        paths = self.tables["paths"]
        closed = np.isclose(paths[:, :3], paths[:, -3:], rtol=0, atol=1e-7).all(axis=(1, 2, 3))
        self.tables |= {"paths": paths.astype(np.float32), "closed": closed}

    def start(self, key: Array) -> Start:
        """Return a path, at its start, and a posture if these are drawn too."""
        row, time = jax.random.randint(key, (), 0, len(self.tables["paths"])), jnp.float32(0.0)
        postures = self.tables.get("postures")
        return Start(PathGoal(self.along(row, time), row, time), None if postures is None else postures[row])

    def advance(self, goal: PathGoal, dt: float) -> PathGoal:
        """Return the goal with its targets `dt` seconds further on their paths."""
        time = goal.time + np.float32(dt)
        return PathGoal(self.along(goal.row, time), goal.row, time)

    def along(self, row: Array, time: Array) -> Array:
        """Return the targets [arms, 3] at a time in s, or [..., arms, 3] at times [...].

        At the end of a closed path, the targets start its next round. At the end of an open path, they rest.
        """
        near, f = self._near(row, time)
        return (jnp.stack(spline.weights(f), axis=-1)[..., None, None] * near).sum(-3)

    def velocities(self, goal: PathGoal) -> Array:
        """Return the velocities of the targets, [arms, 3], m/s."""
        near, f = self._near(goal.row, goal.time)
        slopes = jnp.stack(spline.slopes(f), axis=-1) / np.float32(KNOT)
        rests = ~self.tables["closed"][goal.row] & (goal.time >= np.float32(SEGMENTS * KNOT))
        return jnp.where(rests, 0.0, (slopes[..., None, None] * (near[1:] - near[:-1])).sum(-3))

    def _near(self, row: Array, time: Array) -> tuple[Array, Array]:
        """Return the control points near a time, and how much of the segment has passed.

        The four control points [..., 4, arms, 3] are those of the segment at that time. The second result is the share
        of the segment that has passed, from 0 to 1.
        """
        u = time * np.float32(1 / KNOT)
        around = u - SEGMENTS * jnp.floor(u / np.float32(SEGMENTS))
        u = jnp.where(self.tables["closed"][row], around, jnp.minimum(u, np.float32(SEGMENTS)))
        k = jnp.clip(jnp.floor(u).astype(jnp.int32), 0, SEGMENTS - 1)
        return self.tables["paths"][row, k[..., None] + np.arange(4)], u - k.astype(jnp.float32)

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return the paths from the table.

        The targets that follow from the paths are computed on the device, and their last digit differs between devices.
        """
        return [self.tables["paths"][goal.row]]
