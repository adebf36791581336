"""Words of films: how long it has taken, how each arm is doing, which stages are reached, and whether it has worked.

Arms have their own colours. A stage stays reached until the episode ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from surgical_marl.plugins.task_file import label
from surgical_marl.view.history import reported, summary
from surgical_marl.view.shading import AGENTS

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

Picture = NDArray[np.uint8]
Rgb = tuple[int, int, int]

WHITE, GREY, GREEN, RED = (245, 245, 245), (150, 158, 166), (70, 220, 120), (255, 90, 80)
GROUND = (24, 28, 33)
"""Colour of a panel."""
_LINES = 32
"""Lines that are as high as a picture."""
_SPACING = 1.3
"""Height of a line, in sizes of letters."""
_SMALLEST = 10
"""Size of letters at least, pixels."""
_FAULTS = ("collision", "drop")


class Caption(NamedTuple):
    """A line of words."""

    text: str
    colour: Rgb = WHITE


_FORCES = "tissue_force", "tension"
"""What systems report that a film says: all else would make letters too small."""


class Captions:
    """Reads the captions of environments, step by step."""

    def __init__(self, env: BatchedEnv) -> None:
        self._env, self._forces = env, [name for name in reported(env.scene) if name in _FORCES]
        self._reached: list[set[str]] = [set() for _ in range(env.num_envs)]

    def read(self, infos: Mapping[str, Mapping[str, Any]], index: int) -> list[Caption]:
        """Return the captions of an environment after a step with these infos, [N] each."""
        env, reached = self._env, self._reached[index]
        reached |= {
            name for name in env.task.stages if any(_true(own, f"stage_{name}", index) for own in infos.values())
        }
        time = float(np.asarray(env.steps)[index]) * env.control_dt
        found = [Caption(f"{time:.2f} s  {label(env.task_name)}")]
        for number, agent in enumerate(env.agents):
            words = [word for word in summary(infos[agent], index) if not word.startswith("stages ")]
            found.append(Caption(f"{agent}  {', '.join(words)}", colour_of(number)))
        if any(_true(own, name, index) for own in infos.values() for name in _FAULTS):
            found[0] = found[0]._replace(colour=RED)
        for name in self._forces:
            value = float(np.asarray(infos[env.agents[0]][name])[index])
            found.append(Caption(f"{name.replace('_', ' ')}  {value:.2f} N", GREY))
        for name in env.task.stages:
            done = name in reached
            found.append(Caption(f"{'+' if done else '-'} {name.replace('_', ' ')}", WHITE if done else GREY))
        worked = all(_true(own, "success", index) for own in infos.values())
        return [*found, Caption("success" if worked else "", GREEN)]  # always a line, so that letters keep their size

    def forget(self, ended: NDArray[np.bool_]) -> None:
        """Begin anew where episodes have ended, [N] bool."""
        for index in np.flatnonzero(ended):
            self._reached[index] = set()


def colour_of(agent: int) -> Rgb:
    """Return the colour of an agent by its number, as light as words on a dark ground need."""
    red, green, blue = (round(255 * (0.25 + 0.75 * part)) for part in AGENTS[agent % len(AGENTS)])
    return red, green, blue


def panel(captions: Sequence[Caption], width: int, height: int, whole: int) -> Picture:
    """Return captions on a dark ground, [height, width, 3]; letters fit a picture of a height of `whole` pixels.

    They are smaller where there are so many lines that some would be cut off.
    """
    image = Image.new("RGB", (width, height), GROUND)
    size = min(max(_SMALLEST, whole // _LINES), int(height / (_SPACING * len(captions) + 1 / 3)) if captions else whole)
    _write(ImageDraw.Draw(image), captions, width, max(size, 1))
    return np.asarray(image)


def written(picture: Picture, captions: Sequence[Caption]) -> Picture:
    """Return a picture with captions in its upper left corner, on a dark ground."""
    if not captions:
        return picture
    size, image = max(_SMALLEST, len(picture) // 24), Image.fromarray(picture)
    draw, width = ImageDraw.Draw(image, "RGBA"), picture.shape[1]
    right, bottom = _write(draw, captions, width, size, shown=False)
    draw.rectangle((0, 0, right + size // 2, bottom + size // 4), fill=(0, 0, 0, 130))
    _write(draw, captions, width, size)
    return np.asarray(image)


def _write(
    draw: ImageDraw.ImageDraw, captions: Sequence[Caption], width: int, size: int, shown: bool = True
) -> tuple[int, int]:
    """Write captions from the upper left corner on, and return how far they reach to the right and down, pixels."""
    font, left, right, top = ImageFont.load_default(size), size // 2, 0, size // 3
    for text, colour in captions:
        for line in wrapped(text, font, width - 2 * left):
            if shown:
                draw.text((left, top), line, font=font, fill=colour)
            right, top = max(right, left + round(font.getlength(line))), top + round(_SPACING * size)
    return right, top


def wrapped(line: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: float) -> list[str]:
    """Return a line as several, parted at commas where it would be wider than so many pixels."""
    found: list[str] = []
    for part in line.split(", "):
        if found and font.getlength(f"{found[-1]}, {part}") <= width:
            found[-1] += f", {part}"
        else:
            found.append(f"  {part}" if found else part)
    return found


def _true(info: Mapping[str, Any], name: str, index: int) -> bool:
    return name in info and bool(np.asarray(info[name])[index])
