"""Progress of long work: a bar or a line that changes in a terminal, a widget in a notebook, lines elsewhere."""

from __future__ import annotations

import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from tqdm import tqdm

from surgical_marl.engines.compilation import DONE, FAILED
from surgical_marl.files import has_temporary_caches
from surgical_marl.untrusted.values import plural

EVERY = 30.0
"""Seconds between the lines of a bar that goes to a file or a pipe."""
PATIENCE = 1.0
"""Seconds without a word after which `preparing` speaks."""
PAUSE = 2.0
"""Seconds between lines on a compilation that go to a file or a pipe, at least."""
TICK = 0.5
"""Seconds after which the line on a compilation changes in a terminal."""
_waiting: list[threading.Timer] = []
"""Pending sentences of `preparing`."""
SHORT = 20
"""Longest title, in characters, that stands before a bar in a terminal; a longer one stands above it."""
_NUMBERS = "{n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"
"""Without tqdm's rate, for which a terminal of 80 columns has no room beside the figures."""
_LAYOUTS = "{l_bar}{bar}| " + _NUMBERS, "{desc}" + _NUMBERS, _NUMBERS
"""Layouts of a bar, from the widest to the narrowest."""
_LINE = "{desc}{n_fmt} of {total_fmt} {unit}, {elapsed} done, {remaining} left{postfix}"


def progress(total: int, unit: str, what: str = "", begun: int = 0, leave: bool = True) -> tqdm:
    """Return a bar on stderr to call `update()` and `set_postfix_str(figures, refresh=False)` of, and to close.

    In a notebook with `ipywidgets` it is a widget. Where stderr is no terminal, it is a line at the start, one at
    most every `EVERY` seconds, and one at the end. In a narrow terminal numbers and figures take the place of the bar.

    Args:
        total: how many there are to do.
        unit: what is counted, one of it, such as "step".
        what: what is done, before the bar, or on a line above it if it is longer than `SHORT`.
        begun: how many are done already.
        leave: whether the bar stays when it is closed.
    """
    _hush()
    options: dict[str, Any] = {
        "total": total,
        "unit": plural(total, unit),
        "desc": f"{what}: " if what else None,
        "initial": begun,
        "leave": leave,
    }
    if _has_widgets():
        from tqdm.auto import tqdm as widget

        return widget(**options)
    if sys.stderr.isatty():
        if len(what) > SHORT:
            _write(f"{what}\n")
            options["desc"] = None
        return _Bar(**options, file=sys.stderr, dynamic_ncols=True)
    # tqdm's monitor would write a line after maxinterval, by default 10 s, even where nothing is new.
    lines = {"file": _Lines(sys.stderr), "mininterval": EVERY, "maxinterval": EVERY, "bar_format": _LINE}
    return tqdm(**{**options, **lines, "leave": True})


@contextmanager
def preparing(what: str) -> Iterator[None]:
    """Name on stderr the work that is prepared, if it takes longer than `PATIENCE` and no bar has appeared meanwhile.

    Bad input is found sooner than that in most cases, and then there is only its error.
    """
    timer = threading.Timer(PATIENCE, say, (f"preparing {what}",))
    timer.daemon = True
    _waiting.append(timer)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        _waiting.remove(timer)


class Compilations:
    """Shows the phase of a compilation on stderr; `engines.compilation.told` takes it.

    In a terminal it is one line with the stage and the seconds so far, and at the end with how long it took. Elsewhere
    it is a line at the start, one for each later stage unless the last line is younger than `PAUSE`, one at the end.
    """

    def __init__(self) -> None:
        self._title = self._stage = ""
        self._begun = self._said = 0.0
        self._lock = threading.Lock()
        self._ended = threading.Event()

    def __call__(self, title: str, stage: str) -> None:
        """Take note of a stage that begins, or of the end."""
        now, live = time.monotonic(), sys.stderr.isatty()
        with self._lock:
            first, self._title, self._stage = title != self._title, title, stage
            if first:
                _hush()
                self._begun, self._said = now, -PAUSE + now
                self._ended.set()
                self._ended = threading.Event()
                if live:
                    threading.Thread(target=self._tick, args=(self._ended,), daemon=True).start()
            if stage in (DONE, FAILED):
                self._ended.set()
                self._title = ""
                took = f"surgical-marl: compiled {title} in {now - self._begun:.0f} s{_kept()}\n"
                _write(("\r\x1b[K" if live else "") + (took if stage == DONE else ""))
            elif live:
                self._draw()
            elif now - self._said >= PAUSE:
                self._said = now
                _write(f"surgical-marl: compiling {title}: {stage}{_kept() if first else ''}\n")

    def _tick(self, ended: threading.Event) -> None:
        while not ended.wait(TICK):
            with self._lock:
                if not ended.is_set():
                    self._draw()

    def _draw(self) -> None:
        # the title last: it is what a narrow terminal cuts off
        line = f"surgical-marl: compiling, {time.monotonic() - self._begun:.0f} s, {self._stage}: {self._title}"
        room = max(_columns() - 1, 10)
        _write(f"\r\x1b[K{line if len(line) <= room else line[: room - 3] + '...'}")


def _kept() -> str:
    """Return a text on where a compilation is kept; empty if it is lost."""
    return "" if has_temporary_caches() else "; a second start takes it from the cache"


def _columns() -> int:
    """Return the width of the terminal on stderr; stdout may go elsewhere."""
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns
    except (OSError, ValueError):  # it has no file, or the file no size
        return shutil.get_terminal_size().columns


def _write(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()


def _hush() -> None:
    """Let `preparing` say nothing: something else tells more."""
    for timer in _waiting:
        timer.cancel()


def say(text: str) -> None:
    """Write a line on stderr."""
    print(f"surgical-marl: {text}", file=sys.stderr, flush=True)


def _has_widgets() -> bool:
    """Return whether this is a notebook that can show widgets."""
    if "ipykernel.zmqshell" not in sys.modules:  # tqdm asks the same
        return False
    from tqdm.auto import tqdm as automatic
    from tqdm.notebook import tqdm as widget

    return issubclass(automatic, widget)


class _Bar(tqdm):
    """A bar in a terminal that leaves out whole parts for which there is no room: first the bar, then the last figures.

    tqdm itself would cut figures off in the middle of a word.
    """

    @property
    def format_dict(self) -> dict[str, Any]:
        """Values from which tqdm draws a bar."""
        found: dict[str, Any] = super().format_dict
        room = found["ncols"]
        if not room:  # unknown
            return {**found, "bar_format": _LAYOUTS[0]}
        figures = str(found["postfix"]).split(", ") if found["postfix"] else []
        told = [", ".join(figures[:count]) for count in range(len(figures), -1, -1)]
        for layout, postfix in [(layout, told[0]) for layout in _LAYOUTS] + [(_LAYOUTS[-1], less) for less in told]:
            drawn = {**found, "bar_format": layout, "postfix": postfix}
            if len(self.format_meter(**{**drawn, "ncols": None})) <= room:  # with a bar of ten characters
                return drawn
        return {**found, "bar_format": "{percentage:.0f}%"}


class _Lines:
    """A stream that gets each state of a bar as a line, instead of all of them over each other."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._last = stream, ""

    def write(self, text: str) -> None:
        line = text.strip("\r\n ")
        if line and line != self._last:  # a bar that is closed is drawn once more
            self._stream.write(f"{line}\n")
            self._last = line

    def flush(self) -> None:
        self._stream.flush()
