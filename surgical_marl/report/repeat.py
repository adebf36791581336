"""The commands that repeat a run."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from surgical_marl.report.run import Run, flatten
from surgical_marl.runs.folder import read_settings
from surgical_marl.runs.settings import config_text, load_config
from surgical_marl.yaml_file import dump_yaml, parse_yaml

# What a command need not say of the settings that choose which defaults hold.
_USUAL = {"device": "auto", "difficulty": "default", "start": "home"}


def train_command(run: Run) -> str:
    """Return the `surgical-marl train` that has exactly the settings of a run.

    It names each setting that differs from the defaults of its task and scene, be it those for a CPU or for a GPU.
    """
    task, scene, settings = str(run.config["task"]), str(run.config["scene"]), _settings(run)
    try:
        sections = [f"{name}={settings[name]}" for name in ("difficulty", "start")]
        both = [
            _flat(config_text(load_config(task, scene, [*sections, f"device={device}"]), {}))
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


def eval_command(run: Run) -> str:
    """Return the command that repeats the evaluation."""
    return shlex.join(["surgical-marl", "eval", run.given])


def _settings(run: Run) -> dict[str, Any]:
    """Return a run's settings by dotted name, with those that an older version did not write."""
    try:
        return _flat(config_text(read_settings(run.folder), {}))
    except (ValueError, TypeError):
        return dict(run.config)


def _flat(text: str) -> dict[str, Any]:
    return flatten(parse_yaml(text))


def quote(*words: str) -> str:
    """Return a command line of these words, as a shell reads it."""
    return shlex.join(words)
