"""A picture of an evaluation: success against threshold, and the distribution of errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, PercentFormatter

from surgical_marl.evaluation.evaluate import Played
from surgical_marl.evaluation.interval import interval
from surgical_marl.evaluation.metrics import HOLD, THRESHOLDS_MM, success
from surgical_marl.files import write_atomic

COLOR, PALE = "#1f6f8b", "#9fc3cf"
POINTS = 60


def draw(path: Path, runs: Mapping[str, Played]) -> None:
    """Draw success against threshold with its 95 % interval, and the errors of each agent, as a PNG."""
    first = next(iter(runs.values()))
    held = 1000 * np.stack([run.measures["held"] for run in runs.values()])
    error = 1000 * np.stack([run.measures["error"] for run in runs.values()])
    figure = Figure(figsize=(10, 4), layout="constrained")
    of = next(iter(runs)) if len(runs) == 1 else f"{len(runs)} runs"
    figure.suptitle("{}: {task} in {scene}, {episodes} episodes, seed {seed}".format(of, **first.about), fontsize=11)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    low = np.clip(np.percentile(error, 5) / 1.2, 1e-3, 0.1)
    high = max(10.0, 1.2 * held.max())
    for axis in (left, right):
        axis.set_xscale("log")
        axis.set_xlim(low, high)
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(True, color="#dddddd", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    parts = {name: held[i : i + 1] for i, name in enumerate(runs)} if len(runs) > 1 else {}
    following = first.follows
    _draw_success(left, held, parts, np.geomspace(low, high, POINTS))
    left.set_xlabel("threshold (mm), held " + ("all the time" if following else f"for {HOLD} s"))
    _draw_errors(right, error, first.agents)
    right.set_xlabel(f"{'RMS error' if following else 'error at the end'} (mm): 5, 25, 50, 75, 95 %")
    write_atomic(path, lambda temporary: figure.savefig(temporary, format="png", dpi=150))


def _draw_success(axis: Axes, held: np.ndarray, parts: Mapping[str, np.ndarray], thresholds: np.ndarray) -> None:
    for number, part in enumerate(parts.values()):
        curve = [np.mean(part < threshold) for threshold in thresholds]
        axis.plot(thresholds, curve, color=PALE, linewidth=1, label=None if number else "each run")
    points = [success(held, threshold) for threshold in thresholds]
    low, high = np.transpose([interval(point) or [np.nan, np.nan] for point in points])
    axis.fill_between(thresholds, low, high, color=COLOR, alpha=0.2, linewidth=0, label="95 %")
    axis.plot(thresholds, [point.values.mean() for point in points], color=COLOR, linewidth=2, label="all")
    for threshold in THRESHOLDS_MM:
        axis.vlines(threshold, 0, 1, color="#888888", linewidth=0.8, linestyle=":")
        axis.text(threshold, 1.03, f"{threshold}", color="#666666", fontsize=8, ha="center")
    axis.set_ylim(-0.02, 1.08)
    axis.set_ylabel("arms that succeed")
    axis.yaxis.set_major_formatter(PercentFormatter(1.0))
    axis.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(0, 0.75))


def _draw_errors(axis: Axes, error: np.ndarray, agents: list[str]) -> None:
    axis.boxplot(
        [error[..., i].ravel() for i in range(len(agents))],
        orientation="horizontal",
        whis=(5, 95),
        showfliers=False,
        widths=0.5,
        patch_artist=True,
        boxprops={"facecolor": PALE, "edgecolor": COLOR},
        medianprops={"color": COLOR, "linewidth": 2},
        whiskerprops={"color": COLOR},
        capprops={"color": COLOR},
        tick_labels=agents,
    )
    axis.invert_yaxis()
