"""Runs that differ by nothing but their seed, as one group: its curves, its episodes, and what sets it apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from surgical_marl.evaluation.evaluate import Played
from surgical_marl.evaluation.interval import interval
from surgical_marl.evaluation.metrics import Metric, metrics
from surgical_marl.report.run import Run
from surgical_marl.runs.curve import smooth

POINTS = 160
"""Points of a curve, so that a page of many curves stays small."""


@dataclass(frozen=True)
class Group:
    """Runs whose settings are the same but for the seed."""

    label: str
    """A letter, or the run's name if the report is of one group."""
    runs: tuple[Run, ...]

    @property
    def played(self) -> list[Played]:
        """The episodes of the runs that have any, of the goals that the first one played."""
        found = [run.played for run in self.runs if run.played is not None]
        return [one for one in found if one.about["goal_set"] == found[0].about["goal_set"] and _alike(one, found[0])]


class Curve(NamedTuple):
    """A column of metrics against environment steps, smoothed."""

    x: np.ndarray
    """[n]"""
    mean: np.ndarray
    """[n], over the runs; NaN beyond the end of the shortest."""
    low: np.ndarray
    high: np.ndarray
    """[n], the lowest and the highest run; NaN where the mean is."""
    single: tuple[tuple[np.ndarray, np.ndarray], ...]
    """x and y of each run, to its end."""


def group(runs: Sequence[Run]) -> list[Group]:
    """Put runs together that differ by nothing but their seed, in the order given."""
    found: dict[str, list[Run]] = {}
    for run in runs:
        found.setdefault(repr(sorted(_compared(run).items())), []).append(run)
    alone = len(found) == 1
    members = [tuple(group) for group in found.values()]
    return [Group(_name(group) if alone else _letters(i), group) for i, group in enumerate(members)]


def differences(groups: Sequence[Group]) -> dict[str, list[Any]]:
    """Return the settings in which groups differ: name -> the value of each group, None where it has none."""
    settings = [_compared(group.runs[0]) for group in groups]
    names = dict.fromkeys(name for one in settings for name in one)
    values = {name: [one.get(name) for one in settings] for name in names}
    return {name: each for name, each in values.items() if any(value != each[0] for value in each)}


def curve(group: Group, column: str) -> Curve | None:
    """Return a group's curve of a column; None if no run of it has finite numbers there."""
    single = [found for run in group.runs if (found := _single(run.columns, column)) is not None]
    if not single:
        return None
    low, high = max(x[0] for x, _ in single), min(x[-1] for x, _ in single)
    x = np.linspace(low, high, POINTS) if high > low else np.array([high])
    values = np.stack([np.interp(x, *one) for one in single])
    return Curve(x, values.mean(0), values.min(0), values.max(0), tuple(single))


def numbers(played: Sequence[Played], names: Sequence[str]) -> dict[str, tuple[float, list[float] | None]]:
    """Return metrics of the episodes of several runs together, with their 95 % intervals."""
    found = metrics(stacked(played), played[0].follows)
    return {name: _number(found[name]) for name in names if name in found}


def stacked(played: Sequence[Played]) -> dict[str, np.ndarray]:
    """Return the measures of several runs, [R, E, A] each, that all of them have."""
    names = [name for name in played[0].measures if all(name in one.measures for one in played)]
    return {name: np.stack([one.measures[name] for one in played]) for name in names}


def _alike(one: Played, other: Played) -> bool:
    return one.agents == other.agents and one.measures["error"].shape == other.measures["error"].shape


def _number(metric: Metric) -> tuple[float, list[float] | None]:
    value = float(metric.reduce(metric.values.ravel()))
    known = np.isfinite(value) and not metric.extreme
    return value, interval(metric) if known else None


def _compared(run: Run) -> Mapping[str, Any]:
    return {name: value for name, value in run.config.items() if name != "seed"} | {"scene": run.scene}


def _name(group: Sequence[Run]) -> str:
    return group[0].name if len(group) == 1 else f"{len(group)} seeds"


def _letters(number: int) -> str:
    """Return A to Z, then AA, AB and so on."""
    head, last = divmod(number, 26)
    return (_letters(head - 1) if head else "") + chr(ord("A") + last)


def _single(columns: Mapping[str, np.ndarray], column: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return x and y of a run's column, smoothed and thinned out."""
    steps = columns.get("env_steps", columns.get("iteration"))
    if steps is None or column not in columns:
        return None
    known = np.isfinite(steps) & np.isfinite(columns[column])
    x, y = steps[known], columns[column][known]
    if not len(x):
        return None
    chosen = np.unique(np.linspace(0, len(x) - 1, POINTS).round().astype(int))
    return x[chosen], smooth(y)[chosen]
