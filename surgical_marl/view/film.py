"""Films of a policy for `surgical-marl play`: from outside and from the endoscope, with errors and stages in words.

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
from PIL import Image, ImageDraw, ImageFont

from surgical_marl.content import unknown
from surgical_marl.view.history import summary
from surgical_marl.view.moment import Observer
from surgical_marl.view.record import (
    FPS,
    HEIGHT,
    WIDTH,
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

WALL = 1280
"""Pixels along the width of a film of several environments, about."""
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
        size: width and height of the picture of one environment, pixels; None for 480 and 360, and less in a grid.
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
        width = WALL // self.grid[1] // 2 * 2
        return width, width * HEIGHT // WIDTH // 2 * 2


class Shot(NamedTuple):
    """Content of a frame of one environment."""

    pose: Pose
    words: list[str]


def film(env: BatchedEnv, movers: Movers, path: Path, look: Look, episodes: int = 1, seed: int = 0) -> Path:
    """Film the environments of `env`, as many as `look.grid` holds, and return the path of the film."""
    every = steps_per_frame(env, look.fps * look.slow)
    count, fps = -(-episodes * env.max_steps // every), 1 / (every * env.control_dt * look.slow)
    return write_film(path, pictures(env, movers, look, episodes, seed), count, fps)


def pictures(env: BatchedEnv, movers: Movers, look: Look, episodes: int = 1, seed: int = 0) -> Iterator[Picture]:
    """Yield the pictures of a film, each of all environments."""
    picture, scope = ScenePicture(env, *look.tile), _scope(env, look)

    def draw(shot: Shot) -> Picture:
        seen = written(picture.draw(shot.pose, look.camera), shot.words)
        return seen if scope is None else np.concatenate([seen, scope(shot.pose)], 1)

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


def written(picture: Picture, lines: list[str]) -> Picture:
    """Return a picture with lines of text in its upper left corner, on a dark ground."""
    if not lines:
        return picture
    size = max(10, len(picture) // 24)
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    font = ImageFont.load_default(size)
    text = "\n".join(part for line in lines for part in _wrapped(line, font, picture.shape[1] - size - 8))
    left, top, right, bottom = draw.multiline_textbbox((size // 2, size // 2), text, font=font)
    draw.rectangle((left - 4, top - 4, right + 4, bottom + 4), fill=(0, 0, 0, 130))
    draw.multiline_text((size // 2, size // 2), text, font=font, fill=(255, 255, 255, 255))
    return np.asarray(image)


def _wrapped(line: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: float) -> list[str]:
    """Return a line as several, parted at commas where it would be wider than so many pixels."""
    found: list[str] = []
    for part in line.split(", "):
        if found and font.getlength(f"{found[-1]}, {part}") <= width:
            found[-1] += f", {part}"
        else:
            found.append(f"  {part}" if found else part)
    return found


def _shots(
    env: BatchedEnv, movers: Movers, look: Look, picture: ScenePicture, episodes: int, seed: int
) -> Iterator[list[Shot]]:
    """Yield the shots of each frame, one per environment, while the environments play."""
    every, steps = steps_per_frame(env, look.fps * look.slow), episodes * env.max_steps
    for step, (infos, ended) in enumerate(played(env, movers.actions, movers.begin, steps, seed), 1):
        if step % every == 0 or ended.any():
            words = [_words(env, infos, index) if look.words else [] for index in range(env.num_envs)]
            yield [Shot(picture.pose(index), words[index]) for index in range(env.num_envs)]


def _words(env: BatchedEnv, infos: Mapping[str, Mapping[str, Any]], index: int) -> list[str]:
    time = float(np.asarray(env.steps)[index]) * env.control_dt
    return [f"{time:.2f} s", *(f"{agent}  {', '.join(summary(infos[agent], index))}" for agent in env.agents)]


def _scope(env: BatchedEnv, look: Look) -> Callable[[Pose], Picture] | None:
    """Return a function that draws the endoscope's view; None in a scene without an endoscope, and in a grid."""
    cameras = [agent for agent, mount in env.scene.mounts.items() if mount.arm.camera is not None]
    if not cameras or look.grid != (1, 1):
        return None
    _, side = look.tile
    picture = ScenePicture(env, side, side)
    return lambda pose: picture.draw(pose, f"{cameras[0]}/left")
