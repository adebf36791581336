"""Measure the policies that need no learning on every scene, for the tables in docs/evaluation.md.

    python -m docs.studies.baselines                           # all of them
    python -m docs.studies.baselines reach track --only psm    # some tasks, some scenes

It prints a table for each task, or two if only some of its scenes have objects. It writes the hashes of the goals to
`surgical_marl/evaluation/goal_sets.yaml`, so what is committed must not change without a reason.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any

import surgical_marl.evaluation.goal_set
from docs.studies.command import make_parser, run
from surgical_marl.cli.flags import one_of
from surgical_marl.content import BASELINES, list_scenes
from surgical_marl.evaluation.command import play_all
from surgical_marl.evaluation.evaluate import summarise
from surgical_marl.plugins.tasks import TASKS, list_tasks
from surgical_marl.scenes.placing import scenes_for
from surgical_marl.yaml_file import dump_yaml, parse_yaml

HASHES = Path(surgical_marl.evaluation.goal_set.__file__).with_name("goal_sets.yaml")
ERRORS = {"median_error_mm": "median error (mm)", "p95_error_mm": "95th percentile (mm)"}
FIXED = {"success_2mm": "success at 2 mm", "team_success_2mm": "all arms", "time_to_success_s": "time to it (s)"}
OBJECTS = {"success_rate": "success", "drop_rate": "drops", "time_to_success_s": "time to it (s)"}
MOVING = {"rmse_mm": "RMSE (mm)", "success_2mm": "success at 2 mm"}
ALWAYS = {"collision_rate": "collisions", "path_length_mm": "path (mm)", "smoothness": "smoothness",
          "min_distance_mm": "least distance (mm)"}  # fmt: skip
VIEWS = {"in_view_rate": "tools in view", "centre_error": "centre error (half fields of view)",
         "camera_travel_mm": "camera travel (mm)"}  # fmt: skip
PICTURES = {"image_error": "image error (grey levels)", "angle_error_deg": "angle error (degrees)"}


def main(argv: list[str] | None = None) -> int:
    parser = make_parser(__doc__)
    parser.add_argument("tasks", nargs="*", type=one_of(list_tasks()), metavar="TASK", help="all if none is named")
    parser.add_argument("--only", nargs="+", type=one_of(list_scenes()), metavar="SCENE", help="these scenes alone")
    arguments = parser.parse_args(argv)
    before = HASHES.read_text(encoding="utf-8")
    comments = [line for line in before.splitlines() if line.startswith("#")]
    hashes = parse_yaml(before)
    for task in arguments.tasks or list_tasks():
        for start in TASKS.load(task).starts:
            rows = list[list[Any]]()
            for scene in [name for name in simple_first(task) if name in (arguments.only or list_scenes())]:
                for policy in BASELINES:
                    asked = {"task": task, "scene": scene, "start": start}
                    result = summarise([play_all([policy], asked, episodes=200, seed=0)[policy]])
                    rows.append([scene, policy, result])
                hashes.setdefault(start, {}).setdefault(task, {})[scene] = result["goal_set"]
            for columns, alike in groupby(rows, lambda row: columns_of(row[2])):
                print(f"{task} from {start}:\n\n{table(columns, alike)}", flush=True)
    HASHES.write_text("\n".join([*comments, dump_yaml(hashes)]), encoding="utf-8")
    return 0


def simple_first(task: str) -> list[str]:
    """Return a task's scenes, those of one arm first."""
    return sorted(scenes_for(task), key=lambda name: (name.count("_"), name))


def columns_of(result: dict[str, Any]) -> dict[str, str]:
    """Return the metrics of a result that a table shows, and their headings. Scenes of one task may differ in them."""
    columns = ERRORS | (MOVING if "rmse_mm" in result else OBJECTS if "drop_rate" in result else FIXED) | ALWAYS
    return columns | {name: title for name, title in (PICTURES | VIEWS).items() if name in result}


def table(columns: dict[str, str], rows: Iterable[list[Any]]) -> str:
    lines = ["| " + " | ".join(["scene", "policy", *columns.values()]) + " |", "|---" * (2 + len(columns)) + "|"]
    for scene, policy, result in rows:
        cells = (cell(name, result[name], result["intervals"][name]) for name in columns)
        lines.append("| " + " | ".join([f"`{scene}`", policy, *cells]) + " |")
    return "\n".join(lines) + "\n"


def cell(name: str, value: float | None, bounds: list[float] | None) -> str:
    if value is None:
        return "-"
    if name.startswith(("success_", "team_", "collision_", "drop_", "in_view_")):
        return f"{value:.1%}"
    value = 0.0 if abs(value) < 1e-6 else value  # rounding
    span = f" ({bounds[0]:.3g} to {bounds[1]:.3g})" if bounds and name.endswith("error_mm") else ""
    return f"{value:.3g}{span}"


if __name__ == "__main__":
    sys.exit(run("baselines", main))
