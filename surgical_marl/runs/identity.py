"""The identity of a run: all settings except the ones that may change when it is resumed.

A checkpoint records them, so that its networks act in the problem that they were trained for, and in no other.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from surgical_marl.runs.content import scene_label
from surgical_marl.runs.settings import Settings
from surgical_marl.untrusted.values import shown

# Settings that may change when a run is resumed; all others shape the checkpoint or the problem.
CHANGEABLE = {
    "engine",
    "device",
    "iterations",
    "steps_per_iteration",
    "checkpoint_every",
    "team_reward",
    "ppo",
    "constraint",
    "oracle_states",
}
# Except these, which determine the content of a checkpoint.
FIXED = {"ppo.normalise_values", "constraint.cost"}


def setting(settings: Settings, name: str) -> Any:
    """Return a setting as it is compared: a scene by its label, the same wherever its file is."""
    return scene_label(settings.scene) if name == "scene" else getattr(settings, name)


def identity(settings: Settings) -> dict[str, Any]:
    """Return the settings that a run keeps to its end, by their dotted names such as "network.hidden"."""
    named = {**_dotted(settings), "scene": setting(settings, "scene")}
    return {name: value for name, value in named.items() if name in FIXED or name.partition(".")[0] not in CHANGEABLE}


def check_identity(of: Mapping[str, Any], settings: Settings, what: object) -> None:
    """Raise ValueError if the identity that a checkpoint records differs from that of the run that it lies in.

    Args:
        of: the `identity` of the training that wrote it; one of an older version has less, or nothing.
        settings: of the run.
        what: the checkpoint, for the error.
    """
    for name, own in identity(settings.in_training()).items():
        value = of.get(name, own)
        if name == "scene" and str(value).endswith((".yaml", ".yml")):  # an older version recorded the path
            value, own = Path(str(value)).stem, Path(settings.scene).stem
        if _text(value) != _text(own):
            raise ValueError(f"{what} is of {name} {shown(value)}, and not of {shown(own)} as the run it lies in")


def _text(value: Any) -> str:
    """Return a value as a text to compare: a stranger's may be anything, and JSON has no tuples."""
    return json.dumps(value, default=repr)


def _dotted(settings: Any) -> dict[str, Any]:
    named: dict[str, Any] = {}
    for item in fields(settings):
        value = getattr(settings, item.name)
        inner = _dotted(value) if is_dataclass(value) else None
        named |= {item.name: value} if inner is None else {f"{item.name}.{name}": part for name, part in inner.items()}
    return named
