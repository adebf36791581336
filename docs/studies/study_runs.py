"""The runs of the study: each trains, then plays the standard goals, with all arms and without one arm's policy."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from docs.studies.study_cells import find_cell

EPISODES = 200
WHEN = 0.3
"""Seconds after the start of an episode at which an arm is taken from its policy: most are half-way to their goals."""
PLAYED = "played.npz"


class Job(NamedTuple):
    """One training: a cell's name and a seed."""

    cell: str
    seed: int

    def __str__(self) -> str:
        return f"{self.cell}-seed{self.seed}"


def learn(job: Job, out: Path, overrides: list[str]) -> None:
    """Train a run, or resume it; do nothing if it is complete."""
    from surgical_marl.learning.train import finish
    from surgical_marl.runs.settings import load_config

    cell = find_cell(job.cell)
    finish(load_config(cell.task, cell.scene, [*cell.settings, f"seed={job.seed}", *overrides]), out / str(job))


def play(job: Job, out: Path) -> None:
    """Play the standard goal set with a run's policy: untouched, and with each arm frozen or moved by the oracle."""
    from surgical_marl.evaluation import evaluate
    from surgical_marl.files import write_atomic
    from surgical_marl.machine import machine
    from surgical_marl.policies.oracle import oracle
    from surgical_marl.policies.policy import load_policy, zero_policy
    from surgical_marl.runs.folder import METRICS, read_settings
    from surgical_marl.runs.settings import make_env

    run = out / str(job)
    done = run / PLAYED
    if done.is_file() and done.stat().st_mtime >= (run / METRICS).stat().st_mtime:
        return
    env = make_env(read_settings(run, ["engine=auto", "device=auto", "goals=held_out"]), EPISODES)
    policy, start = load_policy(run, env), round(WHEN / env.control_dt)
    untouched = evaluate.play(env, policy, EPISODES, seed=0)
    found: dict[str, Any] = {f"untouched/{name}": values for name, values in untouched.measures.items()}
    for arm in env.agents:
        instead_of = {"frozen": zero_policy(env)}
        with contextlib.suppress(ValueError):  # some tasks have no oracle
            instead_of["oracle"] = oracle(env, [arm])
        for what, instead in instead_of.items():
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
    """Return a policy in which another policy moves one arm, from control step `start` of each episode on.

    Args:
        policy: moves all arms until then, and the other arms afterwards.
        env: the environment in which both act, with torch arrays.
        arm: the arm that is taken over.
        instead: moves that arm. With `zero_policy` it holds its position target, and its jaw closes.
        start: control step of an episode.
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
    with path.open("wb") as file:  # otherwise numpy would append .npz to the name
        np.savez_compressed(file, **arrays)


def work(part: str, job: Job, out: Path, overrides: list[str]) -> tuple[Job, str]:
    """Do one part of a job in a process of its own; return the job and what went wrong, "" if nothing did."""
    log = out / f"{job}.log"
    # otherwise progress bars of several runs would overwrite each other
    with log.open("a", encoding="utf-8") as file, contextlib.redirect_stderr(file):
        try:
            learn(job, out, overrides) if part == "train" else play(job, out)
        except (ValueError, FloatingPointError) as error:
            return job, " ".join(str(error).split())
    return job, ""
