"""Tables of a report: runs, settings, results of evaluations, versions and devices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from surgical_marl.evaluation.card import SHOWN
from surgical_marl.evaluation.report import explained, number, spanned
from surgical_marl.report.charts import percent, plain
from surgical_marl.report.groups import Group, differences, numbers
from surgical_marl.report.run import Run

ALSO = ("peak_force_n", "min_distance_mm", "path_length_mm", "smoothness", "action_change", "remote_center_error_mm")
"""Metrics that a report shows beside those of a policy's card."""
TAIL = 0.05
"""The share of the iterations at the end over which training's own figures are averaged."""


class Table(NamedTuple):
    """A table; the first cell of a row is its head."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


class Tile(NamedTuple):
    """One of the large numbers at the top."""

    value: str
    label: str


def runs(groups: Sequence[Group]) -> Table:
    """Return a row for each run: its name and seed, how far it went, and its figures at the end of training."""
    head = ["run", "seed", "iterations", "environment steps", "training time", "success", "error (mm)", "collisions"]
    rows = []
    for group in groups:
        for run in group.runs:
            cells = [
                run.seed,
                plain(_end(run, "iteration")),
                _count(_end(run, "env_steps")),
                _duration(run),
                percent(_tail(run, "success_rate")),
                plain(_tail(run, "tip_error_mm")),
                percent(_tail(run, "collision_rate")),
            ]
            rows.append([run.name, *([group.label] if len(groups) > 1 else []), *cells])
    if len(groups) > 1:
        head.insert(1, "group")
    kept = [i for i in range(len(head)) if i == 0 or any(row[i] != "-" for row in rows)]
    head, rows = [head[i] for i in kept], [[row[i] for i in kept] for row in rows]
    caption = f"Runs, with means over the last {TAIL:.0%} of training's iterations, where actions are noisy"
    return Table(caption, head, rows)


def tiles(run: Run) -> list[Tile]:
    """Return the large numbers of a report of one run."""
    found = []
    if run.result is not None:
        for name, label in (
            ("success_rate", "success"),
            ("median_error_mm", "median error"),
            ("collision_rate", "episodes with a collision"),
            ("time_to_success_s", "time to success"),
        ):
            value = run.result.get(name)
            unit = {"median_error_mm": " mm", "time_to_success_s": " s"}.get(name, "")
            if value is not None:
                found.append(Tile(number(name, value) + unit, label))
    else:
        found.append(Tile(percent(_tail(run, "success_rate")), "success in training"))
    found.append(Tile(_count(_end(run, "env_steps")), "environment steps"))
    found.append(Tile(_duration(run), "training"))
    return found


def settings_that_differ(groups: Sequence[Group]) -> Table | None:
    """Return the settings in which groups differ; None for one group."""
    if len(groups) < 2:
        return None
    found = differences(groups)
    rows = [[name, *(show(value) for value in values)] for name, values in found.items()]
    return Table("Settings in which the groups differ", ["setting", *(group.label for group in groups)], rows)


def settings(groups: Sequence[Group]) -> Table:
    """Return all settings of all groups; that of the seed is left out where it differs."""
    configs = [group.runs[0].config for group in groups]
    names = dict.fromkeys(name for config in configs for name in config if name != "seed")
    rows = [[name, *(show(config.get(name)) for config in configs)] for name in names]
    return Table("All settings", ["setting", *(["value"] if len(groups) == 1 else [g.label for g in groups])], rows)


def origins(groups: Sequence[Group]) -> Table:
    """Return device, commit, time and versions of each run; one column for runs that have all of them in common."""
    every = [run for group in groups for run in group.runs]
    common: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for run in every:
        facts = {"device": run.origin.get("device", "unknown"), "commit": run.origin.get("commit", "unknown")}
        common.setdefault(tuple({**facts, **run.versions}.items()), []).append(run.name)
    columns = [dict(facts) for facts in common]
    names = dict.fromkeys(name for column in columns for name in column)
    head = ["what", *(", ".join(who) if len(common) > 1 else "all runs" for who in common.values())]
    rows = [[name, *(column.get(name, "-") for column in columns)] for name in names]
    if len(every) == 1:
        head, rows = ["what", "value"], [*rows, ["started", every[0].origin.get("started", "unknown")]]
    return Table("Where it ran", head, rows)


def results(groups: Sequence[Group]) -> Table | None:
    """Return the metrics of evaluations, with 95 % intervals; None if no run was evaluated.

    One run alone has a column for each agent. Several have one for each group whose episodes are known, and else one
    for each run.
    """
    every = [run for group in groups for run in group.runs]
    if len(every) == 1 and every[0].result is not None:
        result = every[0].result
        agents = result["agents"] if len(result["agents"]) > 1 else {}
        columns = {"all": _cells(result), **{agent: _cells(part) for agent, part in agents.items()}}
    else:
        columns = {}
        for group in groups:
            columns |= _columns(group, several=len(groups) > 1)
    columns = {name: cells for name, cells in columns.items() if cells}
    if not columns:
        return None
    names = [name for name in (*SHOWN, *ALSO) if any(name in cells for cells in columns.values())]
    rows = [[explained(name), *(cells.get(name, "-") for cells in columns.values())] for name in names]
    rows = [row for row in rows if set(row[1:]) != {"-"}]
    return Table("Evaluation, with 95 % intervals in brackets", ["metric", *columns], rows)


def stages(groups: Sequence[Group]) -> Table | None:
    """Return the share of agents that reached each stage, of runs whose single episodes are not known."""
    found = {
        run.name: run.result["stages"]
        for group in groups
        for run in group.runs
        if run.result is not None and run.played is None and isinstance(run.result.get("stages"), dict)
    }
    names = dict.fromkeys(name for each in found.values() for name in each)
    rows = [
        [name.replace("_", " "), *(number("stage_rate", each.get(name)) for each in found.values())] for name in names
    ]
    return Table("Stages of the task", ["stage", *found], rows) if rows else None


def rewards(run: Run) -> Table | None:
    """Return the reward's terms and the costs of a run's evaluation, by agent."""
    if run.result is None:
        return None
    parts = {"all": run.result, **run.result["agents"]}
    names = [name for name in run.result["intervals"] if name.startswith(("reward_", "cost"))]
    rows = [[explained(name), *(_plain(part.get(name)) for part in parts.values())] for name in names]
    return Table("Reward terms and costs of a step in the evaluation", ["term", *parts], rows) if rows else None


def show(value: Any) -> str:
    """Return a setting as text."""
    if value is None:
        return "-"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _columns(group: Group, several: bool) -> dict[str, dict[str, str]]:
    if played := group.played:
        count = f" ({len(played)} seeds)" if len(played) > 1 else ""
        found = numbers(played, [*SHOWN, *ALSO])
        cells = {name: spanned(name, value if np.isfinite(value) else None, b) for name, (value, b) in found.items()}
        return {f"{group.label}{count if several else ''}": cells}
    return {run.name: _cells(run.result) for run in group.runs if run.result is not None}


def _cells(part: Mapping[str, Any]) -> dict[str, str]:
    return {name: spanned(name, part.get(name), bounds) for name, bounds in part["intervals"].items()}


def _plain(value: float | None) -> str:
    return "-" if value is None else plain(value)


def _end(run: Run, name: str) -> float:
    return float(run.columns[name][-1]) if name in run.columns else float("nan")


def _tail(run: Run, name: str) -> float:
    values = run.columns.get(name, np.zeros(0))
    last = values[-max(1, round(TAIL * len(values))) :]
    known = last[np.isfinite(last)]
    return float(known.mean()) if len(known) else float("nan")


def _count(value: float) -> str:
    """Return a number of steps, such as 47.2 million."""
    for size, word in ((1e9, " billion"), (1e6, " million"), (1e4, " thousand")):
        if value >= size:
            return f"{value / (1e3 if size == 1e4 else size):.3g}{word}"
    return plain(value)


def _duration(run: Run) -> str:
    """Return how long a training took, as text; "-" if that is unknown."""
    seconds = float(np.nansum(run.columns.get("seconds", np.zeros(0))))
    if not seconds > 0:
        return "-"
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
