"""Videos of a policy: arms and objects of one environment, and its goals as coloured balls."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgical_marl.envs.observations import replaced
from surgical_marl.machine import cores
from surgical_marl.policies.acting import forget
from surgical_marl.runs.progress import progress
from surgical_marl.view.camera import Focus, best_view, task_places
from surgical_marl.view.drawn import Sphere
from surgical_marl.view.render import Renderer, View
from surgical_marl.view.shading import GOAL_RADIUS, goal_colour
from surgical_marl.view.stage import paint, stage
from surgical_marl.view.video import write_video
from surgical_marl.vision.skin import skins

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

Picture = NDArray[np.uint8]
_Shot = TypeVar("_Shot")
Act = Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""Maps the observations of all agents to their actions."""

FPS = 25
LONGEST = 40.0
"""Seconds of a video at most: of a trial of three minutes it shows the beginning."""
WIDTH, HEIGHT = 480, 360
"""Pixels of a picture unless asked otherwise."""
LEAST, MOST = 1 / 120, 1 / 40
"""Radius of a goal's ball in the picture, at least and at most, as a share of its height."""
THROUGH = 0.45
"""Share of a goal's colour that is seen through shapes in front of it."""


def record(
    env: BatchedEnv,
    policy: Callable[[Mapping[str, Any]], Mapping[str, Any]],
    path: Path,
    episodes: int = 2,
    seed: int = 0,
    small: bool = False,
) -> Path:
    """Film the first environment of `env` for some episodes, or for `LONGEST`; return the path of the video.

    `small`: as for `write_video`.
    """
    count = -(-_steps(env, episodes) // steps_per_frame(env, FPS))
    with _one_thread():
        return write_film(path, frames(env, policy, episodes, seed), count, FPS, small)


def write_film(path: Path, pictures: Iterable[Picture], count: int, fps: float, small: bool = False) -> Path:
    """Write pictures, about `count` of them, as `write_video` does, and show a progress bar; return the path."""
    with progress(count, "frame", "filming") as bar:

        def shown() -> Iterator[Picture]:
            for picture in pictures:
                bar.update()
                yield picture

        return write_video(path, shown(), fps, small)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let torch compute in one thread, in this block: while all cores draw, its threads wait for each other."""
    import torch  # here, because pictures alone need none

    usual = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(usual)


def frames(env: BatchedEnv, policy: Act, episodes: int, seed: int) -> Iterator[Picture]:
    """Yield pictures of the first environment, `FPS` of them for a second of simulated time."""
    picture = ScenePicture(env)
    return draw_in_threads(picture.draw, _poses(env, policy, picture, episodes, seed))


def draw_in_threads(draw: Callable[[_Shot], Picture], shots: Iterable[_Shot]) -> Iterator[Picture]:
    """Yield the picture of each shot, in order."""
    most = cores()  # a picture takes a tenth of a second of a core, without Python's lock
    drawn: deque[Future[Picture]] = deque()
    with ThreadPoolExecutor(most) as threads:
        for shot in shots:
            drawn.append(threads.submit(draw, shot))
            if len(drawn) > most:
                yield drawn.popleft().result()
        while drawn:
            yield drawn.popleft().result()


def _poses(env: BatchedEnv, policy: Act, picture: ScenePicture, episodes: int, seed: int) -> Iterator[Pose]:
    """Yield the poses that the pictures of `frames` show."""
    every, steps = steps_per_frame(env, FPS), _steps(env, episodes)
    for step, (_, ended) in enumerate(played(env, policy, lambda _, ended: forget(policy, ended), steps, seed), 1):
        if step % every == 0 or ended[0]:
            yield picture.pose()


def played(
    env: BatchedEnv,
    act: Act,
    begin: Callable[[Any, Any], None],
    steps: int,
    seed: int,
    over: Callable[[Mapping[str, Mapping[str, Any]]], NDArray[np.bool_]] | None = None,
) -> Iterator[tuple[dict[str, dict[str, Any]], NDArray[np.bool_]]]:
    """Play episodes, and yield after each step while the environments are as that step left them, ended or not.

    Args:
        env: environments.
        act: from observations to actions.
        begin: called with observations, and with None before the first step or where episodes have ended, [N] bool.
        steps: how many.
        seed: of the first episodes.
        over: takes the infos of a step, and returns which episodes end with it beside those that end themselves.

    Yields:
        Infos by agent, [N] each, and where the step ended an episode, [N] bool.
    """
    before, env.autoreset = env.autoreset, False
    try:
        observations: Any = env.reset(seed)[0]
        begin(observations, None)
        for _ in range(steps):
            outcome = env.step(dict(act(observations)))
            observations, ends = outcome.observations, outcome.terminated | outcome.truncated
            ended = np.array([bool(end) for end in ends])
            if over is not None:
                ended |= over(outcome.infos)
            yield outcome.infos, ended
            if ended.any():
                observations = replaced(observations, np.flatnonzero(ended), env.reset(mask=ended)[0])
            begin(observations, ended)
    finally:
        env.autoreset = before


def steps_per_frame(env: BatchedEnv, fps: float) -> int:
    """Return how many control steps there are from one picture to the next, for about `fps` a simulated second."""
    return max(1, round(1 / (fps * env.control_dt)))


def _steps(env: BatchedEnv, episodes: int) -> int:
    """Return how many steps a video shows."""
    return min(episodes * env.max_steps, round(LONGEST / env.control_dt))


class Pose(NamedTuple):
    """The content of a picture."""

    qpos: NDArray[np.float64]
    origins: NDArray[np.float64]
    """Origins of free objects and middles of edges of threads, m, [k, 3]."""
    quaternions: NDArray[np.float64]
    """Orientations of the same, w, x, y, z, [k, 4]."""
    balls: list[Sphere]
    """A ball at each arm's goal."""
    nodes: list[NDArray[np.float64]]
    """Nodes of the skin of each system that has one, [n, 3] each, m."""


class ScenePicture:
    """Draws an environment of `env`, the first one unless asked otherwise, with a ball at each arm's goal.

    Threads may draw at the same time.
    """

    def __init__(self, env: BatchedEnv, width: int = WIDTH, height: int = HEIGHT) -> None:
        self._env, scene = env, env.scene
        self._skins = skins(scene.systems, scene.model)
        self._renderer = Renderer(scene.model, width, height, stage(scene), paint(scene), self._skins)
        self.view = best_view(scene, task_places(env.task), width / height)
        """The view in which the least is hidden."""

    def draw(self, pose: Pose | None = None, camera: str | View | Focus | None = None) -> Picture:
        """Return a picture [height, width, 3] of the environment.

        It shows the environment as it was at `pose`, or as it is now if there is no `pose`. The `camera` is one of
        `Renderer.render`, or follows what happens; without one the least is hidden (`best_view`).
        """
        pose = pose or self.pose()
        data = mujoco.MjData(model := self._env.scene.model)
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = pose.qpos, pose.origins, pose.quaternions
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        camera = camera(data) if isinstance(camera, Focus) else camera or self.view
        balls = pose.balls
        if isinstance(camera, View):  # from afar a goal is larger than it is, or it would be a dot; from near smaller
            height = 2 * np.tan(np.radians(camera.fovy / 2)) * camera.distance
            balls = [(place, np.clip(radius, LEAST * height, MOST * height), rgba) for place, radius, rgba in balls]
        return self._renderer.render(data, camera, balls, THROUGH, pose.nodes)

    def pose(self, index: int = 0) -> Pose:
        """Return the current pose of an environment, by its number in the batch."""
        balls: list[Sphere] = []
        env = self._env
        marks = env.task.marks(env.goal)
        for number, place in enumerate(marks[index] if marks.size else []):
            balls.append((tuple(place), GOAL_RADIUS, (*goal_colour(number, marks.shape[1], len(env.agents)), 1.0)))
        objects = env.drawn_poses
        qpos, origins, quaternions = (
            np.array(part[index], float) for part in (env.qpos, objects.origin, objects.quaternion)
        )
        nodes = env.drawn_nodes
        return Pose(qpos, origins, quaternions, balls, [np.array(nodes[s.name][index], float) for s in self._skins])
