"""Runs `surgical-marl report`, and writes the report at the end of a training."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

from surgical_marl.evaluation.command import judge, play_standard
from surgical_marl.evaluation.evaluate import summarise
from surgical_marl.files import write_atomic
from surgical_marl.report.page import GENERATOR, render
from surgical_marl.report.run import Run, read_run
from surgical_marl.runs.folder import CHECKPOINT, holds_weights
from surgical_marl.untrusted.files import is_folder

REPORT = "report.html"


def report(names: Sequence[str], out: Path | None = None, evaluate: bool = False) -> Path:
    """Write the report of some runs, and return its path.

    Args:
        names: run folders or shipped policies, of one task.
        out: the file; if None, `report.html` in the run's folder, or in the current folder for several runs and for
            shipped policies.
        evaluate: play the standard goals first with all policies whose single episodes are not known. A run keeps them
            in its folder.

    Raises:
        ValueError: something is no run, the runs don't belong together, or the file cannot be written or is not a
            report.
    """
    runs = [read_run(name) for name in names]
    alone = len(runs) == 1 and not holds_weights(runs[0].folder)
    path = out or (runs[0].folder / REPORT if alone else Path(REPORT))
    _check(path)
    if evaluate:
        render(runs)  # refuse what does not belong together before minutes of work
        runs = [run if run.played else _evaluated(run) for run in runs]
    write(path, render(runs))
    return path


def report_run(run: Path) -> Path:
    """Write the report of a run folder into it, and return its path. ValueError if it cannot be written."""
    _check(path := run / REPORT)
    write(path, render([read_run(run)]))
    return path


def write(path: Path, page: str) -> None:
    """Write the page of a report to a file. ValueError if it cannot be written."""
    try:
        write_atomic(path, lambda temporary: temporary.write_bytes(page.encode()))
    except OSError as error:
        raise ValueError(f"cannot write {error.filename}: {error.strerror}") from None


def _check(path: Path) -> None:
    if is_folder(path) or not is_folder(path.parent):
        raise ValueError(f"cannot write {path}: name a .html file in a folder that exists")
    if path.is_file():
        with path.open(encoding="utf-8", errors="replace") as file:
            if f'content="{GENERATOR}"' not in file.read(2000):
                raise ValueError(f"{path} exists and is not a report: name another file with --out")


def _evaluated(run: Run) -> Run:
    """Return a run with an evaluation, if it has a policy."""
    if holds_weights(run.folder):
        *_, played = play_standard(run.folder)
        return replace(run, played=played, result=summarise([played]), notes=())
    if not (run.folder / CHECKPOINT).is_file():
        return run
    with redirect_stdout(sys.stderr):  # a table; what is asked for is the report
        judge(run.folder)
    return read_run(run.given)
