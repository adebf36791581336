"""Reports and videos that show themselves in a notebook."""

from __future__ import annotations

import os
from pathlib import Path

from surgical_marl.report.command import write
from surgical_marl.report.page import render, video_address
from surgical_marl.report.run import read_run
from surgical_marl.untrusted.markup import as_html


class Report:
    """A report of runs of one task, which a notebook shows inline: `Report("runs/mine")`.

    Args:
        runs: run folders or names of shipped policies.
        height: of the frame in a notebook, in pixels.

    Raises:
        ValueError: something is no run, or the runs are of different tasks.
    """

    def __init__(self, *runs: str | os.PathLike[str], height: int = 720) -> None:
        read = [read_run(run) for run in runs]
        self._given, self._height = [run.given for run in read], height
        self.html = render(read)
        """The page."""

    def __repr__(self) -> str:
        return f"Report({', '.join(map(repr, self._given))})"

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file, and return its path. ValueError if it cannot be written."""
        write(Path(path), self.html)
        return Path(path)

    def _repr_html_(self) -> str:
        page, title = as_html(self.html), as_html(repr(self))
        style = f"width: 100%; height: {self._height}px; border: 1px solid #ccc"
        return f'<iframe title="{title}" sandbox="" style="{style}" srcdoc="{page}"></iframe>'  # its styles stay inside


class Video:
    """A video file that a notebook shows inline and keeps: `Video(record(env, policy, Path("clip.mp4")))`.

    Args:
        path: of an .mp4, .webm or .gif file.
        width: in pixels; a narrower page makes it smaller.

    Raises:
        ValueError: there is no such file.
    """

    def __init__(self, path: str | os.PathLike[str], width: int = 480) -> None:
        self.path, self._width = Path(path), width
        if not self.path.is_file():
            raise ValueError(f"there is no video {self.path}")

    def __repr__(self) -> str:
        return f"Video({str(self.path)!r})"

    def _repr_html_(self) -> str:
        name, address = as_html(self.path.name), video_address(self.path)
        style = f"width: {self._width}px; max-width: 100%"
        if self.path.suffix == ".gif":
            return f'<img alt="{name}" style="{style}" src="{address}">'
        return f'<video controls muted loop playsinline aria-label="{name}" style="{style}" src="{address}"></video>'
