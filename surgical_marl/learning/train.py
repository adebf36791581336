"""The training loop: rollouts, updates, checkpoints and metrics of one run."""

from __future__ import annotations

import csv
import math
import signal
import sys
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from surgical_marl.learning.config import Settings
from surgical_marl.learning.memory import check_room, in_memory
from surgical_marl.learning.run import (
    METRICS,
    check_writable,
    claim_folder,
    format_row,
    read_checkpoint,
    read_metrics,
    read_settings,
    write_checkpoint,
    write_config,
    write_metrics,
)
from surgical_marl.learning.training import Report, Training

if TYPE_CHECKING:
    from surgical_marl.batch import BatchedEnv

# What may change when a run goes on; everything else shapes the checkpoint or the problem.
CHANGEABLE = {
    "engine",
    "device",
    "iterations",
    "steps_per_iteration",
    "checkpoint_every",
    "team_reward",
    "ppo",
    "constraint",
}
# Except these, which say what stands in a checkpoint.
FIXED = {"ppo.normalise_values", "constraint.cost"}


def make_env(settings: Settings, num_envs: int | None = None) -> BatchedEnv:
    """The environment of a run, with torch tensors; `num_envs` replaces the setting."""
    # Imports JAX, which takes seconds: not before the settings are known to be good.
    from surgical_marl.batch import BatchedEnv

    return BatchedEnv(
        settings.task,
        settings.scene,
        num_envs=num_envs or settings.num_envs,
        control=settings.control,
        engine=settings.engine,
        device=settings.device,
        max_steps=settings.max_steps,
        difficulty=settings.difficulty,
        reward=settings.reward,
        arrays="torch",
    )


def make_training(settings: Settings) -> Training:
    """A run in memory. ValueError if it has no room there."""
    env = make_env(settings)
    check_room(settings, env)
    with in_memory(settings.num_envs):
        return Training(settings, env)


def train(settings: Settings, *, out: Path, resume: Path | None = None) -> Path:
    """Train until `settings.iterations`, and return the run folder.

    Args:
        settings: the run; when resuming they must agree with the old run on all that shapes it.
        out: the run folder to write; it must not hold a run yet, unless it is the one that is
            resumed.
        resume: the run folder to continue from its checkpoint.

    Raises:
        ValueError: the folder cannot be used, the settings do not fit the run to resume, or so many environments do not
            fit into memory.
        FloatingPointError: training produced NaN; the last good checkpoint is kept.
        KeyboardInterrupt, SystemExit: after Ctrl-C or SIGTERM, when the checkpoint is written.
    """
    out = Path(out)
    new = not out.exists()
    state = _read_resumed(settings, Path(resume)) if resume is not None else None
    if resume is not None and out.resolve() == Path(resume).resolve():
        check_writable(out)
    else:
        claim_folder(out)
    rows = (
        [row for row in read_metrics(Path(resume)) if state and row["iteration"] <= state["iteration"]]
        if resume
        else []
    )

    try:
        training = make_training(settings)
    except ValueError:
        if new:
            out.rmdir()  # it is empty yet
        raise
    if state is not None:
        training.set_state(state)
    write_config(out, settings)
    write_metrics(out, training.columns, rows)
    write_checkpoint(out, training.state())
    with in_memory(settings.num_envs):
        _run(training, out)
    return out


def _run(training: Training, out: Path) -> None:
    settings = training.settings
    with _signals() as received, _Log(training, out) as log:
        while training.iteration < settings.iterations and not received:
            log.add(training.iterate())
            if training.iteration % settings.checkpoint_every == 0:
                log.catch_up()  # raises if something is not finite: the last good checkpoint stays
                write_checkpoint(out, training.state())
        log.catch_up()
        write_checkpoint(out, training.state())
    from surgical_marl.learning.curve import draw_curve  # matplotlib: not before training has begun

    draw_curve(out, f"{settings.task} in {settings.scene}, {settings.algo}, seed {settings.seed}")
    if received:
        raise KeyboardInterrupt if received[0] == signal.SIGINT else SystemExit(128 + received[0])


class _Log:
    """`metrics.csv`, tensorboard and the progress bar of a run. It reads an iteration's report when the next one is
    under way, so that a GPU has always something to do."""

    def __init__(self, training: Training, out: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter  # takes a second to import

        self._training, self._waiting = training, deque[Report]()
        self._lag = 1 if training.env.device == "cuda" else 0
        self._files = ExitStack()
        self._csv = self._files.enter_context((out / METRICS).open("a", newline=""))
        board = SummaryWriter(str(out / "tensorboard"), purge_step=training.iteration + 1)
        self._board = self._files.enter_context(board)
        total, begun = training.settings.iterations, training.iteration
        self._bar = self._files.enter_context(
            tqdm(initial=begun, total=total, unit="it", file=sys.stderr, dynamic_ncols=True)
        )

    def __enter__(self) -> _Log:
        return self

    def __exit__(self, *_: Any) -> None:
        self._files.close()

    def add(self, report: Report) -> None:
        """Take a report; read those whose iteration should be done."""
        self._waiting.append(report)
        while len(self._waiting) > self._lag:
            self._write(self._training.row(self._waiting.popleft()))

    def catch_up(self) -> None:
        """Read all reports."""
        while self._waiting:
            self._write(self._training.row(self._waiting.popleft()))

    def _write(self, row: dict[str, float]) -> None:
        csv.writer(self._csv).writerow(format_row(row))
        self._csv.flush()
        for name in self._training.columns[1:]:
            if math.isfinite(row[name]):
                self._board.add_scalar(name, row[name], row["iteration"])
        self._bar.set_postfix_str(_describe(row), refresh=False)
        self._bar.update()


def _read_resumed(settings: Settings, run: Path) -> dict[str, Any]:
    old, state = read_settings(run), read_checkpoint(run)
    asked = _dotted(settings)
    for name, before in _dotted(old).items():
        fixed = name in FIXED or name.partition(".")[0] not in CHANGEABLE
        if fixed and before != asked[name]:
            raise ValueError(f"the run in {run} has {name} {before!r}, and cannot go on with {asked[name]!r}")
    if state["iteration"] >= settings.iterations:
        raise ValueError(
            f"the run in {run} already has {state['iteration']} iterations: ask for more than {settings.iterations}"
        )
    return state


def _dotted(settings: Any) -> dict[str, Any]:
    """Settings by their names, such as "ppo.gamma"."""
    named: dict[str, Any] = {}
    for item in fields(settings):
        value = getattr(settings, item.name)
        inner = _dotted(value) if is_dataclass(value) else None
        named |= {item.name: value} if inner is None else {f"{item.name}.{name}": part for name, part in inner.items()}
    return named


def _describe(row: Mapping[str, float]) -> str:
    episodes = "no episode ended"
    if row["episodes"]:
        rates = f"success {row['success_rate']:.0%}, collision {row['collision_rate']:.0%}"
        episodes = f"tip {row['tip_error_mm']:.2f} mm, {rates}"
    return f"{episodes}, {row['steps_per_s']:,.0f} steps/s"


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Collect Ctrl-C and SIGTERM, so that the iteration ends and is saved.

    A second one stops at once.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set handlers
        yield received
        return
    old = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def receive(number: int, _: FrameType | None) -> None:
        received.append(number)
        for each, handler in old.items():
            signal.signal(each, handler)
        tqdm.write("stopping after this iteration (again to stop at once)", file=sys.stderr)

    for number in old:
        signal.signal(number, receive)
    try:
        yield received
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
