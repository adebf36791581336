"""Training runs on fake environments, in this process or another, and what they left."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from surgical_marl.learning import train
from surgical_marl.policies.acting import Policy
from surgical_marl.policies.actor import acting_policy, untrained_actor
from surgical_marl.policies.layout import Layout
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import read_metrics
from surgical_marl.runs.settings import ConstraintSettings, NetworkSettings, PPOSettings, Settings
from tests.helpers.fake_env import FakeEnv

COUNTS, SIZES = {"psm": 2, "ecm": 1}, {"psm": 3, "ecm": 2}
SMALL = Settings(
    scene="psm",
    num_envs=32,
    iterations=4,
    steps_per_iteration=8,
    checkpoint_every=2,
    device="cpu",
    network=NetworkSettings(hidden=(16,)),
    ppo=PPOSettings(epochs=2, mini_batches=2),
)
OPTIONS: list[dict[str, Any]] = [
    {},
    {"ppo": replace(SMALL.ppo, normalise_values=True)},
    {"constraint": ConstraintSettings(cost="collision", limit=0.01)},
    {"network": replace(SMALL.network, recurrent="gru")},
]
"""What an algorithm may have beside its networks."""
ALL: dict[str, Any] = {
    **OPTIONS[1],
    **OPTIONS[2],
    "network": replace(SMALL.network, recurrent="lstm"),
    "team_reward": True,
}


def fake_env(settings: Settings, num_envs: int | None = None) -> Any:
    return FakeEnv(COUNTS, SIZES, settings.num_envs, max_steps=10)


def untrained_policy(env: Any, settings: Settings, grouping: Any = "type") -> Policy:
    """Make the policy that a run with these settings starts from: fresh weights, for comparison."""
    layout = Layout(env, grouping)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        return acting_policy(untrained_actor(settings, env, layout), layout, str(env.device))


def run(settings: Settings, out: Path, resume: bool = False) -> None:
    """Train on fake environments; for another process, as it patches this one."""
    train.make_env = fake_env
    train.train(settings, out=out, resume=out if resume else None)


def run_or_resume(settings: Settings, out: Path) -> None:
    """As the command does it when it gets the same folder for both."""
    run(settings, out, resume=(out / "config.yaml").exists())


def run_until(settings: Settings, out: Path, moment: str) -> None:
    """As `run_or_resume`, but the process kills itself at a moment of `MOMENTS`."""
    MOMENTS[moment]()
    run_or_resume(settings, out)


def same_state(first: Path, second: Path) -> bool:
    """Whether two runs have the same checkpoint, bit for bit, and the same metrics but for times."""
    return _same(read_checkpoint(first), read_checkpoint(second)) and _metrics(first) == _metrics(second)


def _same(first: Any, second: Any) -> bool:
    if isinstance(first, torch.Tensor):
        return torch.equal(first, second)
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(_same(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(_same, first, second))
    return bool(first == second)


def _metrics(run: Path) -> str:
    return str(
        [{k: v for k, v in row.items() if not k.startswith(("seconds", "steps_per_s"))} for row in read_metrics(run)]
    )


def _kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _at(owner: Any, name: str, kill: Callable[..., bool], after: bool = False) -> None:
    """Kill the process when a function is called with certain arguments."""
    original = getattr(owner, name)

    def patched(*arguments: Any, **options: Any) -> Any:
        dead = kill(*arguments)
        if dead and not after:
            _kill()
        result = original(*arguments, **options)
        if dead:
            _kill()
        return result

    setattr(owner, name, patched)


def _half_a_file(state: Any, file: Any) -> bool:
    if "iteration" in state and state["iteration"] == 2:
        file.write(b"half of it")
        file.flush()
        return True
    return False


def _is(name: str) -> Callable[..., bool]:
    return lambda source, target: Path(target).name == name and (name != "checkpoint.pt" or _iteration(source) == 2)


def _iteration(checkpoint: Path) -> int:
    return int(torch.load(checkpoint, weights_only=True)["iteration"])


MOMENTS: dict[str, Callable[[], None]] = {
    "before anything is written": lambda: _at(train, "claim_folder", lambda out: True),
    "before the settings have their name": lambda: _at(os, "replace", _is("config.yaml")),
    "before the first checkpoint": lambda: _at(train, "make_training", lambda settings: True),
    "in the metrics": lambda: _at(os, "replace", _is("metrics.csv")),
    "in a checkpoint": lambda: _at(torch, "save", _half_a_file),
    "before a checkpoint has its name": lambda: _at(os, "replace", _is("checkpoint.pt")),
    "after a checkpoint has its name": lambda: _at(os, "replace", _is("checkpoint.pt"), after=True),
    "in an iteration": lambda: _at(train.Trainer, "update", lambda training: training.iteration == 2),
    "after an iteration": lambda: _at(train.Log, "write", lambda log, row: row["iteration"] == 3, after=True),
}

LONG = replace(SMALL, iterations=1_000_000, checkpoint_every=3)
