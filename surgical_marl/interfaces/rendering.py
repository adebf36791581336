"""Pictures of an environment, as arrays or in a window: the meaning of `render_mode`."""

from __future__ import annotations

import operator
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.view.record import ScenePicture

MODES = ("human", "rgb_array")
SIZE = (480, 360)
"""Width and height of a picture unless asked otherwise, pixels."""
MOST = 8192
"""Pixels of a side at most."""


def check_mode(mode: str | None, modes: Sequence[str] = MODES) -> None:
    """Raise a ValueError if a render mode is none of the `modes`, or is "human" where no window can be opened."""
    if mode is not None and mode not in modes:
        *first, last = ("None", *map(repr, modes))
        raise ValueError(f"unknown render_mode {mode!r}; the modes are {', '.join(first)} and {last}")
    if mode == "human":
        from matplotlib import get_backend

        # Without a display matplotlib itself chooses "agg", which draws on nothing. Who asks for it gets it.
        if get_backend().lower() == "agg" and os.environ.get("MPLBACKEND", "").lower() != "agg":
            raise ValueError("render_mode 'human' needs a display, and there is none: use render_mode='rgb_array'")


def check_size(size: Any) -> tuple[int, int]:
    """Return width and height of pictures in pixels, `SIZE` for None; ValueError if they are no such numbers."""
    try:
        width, height = SIZE if size is None else size
        good = 1 <= (width := operator.index(width)) <= MOST and 1 <= (height := operator.index(height)) <= MOST
    except (TypeError, ValueError):
        good = False
    if not good:
        raise ValueError(f"render_size {size!r} must be width and height of a picture, 1 to {MOST} pixels each")
    return width, height


class Rendering:
    """Pictures of the first environment of a batch, as `mode` says.

    A copy has the same mode and size, and a window of its own.

    Args:
        batch: environments.
        mode: one of `MODES`, or None.
        size: width and height, pixels; None for `SIZE`.
    """

    def __init__(self, batch: BatchedEnv, mode: str | None, size: tuple[int, int] | None = None) -> None:
        check_mode(mode)
        self.batch, self.mode, self.size = batch, mode, check_size(size)
        self._picture: ScenePicture | None = None
        self._window: Any = None

    def render(self) -> np.ndarray | None:
        """Return a picture [H, W, 3] uint8 with mode "rgb_array", show it with "human", do nothing with None.

        Who closes the window sees no more of the environment, and steps take no longer than without one.

        Raises:
            ValueError: no episode has begun, or the environment is closed.
        """
        self.batch.check_open()
        if self.mode is None or self._closed_by_hand():
            return None
        from surgical_marl.view.record import ScenePicture

        self._picture = self._picture or ScenePicture(self.batch, *self.size)
        drawn = self._picture.draw()
        if self.mode == "rgb_array":
            return drawn
        self._show(drawn)
        return None

    def follow(self) -> None:
        """Show the current state, with mode "human"."""
        if self.mode == "human":
            self.render()

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            from matplotlib import pyplot

            pyplot.close(self._window.figure)
        self._picture = self._window = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_picture": None, "_window": None}

    def _closed_by_hand(self) -> bool:
        if self._window is None:
            return False
        from matplotlib import pyplot

        return not pyplot.fignum_exists(self._window.figure.number)

    def _show(self, drawn: np.ndarray) -> None:
        from matplotlib import pyplot

        if self._window is None:
            with pyplot.rc_context({"toolbar": "None"}):  # its buttons are for plots
                figure = pyplot.figure(self.batch.env.title, frameon=False)
            axes = figure.add_axes((0, 0, 1, 1))
            axes.set_axis_off()
            self._window = axes.imshow(drawn)
            pyplot.show(block=False)
        self._window.set_data(drawn)
        self._window.figure.canvas.draw_idle()
        self._window.figure.canvas.flush_events()
