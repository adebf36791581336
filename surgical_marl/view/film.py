"""Films of a policy for `surgical-marl play`: from outside, from near and from the endoscope, with words beside.

    env = make_env(settings, num_envs=16, arrays="numpy")
    film(env, Movers(env, "oracle"), Path("sixteen.mp4"), Look(grid=(4, 4)))

The environments of a grid play at the same time, and each frame holds all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgical_marl.content import unknown
from surgical_marl.view.camera import Focus
from surgical_marl.view.captions import Caption, Captions, panel, written
from surgical_marl.view.moment import Observer
from surgical_marl.view.record import (
    FPS,
    Picture,
    Pose,
    ScenePicture,
    draw_in_threads,
    played,
    steps_per_frame,
    write_film,
)
from surgical_marl.view.render import View

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.view.movers import Movers

WIDTH, HEIGHT = 1280, 720
"""Pixels of a film, about: one of several environments is as wide."""
AFTER = 1.2
"""Time that a film goes on after success, s."""
SMALLEST, LARGEST = 16, 4096
"""Pixels of a side of a picture. A grid is at most twice as wide and high: a frame of 64 of the largest has 3 GB."""
TURNS = 3600.0
"""Angles of a camera at most, degrees."""
CLOSEST, FARTHEST = 0.001, 100.0
"""Distances of a camera, m."""
MOST = 8
"""Rows and columns of a grid at most."""


@dataclass(frozen=True)
class Look:
    """Style of a film.

    Attributes:
        grid: rows and columns of environments.
        slow: how many times slower than real time.
        camera: a camera of the scene by name, or a free one; None for the view in which the least is hidden.
        words: whether to write errors and stages into the pictures.
        size: width and height of the picture of one environment, pixels; None for 1280 and 720, and less in a grid.
        fps: pictures a second of the film, about.

    Raises:
        ValueError: a grid, a slowness or a size that can't be.
    """

    grid: tuple[int, int] = (1, 1)
    slow: float = 1.0
    camera: str | View | None = None
    words: bool = True
    size: tuple[int, int] | None = None
    fps: float = FPS

    def __post_init__(self) -> None:
        if not all(1 <= side <= MOST for side in self.grid):
            raise ValueError(f"a grid has 1 to {MOST} rows and columns, not {self.grid[0]}x{self.grid[1]}")
        if not 0.1 <= self.slow <= 100:
            raise ValueError(f"slow must be from 0.1 to 100, not {self.slow:g}")
        if self.size is not None and not all(SMALLEST <= side <= LARGEST for side in self.size):
            width, height = self.size
            raise ValueError(f"a film is {SMALLEST} to {LARGEST} pixels wide and high, not {width}x{height}")
        rows, columns = self.grid
        width, height = self.tile[0] * columns, self.tile[1] * rows
        if max(width, height) > 2 * LARGEST:
            raise ValueError(
                f"a grid of {rows}x{columns} makes a film of {width}x{height} pixels: ask for a smaller size, so that "
                f"it is at most {2 * LARGEST} pixels wide and high"
            )

    @property
    def tile(self) -> tuple[int, int]:
        """Width and height of the picture of one environment, pixels."""
        if self.size is not None:
            return self.size
        if self.grid == (1, 1):
            return WIDTH, HEIGHT
        width = WIDTH // self.grid[1] // 2 * 2
        return width, 3 * width // 8 * 2

    @property
    def column(self) -> int:
        """Width of the column beside the picture of a single environment, with words and insets, pixels."""
        return self.tile[0] * 9 // 32

    def inset(self, count: int) -> int:
        """Return the height of each of so many insets, pixels: words have the rest of the column."""
        _, height = self.tile
        return min(self.column, height * 7 // 10 // count) if self.words else height // count


class Shot(NamedTuple):
    """Content of a frame of one environment."""

    pose: Pose
    captions: list[Caption]


def film(env: BatchedEnv, movers: Movers, path: Path, look: Look, episodes: int = 1, seed: int = 0) -> Path:
    """Film the environments of `env`, as many as `look.grid` holds, and return the path of the film."""
    every = steps_per_frame(env, look.fps * look.slow)
    count, fps = -(-episodes * env.max_steps // every), 1 / (every * env.control_dt * look.slow)
    return write_film(path, pictures(env, movers, look, episodes, seed), count, fps)


def pictures(env: BatchedEnv, movers: Movers, look: Look, episodes: int = 1, seed: int = 0) -> Iterator[Picture]:
    """Yield the pictures of a film, each of all environments."""
    width, height = look.tile
    alone = look.grid == (1, 1)
    picture = ScenePicture(env, width - look.column if alone else width, height)
    insets = _insets(env, look, picture.view) if alone else []

    def draw(shot: Shot) -> Picture:
        seen = picture.draw(shot.pose, look.camera)
        if not alone:
            return written(seen, shot.captions)
        near = [inset(shot.pose) for inset in insets]
        words = panel(shot.captions, look.column, height - sum(map(len, near)), height)
        return np.concatenate([seen, np.concatenate([words, *near])], 1)

    def draw_all(shots: list[Shot]) -> Picture:
        return wall(map(draw, shots), look.grid[1])

    return draw_in_threads(draw_all, _shots(env, movers, look, picture, episodes, seed))


def camera_of(text: str | None, env: BatchedEnv) -> str | View | None:
    """Return the camera that a text names: one of the scene, or AZIMUTH,ELEVATION,DISTANCE about the tool tips.

    Raises:
        ValueError: it names none.
    """
    names = [env.scene.model.camera(index).name for index in range(env.scene.model.ncam)]
    if text is None or text in names:
        return text
    try:
        azimuth, elevation, distance = map(float, text.split(","))
    except ValueError:
        raise unknown("camera", text, [*names, "AZIMUTH,ELEVATION,DISTANCE"]) from None
    if not (abs(azimuth) <= TURNS and abs(elevation) <= TURNS and CLOSEST <= distance <= FARTHEST):
        raise ValueError(
            f"a camera's angles are from {-TURNS:g} to {TURNS:g} degrees and its distance from {CLOSEST:g} to "
            f"{FARTHEST:g} m, not {text!r}"
        )
    env.reset(0)
    middle = Observer(env.scene).look(env).tips[0].mean(0)
    return View(middle, distance, azimuth, elevation)


def wall(pictures: Iterable[Picture], columns: int) -> Picture:
    """Return pictures of the same size as one, row by row."""
    tiles = list(pictures)
    rows = [np.concatenate(tiles[first : first + columns], 1) for first in range(0, len(tiles), columns)]
    return np.concatenate(rows, 0)


def _shots(
    env: BatchedEnv, movers: Movers, look: Look, picture: ScenePicture, episodes: int, seed: int
) -> Iterator[list[Shot]]:
    """Yield the shots of each frame, one per environment, while the environments play.

    An episode of a task with stages ends `AFTER` all environments have succeeded.
    """
    every, captions = steps_per_frame(env, look.fps * look.slow), Captions(env)
    done = np.zeros(env.num_envs)  # steps since success

    def over(infos: Mapping[str, Mapping[str, Any]]) -> NDArray[np.bool_]:
        nonlocal done
        success = np.all([np.asarray(own["success"], bool) for own in infos.values()], axis=0)
        done = np.where(success, done + 1, 0)
        return np.full(env.num_envs, bool(env.task.stages) and bool((done * env.control_dt > AFTER).all()))

    left, steps = episodes, episodes * env.max_steps
    for step, (infos, ended) in enumerate(played(env, movers.actions, movers.begin, steps, seed, over), 1):
        words = [captions.read(infos, index) if look.words else [] for index in range(env.num_envs)]
        if step % every == 0 or ended.any():
            yield [Shot(picture.pose(index), words[index]) for index in range(env.num_envs)]
        if ended.any():
            captions.forget(ended)
            left, done = left - 1, np.where(ended, 0, done)
            if ended.all() and not left:
                return


def _insets(env: BatchedEnv, look: Look, view: View) -> list[Callable[[Pose], Picture]]:
    """Return functions that draw the pictures beside a film: from near, and the endoscope's if there is one."""
    cameras = [f"{agent}/left" for agent, mount in env.scene.mounts.items() if mount.arm.camera is not None]
    width, height = look.column, look.inset(1 + len(cameras[:1]))
    picture = ScenePicture(env, width, height)

    def drawn(camera: str | Focus) -> Callable[[Pose], Picture]:
        return lambda pose: picture.draw(pose, camera)

    return [drawn(Focus(env.scene, view)), *map(drawn, cameras[:1])]
