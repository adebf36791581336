"""Films of a policy at work: the arms of one environment, and its goals as coloured balls."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgical_marl.acting import forget
from surgical_marl.view.render import Renderer, Sphere
from surgical_marl.view.video import write_video

if TYPE_CHECKING:
    from surgical_marl.batch import BatchedEnv

FPS = 25
GOAL_RADIUS = 0.004
"""In m: a ball that a tip can be seen to touch, at the size of the films."""
COLOURS = ((0.10, 0.60, 0.42, 1.0), (0.95, 0.60, 0.10, 1.0), (0.35, 0.40, 0.90, 1.0))


def record(
    env: BatchedEnv,
    policy: Callable[[Mapping[str, Any]], Mapping[str, Any]],
    path: Path,
    episodes: int = 2,
    seed: int = 0,
) -> Path:
    """Film the first environment of `env` for some episodes; returns the path of the video."""
    return write_video(path, frames(env, policy, episodes, seed), FPS)


def frames(
    env: BatchedEnv,
    policy: Callable[[Mapping[str, Any]], Mapping[str, Any]],
    episodes: int,
    seed: int,
) -> Iterator[NDArray[np.uint8]]:
    """Pictures of the first environment, `FPS` of them for a second of simulated time."""
    picture = ScenePicture(env)
    every = max(1, round(1 / (FPS * env.control_dt)))
    observations, *_ = env.reset(seed)
    forget(policy)
    for step in range(episodes * env.max_steps):
        if step % every == 0:
            yield picture.draw()
        outcome = env.step(dict(policy(observations)))
        observations = outcome.observations
        forget(policy, outcome.terminated | outcome.truncated)


class ScenePicture:
    """Draws the first environment of `env` as it stands, with a ball at each arm's goal."""

    def __init__(self, env: BatchedEnv, width: int = 480, height: int = 360) -> None:
        self._env = env
        self._data = mujoco.MjData(env.scene.model)
        self._renderer = Renderer(env.scene.model, width, height)

    def draw(self) -> NDArray[np.uint8]:
        """The picture [height, width, 3]."""
        model = self._env.scene.model
        self._data.qpos[:] = self._env.qpos[0]
        mujoco.mj_kinematics(model, self._data)
        mujoco.mj_camlight(model, self._data)
        return self._renderer.render(self._data, spheres=self._goals())

    def _goals(self) -> list[Sphere]:
        # The task gives each goal in its arm's base frame.
        balls: list[Sphere] = []
        goals = self._env.goal[0]
        for index, mount in enumerate(self._env.scene.mounts.values()):
            place = mount.rotation @ goals[index] + mount.position
            balls.append((tuple(place), GOAL_RADIUS, COLOURS[index % len(COLOURS)]))
        return balls
