"""Tables and figures of the study, from the folders that its runs leave."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from docs.studies.study_cells import CELLS, QUESTIONS
from docs.studies.study_runs import PLAYED, Job
from surgical_marl.evaluation.interval import interval, over_seeds
from surgical_marl.evaluation.metrics import SUCCESS_MM, Metric, metrics, success
from surgical_marl.files import write_atomic, write_text
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.runs.folder import read_metrics, read_origin, read_settings

COLORS = ("#1f6f8b", "#b23a48", "#7a7a7a", "#c98a1b")
FINAL = (f"success_{SUCCESS_MM}mm", f"team_success_{SUCCESS_MM}mm", "median_error_mm", "collision_rate")
BOUNDED = (FINAL[0], "collision_rate")
"""The metrics that the page gives with their intervals; study.json has all."""
BROKEN = ("untouched", "frozen", "oracle")
LEVEL = 0.8
"""Level of training's own success for which the table gives samples and seconds."""
POINTS = 60
SIZE = "{num_envs:,} environments, {steps_per_iteration} steps an iteration, {iterations} iterations"
BEGIN, END = "<!-- study begin -->", "<!-- study end -->"


def report(jobs: Sequence[Job], out: Path, results: Path) -> None:
    """Write study.json, study.csv and study.png, and the tables in study.md.

    Rows of an older study.json stay where there is no run of their cell. ValueError if there is nothing to report yet.
    """
    if not jobs:
        raise ValueError(f"{out} holds no run that was played: nothing to report")
    order, page, numbers = list(CELLS), results / "study.md", results / "study.json"
    groups = groupby(sorted(jobs, key=lambda job: (order.index(job.cell), job.seed)), key=lambda job: job.cell)
    rows = {row["cell"]: row for row in (json.loads(numbers.read_text(encoding="utf-8")) if numbers.is_file() else [])}
    rows |= {cell: describe(list(members), out) for cell, members in groups}
    found = [rows[name] for name in order if name in rows]
    write_text(numbers, json.dumps(found, indent=1) + "\n")
    write_atomic(results / "study.csv", lambda path: _write_csv(path, found))
    draw(found, results / "study.png")
    text = page.read_text(encoding="utf-8") if page.is_file() else f"{BEGIN}\n{END}\n"
    before, _, rest = text.partition(BEGIN)
    write_text(page, before + tables(found) + rest.partition(END)[2])


def tables(found: Sequence[dict[str, Any]]) -> str:
    """Return the part of study.md that is made of rows of study.json, with its markers."""
    parts = ["![success and collisions while training](study.png)"]
    for members in _by_question(found).values():
        title = QUESTIONS[CELLS[members[0]["cell"]].question]
        parts += [f"### {title}", about(members), final_table(members), broken_table(members)]
    return "\n\n".join([BEGIN, *parts, END])


