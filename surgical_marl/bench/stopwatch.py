"""Measures the seconds of a training's parts without slowing them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch

from surgical_marl.learning.reporter import Mark, mark, seconds_between
from surgical_marl.learning.trainer import Trainer

STARTING = 2
"""Iterations that take longer than the others: a CUDA graph is captured in the second."""


class Stopwatch:
    """Takes the time of each rollout and update of a training.

    On a GPU it records CUDA events in the stream, so that nothing waits for the device.
    """

    def __init__(self, training: Trainer) -> None:
        self._cuda = str(training.env.device).startswith("cuda")
        self._marks: dict[str, list[tuple[Mark, Mark]]] = {}
        for name in ("rollout", "update"):
            setattr(training, name, self._timed(name, getattr(training, name)))

    def seconds(self, name: str) -> list[float]:
        """Of each "rollout" or "update" so far. Waits for the device."""
        self.wait()
        return [seconds_between(*marks) for marks in self._marks[name]]

    def wait(self) -> None:
        """Wait until all work so far is done."""
        if self._cuda:
            torch.cuda.synchronize()

    def _timed(self, name: str, work: Callable[[], None]) -> Callable[[], None]:
        marks = self._marks[name] = []

        def run() -> None:
            start = mark(self._cuda)
            work()
            marks.append((start, mark(self._cuda)))

        return run


def rows(training: Trainer) -> Iterator[dict[str, float]]:
    """Yield the metrics of one iteration after the other, without end.

    On a GPU a row is read when the next iteration is under way, as `train` does, so that the device always has
    something to do.
    """
    ahead = training.iterate() if str(training.env.device).startswith("cuda") else None
    while True:
        report, ahead = (training.iterate(), None) if ahead is None else (ahead, training.iterate())
        yield training.row(report)
