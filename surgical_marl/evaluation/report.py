"""Results as a table for people and as a CSV file for other programs."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from surgical_marl.evaluation.goal_set import is_standard
from surgical_marl.files import write_atomic
from surgical_marl.untrusted.markup import as_html

ABOUT = (
    *(
        "policy",
        "task",
        "scene",
        "control",
        "difficulty",
        "goals",
        "start",
        "episodes",
        "seed",
        "max_steps",
        "control_dt",
    ),
    *("protocol", "goal_set"),
)


class Evaluation(dict[str, Any]):
    """Result of `evaluate`: a dict that a notebook shows as a table."""

    def _repr_html_(self) -> str:
        head, *rows = _rows(self, self["agents"])
        cells = "".join(f"<th>{as_html(cell)}</th>" for cell in head)
        lines = "".join("<tr>" + "".join(f"<td>{as_html(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        caption = as_html(_describe(self))
        return f"<table><caption>{caption}</caption><thead><tr>{cells}</tr></thead><tbody>{lines}</tbody></table>"


def format_table(result: Mapping[str, Any], others: Mapping[str, Mapping[str, Any]] | None = None) -> str:
    """Return a result as plain text: one line for each metric, with its 95 % interval.

    Args:
        result: what `evaluate` returned.
        others: further columns to show beside it, metrics by title; if None, one column for each agent.
    """
    rows = _rows(result, result["agents"] if others is None else others)
    return "\n".join([_describe(result), *aligned(rows)])


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows of cells, the first one a head, as lines of columns; columns of numbers are aligned to the right."""
    columns = list(zip(*rows, strict=True))
    adjusts = [
        str.rjust if all(cell == "-" or cell.lstrip("-")[:1].isdigit() for cell in column[1:]) else str.ljust
        for column in columns
    ]
    widths = [max(map(len, column)) for column in columns]
    return [
        "  ".join(adjust(cell, width) for adjust, cell, width in zip(adjusts, row, widths, strict=True)).rstrip()
        for row in rows
    ]


def described(result: Mapping[str, Any]) -> str:
    """Return a text on the task, the options, the number of episodes and the seed of a result."""
    words = "{task} in {scene}, {difficulty}, {control} control, {goals} goals, {start} start: {episodes} episodes"
    return f"{words.format(**result)}, seed {result['seed']}"


def _describe(result: Mapping[str, Any]) -> str:
    """Return a text on the task, options, episodes, partners and goal set of a result."""
    what = described(result)
    what += "".join(f", {agent} is {who}" for agent, who in result.get("partners", {}).items())
    return f"{what}, goal set {result['goal_set']:.12} ({'standard' if is_standard(result) else 'not a standard one'})"


def _rows(result: Mapping[str, Any], columns: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Return the head of a table and a row for each metric."""
    rows = [["", "all", "95 % interval", *columns]]
    for name, bounds in result["intervals"].items():
        span = "-" if bounds is None else " to ".join(number(name, bound) for bound in bounds)
        rows.append([explained(name), number(name, result[name]), span])
        rows[-1] += [number(name, values.get(name)) for values in columns.values()]
    return rows


def write_csv(path: Path, results: Sequence[Mapping[str, Any]]) -> None:
    """Write a CSV file with a row for all agents together and a row for each agent, of every result.

    An empty cell is an undefined number. A result's `policy` is the name of a run. Columns `<metric>_low` and
    `<metric>_high` bound its 95 % interval.
    """
    rows = [_csv_row(result, agent) for result in results for agent in (None, *result["agents"])]

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0].keys())
            writer.writeheader()
            writer.writerows(rows)

    write_atomic(path, write)


def _csv_row(result: Mapping[str, Any], agent: str | None) -> dict[str, Any]:
    values = result if agent is None else result["agents"][agent]
    row = {key: result[key] for key in ABOUT}
    row["agent"] = agent or "all"
    for name in result["intervals"]:
        low, high = values["intervals"].get(name) or (None, None)
        row |= {name: values.get(name), f"{name}_low": low, f"{name}_high": high}
    return row


UNITS = {"_mm": " (mm)", "_s": " (s)", "_deg": " (degrees)", "_n": " (N)", "image_error": "image error (grey levels)"}
"""Units of metrics, by the suffix of their names."""


KINDS = {
    "reward_": "mean of a step",
    "cost_": "share of steps",
    "cost": "limits broken, mean of a step",
    "stage_": "share of episodes",
    "smoothness": "spectral arc length",
    "action_change": "rms at the goal, of -1 to 1",
}
"""Kinds of metrics without a unit, by the beginning of their names; the first that fits counts."""


def title(name: str) -> str:
    """Return the name of a metric in words, with its unit."""
    name = name.replace("p95_", "95th-percentile_")
    for end, unit in UNITS.items():
        name = name.removesuffix(end) + unit if name.endswith(end) else name
    for threshold in ("1mm", "2mm", "5mm"):
        name = name.replace(f"_{threshold}", f" within {threshold[0]} mm")
    return name.replace("_", " ")


def explained(name: str) -> str:
    """Return the title of a metric, with its kind where neither a unit nor a percent sign tells it."""
    return title(name) + next((f" ({what})" for start, what in KINDS.items() if name.startswith(start)), "")


def number(name: str, value: float | None) -> str:
    """Return the value of a metric as text: a rate in percent with one decimal, all else with two, "-" for None.

    A rate that is not quite 0 or 100 % has up to three decimals, so that it does not look as if it were.
    """
    if value is None:
        return "-"
    if not (name.endswith("_rate") or name.startswith(("success_", "team_success_", "cost_"))):
        return f"{value:z.2f}"
    texts = (f"{value:z.{digits}%}" for digits in (1, 2, 3))
    exact = next((text for text in texts if float(text[:-1]) not in (0, 100)), None)
    return exact or f"{value:z.1%}"


def spanned(name: str, value: float | None, bounds: Sequence[float] | None) -> str:
    """Return the value of a metric as text, with its interval in brackets where it has one."""
    span = "" if value is None or bounds is None else f" ({' to '.join(number(name, bound) for bound in bounds)})"
    return f"{number(name, value)}{span}"
