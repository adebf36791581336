"""Progress bars: a bar in a terminal, a widget in a notebook, and now and then a line anywhere else."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from tqdm import tqdm

EVERY = 30.0
"""Seconds between the lines of a bar that goes to a file or a pipe."""
PATIENCE = 1.0
"""Seconds without a word after which `preparing` speaks."""
_waiting: list[threading.Timer] = []
"""What `preparing` would say."""
_LINE = "{desc}{n_fmt} of {total_fmt} {unit}, {elapsed} done, {remaining} left{postfix}"


def progress(total: int, unit: str, what: str = "", begun: int = 0, leave: bool = True) -> tqdm:
    """Return a bar on stderr to call `update()` and `set_postfix_str(figures, refresh=False)` of, and to close.

    In a notebook with `ipywidgets` it is a widget. Where stderr is no terminal, it is a line at the start, one at
    most every `EVERY` seconds, and one at the end.

    Args:
        total: how many there are to do.
        unit: what is counted, such as "step".
        what: what is done, before the bar.
        begun: how many are done already.
        leave: whether the bar stays when it is closed.
    """
    for timer in _waiting:
        timer.cancel()
    options: dict[str, Any] = {
        "total": total,
        "unit": unit,
        "desc": f"{what}: " if what else None,
        "initial": begun,
        "leave": leave,
    }
    if _has_widgets():
        from tqdm.auto import tqdm as widget

        return widget(**options)
    if sys.stderr.isatty():
        return tqdm(**options, file=sys.stderr, dynamic_ncols=True)
    # tqdm's monitor would write a line after maxinterval, by default 10 s, even where nothing is new.
    lines = {"file": _Lines(sys.stderr), "mininterval": EVERY, "maxinterval": EVERY, "bar_format": _LINE}
    return tqdm(**{**options, **lines, "leave": True})


@contextmanager
def preparing(what: str) -> Iterator[None]:
    """Say on stderr what is prepared if that takes longer than `PATIENCE`, and no bar has appeared meanwhile.

    Bad input is found sooner than that in most cases, and then there is only its error.
    """
    timer = threading.Timer(PATIENCE, _say, (what,))
    timer.daemon = True
    _waiting.append(timer)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        _waiting.remove(timer)


def _say(what: str) -> None:
    print(f"surgical-marl: preparing {what}", file=sys.stderr, flush=True)


def _has_widgets() -> bool:
    """Return whether this is a notebook that can show widgets."""
    if "ipykernel.zmqshell" not in sys.modules:  # tqdm asks the same
        return False
    from tqdm.auto import tqdm as automatic
    from tqdm.notebook import tqdm as widget

    return issubclass(automatic, widget)


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
