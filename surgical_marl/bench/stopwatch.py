"""Measures the seconds of a training's parts without slowing them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import torch

from surgical_marl.learning.trainer import Trainer

STARTING = 2
"""Iterations that take longer than the others: a CUDA graph is captured in the second."""


class Stopwatch:
    """Takes the time of each rollout and update of a training.

    On a GPU it records CUDA events in the stream, so that nothing waits for the device.
    """

    def __init__(self, training: Trainer) -> None:
        self._cuda = str(training.env.device).startswith("cuda")
        self._marks: dict[str, list[tuple[Any, Any]]] = {}
        for name in ("rollout", "update"):
            setattr(training, name, self._timed(name, getattr(training, name)))

    def seconds(self, name: str) -> list[float]:
        """Of each "rollout" or "update" so far. Waits for the device."""
        self.wait()
        if self._cuda:
            return [start.elapsed_time(end) / 1e3 for start, end in self._marks[name]]
        return [end - start for start, end in self._marks[name]]

    def wait(self) -> None:
        """Wait until all work so far is done."""
        if self._cuda:
            torch.cuda.synchronize()

    def _timed(self, name: str, work: Callable[[], None]) -> Callable[[], None]:
        marks = self._marks[name] = []

        def run() -> None:
            start = self._mark()
            work()
            marks.append((start, self._mark()))

        return run

    def _mark(self) -> Any:
        if not self._cuda:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event


def rows(training: Trainer) -> Iterator[dict[str, float]]:
    """Yield the metrics of one iteration after the other, without end.

    On a GPU a row is read when the next iteration is under way, as `train` does, so that the device always has
    something to do.
    """
    ahead = training.iterate() if str(training.env.device).startswith("cuda") else None
    while True:
        report, ahead = (training.iterate(), None) if ahead is None else (ahead, training.iterate())
        yield training.row(report)
