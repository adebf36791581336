"""The page of a report: one HTML file that needs nothing else, and loads nothing."""

from __future__ import annotations

import base64
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup

from surgical_marl.plugins.task_file import label
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.report import evaluation, tables, training
from surgical_marl.report.charts import COLORS, Chart, Drawing
from surgical_marl.report.groups import Group, group
from surgical_marl.report.run import Run, flatten
from surgical_marl.runs.folder import read_settings
from surgical_marl.runs.settings import config_text, load_config
from surgical_marl.runtime import package_version
from surgical_marl.untrusted.markup import template, whole
from surgical_marl.yaml_file import dump_yaml, parse_yaml

_USUAL = {"device": "auto", "difficulty": "default", "start": "home"}
"""Usual values of the settings that choose the defaults: a command need not name them."""


FOLDER = Path(__file__).parent
GENERATOR = "surgical-marl report"
"""Mark of a report in its file: such a file may be replaced."""
CLIP_LIMIT = 4_000_000
"""The largest video that is put into the page, in bytes; it grows by a third there."""
CLIPS = 6
"""The most videos of a page: those of the first groups."""


class Clip(NamedTuple):
    """A video, or a sentence that says why it is not shown."""

    label: str
    address: Markup | None
    note: str


class Section(NamedTuple):
    """A part of the page: charts and tables under a heading."""

    key: str
    title: str
    notes: Sequence[str]
    charts: Sequence[Chart] = ()
    tables: Sequence[tables.Table] = ()
    folded: bool = False
    """True if its tables are opened by the reader."""


def render(runs: Sequence[Run]) -> str:
    """Return the report of some runs of one task as HTML.

    ValueError if there are none, one is named twice, or they are of different tasks.
    """
    _check(runs)
    groups = group(runs)
    task, scenes = runs[0].config["task"], list(dict.fromkeys(run.scene for run in runs))
    heading = f"{label(str(task))} in {', '.join(scenes)}"
    drawing = Drawing()
    sections = [*_evaluation(drawing, groups), *_training(drawing, groups), *_settings(groups)]
    page = template(FOLDER / "page.html").render(
        generator=GENERATOR,
        version=package_version(),
        made=time.strftime("%Y-%m-%d %H:%M %Z"),
        heading=heading,
        about=_about(str(task)),
        statuses=_statuses(runs),
        tiles=tables.tiles(runs[0]) if len(runs) == 1 else [],
        overview=tables.runs(groups),
        differences=tables.settings_that_differ(groups),
        clips=_clips(groups),
        sections=sections,
        commands=_commands(runs),
        colors=COLORS,
        style=Markup((FOLDER / "page.css").read_text(encoding="utf-8")),
    )
    return whole(page)  # a folder's name may hold bytes that are no text


def _check(runs: Sequence[Run]) -> None:
    if not runs:
        raise ValueError("a report needs at least one run")
    first = runs[0]
    for number, run in enumerate(runs):
        if any(run.folder == other.folder for other in runs[:number]):
            raise ValueError(f"{run.given!r} is named twice")
        if (task := run.config["task"]) != first.config["task"]:
            raise ValueError(
                f"{run.given} is of task {task!r} and {first.given} of {first.config['task']!r}: "
                "a report compares runs of one task"
            )


def _about(task: str) -> str:
    """Return a sentence on the task; empty for a task that is not installed."""
    try:
        return TASKS.load(task).summary().partition(": ")[2]
    except ValueError:
        return ""


def _statuses(runs: Sequence[Run]) -> list[tuple[str, str, bool]]:
    """Return run names, a sentence on their status and whether it is good; each sentence once."""
    found: dict[tuple[str, bool], list[str]] = {}
    for run in runs:
        found.setdefault((run.status, run.finished), []).append(run.name)
    for run in runs:
        for note in run.notes:
            found.setdefault((note, False), []).append(run.name)
    return [(", ".join(names), text, good) for (text, good), names in found.items()]


def _evaluation(drawing: Drawing, groups: Sequence[Group]) -> list[Section]:
    every = [run for group in groups for run in group.runs]
    first = next((run.result for run in every if run.result is not None), None)
    if first is None:
        return []
    words = "{episodes} episodes of {goals} goals, difficulty {difficulty}, {control} control, {start} start"
    words = words.format(**first)
    notes = [f"Without exploration noise: {words}; goal set {first['goal_set']:.12}."]
    if any(run.result is not None and run.result["goal_set"] != first["goal_set"] for run in every):
        notes.append("Not all runs were evaluated on the same goals, so that their numbers compare only roughly.")
    found = [tables.results(groups), tables.stages(groups)]
    own = tables.rewards(every[0]) if len(every) == 1 else None
    sections = [Section("evaluation", "How well it does", notes, tables=[table for table in found if table])]
    if charts := evaluation.charts(drawing, groups):
        notes = ["Bands are 95 % intervals over episodes, and over seeds where a group has several."]
        sections.append(Section("episodes", "Errors, distances and forces", notes, charts))
    if own:
        sections.append(Section("terms", "Reward terms and costs in the evaluation", [], tables=[own], folded=True))
    return sections


