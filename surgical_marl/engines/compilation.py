"""The phases of a compilation. Whoever asks is told, and the log of this package at level INFO; nobody else is.

with told(lambda title, phase: print(title, phase)):
    ...

with compiling("reach on psm (fused, cpu)") as phase:
    phase("tracing the step")
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Phase = Callable[[str], None]
"""Takes the name of the phase that begins."""
Listener = Callable[[str, str], None]
"""Takes the title of a compilation and the name of the phase that begins: `DONE` at the end, `FAILED` after errors."""
DONE, FAILED = "done", "failed"

_log = logging.getLogger("surgical_marl")
_listeners: list[Listener] = []


@contextmanager
def told(listener: Listener) -> Iterator[None]:
    """Tell somebody what compilations are at, in this block."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


@contextmanager
def compiling(title: str) -> Iterator[Phase]:
    """Say what is compiled; yield what names its phases. Without a phase, as all was kept on disk, nothing is said."""
    begun = False

    def phase(name: str) -> None:
        nonlocal begun
        begun = True
        _tell(title, name)

    try:
        yield phase
    except BaseException:
        if begun:
            _tell(title, FAILED)
        raise
    if begun:
        _tell(title, DONE)


def unsaid(name: str) -> None:
    """Name a phase to nobody."""


def _tell(title: str, phase: str) -> None:
    _log.info("compiling %s: %s", title, phase)
    for listener in _listeners:
        listener(title, phase)
