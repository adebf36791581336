"""Find numbers that are not finite in an iteration. Faults are detected on the device, and read with the metrics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

KINDS = ("environments", "observations", "rewards", "actions", "values", "gradients", "losses", "weights", "checkpoint")
"""Kinds of values that can be at fault, in the order in which a fault spreads."""


MOST, SHARE = 10, 1e-4
"""Training stops if, in an iteration, more environments than both of these are at fault: this many, and this share of
all steps of environments."""


class Fault(NamedTuple):
    """The first environment of an iteration that was not finite."""

    iteration: int
    total: int
    """Number of faults in this iteration, in this process."""
    step: int
    """Number of the step in the rollout, from 0."""
    number: int
    """Number of the environment among those of this process."""
    code: int
    """Code of the place of the fault, see `BatchedEnv.fault_place`."""
    start: dict[str, np.ndarray]
    """Carry of the environment when the rollout began, [1, ...]."""
    actions: np.ndarray
    """Actions of the environment up to that step, [T, sum]."""


def too_many(count: float, steps: int) -> bool:
    """Return whether so many faults in so many steps of environments stop a training."""
    return count > max(MOST, SHARE * steps)


class Diverged(FloatingPointError):
    """An iteration is not finite.

    Attributes:
        iteration: which one.
        found: for each of `KINDS` that is at fault the names of what is NaN or infinite.
        learning_rate: of that iteration, as far as it is known.
    """

    def __init__(self, iteration: int, found: Mapping[str, Sequence[str]], learning_rate: float) -> None:
        self.iteration, self.found, self.learning_rate = iteration, dict(found), learning_rate
        kind = next(kind for kind in KINDS if kind in found)
        names = ", ".join(found[kind][:3]) + (f" and {len(found[kind]) - 3} more" if len(found[kind]) > 3 else "")
        advice = f"resume the last checkpoint with a lower ppo.learning_rate than {learning_rate:g}"
        if kind == "environments":
            advice = "`surgical-marl replay` of a fault-*.npz in the run folder shows where"
        super().__init__(f"{kind} became NaN or infinite in iteration {iteration} ({names}): {advice}")

    @property
    def summary(self) -> dict[str, Any]:
        """Summary of the error as values that JSON can hold."""
        rate = self.learning_rate if math.isfinite(self.learning_rate) else None
        return {"iteration": self.iteration, "not_finite": self.found, "learning_rate": rate}


def find(values: Mapping[str, Mapping[str, float]]) -> dict[str, list[str]]:
    """Return the names of values that are not finite, by kind; kinds without any are left out."""
    bad = {kind: [name for name, value in named.items() if not math.isfinite(value)] for kind, named in values.items()}
    return {kind: bad[kind] for kind in KINDS if bad.get(kind)}


def column_names(observations: TensorDict) -> list[str]:
    """Return the names of the columns that `mark_columns` marks, such as "psm[3]"."""
    return [f"{name}[{column}]" for name, group in _numbers(observations) for column in range(group.shape[-1])]


def mark_columns(stored: TensorDict, after: TensorDict) -> Tensor:
    """Mark the columns of observations in which the first values that are not finite appear.

    The columns are those of the groups `[T, N, ..., d]` of a rollout, and of the groups `[N, ..., d]` after it. Each
    column gets 0 or NaN. It gets NaN if one of its values is not finite in the first step in which any value is not
    finite. Later steps don't count, because faults spread from then on. Pictures have no columns.
    """
    rows = [_numbers(stored), [(name, group.unsqueeze(0)) for name, group in _numbers(after)]]
    finite = [torch.cat([group.flatten(1, -2).isfinite().all(1) for _, group in groups], -1) for groups in rows]
    bad = ~torch.cat(finite)
    first = bad & (bad.any(1, keepdim=True).cumsum(0) == 1)
    return _mark(~first.any(0))


def mark(parts: Iterable[Tensor]) -> Tensor:
    """Return for each part 0, or NaN if a value in it is not finite."""
    return _mark(torch.stack([part.isfinite().all() for part in parts]))


def _numbers(observations: TensorDict) -> list[tuple[str, Tensor]]:
    groups: dict[str, Any] = dict(observations.items())
    return [(name, group) for name, group in groups.items() if group.is_floating_point()]


def _mark(finite: Tensor) -> Tensor:
    return 0.0 / finite.float()
