"""Read all that a report says about one run from its folder; nothing is played or trained."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from surgical_marl.content import find
from surgical_marl.evaluation.card import CLIP, EVALUATION
from surgical_marl.evaluation.command import FILM, RESULT, read_result
from surgical_marl.evaluation.evaluate import EPISODES, Played, read_played
from surgical_marl.runs.content import found_scene, scene_label
from surgical_marl.runs.folder import CHECKPOINT, CONFIG, DIVERGED, METRICS, holds_weights, read_metrics
from surgical_marl.untrusted.files import is_file, is_folder
from surgical_marl.untrusted.values import plural
from surgical_marl.yaml_file import load_yaml

NOTES = ("versions", "origin")
"""Sections of a run's config that are no settings."""


@dataclass(frozen=True)
class Run:
    """A run or a shipped policy."""

    name: str
    """Name of the folder."""
    given: str
    """Name of the run on the command line."""
    folder: Path
    config: Mapping[str, Any]
    """Dotted name -> setting."""
    versions: Mapping[str, str]
    origin: Mapping[str, str]
    """device, commit and started, as far as they are known."""
    columns: Mapping[str, np.ndarray]
    """The columns of its metrics, [iterations] each; NaN where unknown."""
    finished: bool
    status: str
    """A sentence: whether it is finished, and if not, where it stopped."""
    result: Mapping[str, Any] | None
    """The evaluation, as `surgical-marl eval --json` prints it."""
    played: Played | None
    """The episodes of that evaluation."""
    clip: Path | None
    notes: tuple[str, ...]
    """Sentences about missing or damaged files."""

    @cached_property
    def scene(self) -> str:
        """The name of the scene, and of a copy in the folder also the hash of its content."""
        stored = str(self.config["scene"])
        try:
            found = found_scene(stored, self.folder)
            return stored if found == stored else scene_label(found)
        except ValueError:  # something is missing or damaged
            return stored

    @property
    def seed(self) -> str:
        """The seed of the training."""
        return str(self.config.get("seed", "unknown"))


def read_run(given: str | os.PathLike[str]) -> Run:
    """Read a run folder, or a shipped policy by its name; a `Path` is always a folder.

    Settings that this version does not know are read like others, so that runs of older versions can be reported.

    Raises:
        ValueError: there is no such folder, it holds no run, or its config cannot be read.
    """
    text = os.fspath(given)
    if is_file(text):
        raise ValueError(f"{text} is a file, not a run: name the run's folder")
    folder = find("policies", text) if isinstance(given, str) or not is_folder(given) else Path(given).resolve()
    config, versions, origin = _read_config(folder, text)
    columns, notes = _read_columns(folder), []
    shipped = holds_weights(folder)
    finished, status = (True, "A shipped policy.") if shipped else _status(folder, config, columns)
    result = played = None
    try:
        result = _read_result(folder / (EVALUATION if shipped else RESULT))
    except ValueError as error:
        notes.append(f"The evaluation is left out: {error}.")
    if result is None and not notes:
        notes.append(_why_not_evaluated(folder))
    elif result is not None and _is_older(result, columns):
        notes.append(f"The evaluation is of iteration {result['iteration']}; training went on since.")
    if result is not None and (folder / EPISODES).is_file():
        try:
            played = read_played(folder / EPISODES)
        except ValueError as error:
            notes.append(f"Histograms are left out: {error}.")
        if played is not None and played.about.get("goal_set") != result["goal_set"]:
            notes.append("Histograms are left out: the episodes in the folder are of another evaluation.")
            played = None
    elif result is not None:
        notes.append("Histograms are left out: the folder holds no single episodes of the evaluation.")
    clip = next((path for name in (FILM, CLIP) if (path := folder / name).is_file()), None)
    return Run(
        name=folder.name or str(folder), given=text, folder=folder, config=config, versions=versions, origin=origin,
        columns=columns, finished=finished, status=status, result=result, played=played, clip=clip, notes=tuple(notes),
    )  # fmt: skip


def flatten(values: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings by their dotted names, such as `ppo.gamma`; an empty mapping stays as it is."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _read_config(folder: Path, given: str) -> tuple[dict[str, Any], dict[str, str], dict[str, str]]:
    path = folder / CONFIG
    if not is_file(path):
        raise ValueError(f"{given} is not a run folder: it has no {CONFIG}")
    try:
        values = load_yaml(path)
    except ValueError as error:
        raise ValueError(f"{path} cannot be read: {str(error).removeprefix(f'{path} cannot be read: ')}") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path} holds no settings")
    for name in ("task", "scene"):
        if not isinstance(values.get(name), str):
            raise ValueError(f"{path} has no {name}: it is cut short, so restore it from a copy")
    notes = [values.pop(name, None) for name in NOTES]
    versions, origin = ({str(k): str(v) for k, v in n.items()} if isinstance(n, dict) else {} for n in notes)
    return flatten(values), versions, {name: value for name, value in origin.items() if value != "None"}


def _read_columns(folder: Path) -> dict[str, np.ndarray]:
    rows = read_metrics(folder)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]} if rows else {}


def _status(folder: Path, config: Mapping[str, Any], columns: Mapping[str, np.ndarray]) -> tuple[bool, str]:
    """Return whether a run is finished, and the sentence that says so."""
    wanted, done = config.get("iterations"), _last(columns, "iteration")
    of = f" of {wanted:,}" if isinstance(wanted, int) else ""
    if (folder / DIVERGED).is_file():
        return False, f"Diverged after {done:,}{of} iterations: a number was not finite ({DIVERGED} says where)."
    if not done:
        return False, "Unfinished: no iteration is done yet."
    if isinstance(wanted, int) and done < wanted:
        return False, f"Unfinished: {done:,}{of} iterations are done. It was stopped, or is still running."
    return True, f"Finished: {done:,} {plural(done, 'iteration')}."


def _last(columns: Mapping[str, np.ndarray], name: str) -> int:
    value = float(columns[name][-1]) if name in columns else 0.0
    return int(value) if math.isfinite(value) else 0


def _is_older(result: Mapping[str, Any], columns: Mapping[str, np.ndarray]) -> bool:
    at = result.get("iteration")
    return isinstance(at, int) and at < _last(columns, "iteration")


def _why_not_evaluated(folder: Path) -> str:
    if (folder / CHECKPOINT).is_file():
        return "This run was not evaluated yet: surgical-marl report RUN --evaluate does it."
    lacks = f" and no {METRICS}" if not (folder / METRICS).is_file() else ""
    return f"This run has no {CHECKPOINT}{lacks}, so that it cannot be evaluated."


def _read_result(path: Path) -> dict[str, Any] | None:
    """Read an evaluation; None if there is none. ValueError if it is damaged, or a number in it is none."""
    return read_result(path) if path.is_file() else None
