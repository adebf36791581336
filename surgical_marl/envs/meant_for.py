"""Which scenes a task is meant for, as a part of what an error says."""

from __future__ import annotations

from contextlib import suppress

from surgical_marl.plugins.task_file import is_task_file, label
from surgical_marl.plugins.tasks import TASKS, list_tasks
from surgical_marl.scenes.load import load_scene


def meant_for(task: str, scene: str | None, error: ValueError) -> str:
    """Return the scenes that a task is meant for, as the end of an error about a scene that is none of them.

    "" for other errors, and where the error says it itself.
    """
    if type(error) is not ValueError or not (is_task_file(task) or task in list_tasks()) or "choose from" in str(error):
        return ""
    with suppress(ValueError):  # of a scene that fits no task
        if scene and (meant := TASKS.load(task).scenes) and load_scene(scene).name not in meant:
            return f"; {label(task)} is meant for the scenes {', '.join(meant)}"
    return ""
