"""An export of episodes as it is asked for, and the names that it may use."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from surgical_marl.runs.settings import Settings

MOST = 4096
"""Pixels of a side of a picture at most."""


@dataclass(frozen=True)
class Request:
    """An export, as it is asked for.

    Raises:
        ValueError: a size that no film can have.
    """

    format: str
    """A name of `surgical_marl.data.formats.FORMATS`."""
    takes: tuple[Path, ...] = ()
    """Takes that are exported; without any, a policy plays."""
    policy: str = "oracle"
    settings: Settings | None = None
    """Of the environments in which the policy plays."""
    episodes: int | None = None
    """How many; None for all of the takes."""
    pictures: tuple[str, ...] = ()
    """Of `PICTURES`."""
    size: tuple[int, int] = (480, 480)
    """Width and height of pictures, pixels: even, and at most `MOST`."""
    rate: int | None = None
    """Rows a second; None for one in each control step."""
    actions: str | None = None
    """One of `FORMS`; None for that of the format."""
    only_success: bool = False
    """Leave out episodes in which not all agents succeed at the end."""

    def __post_init__(self) -> None:
        width, height = self.size
        if not all(2 <= side <= MOST and side % 2 == 0 for side in self.size):
            raise ValueError(f"--size must be even numbers of pixels from 2 to {MOST}, not {width}x{height}")
