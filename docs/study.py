"""MAPPO against IPPO and joint PPO on the scenes of several arms, for study.md: trains, evaluates, breaks, reports.

    python docs/study.py                                  # all of it; a second call goes on where the first stopped
    python docs/study.py --out runs/other iterations=60   # with other settings than those of configs/
    python docs/study.py --only report --results docs     # tables and figures of what there is, for study.md

Every scene, algorithm and seed is a run of its own, as `surgical-marl train` makes it, in a folder of --out. Seconds
only mean something where runs don't share a machine's cores or GPU: leave --jobs at 1 for them.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import signal
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from surgical_marl.cli.main import whole

TASK = "reach"
SCENES = ("bimanual_psm", "bimanual_star", "trimanual_psm_ecm")
ALGOS = ("mappo", "ippo", "joint")
EPISODES = 200
WHEN = 0.3
"""Seconds after the start of an episode at which an arm is taken from its policy: most are half-way to their goals."""
PLAYED = "played.npz"
PARTS = ("train", "play", "report")


class Job(NamedTuple):
    """One training."""

    scene: str
    algo: str
    seed: int

    def __str__(self) -> str:
        return f"{self.scene}-{self.algo}-seed{self.seed}"


def learn(job: Job, out: Path, overrides: list[str]) -> None:
    """Trains a run, or goes on with it; nothing if it is done."""
    from surgical_marl.learning.train import finish
    from surgical_marl.runs.settings import load_config

    finish(load_config(TASK, job.scene, [f"algo={job.algo}", f"seed={job.seed}", *overrides]), out / str(job))


def play(job: Job, out: Path) -> None:
    """Plays the standard goal set with a run's policy: untouched, and with each arm frozen or moved by the oracle."""
    from surgical_marl.evaluation import evaluate
    from surgical_marl.files import write_atomic
    from surgical_marl.machine import machine
    from surgical_marl.policies.oracle import oracle
    from surgical_marl.policies.policy import load_policy, zero_policy
    from surgical_marl.runs.environment import make_env
    from surgical_marl.runs.folder import METRICS, read_settings

    run = out / str(job)
    done = run / PLAYED
    if done.is_file() and done.stat().st_mtime >= (run / METRICS).stat().st_mtime:
        return
    env = make_env(read_settings(run, ["engine=auto", "device=auto"]), EPISODES)
    policy, start = load_policy(run, env), round(WHEN / env.control_dt)
    untouched = evaluate.play(env, policy, EPISODES, seed=0)
    found: dict[str, Any] = {f"untouched/{name}": values for name, values in untouched.measures.items()}
    for arm in env.agents:
        for what, instead in (("frozen", zero_policy(env)), ("oracle", oracle(env, [arm]))):
            measures = evaluate.play(env, taken_over(policy, env, arm, instead, start), EPISODES, seed=0).measures
            found |= {f"{what} {arm}/{name}": measures[name] for name in ("held", "collided")}
    about = json.dumps({**untouched.about, **machine(), "agents": untouched.agents})
    write_atomic(done, lambda path: _save(path, about=about, **found))


def taken_over(
    policy: Callable[[Mapping[str, Any]], Mapping[str, Any]],
    env: Any,
    arm: str,
    instead: Callable[[Mapping[str, Any]], Mapping[str, Any]],
    start: int,
) -> Callable[[Mapping[str, Any]], dict[str, Any]]:
    """A policy whose arm another one moves from control step `start` of each episode on.

    Args:
        env: with torch arrays; what both act in.
        instead: `zero_policy` freezes the arm: it stays where it was sent.
    """
    import torch

    from surgical_marl.policies.acting import forget

    def acting(observations: Mapping[str, Any]) -> dict[str, Any]:
        actions, others = dict(policy(observations)), instead(observations)
        late = torch.as_tensor(env.steps, device=actions[arm].device)[:, None] >= start
        return {**actions, arm: torch.where(late, others[arm], actions[arm])}

    def reset(ended: Any = None) -> None:
        for each in (policy, instead):
            forget(each, ended)

    acting.reset = reset  # type: ignore[attr-defined]  # for a policy that remembers
    return acting


def _save(path: Path, **arrays: Any) -> None:
    with path.open("wb") as file:  # or numpy would append .npz to the name
        np.savez_compressed(file, **arrays)


def work(part: str, job: Job, out: Path, overrides: list[str]) -> tuple[Job, str]:
    """A part of a job in a process of its own; returns what went wrong, if anything."""
    log = out / f"{job}.log"
    # or progress bars of several runs would overwrite each other
    with log.open("a") as file, contextlib.redirect_stderr(file):
        try:
            learn(job, out, overrides) if part == "train" else play(job, out)
        except (ValueError, FloatingPointError) as error:
            return job, " ".join(str(error).split())
    return job, ""


def main(argv: list[str] | None = None) -> int:
    arguments = _parse(argv)
    results = arguments.results or arguments.out
    jobs = [Job(s, a, n) for n in range(arguments.seeds) for s in arguments.scenes for a in arguments.algos]
    for folder in (arguments.out, results):
        folder.mkdir(parents=True, exist_ok=True)
    failed: dict[str, str] = {}
    for part in [part for part in PARTS[:2] if part in arguments.only]:
        ready = [job for job in jobs if str(job) not in failed]
        # processes of their own: a GPU's context does not survive a fork
        with multiprocessing.get_context("spawn").Pool(arguments.jobs) as pool:
            one = partial(work, part, out=arguments.out, overrides=arguments.settings)
            for number, (job, wrong) in enumerate(pool.imap_unordered(one, ready), 1):
                print(f"{part} {number} of {len(ready)}: {job} {wrong or 'done'}", file=sys.stderr, flush=True)
                if wrong:
                    failed[str(job)] = wrong
            pool.close()
            pool.join()
    if "report" in arguments.only:
        from study_report import report

        report([job for job in jobs if (arguments.out / str(job) / PLAYED).is_file()], arguments.out, results)
    return 1 if failed else 0


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        usage="%(prog)s [options] [key=value ...]",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts of the work")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    parser.add_argument("--algos", nargs="+", choices=ALGOS, default=ALGOS)
    parser.add_argument("--seeds", type=whole(1), default=5, metavar="N", help="0 to N - 1")
    parser.add_argument("--jobs", type=whole(1), default=1, metavar="N", help="processes")
    parser.add_argument("--out", type=Path, default=Path("runs/study"), metavar="DIR", help="folder of the runs")
    parser.add_argument("--results", type=Path, metavar="DIR", help="of study.md, .json, .csv, .png (default: --out)")
    given = sys.argv[1:] if argv is None else argv
    settings = [text for text in given if "=" in text and not text.startswith("-")]
    arguments = parser.parse_args([text for text in given if text not in settings])
    arguments.settings = settings
    return arguments


if __name__ == "__main__":
    # what ends this process ends its runs as well: the next call goes on from their checkpoints
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        sys.exit(main())
    except (ValueError, OSError) as error:  # bad input, in one sentence
        print(f"study: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit("study: interrupted; the same command goes on")
