"""The learning curve of a run as a picture."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, NullFormatter, PercentFormatter
from PIL import Image

from surgical_marl.files import write_atomic
from surgical_marl.runs.folder import CURVE, read_metrics
from surgical_marl.untrusted.values import one_line

PANELS = (
    ("tip_error_mm", "tip error at the end (mm)", "#1f6f8b"),
    ("success_rate", "success", "#3a7d44"),
    ("collision_rate", "episodes with a collision", "#b23a48"),
)

COLOURS = 128
"""Number of colours of the picture: nobody sees the difference, and the file is a third as large as with all."""


def draw_curve(run: Path, title: str) -> None:
    """Draw `curve.png` from `metrics.csv`: error, success, collisions against steps."""
    rows = read_metrics(run)
    steps = np.array([row.get("env_steps", math.nan) for row in rows])
    figure = Figure(figsize=(12, 3.6), dpi=150, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(one_line(title), fontsize=11, parse_math=False)  # a name in it may hold anything
    for axis, (name, label, color) in zip(figure.subplots(1, 3), PANELS, strict=True):
        values = np.array([row.get(name, math.nan) for row in rows])
        known = np.isfinite(values) & np.isfinite(steps)
        if name == "tip_error_mm":
            known &= values > 0  # others have no place on its axis
        axis.plot(steps[known], values[known], color=color, alpha=0.25, linewidth=1)
        axis.plot(steps[known], smooth(values[known]), color=color, linewidth=2)
        axis.set(title=label, xlabel="environment steps")
        axis.title.set_fontsize(10)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.grid(True, which="both", color="#dddddd", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        if name == "tip_error_mm":
            axis.set_yscale("log")
            axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.yaxis.set_minor_formatter(NullFormatter())
            # Whole decades at least, so that runs compare at a glance and the axis has labels.
            axis.set_ylim(*_log_limits(values[known]))
        else:
            axis.set_ylim(-0.02, 1.02)
            axis.yaxis.set_major_formatter(PercentFormatter(1.0))
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    picture = picture.quantize(COLOURS, dither=Image.Dither.NONE)
    write_atomic(run / CURVE, lambda path: picture.save(path, format="png", optimize=True))


def smooth(values: np.ndarray) -> np.ndarray:
    """Return the running mean over a fiftieth of the curve, with shorter windows at the ends."""
    half = len(values) // 100
    sums = np.concatenate([[0.0], np.cumsum(values)])
    middle = np.arange(len(values))
    low, high = np.maximum(middle - half, 0), np.minimum(middle + half + 1, len(values))
    return (sums[high] - sums[low]) / (high - low)


def _log_limits(values: np.ndarray) -> tuple[float, float]:
    """Return limits from 1 to 100, extended to further values."""
    positive = values[values > 0]
    return float(min([1.0, *positive / 1.2])), float(max([100.0, *positive * 1.2]))
