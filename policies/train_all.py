"""Trains the policies that ship, one for every task and scene, evaluates them and exports them here.

    python policies/train_all.py                                        # all of them, three seeds each, four at a time
    python policies/train_all.py --evaluate                             # only evaluate those that are here, anew
    python policies/train_all.py --only reach-psm track-psm --seeds 0 1 2 --jobs 4 iterations=500

Runs go to `runs/policies/<task>-<scene>/seed<seed>`. It may be stopped at any time and started again: it goes on with
unfinished runs, and leaves finished runs and exported policies as they are (delete a policy's folder to make it anew).
What each process says is in a log beside its run. Where git is missing, `GIT_COMMIT` says which commit trains. At the
end the table in `policies/README.md` is written anew: with all policies there that is all it does.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

from surgical_marl.content import content_dir, unknown
from surgical_marl.plugins.tasks import list_tasks
from surgical_marl.runs.settings import own_sections
from surgical_marl.runtime import defer_compiler
from surgical_marl.scenes.placing import scenes_for

PLACES = {
    f"{task}-{scene}{end}": (task, scene, level)
    for task in list_tasks()
    for levels in [(("", "default"), *((f"-{level}", level) for level in own_sections(task, "difficulties")))]
    for scene in scenes_for(task)
    for end, level in levels
}
"""Task, scene and difficulty of each policy, by its name. A level with settings of its own has policies of its own."""


class Job(NamedTuple):
    """Something to do in a process of its own, after the jobs of the same policy that come before it."""

    policy: str
    what: str
    work: Callable[..., object]
    arguments: tuple[object, ...]
    log: Path
    needs: int = 0
    """How many trainings must have succeeded before."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="POLICY", help="<task>-<scene>[-<difficulty>]")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], metavar="S")
    parser.add_argument("--jobs", type=int, default=4, metavar="J", help="processes at a time")
    parser.add_argument("--runs", type=Path, default=Path("runs/policies"), metavar="DIR")
    parser.add_argument("--out", type=Path, default=content_dir("policies"), metavar="DIR")
    parser.add_argument("--evaluate", action="store_true", help="train nothing: evaluate the policies in --out anew")
    arguments, overrides = parser.parse_known_args()
    # `--only a b key=value` leaves overrides among the names.
    there = [name for name in PLACES if (arguments.out / name).exists()]
    only = arguments.only or (there if arguments.evaluate else [n for n, place in PLACES.items() if _fits(*place)])
    names = [name for name in only if "=" not in name]
    overrides += [name for name in only if "=" in name]
    for name in names:
        if name not in PLACES:
            parser.error(str(unknown("policy", name, list(PLACES))))
    # Several processes share one GPU: JAX must not take most of its memory for each.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    # They share the cores too: torch's threads wait for each other by spinning, and with more of them than cores a CPU
    # does little else.
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // arguments.jobs)))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    if arguments.evaluate:
        logs = arguments.runs / "evaluate"
        todo = [Job(name, "evaluate", evaluate, (arguments.out / name,), logs / f"{name}.log") for name in names]
    else:
        todo = [job for name in names for job in _jobs(name, arguments, overrides)]
    failed = run(todo, arguments.jobs)
    if arguments.out.resolve() == content_dir("policies").resolve():
        write_table(arguments.out / "README.md")
    return 1 if failed else 0


def _fits(task: str, scene: str, difficulty: str) -> bool:
    """Return whether a scene's arms can do a task at a level of difficulty."""
    from surgical_marl.envs.env import Env

    try:
        return difficulty == "default" or bool(Env(task, scene, difficulty=difficulty))
    except ValueError:
        return False


def _jobs(name: str, arguments: argparse.Namespace, overrides: Sequence[str]) -> list[Job]:
    """What is left to do for one policy."""
    out, folder = arguments.out / name, arguments.runs / name
    if out.exists():
        return []
    runs = {seed: folder / f"seed{seed}" for seed in arguments.seeds}
    task, scene, difficulty = PLACES[name]
    at_level = [] if difficulty == "default" else [f"difficulty={difficulty}"]
    # A policy that is ready for more starts is of more use.
    anywhere = [] if at_level else [f"start={start}" for start in own_sections(task, "starts")]
    own = [*at_level, *anywhere, *overrides]
    trainings = [
        Job(name, path.name, train, (task, scene, path, [f"seed={seed}", *own]), folder / f"{path.name}.log")
        for seed, path in runs.items()
    ]
    sources = [str(path) for path in runs.values()]
    return [*trainings, Job(name, "export", export, (sources, out), folder / "export.log", len(trainings))]


def run(todo: list[Job], at_once: int) -> list[Job]:
    """Do all jobs, some at once; returns those that failed or could not be done for that. Stops them if stopped."""
    spawn = multiprocessing.get_context("spawn")
    going: dict[BaseProcess, tuple[Job, float]] = {}
    done: list[Job] = []
    failed: list[Job] = []
    try:
        while todo or going:
            ready = [job for job in todo if sum(each.policy == job.policy for each in done) >= job.needs]
            for job in ready[: at_once - len(going)]:
                todo.remove(job)
                job.log.parent.mkdir(parents=True, exist_ok=True)
                process = spawn.Process(target=_work, args=(job,))
                process.start()
                going[process] = (job, time.monotonic())
            if not going:  # what is left waits for what failed
                return failed + todo
            wait([process.sentinel for process in going])
            for process in [process for process in going if not process.is_alive()]:
                job, started = going.pop(process)
                good = process.exitcode == 0
                (done if good else failed).append(job)
                how = "done" if good else f"FAILED, see {job.log}"
                print(f"{job.policy} {job.what}: {how} after {time.monotonic() - started:.0f} s", flush=True)
        return failed
    finally:
        for process in going:
            process.terminate()
        for process in going:
            process.join()


def _work(job: Job) -> None:
    """In the new process: write to the job's log, and stop as after SIGTERM if the first process is gone."""
    os.setsid()  # Ctrl-C is for the first process, which then asks this one to stop, once
    log = os.open(job.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
    job.work(*job.arguments)


def train(task: str, scene: str, run: Path, overrides: Sequence[str]) -> None:
    """Train one run from where it is to its end."""
    defer_compiler()

    from surgical_marl.learning.train import finish
    from surgical_marl.runs.settings import load_config

    finish(load_config(task, scene, overrides), run)


def export(runs: Sequence[str], out: Path) -> None:
    """Evaluate the runs of one policy and write its folder."""
    from surgical_marl.evaluation.export import export_policy

    export_policy(runs, out)


def evaluate(folder: Path) -> None:
    """Evaluate a policy anew with the weights that it has."""
    from surgical_marl.evaluation.export import evaluate_again

    evaluate_again(folder)


def write_table(path: Path) -> None:
    """Replace what stands between the two marks in a file by the table of all policies that ship."""
    from surgical_marl.evaluation.card import table
    from surgical_marl.files import write_text

    before, mark, rest = path.read_text(encoding="utf-8").partition("<!-- table -->\n")
    _, end, after = rest.partition("<!-- end of table -->\n")
    write_text(path, f"{before}{mark}{table()}\n{end}{after}")


if __name__ == "__main__":
    sys.exit(main())
