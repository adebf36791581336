"""The log of a training: `metrics.csv`, tensorboard and a progress bar."""

from __future__ import annotations

import csv
import math
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from surgical_marl.learning.faults import Fault
from surgical_marl.learning.reporter import Report
from surgical_marl.learning.trainer import Trainer
from surgical_marl.runs.folder import METRICS, format_row
from surgical_marl.runs.progress import progress


class Reports:
    """Reads an iteration's report when the next one is under way, so that a GPU is never idle."""

    def __init__(
        self, training: Trainer, write: Callable[[dict[str, float]], None], keep: Callable[[Fault], None]
    ) -> None:
        self._training, self._write, self._keep = training, write, keep
        self._waiting = deque[Report]()
        self._lag = 1 if training.env.device == "cuda" else 0

    def add(self, report: Report) -> None:
        """Take a report; read the reports whose iteration should be done."""
        self._waiting.append(report)
        self._read(self._lag)

    def catch_up(self) -> None:
        """Read all reports."""
        self._read(0)

    def _read(self, left: int) -> None:
        while len(self._waiting) > left:
            report = self._waiting.popleft()
            if (fault := self._training.fault(report)) is not None:
                self._keep(fault)
            self._write(self._training.row(report))


class Log:
    """`metrics.csv`, tensorboard and the progress bar of a run."""

    def __init__(self, training: Trainer, out: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter  # takes a second to import

        self._columns = training.columns
        self._files = ExitStack()
        self._files.enter_context(_quiet_threads())
        self._csv = self._files.enter_context((out / METRICS).open("a", newline="", encoding="utf-8"))
        board = SummaryWriter(str(out / "tensorboard"), purge_step=training.iteration + 1)
        self._board = self._files.enter_context(board)
        total, begun = training.settings.iterations, training.iteration
        self._bar = self._files.enter_context(progress(total, "iteration", begun=begun))

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        self._files.close()

    def write(self, row: dict[str, float]) -> None:
        """Write an iteration's metrics."""
        csv.writer(self._csv).writerow(format_row(row))
        self._csv.flush()
        for name in self._columns[1:]:
            if math.isfinite(row[name]):
                self._board.add_scalar(name, row[name], row["iteration"])
        self._bar.set_postfix_str(_describe(row), refresh=False)
        self._bar.update()

    def keep(self) -> None:
        """Flush to disk, so that the metrics survive a power loss."""
        os.fsync(self._csv.fileno())


@contextmanager
def _quiet_threads() -> Iterator[None]:
    """Print no traceback where tensorboard's thread cannot write: the next call of its writer raises that error."""
    usual = threading.excepthook

    def report(arguments: threading.ExceptHookArgs) -> None:
        if not issubclass(arguments.exc_type, OSError):
            usual(arguments)

    threading.excepthook = report
    try:
        yield
    finally:
        threading.excepthook = usual


def _describe(row: Mapping[str, float]) -> str:
    episodes = "no episode ended"
    if row["episodes"]:
        rates = f"success {row['success_rate']:.0%}, collision {row['collision_rate']:.0%}"
        error = row["tip_error_mm"]  # unknown in a task without targets
        episodes = rates if math.isnan(error) else f"tip {error:.2f} mm, {rates}"
    return f"{episodes}, {row['steps_per_s']:,.0f} steps/s"
