"""The study of controls: which runs are made, and the table of those that are there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from docs.studies import control
from docs.studies.control import Job, all_jobs, main, table


def line(job: Job, seconds: float, solved: bool = True) -> dict[str, Any]:
    return {**job._asdict(), "solved": solved, "learning_s": seconds, "best_success": 0.97 if solved else 0.5}


def test_each_run_is_made_once_and_then_stands_in_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    jobs, made = [job for job in all_jobs(2) if job.task == "reach"], list[Job]()

    def learn(job: Job, gpu: int | None, limit: float, settings: list[str]) -> dict[str, Any]:
        made.append(job)
        if job == jobs[0] and made.count(job) == 1:
            raise ValueError("no memory")
        return line(job, 10.0 * (job.seed + 1))

    monkeypatch.setattr(control, "learn", learn)
    argv = ["--out", str(tmp_path), "--gpus", "2", "--seeds", "2", "--tasks", "reach"]
    assert main(argv) == 1 and f"{jobs[0]}: no memory" in capsys.readouterr().err
    assert main(argv) == 0 and sorted(made) == sorted([*jobs, jobs[0]])
    lines = [json.loads(text) for text in (tmp_path / "control.jsonl").read_text().splitlines()]
    assert len(lines) == len(jobs) == 8 and {Job.of(found) for found in lines} == set(jobs)
    made.clear()
    capsys.readouterr()
    assert main(argv) == 0 and not made
    assert (
        "| `reach` | `trimanual_psm_ecm` | cartesian | camera | 2 of 2 | **15** (10, 20) |" in capsys.readouterr().out
    )
    assert main([*argv[:2], "--limit", "100", "--within", "100"]) == 1 and not made  # no time for those of other tasks


@pytest.mark.parametrize(
    ("seconds", "solved", "cells"),
    [
        ([30.0, 10.0, 20.0], [True, True, True], "3 of 3 | **20** (30, 10, 20)"),
        ([30.0, 300.0, 20.0], [True, False, True], "2 of 3 | **30** (30, given up after 300, best 50.0%, 20)"),
        ([300.0, 300.0, 20.0], [False, False, True], "1 of 3 | - (given up after 300, best 50.0%, given up"),
    ],
)
def test_a_run_that_was_given_up_counts_as_longer_than_any_other(
    seconds: list[float], solved: list[bool], cells: str
) -> None:
    jobs = [Job("reach", "bimanual_psm", "position", "base", seed) for seed in range(3)]
    rows = table([line(*each) for each in zip(jobs, seconds, solved, strict=True)]).splitlines()
    assert rows[2].startswith(f"| `reach` | `bimanual_psm` | position |  | {cells}") and len(rows) == 3
