"""The paths of moving targets in the world, from their start to the end of an episode."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.runtime import jnp
from surgical_marl.tasks.base.path_task import PathTask

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

POINTS = 120
"""Points of a path that is drawn."""


class Paths:
    """The paths of the episodes of N environments; computed again only where a new episode has another path."""

    def __init__(self, env: BatchedEnv) -> None:
        self._mounts = list(env.scene.mounts.values())
        self._times = np.linspace(0, env.max_steps * env.control_dt, POINTS, dtype=np.float32)
        self._known: dict[int, np.ndarray] = {}

    def read(self, env: BatchedEnv) -> np.ndarray | None:
        """Return the paths of all arms' targets, [N, POINTS, arms, 3], m; None for a task whose targets follow none."""
        task = env.task
        if not isinstance(task, PathTask):
            return None
        rows = [int(row) for row in env.goal.row]
        self._known = {row: self._known[row] if row in self._known else self._path(task, row) for row in rows}
        return np.stack([self._known[row] for row in rows])

    def _path(self, task: PathTask, row: int) -> np.ndarray:
        own: np.ndarray = np.asarray(task.along(jnp.int32(row), jnp.asarray(self._times)))
        placed = [own[:, arm] @ mount.rotation.T + mount.position for arm, mount in enumerate(self._mounts)]
        return np.stack(placed, 1)
