"""Time to learn a task under each control: `bench solve` by task, scene, control and seed, for docs/control.md.

    python -m docs.studies.control --gpus 8                # all runs, one process a GPU, then the table
    python -m docs.studies.control --seeds 1 --limit 60 num_envs=64       # on a CPU, one after the other
    python -m docs.studies.control --only-table            # of the lines that there are

Each run adds a line of JSON to control.jsonl in --out. A run that has its line is not made again, so the same command
goes on where it was stopped. Seconds are those of learning and evaluations, without imports and compilation, until
95 % of the arms succeed in the frozen evaluation.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import queue
import statistics
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from docs.studies.command import make_parser, parse_with_settings, run
from surgical_marl.cli.flags import whole

SPARE = 40.0
"""Seconds beyond --limit after which a run is killed: it gives up between iterations, and evaluates once more."""


class Job(NamedTuple):
    """One training."""

    task: str
    scene: str
    control: str
    control_frame: str
    seed: int

    def __str__(self) -> str:
        return " ".join(map(str, self))

    @classmethod
    def of(cls, line: dict[str, Any]) -> Job:
        """Return the job that a line of results belongs to."""
        return cls(*(line[name] for name in cls._fields))


SCENES = {
    "needle_handover": ("bimanual_psm_needle", "trimanual_psm_ecm_needle"),
    "peg_transfer": ("bimanual_psm_pegs", "trimanual_psm_ecm_pegs"),
    "reach": ("bimanual_psm", "trimanual_psm_ecm"),
}
"""The scenes of each task: joint against Cartesian control in the first, base against camera in the second, which has
an endoscope. Tasks that learn for minutes come first, so that short runs fill the end."""


def all_jobs(seeds: int) -> list[Job]:
    """Return all trainings, those of the first seed first."""
    return [
        Job(task, scene, control, frame, seed)
        for seed in range(seeds)
        for task, (joints, views) in SCENES.items()
        for scene, control, frame in (
            (joints, "position", "base"),
            (joints, "cartesian", "base"),
            (views, "cartesian", "base"),
            (views, "cartesian", "camera"),
        )
    ]


def learn(job: Job, gpu: int | None, limit: float, settings: list[str]) -> dict[str, Any]:
    """Train in a process of its own, on a GPU or on the CPU if `gpu` is None; return what `bench solve` says.

    Raises:
        ValueError: the process failed, or did not give up in time.
    """
    command = [sys.executable, "-m", "surgical_marl", "bench", "solve", "--json", "--collisions", "1"]
    command += ["--task", job.task, "--scene", job.scene, "--seed", str(job.seed), "--limit", str(limit)]
    command += ["--device", "cpu" if gpu is None else "cuda"]
    command += [f"control={job.control}", f"control_frame={job.control_frame}", *settings]
    seen = {} if gpu is None else {"CUDA_VISIBLE_DEVICES": str(gpu)}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=limit + SPARE, env={**os.environ, **seen}, check=False
        )
    except subprocess.TimeoutExpired:
        raise ValueError(f"still busy {SPARE:g} s after --limit {limit:g}, so it was ended") from None
    try:
        found: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise ValueError(f"exit code {done.returncode}, {last}") from None
    return {**found, "learning_s": found["seconds"] - found["imports_s"] - found["compile_s"]}


def table(lines: list[dict[str, Any]]) -> str:
    """Return the table for docs/control.md: a row for each task, scene, control and frame, seeds side by side."""
    rows = ["| task | scene | control | frame | solved | seconds to 95 %, median (each seed) |", "|---" * 6 + "|"]
    order = [job[:4] for job in all_jobs(1)]
    ordered = sorted((Job.of(line), line) for line in lines)
    cells = {cell: [line for _, line in some] for cell, some in groupby(ordered, lambda pair: pair[0][:4])}
    for cell in sorted(cells, key=lambda cell: order.index(cell) if cell in order else len(order)):
        runs = cells[cell]
        # a run that was given up would have taken longer than any other
        middle = statistics.median(line["learning_s"] if line["solved"] else math.inf for line in runs)
        median = "-" if math.isinf(middle) else f"**{middle:.0f}**"
        each = ", ".join(map(seconds, runs))
        task, scene, control, frame = cell
        frame = frame if control == "cartesian" else ""
        solved = f"{sum(line['solved'] for line in runs)} of {len(runs)}"
        rows.append(f"| `{task}` | `{scene}` | {control} | {frame} | {solved} | {median} ({each}) |")
    return "\n".join(rows)


def seconds(line: dict[str, Any]) -> str:
    """Return the seconds of a run, and its best success if it never reached the goal."""
    took = f"{line['learning_s']:.0f}"
    return took if line["solved"] else f"given up after {took}, best {line['best_success']:.1%}"


def read(path: Path) -> list[dict[str, Any]]:
    """Return the lines of results that there are, the last of each job."""
    lines = map(json.loads, path.read_text("utf-8").splitlines()) if path.is_file() else ()
    return list({Job.of(line): line for line in lines}.values())


def learn_all(jobs: list[Job], path: Path, arguments: argparse.Namespace) -> int:
    """Make all runs that have no line yet, as far as time allows; return how many failed."""
    began, failed = time.monotonic(), 0
    free: queue.Queue[int | None] = queue.Queue()
    for gpu in [*range(arguments.gpus)] * arguments.each or [None]:
        free.put(gpu)

    def one(job: Job) -> tuple[Job, dict[str, Any] | str]:
        if time.monotonic() - began + arguments.limit + SPARE > arguments.within:
            return job, "left for the next call"
        gpu = free.get()
        try:
            return job, learn(job, gpu, arguments.limit, arguments.settings)
        except ValueError as error:
            return job, str(error)
        finally:
            free.put(gpu)

    made = {Job.of(line) for line in read(path)}
    with ThreadPoolExecutor(free.qsize()) as pool:
        for done in as_completed([pool.submit(one, job) for job in jobs if job not in made]):
            job, found = done.result()
            if isinstance(found, str):
                failed += 1
                print(f"{job}: {found}", file=sys.stderr, flush=True)
                continue
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(found) + "\n")
            print(f"{job}: {found['learning_s']:.1f} s, best {found['best_success']:.1%}", file=sys.stderr, flush=True)
    return failed


def main(argv: list[str] | None = None) -> int:
    parser = make_parser(__doc__, usage="%(prog)s [options] [key=value ...]")
    parser.add_argument("--out", type=Path, default=Path("runs/control"), metavar="DIR", help="(%(default)s)")
    parser.add_argument("--gpus", type=whole(0), default=0, metavar="N", help="GPUs; 0: on the CPU")
    parser.add_argument("--each", type=whole(1), default=1, metavar="N", help="runs that share a GPU (%(default)s)")
    parser.add_argument("--seeds", type=whole(1), default=3, metavar="N", help="0 to N - 1 (%(default)s)")
    parser.add_argument("--tasks", nargs="+", choices=SCENES, default=list(SCENES), help="some of them")
    parser.add_argument("--limit", type=float, default=300.0, metavar="SECONDS", help="of a run (%(default)s)")
    parser.add_argument(
        "--within", type=float, default=float("inf"), metavar="SECONDS", help="start no run that could end later"
    )
    parser.add_argument("--only-table", action="store_true", help="make no run")
    arguments = parse_with_settings(parser, argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    path, failed = arguments.out / "control.jsonl", 0
    if not arguments.only_table:
        jobs = [job for job in all_jobs(arguments.seeds) if job.task in arguments.tasks]
        failed = learn_all(jobs, path, arguments)
    print(table(read(path)))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(run("control", main))
