"""What a compilation is at. Whoever asks is told, and the log of this package at level INFO; nobody else hears of it.

with told(lambda title, stage: print(title, stage)):
    ...

with compiling("reach on psm (fused, cpu)") as stage:
    stage("tracing the step")
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Stage = Callable[[str], None]
"""Takes the name of the stage that begins."""
Listener = Callable[[str, str], None]
"""Takes the title of a compilation and the name of the stage that begins: `DONE` at the end, `FAILED` after errors."""
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
def compiling(title: str) -> Iterator[Stage]:
    """Say what is compiled; yield what names its stages. Without a stage, as all was kept on disk, nothing is said."""
    begun = False

    def stage(name: str) -> None:
        nonlocal begun
        begun = True
        _tell(title, name)

    try:
        yield stage
    except BaseException:
        if begun:
            _tell(title, FAILED)
        raise
    if begun:
        _tell(title, DONE)


def unsaid(name: str) -> None:
    """Name a stage to nobody."""


def _tell(title: str, stage: str) -> None:
    _log.info("compiling %s: %s", title, stage)
    for listener in _listeners:
        listener(title, stage)
