"""Report of an iteration: put together on the device, copied to the host, and read there."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from surgical_marl.interfaces.rsl_rl import RslRlVecEnv, bounded
from surgical_marl.learning import distributed, faults
from surgical_marl.learning.algorithm import LOSSES, Algorithm
from surgical_marl.learning.constraint import METRICS
from surgical_marl.learning.episodes import ENDED, Episodes

Mark = float | torch.cuda.Event
"""A time of the host in s, or a place in the queue of a GPU."""


def mark(cuda: bool) -> Mark:
    """Return a mark behind all work that was enqueued so far."""
    if not cuda:
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def seconds_between(first: Mark, last: Mark) -> float:
    """Return the time from one mark to a later one, in s; a GPU must have come to both."""
    if isinstance(first, float) or isinstance(last, float):
        return float(last) - float(first)  # type: ignore[arg-type]
    return first.elapsed_time(last) / 1000


PARTS = ("seconds_rollout", "seconds_update")
"""Columns of metrics with the parts of an iteration."""


class Report(NamedTuple):
    """The report of an iteration, while it is copied from the device."""

    iteration: int
    env_steps: int
    started: float
    values: Tensor
    """The report on the host, once `arrived`: first the numbers that `row` reads, then the first fault."""
    arrived: torch.cuda.Event | None
    """None where nothing has to arrive."""
    marks: Sequence[Mark]
    """Before the rollout, between it and the update, and after both."""


class Reporter:
    """Puts the report of an iteration together.

    What it calls within a rollout and after an update may be a part of a CUDA graph: it works in place, and nothing
    waits for the device.

    Args:
        algorithm: of the training.
        env: its environments in this process.
        observations: what they observe.
        episodes: statistics, which each report takes.
        steps: of each environment in a rollout.

    Attributes:
        stop: set it to 1 if this process wants to stop after the iteration, [1].
    """

    def __init__(
        self, algorithm: Algorithm, env: RslRlVecEnv, observations: TensorDict, episodes: Episodes, steps: int
    ) -> None:
        self._algorithm, self._env, self._episodes = algorithm, env, episodes
        device, bounds = str(env.device), METRICS if algorithm.constraint is not None else ()
        self._cuda = device.startswith("cuda")
        self._samples, self._steps = steps * env.num_envs * distributed.size(), steps
        # What `gather` puts together, in order.
        self._names: dict[str, Sequence[str]] = {
            "episodes": ENDED[:-1],
            "rewards": [ENDED[-1], *env.reward_terms],
            "losses": [*LOSSES, *bounds, "action_std"],
            "stop": ["stop"],
            "faults": ["faults"],
            "before": ["actor", "critic"],
            "gradients": ["actor", "critic"],
            "observations": faults.column_names(observations),
            "values": ["values", "returns"],
            "actions": env.layout.agents,
            "weights": [name for name, _ in self._weights()],
        }
        self.columns = (
            *("iteration", "env_steps", "seconds", *PARTS, "steps_per_s"),
            *("reward", *env.reward_terms),
            *("episodes", "tip_error_mm", "success_rate", "collision_rate", "faults"),
            *(*bounds, *LOSSES, "action_std"),
        )
        self.stop = torch.zeros(1, device=device)
        marked = sum(len(self._names[kind]) for kind in ("observations", "values", "actions"))
        self._marks = torch.zeros(marked, device=device)
        # Codes of faults in each step of a rollout, the carry before it, and the number of each of its steps.
        self._faults = torch.full((steps, env.num_envs), -1, dtype=torch.int32, device=device)
        self._before = env.packed_carry()
        self._order = torch.arange(self._faults.numel(), device=device)
        self._count = sum(map(len, self._names.values()))
        width = 4 + self._before.shape[-1] + steps * env.num_actions
        self._report = torch.zeros(self._count + width, device=device)
        self._values, self._fault = self._report[: self._count], self._report[self._count :]
        self._read = 0.0

    def begin(self) -> None:
        """Note where environments are before a rollout."""
        self._before.copy_(self._env.packed_carry())

    def add(self, step: int, codes: Tensor) -> None:
        """Note the faults of a step, [N]: see `BatchedEnv.fault_place`."""
        self._faults[step].copy_(codes)

    def end(self, observations: TensorDict) -> None:
        """Note which numbers are not finite in the stored rollout and in the observations after it."""
        stored = self._algorithm.storage
        columns = faults.mark_columns(stored.observations, observations)
        moves = self._env.layout.split(stored.actions).values()
        self._marks.copy_(torch.cat([columns, faults.mark([stored.values, stored.returns, *moves])]))
        self._note_fault()

    def _note_fault(self) -> None:
        """Note how many faults the rollout had, and of the first one all that reproduces it."""
        bad, last = self._faults.flatten() >= 0, self._order.numel() - 1
        first = torch.where(bad, self._order, last).min()
        step, index = first // self._env.num_envs, (first % self._env.num_envs)[None]
        numbers = torch.stack([bad.sum(), step, index[0], self._faults.flatten()[first[None]][0]])
        actions = bounded(self._algorithm.storage.actions.index_select(1, index))
        self._fault.copy_(torch.cat([numbers.float(), self._before.index_select(0, index)[0], actions.flatten()]))

    def gather(self) -> None:
        """Put together the numbers that `row` reads, summed over all processes."""
        algorithm = self._algorithm
        std = algorithm.actor.output_std.detach().mean()
        weights = torch.stack([weight.detach().sum() for _, weight in self._weights()])
        parts = [self._episodes.take(), algorithm.losses]
        if algorithm.constraint is not None:
            parts.append(algorithm.constraint.metrics())
        learning = [algorithm.before, algorithm.gradients]
        self._values.copy_(torch.cat([*parts, std[None], self.stop, self._fault[:1], *learning, self._marks, weights]))
        distributed.total(self._values)

    def _weights(self) -> list[tuple[str, Tensor]]:
        return [
            (f"{kind}.{name}", weight)
            for kind, model in (("actor", self._algorithm.actor), ("critic", self._algorithm.critic))
            for name, weight in model.named_parameters()
        ]

    def report(self, iteration: int, env_steps: int, started: float, marks: Sequence[Mark]) -> Report:
        """Return the report of an iteration; on a GPU this returns before the iteration is done."""
        if not self._cuda:
            return Report(iteration, env_steps, started, self._report.clone(), None, marks)
        host = torch.empty(self._report.shape, pin_memory=True).copy_(self._report, non_blocking=True)
        arrived = torch.cuda.Event()
        arrived.record()
        return Report(iteration, env_steps, started, host, arrived, marks)

    def fault(self, report: Report) -> faults.Fault | None:
        """Return the first fault of an iteration in this process; this waits until the iteration is done."""
        found = _arrived(report)[self._count :].numpy()
        count, step, index, code = (int(value) for value in found[:4])
        if not count:
            return None
        end = 4 + self._before.shape[-1]
        actions = found[end:].reshape(-1, self._env.num_actions)[: step + 1]
        start = self._env.unpacked_carry(found[4:end])
        return faults.Fault(report.iteration, count, step, index, code, start, actions)

    def row(self, report: Report) -> dict[str, float]:
        """Return the metrics of an iteration (see `columns`); this waits until the iteration is done.

        Raises: Diverged: something in it is not finite.
        """
        sums = self._sums(report)
        means = {name: value / distributed.size() for name, value in sums["losses"].items()}
        count = int(sums["faults"]["faults"])
        if found := self._not_finite(sums, count):
            raise faults.Diverged(report.iteration, found, means["learning_rate"])
        # on a GPU an iteration is enqueued before the last one is done
        now = time.perf_counter()
        seconds = now - max(report.started, self._read)
        self._read = now
        ended, steps = sums["episodes"], self._steps * distributed.size()
        share = 1 / ended["episodes"] if ended["episodes"] else math.nan
        parts = [seconds_between(*marks) for marks in pairwise(report.marks)]
        row = {
            **ended,
            **means,
            "iteration": report.iteration,
            "env_steps": report.env_steps,
            "seconds": seconds,
            **dict(zip(PARTS, parts, strict=True)),
            "steps_per_s": self._samples / seconds,
            **{name: value / steps for name, value in sums["rewards"].items()},
            "tip_error_mm": 1000 * ended["error"] * share,
            "success_rate": ended["success"] * share,
            "collision_rate": ended["collision"] * share,
            "faults": count,
        }
        return {name: row[name] for name in self.columns}

    def stops(self, report: Report) -> bool:
        """Return whether any process wanted to stop after an iteration; this waits until the iteration is done."""
        return bool(self._sums(report)["stop"]["stop"])

    def _sums(self, report: Report) -> dict[str, dict[str, float]]:
        """Return the numbers that `gather` has put together, by kind and name."""
        values = iter(_arrived(report)[: self._count].tolist())
        return {kind: {name: next(values) for name in names} for kind, names in self._names.items()}

    def _not_finite(self, sums: dict[str, dict[str, float]], count: int) -> dict[str, list[str]]:
        """Return the names of values that are not finite, by kind; `count` environments were at fault."""
        many = faults.too_many(count, self._samples)
        done = {name: int(value) // distributed.size() for name, value in sums["before"].items()}
        gradients = {f"{name} in mini-batch {done[name] + 1}": value for name, value in sums["gradients"].items()}
        environments = {f"{count:,} of {self._samples:,} steps": math.nan if many else 0.0}
        return faults.find({**sums, "gradients": gradients, "environments": environments})


def _arrived(report: Report) -> Tensor:
    if report.arrived is not None:
        report.arrived.synchronize()
    return report.values
