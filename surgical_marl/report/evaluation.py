"""Charts of an evaluation: errors, success against threshold, stages, distances, forces, time to success, courses."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from surgical_marl.evaluation.evaluate import Played
from surgical_marl.evaluation.interval import interval
from surgical_marl.evaluation.metrics import HOLD, STAGE, THRESHOLDS_MM, Metric, mean_of_known, success
from surgical_marl.report.charts import NUMBER, SHARE, Chart, Drawing, Line, Scale, Text, percent, plain
from surgical_marl.report.groups import Group, stacked

THRESHOLDS, BINS = 24, 24
ROWS = 12
"""Most rows of a histogram's table."""


class Series(NamedTuple):
    """Episodes that a chart shows by one colour."""

    label: str
    number: int
    measures: dict[str, np.ndarray]
    """[R, E, A] each."""


class Histogram(NamedTuple):
    """A measure to count, in a unit that people read."""

    measure: str
    unit: float
    title: str
    label: str
    log: bool = False


HISTOGRAMS = (
    Histogram("error", 1000.0, "Error (mm)", "error (mm)", log=True),
    Histogram("time", 1.0, "Time to success (s)", "time (s)"),
    Histogram("distance", 1000.0, "Least distance to another arm (mm)", "least distance of an episode (mm)"),
    Histogram("contact_force", 1.0, "Peak contact force (N)", "largest force of an episode (N)"),
)

COURSES = (
    ("tissue_force", "Force on tissue over time (N)", "the largest force on tissue"),
    ("tension", "Tension of thread over time (N)", "the largest tension of a thread"),
)
"""What is drawn over time: its name, the title of its chart, and words for it."""


def charts(drawing: Drawing, groups: Sequence[Group]) -> list[Chart]:
    """Return all charts that the groups' episodes allow."""
    played = [(number, group, group.played) for number, group in enumerate(groups)]
    by_group = [Series(group.label, number, stacked(found)) for number, group, found in played if found]
    if not by_group:
        return []
    following = any(found[0].follows for _, _, found in played if found)
    series = by_group if len(groups) > 1 else _by_agent(by_group[0], groups[0].played[0].agents)
    found = [_threshold(drawing, series, following), *(_histogram(drawing, series, kind) for kind in HISTOGRAMS)]
    over_time = [(number, group.label, group.played) for number, group, _ in played]
    found += [_course(drawing, over_time, *course) for course in COURSES]
    found.insert(2, _stages(drawing, series, next(found[0].stages for _, _, found in played if found)))
    return [chart for chart in found if chart is not None]


def _by_agent(whole: Series, agents: Sequence[str]) -> list[Series]:
    """Return a series for each agent; agents whose numbers are all unknown are left out by the charts."""
    cut = [{name: values[..., i : i + 1] for name, values in whole.measures.items()} for i in range(len(agents))]
    return [Series(agent, i, cut[i]) for i, agent in enumerate(agents)]


def _legend(series: Sequence[Series]) -> tuple[tuple[str, int], ...]:
    return tuple((one.label, one.number) for one in series) if len(series) > 1 else ()


