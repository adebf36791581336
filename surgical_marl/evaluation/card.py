"""Texts about a shipped policy, from its files: its card (`README.md`) and its row in the table of all policies."""

from __future__ import annotations

import operator
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from surgical_marl.content import find, list_policies
from surgical_marl.evaluation.goal_set import is_standard
from surgical_marl.evaluation.interval import Interval, over_seeds, share_interval
from surgical_marl.evaluation.report import number, spanned, title
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.policies.onnx_file import SUFFIX, read_pictures
from surgical_marl.policies.weights import read_weights
from surgical_marl.runs.content import stored_scene
from surgical_marl.runs.folder import CURVE, read_metrics, read_origin, read_settings
from surgical_marl.runs.settings import Settings
from surgical_marl.scenes.load import load_scene
from surgical_marl.untrusted.files import read_json
from surgical_marl.untrusted.markup import as_link, as_markdown, template

CARD, CLIP, EVALUATION = "README.md", "clip.mp4", "evaluation.json"
SHOWN = ("median_error_mm", "p95_error_mm", "rmse_mm", "success_1mm", "success_2mm", "success_5mm", "team_success_2mm",
         "success_rate", "score", "score_time_s", "in_view_rate", "object_in_view_rate", "centre_error",
         "camera_travel_mm", "drop_rate", "collision_rate", "time_to_success_s", "image_error",
         "angle_error_deg")  # fmt: skip
SCORE, ERRORS = "score", SHOWN[:7]
"""Points of an episode, and how near to goals it ends: that says nothing where an episode goes on for points."""
COLUMNS = (
    *("policy", "imitated the oracle", "seeds", "median error of the worst arm (mm)", "within 2 mm", "collisions"),
    *("these weights: median error (mm)", "on training goals (mm)", "RMSE (mm)", "within 2 mm from random starts"),
    *("training", "misses"),
)
"""Columns of the table of all policies: means over training seeds up to the collisions, then results of what ships."""
_HOLDS = {"below": operator.lt, "at least": operator.ge}


def worst_median(result: Mapping[str, Any]) -> float | None:
    """Return the median error of the arm that has the largest one, in mm.

    Arms that only keep still can't hide the error of another arm in this number. Return None in a task whose tool tips
    have no targets, and in one that goes on for points: what is left at its end is some object's way.
    """
    arm = _worst_arm(result)
    return None if arm is None else arm["median_error_mm"]


def worst_over_seeds(runs: Sequence[Mapping[str, Any]]) -> tuple[float | None, Interval]:
    """Return the mean of `worst_median` over the results of training seeds, in mm, and its 95 % interval."""
    arms = [arm for arm in map(_worst_arm, runs) if arm is not None]
    if not arms:
        return None, None
    values = [arm["median_error_mm"] for arm in arms]
    return sum(values) / len(values), over_seeds(values, [arm["intervals"]["median_error_mm"] for arm in arms])


