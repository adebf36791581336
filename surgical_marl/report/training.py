"""Charts of how training went: success, error, reward and its terms, collisions, speed, and what the algorithm did."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from surgical_marl.evaluation.metrics import TERMS
from surgical_marl.evaluation.report import title
from surgical_marl.report.charts import NUMBER, SHARE, Chart, Drawing, Line, Scale, Text, percent, plain
from surgical_marl.report.groups import Curve, Group, curve

MAIN = ("success_rate", "tip_error_mm", "reward", "collision_rate")
TITLES = {
    "success_rate": "success in training",
    "tip_error_mm": "tip error at the end of episodes (mm)",
    "reward": "reward of a step",
    "collision_rate": "episodes with a collision",
    "steps_per_s": "environment steps a second",
    "seconds": "seconds of an iteration",
}
_KNOWN = ("iteration", "env_steps", "episodes", *MAIN, "steps_per_s", "seconds")
LOG = ("tip_error_mm", "learning_rate")
ROWS = 9
"""Rows of the table beside a curve."""


def main(drawing: Drawing, groups: Sequence[Group]) -> list[Chart]:
    """Return the curves of success, error, reward and collisions that the runs have."""
    return _charts(drawing, groups, MAIN)


def reward_terms(drawing: Drawing, groups: Sequence[Group]) -> tuple[list[Chart], list[str]]:
    """Return a curve of each reward term, and the names of the terms that were zero all the time."""
    names = [name for name in _columns(groups) if name.startswith(TERMS[0])]
    zero = [name for name in names if not any(np.nan_to_num(c).any() for c in _values(groups, name))]
    charts = _charts(drawing, groups, [name for name in names if name not in zero])
    return charts, [title(name.removeprefix(TERMS[0])) for name in zero]


def speed(drawing: Drawing, groups: Sequence[Group]) -> list[Chart]:
    """Return the curves of steps a second, and of the seconds of each part of an iteration where they are known."""
    parts = [name for name in _columns(groups) if name.startswith("seconds_")]
    return _charts(drawing, groups, ["steps_per_s", *(["seconds", *parts] if parts else [])])


def internals(drawing: Drawing, groups: Sequence[Group]) -> list[Chart]:
    """Return the curves of all other columns: losses, entropy, learning rate and so on."""
    known = (*_KNOWN, *(n for n in _columns(groups) if n.startswith((TERMS[0], "seconds_"))))
    return _charts(drawing, groups, [name for name in _columns(groups) if name not in known])


def _charts(drawing: Drawing, groups: Sequence[Group], names: Sequence[str]) -> list[Chart]:
    charts = (_chart(drawing, groups, name) for name in names)
    return [chart for chart in charts if chart is not None]


def _chart(drawing: Drawing, groups: Sequence[Group], name: str) -> Chart | None:
    curves = {i: found for i, group in enumerate(groups) if (found := curve(group, name)) is not None}
    if not curves:
        return None
    lines, share = [], name.endswith("_rate") and name != "learning_rate"
    for number, found in curves.items():
        several = len(found.single) > 1
        band = (found.low, found.high) if several else None
        lines.append(Line(number, found.x, found.mean, band, found.single if several else ()))
    values = np.concatenate([y for found in curves.values() for _, y in found.single])
    scale = _share_scale(name, values) if share else _log_scale(values) if name in LOG else NUMBER
    words = TITLES.get(name, title(name.removeprefix("reward_") if name != "reward" else name))
    words = f"reward: {words}" if name.startswith("reward_") else words
    x_label = "environment steps" if _has(groups, "env_steps") else "iterations"
    text = Text(
        words[0].upper() + words[1:],
        _describe(groups, curves, scale.write, x_label),
        *_table(groups, curves, scale.write, x_label),
        tuple((group.label, i) for i, group in enumerate(groups) if i in curves) if len(groups) > 1 else (),
    )
    return drawing.lines(text, lines, NUMBER, scale, x_label)


def _describe(groups: Sequence[Group], curves: dict[int, Curve], write: Callable[[float], str], x_label: str) -> str:
    sentences = []
    for number, found in curves.items():
        who = f"{groups[number].label}: " if len(groups) > 1 else ""
        seeds = f", mean of {len(found.single)} runs" if len(found.single) > 1 else ""
        first, last = write(found.mean[0]), write(found.mean[-1])
        sentences.append(f"{who}from {first} to {last} within {found.x[-1]:,.0f} {x_label}{seeds}.")
    return " ".join(sentences)


def _table(
    groups: Sequence[Group], curves: dict[int, Curve], write: Callable[[float], str], x_label: str
) -> tuple[list[str], list[list[str]]]:
    """Return head and rows: x, and the mean of each group, with the lowest and highest run in brackets."""
    ends = [found.x[[0, -1]] for found in curves.values()]
    grid = np.unique(np.linspace(min(x[0] for x in ends), max(x[1] for x in ends), ROWS).round())
    columns = []
    for found in curves.values():
        kept = [np.interp(grid, found.x, y, left=np.nan, right=np.nan) for y in (found.mean, found.low, found.high)]
        several = len(found.single) > 1
        columns.append([
            write(mean) + (f" ({write(low)} to {write(high)})" if several and np.isfinite(mean) else "")
            for mean, low, high in zip(*kept, strict=True)
        ])  # fmt: skip
    head = [x_label, *(groups[number].label for number in curves)]
    return head, [[f"{x:,.0f}", *cells] for x, *cells in zip(grid, *columns, strict=True)]


def _share_scale(name: str, values: np.ndarray) -> Scale:
    """Return a scale to 100 %, or to less for a small share that should be small."""
    most = float(values.max())
    if most > 0.2 or name == "success_rate":
        return SHARE
    high = max(1.1 * most, 0.01)
    return Scale(percent, (-0.02 * high, high))


def _log_scale(values: np.ndarray) -> Scale:
    """Return a logarithmic scale over a decade or more, or a linear one if a value is not positive."""
    if not (values > 0).all():
        return NUMBER
    low, high = float(values.min() / 1.3), float(values.max() * 1.3)
    middle = np.sqrt(low * high)
    return Scale(plain, (min(low, middle / 3.2), max(high, middle * 3.2)), log=True)


def _columns(groups: Sequence[Group]) -> list[str]:
    return list(dict.fromkeys(name for group in groups for run in group.runs for name in run.columns))


def _has(groups: Sequence[Group], name: str) -> bool:
    return any(name in run.columns for group in groups for run in group.runs)


def _values(groups: Sequence[Group], name: str) -> list[np.ndarray]:
    return [run.columns[name] for group in groups for run in group.runs if name in run.columns]
