"""Writes tables of content and figures into the pages: each stands in one place, and in no list kept by hand.

    python docs/theme/tables.py

A table stands between `<!-- table: NAME -->` and `<!-- end of table -->`. A picture docs/images/<kind>/<name>.webp
is shown in the row of its arm, object, scene or task. A figure stands between `<!-- figure: NAME -->` and
`<!-- end -->`: one of docs/figures.yaml, or one that is counted here. `tests/docs/test_site.py` holds the pages
to both.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path

import yaml

from surgical_marl import list_arms, list_objects, list_policies, list_scenes, list_tasks
from surgical_marl.content import find
from surgical_marl.evaluation.card import worst_over_seeds
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.robots.arm import load_arm
from surgical_marl.runs.folder import read_metrics, read_origin, read_settings
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.objects import load_object
from surgical_marl.scenes.placing import scenes_for

DOCS = Path(__file__).resolve().parents[1]
MARKED = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end of table -->)", re.DOTALL)
FIGURE = re.compile(r"(<!-- figure: (\w+) -->).*?(<!-- end -->)")


def main() -> None:
    """Write all tables and figures of all pages."""
    for page in pages():
        page.write_text(written(page.read_text(encoding="utf-8")), encoding="utf-8")


def pages() -> list[Path]:
    """Return the pages that have tables of content, or figures."""
    places = [DOCS.parent / "README.md", DOCS.parent / "policies" / "README.md", *sorted(DOCS.rglob("*.md"))]
    return [path for path in places if any(mark.search(path.read_text(encoding="utf-8")) for mark in (MARKED, FIGURE))]


def written(text: str) -> str:
    """Return a page with the tables and figures that it should have."""
    text = MARKED.sub(lambda match: f"{match[1]}{TABLES[match[2]]()}\n{match[3]}", text)
    return FIGURE.sub(lambda match: f"{match[1]}{figures()[match[2]]}{match[3]}", text)


@cache
def figures() -> dict[str, str]:
    """Return all figures by name: those that were measured, and those that are counted or follow from the policies."""
    measured = yaml.safe_load((DOCS / "figures.yaml").read_text(encoding="utf-8"))
    policies, handover = [Card(name) for name in list_policies()], Card("needle_handover-bimanual_psm_needle")
    return {
        "scenes": str(len(list_scenes())),
        "tasks": str(len(list_tasks())),
        "imitated": f"{sum(card.imitated for card in policies)} of {len(policies)}",
        "handover": handover.success,
        "handover_seeds": str(handover.seeds),
        "handover_time": f"{handover.time:.1f} s",
        **{name: value for run in measured for name, value in run["figures"].items()},
    }


def arms() -> str:
    def rows() -> Iterator[list[str]]:
        for name in list_arms():
            arm = load_arm(name)
            picture = shown("arms", name) or f"![{name}](../arms/{name}/preview.png)"
            yield [
                f"[`{name}`](../arms/{name}/README.md)",
                picture,
                arm.description + (f"; tools {words(f'`{tool}`' for tool in arm.tools)}" if arm.tools else ""),
                words(j.name for j in arm.actuated),
            ]

    return table(["arm", "picture", "what it is", "joints, one number of an action each"], rows())


def objects() -> str:
    def rows() -> Iterator[list[str]]:
        for name in list_objects():
            item = load_object(name)
            mass = f"{1000 * item.mass:.3g} g" if item.free else "fixed"
            yield [
                f"`{name}`",
                shown("objects", name),
                item.description,
                mass,
                str(len(item.shapes)),
                sites(item.sites),
            ]

    return table(["object", "picture", "what it is", "mass", "shapes", "named places"], rows())


def scenes() -> str:
    def rows() -> Iterator[list[str]]:
        for name in list_scenes():
            scene = load_scene(name)
            held = words(f"{key} (`{place.object.name}`)" for key, place in scene.placements.items()) or "-"
            tasks = words(f"`{task}`" for task in list_tasks() if name in scenes_for(task)) or "-"
            agents = words(f"`{agent}`" for agent in scene.agents)
            yield [f"`{name}`", shown("scenes", name), scene.description, agents, held, tasks]

    return table(["scene", "picture", "what stands there", "agents", "objects", "tasks meant for it"], rows())


def tasks() -> str:
    def rows() -> Iterator[list[str]]:
        for name in list_tasks():
            task = TASKS.load(name)
            _, _, what = task.summary().partition(": ")
            where = "all without objects" if task.scenes is None else words(f"`{scene}`" for scene in task.scenes)
            levels = words(f"`{level}`" for level in task.levels)
            policies = sum(policy.startswith(f"{name}-") for policy in list_policies())
            yield [f"`{name}`", shown("tasks", name), what.rstrip("."), where, levels, str(policies)]

    return table(["task", "picture", "what is to be done", "scenes", "difficulty", "policies that ship"], rows())


def examples() -> str:
    def rows() -> Iterator[list[str]]:
        for path in sorted((DOCS / "examples").glob("*.py")):
            what = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]
            yield [f"[{path.name}]({path.name})", what]

    return table(["program", "what it is"], rows())


def results() -> str:
    """Return how well trainings do, as means over their seeds; of those without objects all in one row."""
    cards = [Card(name) for name in list_policies()]
    objects, without = [card for card in cards if card.objects], [card for card in cards if not card.objects]
    assisting = [card for card in without if "in_view_rate" in card.result]
    usual = [card for card in without if card.level == "default" and card not in assisting]
    seen = [card for card in usual if card.task == "match_image"]

    def rows() -> Iterator[list[str]]:
        for card in objects:
            done = f"{card.success} of {card.episodes} unseen starts, {card.time:.1f} s each"
            if "score" in card.result:
                minutes = card.result["max_steps"] * card.result["control_dt"] / 60
                done = f"{card.points} points in {minutes:.0f} minutes, {card.episodes} unseen trials"
            yield [*card.row, done]
        for card in assisting:
            seen_share = f"tools in view {100 * card.result['in_view_rate']:.2f} % of the time"
            yield [*card.row, f"{seen_share}; {card.success} of {card.episodes} unseen starts"]
        worst = max((card for card in usual if card not in seen), key=lambda card: card.error[0])
        pictures = " and ".join(card.millimetres for card in sorted(seen, key=lambda card: card.error[0]))
        times = [card.seconds for card in usual if card.on_gpu]
        others = sorted(f"{card.link} {card.seconds:.0f} s on a CPU" for card in usual if not card.on_gpu)
        yield [
            f"{len(usual)} policies, one for each task without objects on each scene",
            f"{sum(card.imitated for card in usual)} of them",
            " or ".join(sorted({str(card.seeds) for card in usual})) + " each",
            "; ".join(
                [f"{min(times):.0f} to {max(times):.0f} s each on an H200 or H100 that up to 15 others share", *others]
            ),
            f"median error of the worst arm at most {worst.millimetres} mm; {pictures} mm where pictures are matched",
        ]
        for card in without:
            if card not in usual and card not in assisting:
                yield [*card.row, f"{card.success} within 2 mm in {card.episodes} episodes"]

    head = ["policies", "imitated the oracle", "seeds", "training of the one that ships", "result, mean over the seeds"]
    return table(head, rows())


class Card:
    """The training of a shipped policy, from its files: means over seeds, with 95 % intervals."""

    def __init__(self, name: str) -> None:
        folder = find("policies", name)
        evaluation = json.loads((folder / "evaluation.json").read_text(encoding="utf-8"))
        origin, runs = read_origin(folder)["origin"], evaluation["seeds"]["runs"]
        self.link = f"[`{name}`](policies/{name}/README.md)"
        self.result = result = evaluation["seeds"]["aggregate"]
        self.task, self.level, self.episodes = result["task"], result["difficulty"], result["episodes"]
        scene = load_scene(result["scene"])
        self.objects = bool(scene.free_objects or scene.systems)
        self.seeds, self.imitated = len(runs), read_settings(folder).shown_by_oracle
        self.seconds = sum(row["seconds"] for row in read_metrics(folder))
        self.on_gpu = "NVIDIA" in str(origin.get("device"))
        training = f"{self.seconds:.0f} s, {origin.get('device')}"
        self.row = [self.link, "yes" if self.imitated else "no", str(self.seeds), training]
        bounds = [100 * bound for bound in result["intervals"]["success_rate"]]
        self.success = spanned(100 * result["success_rate"], bounds, " %")
        self.points = spanned(result.get("score", 0.0), result["intervals"].get("score"))
        self.error = worst_over_seeds(runs)
        self.millimetres = spanned(*self.error, digits=2)
        self.time = result["time_to_success_s"]


def spanned(value: float | None, bounds: list[float] | None, unit: str = "", digits: int = 1) -> str:
    """Return a value with its interval in brackets, such as "98.3 % (94.0 to 100.0)"."""
    span = f" ({' to '.join(f'{bound:.{digits}f}' for bound in bounds)})" if bounds else ""
    return "-" if value is None else f"{value:.{digits}f}{unit}{span}"


TABLES: dict[str, Callable[[], str]] = {
    function.__name__: function for function in (arms, objects, scenes, tasks, examples, results)
}


def table(head: list[str], rows: Iterator[list[str]]) -> str:
    """Return a table in Markdown, without the columns that are empty in all rows."""
    found = list(rows)
    full = [column for column in range(len(head)) if any(row[column] for row in found)]
    lines = [head, ["---"] * len(head), *found]
    return "\n".join(f"| {' | '.join(line[column] for column in full)} |" for line in lines)


def shown(kind: str, name: str) -> str:
    """Return the picture of a piece of content, as Markdown for a page in docs/; nothing if there is none."""
    path = f"images/{kind}/{name}.webp"
    return f"![{name}]({path})" if (DOCS / path).is_file() else ""


def words(names: Iterable[str]) -> str:
    return ", ".join(names)


def sites(names: Iterable[str]) -> str:
    """Return the names of sites, those that only differ by a number as first to last."""
    families: dict[str, list[str]] = {}
    for name in names:
        families.setdefault(re.sub(r"_\d+$", "", name), []).append(name)
    ranges = (f"`{group[0]}`" + (f" to `{group[-1]}`" if len(group) > 1 else "") for group in families.values())
    return words(ranges) or "-"


if __name__ == "__main__":
    main()