def _worst_arm(result: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the metrics of the arm with the largest median error; None as `worst_median`."""
    agents = [] if SCORE in result else result["agents"].values()
    known = [agent for agent in agents if agent["median_error_mm"] is not None]
    return max(known, key=lambda agent: agent["median_error_mm"], default=None)


def _worst(result: Mapping[str, Any]) -> str:
    return number("median_error_mm", worst_median(result))


def misses(result: Mapping[str, Any]) -> list[str]:
    """Return the goals of its task that a result misses, each as a text that names the value and the goal."""
    found = []
    for name, (relation, goal) in TASKS.load(result["task"]).wanted.items():
        value: float | None = worst_median(result) if name == "median_error_mm" else result[name]
        if value is None or not _HOLDS[relation](value, goal):
            found.append(f"{title(name)} is {number(name, value)}, not {relation} {number(name, goal)}")
    return found


def facts(policy: str) -> str:
    """Return the row of the table of a shipped policy, as one line of text."""
    cells = zip(COLUMNS, _row(find("policies", policy)), strict=True)
    return "; ".join(f"{column}: {cell}" for column, cell in list(cells)[1:] if cell != "-")


def table() -> str:
    """Return the table of all shipped policies in Markdown."""
    rows = [_row(find("policies", name)) for name in list_policies()]
    widths = [max(map(len, column)) for column in zip(COLUMNS, *rows, strict=True)]
    lines = [COLUMNS, tuple("-" * width for width in widths), *rows]
    cells = ([cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines)
    return "\n".join("| " + " | ".join(line) + " |" for line in cells) if rows else ""


def _row(folder: Path) -> tuple[str, ...]:
    result = read_json(folder / EVALUATION)
    also, runs, whole = result.get("also", {}), result["seeds"]["runs"], result["seeds"]["aggregate"]
    seen = also.get("training goals")
    elsewhere = result if result["start"] == "random" else also.get("random starts", {})
    last, origin = _training(folder), read_origin(folder)["origin"]
    return (
        as_link(folder.name),
        "yes" if read_settings(folder).shown_by_oracle else "no",
        str(len(runs)),
        spanned("median_error_mm", *worst_over_seeds(runs)),
        "-" if SCORE in result else _with_interval("success_2mm", whole),
        _with_interval("collision_rate", whole),
        _worst(result),
        _worst(seen) if seen else "-",
        number("rmse_mm", result.get("rmse_mm")),
        number("success_2mm", elsewhere.get("success_2mm")),
        f"{last['seconds']:.0f} s, {as_markdown(origin.get('device') or 'unknown device')}",
        "; ".join(misses(result)) or "-",
    )


def card(folder: Path, name: str) -> str:
    """Return the card of the policy in a folder, in Markdown.

    Args:
        folder: of the policy.
        name: of the policy. It is not taken from the folder, which has another name while it is being written.
    """
    from surgical_marl.view.record import LONGEST  # imports the renderer: not for the table

    settings, result, notes = read_settings(folder), read_json(folder / EVALUATION), read_origin(folder)
    task, groups = TASKS.load(settings.task), read_weights(folder)[0]
    whole = 2 * result["max_steps"] * result["control_dt"] <= LONGEST
    shown = "two episodes" if whole else f"the first {LONGEST:.0f} s of an episode"
    return template(Path(__file__).with_name("card.md")).render(
        name=name,
        settings=settings,
        scene=load_scene(settings.scene),
        task=task.summary().partition(": ")[2],
        clip=shown if (folder / CLIP).is_file() else "",
        result=result,
        standard=is_standard(result),
        seeds=result["seeds"],
        also=result.get("also") or {},
        shown=_shown(result),
        score=SCORE,
        value=_with_interval,
        worst=_worst,
        title=title,
        number=number,
        train=_train_command(folder, settings),
        last=_training(folder),
        curve=CURVE,
        misses=misses(result),
        wanted=task.wanted,
        rare=share_interval(0.0, result["episodes"])[1],
        networks=[(f := name + SUFFIX, sizes, read_pictures(folder / f)) for name, sizes in groups.items()],
        **notes,
    )


def _shown(result: Mapping[str, Any]) -> list[str]:
    """Return the names of the metrics that a card shows."""
    of_ways = ERRORS if SCORE in result else ()
    return [key for key in SHOWN if key in result and key not in of_ways]


def _with_interval(key: str, result: Mapping[str, Any]) -> str:
    if key not in result:  # an older protocol did not measure it
        return "-"
    return spanned(key, result[key], result["intervals"][key])


def _train_command(folder: Path, settings: Settings) -> str:
    level = [] if settings.difficulty == "default" else ["--difficulty", settings.difficulty]
    start = [] if settings.start == "home" else ["--start", settings.start]
    what = ["surgical-marl", "train", settings.task, "--scene", stored_scene(settings.scene, folder), *level, *start]
    acts = {"control": settings.control, "control_frame": settings.control_frame}
    own = [f"{name}={value}" for name, value in acts.items() if value != getattr(Settings, name)]
    return shlex.join([*what, "--seed", str(settings.seed), *own])


def _training(folder: Path) -> dict[str, float]:
    """Return the last row of metrics, with the seconds of all rows added up."""
    rows = read_metrics(folder)
    return {**rows[-1], "seconds": sum(row["seconds"] for row in rows)}