def _threshold(drawing: Drawing, series: Sequence[Series], following: bool) -> Chart | None:
    """Draw success against threshold with its 95 % interval."""
    series = [one for one in series if np.isfinite(one.measures["held"]).any()]
    if not series:
        return None
    held = {one.label: 1000 * one.measures["held"] for one in series}
    every = np.concatenate([values[np.isfinite(values)] for values in held.values()])
    low = float(np.clip(np.percentile(every, 2) / 1.2, 1e-3, 0.3))
    high = float(np.clip(1.2 * every.max(), 10.0, 1e4))
    grid = np.unique([*np.geomspace(low, high, THRESHOLDS), *THRESHOLDS_MM])
    lines, columns, sentences = [], [], []
    for one in series:
        metrics = [success(held[one.label], threshold)._replace(reduce=mean_of_known) for threshold in grid]
        value = np.array([_mean(metric) for metric in metrics])
        bounds = np.array([interval(metric) or (np.nan, np.nan) for metric in metrics])
        lines.append(Line(one.number, grid, value, (bounds[:, 0], bounds[:, 1])))
        columns.append([_cell(*pair) for pair in zip(value, bounds, strict=True)])
        at = ", ".join(f"{percent(value[grid == t][0])} within {t} mm" for t in THRESHOLDS_MM)
        sentences.append(f"{one.label}: {at}.")
    rows = [[plain(x), *cells] for x, *cells in zip(grid, *columns, strict=True)]
    when = "all the time" if following else f"for the last {HOLD} s of the episode"
    text = Text(
        "Success against threshold",
        f"Share of arms whose error stays below a threshold {when}. " + " ".join(sentences),
        ["threshold (mm)", *(one.label for one in series)],
        rows[:: max(1, len(rows) // 14)],
        _legend(series),
    )
    return drawing.lines(text, lines, Scale(plain, (low, high), log=True), SHARE, "threshold (mm)")


def _histogram(drawing: Drawing, series: Sequence[Series], kind: Histogram) -> Chart | None:
    """Draw the share of episodes and arms in each bin of a measure."""
    found = {}
    for one in series:
        values = kind.unit * one.measures.get(kind.measure, np.full(1, np.nan)).ravel()
        if (known := values[np.isfinite(values)]).size:
            found[one.label] = known, values.size
    every = np.concatenate([known for known, _ in found.values()]) if found else np.zeros(0)
    if not every.size or not every.any():
        return None
    log = kind.log and every.min() > 0 and every.max() > 10 * every.min()
    edges = _edges(every, log)
    lines, columns, sentences = [], [], []
    shown = [one for one in series if one.label in found]
    for one in shown:
        known, size = found[one.label]
        share = np.histogram(np.minimum(known, edges[-1]), edges)[0] / size
        lines.append(Line(one.number, edges, share, steps=True))
        columns.append(share.reshape(-1, len(share) // ROWS).sum(1))
        spread = ", ".join(plain(value) for value in np.percentile(known, [5, 50, 95, 100]))
        sentences.append(f"{one.label}: {spread}; {percent(known.size / size)} have a value.")
    coarse = edges[:: (len(edges) - 1) // ROWS]
    rows = [
        [f"{plain(low)} to {plain(high)}", *(percent(column[i]) for column in columns)]
        for i, (low, high) in enumerate(pairwise(coarse))
    ]
    label = kind.label
    if every.max() > edges[-1]:
        label += "; last bin: or more"
        rows[-1][0] = f"{plain(coarse[-2])} or more"
    text = Text(
        kind.title,
        f"Share of episodes and arms by {kind.label}. 5th, 50th and 95th percentile, and the largest: "
        f"{' '.join(sentences)}",
        [kind.label, *(one.label for one in shown)],
        rows,
        _legend(shown),
    )
    return drawing.lines(text, lines, Scale(plain, (edges[0], edges[-1]), log=log), Scale(percent), label)


def _course(
    drawing: Drawing, groups: Sequence[tuple[int, str, Sequence[Played]]], name: str, title: str, words: str
) -> Chart | None:
    """Draw the median over episodes of a number over time, with a band from the 5th to the 95th percentile."""
    lines, columns, shown = [], [], []
    for number, label, played in groups:
        courses = [one.courses[name] for one in played if name in one.courses]
        if not courses or len({len(one) for one in courses}) > 1:
            continue
        every, about = np.concatenate(courses, 1), played[0].about
        going = np.isfinite(every).any(1)
        time = float(about["max_steps"] * about["control_dt"]) * (np.arange(len(every)) + 1) / len(every)
        low, middle, high = np.nanpercentile(every[going], [5, 50, 95], axis=1)
        lines.append(Line(number, time[going], middle, (low, high)))
        columns.append([(plain(t), *map(plain, row)) for t, *row in zip(time[going], low, middle, high, strict=True)])
        shown.append((label, number))
    if not lines or not any(line.y.any() or (line.band is not None and line.band[1].any()) for line in lines):
        return None
    rows = [(label, *row) for (label, _), column in zip(shown, columns, strict=True)
            for row in column[:: max(1, len(column) // ROWS)]]  # fmt: skip
    text = Text(
        title,
        f"Over the episodes that go on, {words} in each share of the time: the median, and a band from the 5th to the "
        "95th percentile.",
        ["episodes of", "time (s)", "5th percentile (N)", "median (N)", "95th percentile (N)"],
        rows,
        tuple(shown) if len(shown) > 1 else (),
    )
    return drawing.lines(text, lines, NUMBER, NUMBER, "time (s)")


def _edges(values: np.ndarray, log: bool) -> np.ndarray:
    low, high = float(values.min()), float(values.max())
    if log:
        return np.geomspace(low, high * 1.0001, BINS + 1)
    usual = float(np.percentile(values, 99))
    high = usual if high > 3 * usual > 0 else high  # the last bin has what is beyond
    low = min(low, 0.0) if low < 0.3 * high else low
    return np.linspace(low, high if high > low else low + 1.0, BINS + 1)


def _stages(drawing: Drawing, series: Sequence[Series], stages: Sequence[str]) -> Chart | None:
    """Draw the share of episodes that reached each stage."""
    stages = [stage for stage in stages if all(f"{STAGE}{stage}" in one.measures for one in series)]
    if not stages:
        return None
    metrics = [[Metric(one.measures[f"{STAGE}{s}"], mean_of_known, share=True) for one in series] for s in stages]
    values = np.array([[_mean(metric) for metric in row] for row in metrics])
    missing = np.full(2, np.nan)
    bounds = np.array([
        [interval(metric) or missing if np.isfinite(value) else missing for metric, value in zip(*pair, strict=True)]
        for pair in zip(metrics, values, strict=True)
    ])  # fmt: skip
    cells = [[_cell(*pair) for pair in zip(*row, strict=True)] for row in zip(values, bounds, strict=True)]
    words = [stage.replace("_", " ") for stage in stages]
    text = Text(
        "Stages of the task",
        "Share of episodes in which an agent reached each stage at some time, in order; lines are 95 % intervals.",
        ["stage", *(one.label for one in series)],
        [[word, *row] for word, row in zip(words, cells, strict=True)],
        _legend(series),
    )
    return drawing.bars(text, words, values, bounds, SHARE)


def _cell(value: float, bounds: np.ndarray) -> str:
    return f"{percent(value)} ({percent(bounds[0])} to {percent(bounds[1])})"


def _mean(metric: Metric) -> float:
    return float(metric.reduce(metric.values.ravel()))