def _by_question(found: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    groups: dict[str, list[dict[str, Any]]] = {}
    for each in found:
        groups.setdefault(CELLS[each["cell"]].question, []).append(each)
    return groups


def describe(jobs: Sequence[Job], out: Path) -> dict[str, Any]:
    """Summarise the R runs of one cell.

    Numbers with an interval are [value, low, high], with None where unknown.
    """
    played = [dict(np.load(out / str(job) / PLAYED)) for job in jobs]
    abouts = [json.loads(str(each["about"])) for each in played]
    if len({each["goal_set"] for each in abouts}) > 1:
        raise ValueError(f"the runs of {jobs[0].cell} did not play the same goals: play them anew")
    rows = [read_metrics(out / str(job)) for job in jobs]
    settings = read_settings(out / str(jobs[0]))
    played_held = _stacked(played, "untouched")["held"]
    final = metrics(_stacked(played, "untouched"), TASKS.load(settings.task).follows)
    return {
        "cell": jobs[0].cell,
        "task": settings.task,
        "scene": settings.scene,
        "algo": settings.algo,
        "seeds": [job.seed for job in jobs],
        "num_envs": settings.num_envs,
        "steps_per_iteration": settings.steps_per_iteration,
        "iterations": settings.iterations,
        "trained_on": read_origin(out / str(jobs[0]))["origin"].get("device"),
        **{key: abouts[0][key] for key in ("goal_set", "episodes", "cpu", "gpu")},
        **{name: number(final[name]) for name in FINAL},
        "samples": rows[0][-1]["env_steps"],
        "seconds": _over_runs([sum(row["seconds"] for row in run) for run in rows]),
        "by_seed": [{name: _value(final[name], at) for name in FINAL} for at in range(len(jobs))],
        "curves": {axis: curve(rows, axis) for axis in ("samples", "seconds")},
        "broken": {what: broken(played, abouts[0]["agents"], what) for what in BROKEN if _was_played(played, what)},
        "arms": {
            arm: number(success(1000 * played_held[..., index : index + 1], SUCCESS_MM))
            for index, arm in enumerate(abouts[0]["agents"])
        },
    }


def curve(runs: Sequence[Sequence[dict[str, float]]], axis: str) -> dict[str, Any]:
    """Return success and collisions of training against samples or seconds: means over the runs and their intervals."""
    reached = [
        np.cumsum([row["seconds"] for row in run]) if axis == "seconds" else np.array([row["env_steps"] for row in run])
        for run in runs
    ]
    grid = np.linspace(0, min(x[-1] for x in reached), POINTS + 1)[1:]
    found: dict[str, Any] = {"x": grid.tolist()}
    for name in ("success_rate", "collision_rate"):
        lines = []
        for x, run in zip(reached, runs, strict=True):
            y = np.array([row[name] for row in run])
            known = np.isfinite(y)  # no episode ended
            lines.append(np.interp(grid, x[known], y[known], left=0.0) if known.any() else np.zeros(POINTS))
        found[name] = [_over_runs(values, most=1.0) for values in np.transpose(lines).tolist()]
    reaches = [x for x, y in zip(grid, found["success_rate"], strict=True) if y[0] >= LEVEL]
    return {**found, "reached": float(reaches[0]) if reaches else None}


def broken(played: Sequence[dict[str, np.ndarray]], agents: Sequence[str], what: str) -> dict[str, Any]:
    """Return what is left of success when each arm in turn is taken from its policy, and the collisions.

    `others` is the success of the remaining arms, and `itself` that of the arm that was taken. If `what` is
    "untouched", no arm is taken: the numbers are then those of the same arms under their own policy.
    """
    others, itself, collided = [], [], []
    for index, arm in enumerate(agents):
        measures = _stacked(played, what if what == "untouched" else f"{what} {arm}")
        others.append(np.delete(measures["held"], index, -1))
        itself.append(measures["held"][..., index : index + 1])
        collided.append(measures["collided"].any(-1, keepdims=True).astype(float))
    return {
        "others": number(success(1000 * np.concatenate(others, -1), SUCCESS_MM)),
        "itself": number(success(1000 * np.concatenate(itself, -1), SUCCESS_MM)),
        "collisions": number(Metric(np.concatenate(collided, -1), lambda values: values.mean(-1), share=True)),
    }


def number(metric: Metric) -> list[float | None]:
    """Return [value, low, high] of a 95 % interval."""
    return [float(metric.reduce(metric.values.ravel())), *(interval(metric) or (None, None))]


def about(found: Sequence[dict[str, Any]]) -> str:
    """Return a sentence that says what was run."""
    seeds = sorted({len(each["seeds"]) for each in found})
    how = _by_scene(found, SIZE.format_map)
    where = _by_scene(found, _devices)
    task = " and ".join(dict.fromkeys(f"`{each['task']}`" for each in found))
    return f"{task}, {' to '.join(map(str, seeds))} seeds each, {how}; {where}."


def _devices(row: dict[str, Any]) -> str:
    return f"trained on {row['trained_on'] or 'an unknown device'}, played on {row['gpu'] or row['cpu']}"


def _by_scene(found: Sequence[dict[str, Any]], say: Callable[[dict[str, Any]], str]) -> str:
    """Return what is said of rows; what differs between them with the scenes that it is about.

    Where not all rows of a scene agree, it is about their settings instead.
    """
    said: dict[str, set[str]] = {}
    for each in found:
        said.setdefault(each["scene"], set()).add(say(each))
    places: dict[str, dict[tuple[str, str], None]] = {}  # of each text, in order
    for each in found:
        alike = len(said[each["scene"]]) == 1
        where = ("on", f"`{each['scene']}`") if alike else ("with", f"`{CELLS[each['cell']].label()}`")
        places.setdefault(say(each), {})[where] = None
    return "; ".join(text + (f" {_joined(list(names))}" if len(places) > 1 else "") for text, names in places.items())


def _joined(places: Sequence[tuple[str, str]]) -> str:
    """Return places and settings as a phrase that has each one's "on" or "with" only where that begins or changes."""
    kept = [name if at and places[at - 1][0] == how else f"{how} {name}" for at, (how, name) in enumerate(places)]
    return " and ".join(kept)


def final_table(found: Sequence[dict[str, Any]]) -> str:
    """Return the results of the frozen evaluation, and how long it took to learn, as a Markdown table."""
    level = f"{LEVEL:.0%} in training"
    head = ["scene", "settings", f"within {SUCCESS_MM} mm", "all arms", "median error (mm)", "collisions",
            f"M samples to {level}", f"seconds to {level}", "seconds in all"]  # fmt: skip
    rows = []
    for each in found:
        samples, seconds = (each["curves"][axis]["reached"] for axis in ("samples", "seconds"))
        cells = [_cell(each[name] if name in BOUNDED else each[name][:1], name) for name in FINAL]
        cells += ["-" if samples is None else f"{samples / 1e6:.3g}", "-" if seconds is None else f"{seconds:.3g}"]
        rows.append(
            [f"`{each['scene']}`", f"`{CELLS[each['cell']].label()}`", *cells, _cell(each["seconds"][:1], "seconds")]
        )
    return _markdown(head, rows)


def broken_table(found: Sequence[dict[str, Any]]) -> str:
    """Return how the other arms do when each arm in turn is taken from its policy, as a Markdown table."""
    ways = {"frozen": "one frozen", "oracle": "one moved by the oracle"}
    head = ["scene", "settings", *(cell for way in ways.values() for cell in (f"other arms, {way}", "collisions"))]
    rows = [
        [f"`{each['scene']}`", f"`{CELLS[each['cell']].label()}`"]
        + [
            _cell(each["broken"].get(way, {}).get(name, [None])[:most], "rate")  # "-" if nobody played it
            for way in ways
            for name, most in (("others", 3), ("collisions", 1))
        ]
        for each in found
    ]
    return _markdown(head, rows)


def draw(found: Sequence[dict[str, Any]], out: Path) -> None:
    """Draw success against samples and seconds, and collisions: a row for a question and scene, a line for a cell."""
    places = list(dict.fromkeys((CELLS[each["cell"]].question, each["scene"]) for each in found))
    figure = Figure(figsize=(11, 2.9 * len(places)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = (("samples", "success_rate"), ("seconds", "success_rate"), ("samples", "collision_rate"))
    titles = {"success_rate": f"tips within {SUCCESS_MM} mm", "collision_rate": "episodes with a collision"}
    for axes, place in zip(figure.subplots(len(places), 3, squeeze=False), places, strict=True):
        members = [each for each in found if (CELLS[each["cell"]].question, each["scene"]) == place]
        for axis, (x, name) in zip(axes, panels, strict=True):
            for color, each in zip(COLORS, members, strict=False):
                lines = each["curves"][x]
                mean, low, high = (np.array(side, float) for side in zip(*lines[name], strict=True))
                axis.plot(lines["x"], mean, color=color, label=CELLS[each["cell"]].label())
                axis.fill_between(lines["x"], low, high, color=color, alpha=0.2, linewidth=0)
            axis.set_title(f"{place[1]}: {titles[name]}", fontsize=9)
            axis.set_xlabel(x)
            if x == "samples":
                axis.xaxis.set_major_formatter(EngFormatter(sep=""))
            axis.yaxis.set_major_formatter(PercentFormatter(1.0))
            axis.set_ylim(*((-0.02, 1.02) if name == "success_rate" else (0.0, None)))
            axis.grid(True, color="#dddddd", linewidth=0.6)
            axis.spines[["top", "right"]].set_visible(False)
        axes[0].legend(fontsize=8, frameon=False)
    write_atomic(out, lambda path: figure.savefig(path, format="png", dpi=120))


def _was_played(played: Sequence[dict[str, np.ndarray]], what: str) -> bool:
    return all(any(name.startswith(what) for name in each) for each in played)


def _stacked(played: Sequence[dict[str, np.ndarray]], what: str) -> dict[str, np.ndarray]:
    """Return measures [R, E, A] of one way of playing."""
    names = [name.partition("/")[2] for name in played[0] if name.startswith(f"{what}/")]
    return {name: np.stack([each[f"{what}/{name}"] for each in played]) for name in names}


def _over_runs(values: Sequence[float], most: float = np.inf) -> list[float | None]:
    """Return [mean, low, high] of one number of each run, by t; its largest possible value is `most`."""
    bounds = over_seeds(values, [[value, value] for value in values], most) if len(values) > 1 else None
    return [float(np.mean(values)), *(bounds or (None, None))]


def _value(metric: Metric, run: int) -> float:
    return float(metric.reduce(metric.values[run].ravel()))


def _cell(numbers: Sequence[float | None], name: str) -> str:
    rate = name.startswith(("success", "team", "collision", "rate"))
    show: Callable[[float], str] = (lambda x: f"{x:.1%}") if rate else (lambda x: f"{x:.3g}")
    value, *bounds = ("-" if x is None else show(x) for x in numbers)
    return f"{value} ({' to '.join(bounds)})" if None not in numbers[1:] and bounds else value


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows))


def _write_csv(path: Path, found: Sequence[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["cell", "seed", *FINAL])
        for each in found:
            for seed, numbers in zip(each["seeds"], each["by_seed"], strict=True):
                writer.writerow([each["cell"], seed, *(format(numbers[name], ".6g") for name in FINAL)])