def _training(drawing: Drawing, groups: Sequence[Group]) -> list[Section]:
    charts = training.main(drawing, groups)
    if not charts:
        return []
    notes = ["Running means over a fiftieth of the training, in which actions are noisy."]
    if any(len(group.runs) > 1 for group in groups):
        notes.append(
            "A thick line is the mean over the seeds of a group, its band goes from the lowest to the highest."
        )
    sections = [Section("training", "How training went", notes, charts)]
    terms, zero = training.reward_terms(drawing, groups)
    notes = [f"Always zero: {', '.join(zero)}."] if zero else []
    if terms or zero:
        sections.append(Section("rewards", "Reward terms in training", notes, terms))
    if speed := training.speed(drawing, groups):
        sections.append(Section("speed", "Speed", [], speed))
    if inside := training.internals(drawing, groups):
        sections.append(Section("internals", "Losses and exploration", [], inside, folded=True))
    return sections


def _settings(groups: Sequence[Group]) -> list[Section]:
    return [
        Section("settings", "Settings", [], tables=[tables.settings(groups)], folded=True),
        Section("origin", "Versions and device", [], tables=[tables.origins(groups)]),
    ]


def _commands(runs: Sequence[Run]) -> list[tuple[str, list[str], str]]:
    """Return the name of each run, the commands that repeat it, and a sentence on its code."""
    found = []
    for run in runs:
        commit = run.origin.get("commit", "")
        checkout: list[str] = []
        if not commit:
            note = "The commit of its code is not known."
        elif commit.endswith("-dirty"):
            note = f"Its code had changes beside commit {commit.removesuffix('-dirty')}."
        else:
            note, checkout = "", [shlex.join(["git", "checkout", commit])]
        found.append(
            (run.name, [*checkout, train_command(run), shlex.join(["surgical-marl", "eval", run.given])], note)
        )
    return found


def _clips(groups: Sequence[Group]) -> list[Clip]:
    found: list[Clip] = []
    for one in groups:
        run = next((run for run in one.runs if run.clip is not None), None)
        if run is None or run.clip is None:
            continue
        label = run.name if len(groups) == 1 else f"{one.label}: {run.name}"
        if len(found) == CLIPS:
            found.append(Clip(label, None, f"Clips of further groups are left out: a page shows {CLIPS}."))
            break
        try:
            found.append(_clip(run.clip, label))
        except OSError as error:
            found.append(Clip(label, None, f"{run.clip.name} cannot be read: {error.strerror}."))
    return found


def _clip(path: Path, label: str) -> Clip:
    if (size := path.stat().st_size) > CLIP_LIMIT:
        most = f"more than {CLIP_LIMIT / 1e6:g} MB are not shown here"
        return Clip(label, None, f"{path.name} in the run's folder has {size / 1e6:.1f} MB; {most}.")
    return Clip(label, video_address(path), "")


def video_address(path: Path) -> Markup:
    """Return a video as the address of an HTML page that needs no file: a data URI."""
    kind = {".webm": "video/webm", ".gif": "image/gif"}.get(path.suffix, "video/mp4")
    return Markup(f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}")


def train_command(run: Run) -> str:
    """Return the `surgical-marl train` that has exactly the settings of a run.

    It names each setting that differs from the defaults of its task and scene, be it those for a CPU or for a GPU.
    """
    task, scene, settings = str(run.config["task"]), str(run.config["scene"]), _settings_of(run)
    try:
        sections = [f"{name}={settings[name]}" for name in ("difficulty", "start")]
        both = [
            flatten(parse_yaml(config_text(load_config(task, scene, [*sections, f"device={device}"]), {})))
            for device in ("cpu", "cuda")
        ]
    except (ValueError, KeyError):  # a task, or settings, that are not of this installation
        both = []
    if scene != run.scene:  # a copy in the folder
        scene = str(Path(run.given) / scene)
    command = ["surgical-marl", "train", task, "--scene", scene, "--seed", run.seed]
    for name, value in settings.items():
        usual = bool(both) and all(name in defaults and defaults[name] == value for defaults in both)
        if name in _USUAL:  # the defaults above are those of the run's own level and start, on two devices
            usual = value == _USUAL[name]
        if not usual and name not in ("task", "scene", "seed"):
            command.append(f"{name}={dump_yaml(value, flow=True)}")
    return shlex.join(command)


def _settings_of(run: Run) -> dict[str, Any]:
    """Return a run's settings by dotted name, with settings that an older version did not write."""
    try:
        return flatten(parse_yaml(config_text(read_settings(run.folder), {})))
    except (ValueError, TypeError):
        return dict(run.config)
