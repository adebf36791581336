"""Finds tasks by name; no other module does."""

from __future__ import annotations

import os
from typing import Any

from surgical_marl.plugins.registry import Registry
from surgical_marl.plugins.task_file import absolute, allow, check_allowed, is_task_file, label, load_task_file


class TaskRegistry(Registry):
    """Tasks by name. The name may also be a task file, `my_task.py` or `my_task.py:Escort`."""

    def check(self, name: str) -> None:
        """Raise a ValueError if there is no such task, or if it is a file that nobody has named on this machine."""
        if is_task_file(name):
            check_allowed(name)
        else:
            super().check(name)

    def load(self, name: str) -> Any:
        """Return the class of a name, as `Registry.load` and `load_task_file` do."""
        return load_task_file(name, self._base()) if is_task_file(name) else super().load(name)


TASKS = TaskRegistry(
    "task",
    package="surgical_marl.tasks",
    group="surgical_marl.tasks",
    base="surgical_marl.tasks.base.task:Task",
)

VERSIONS: dict[str, int] = {}
"""Versions of the tasks whose numbers are no longer those of their first release; every other task is at version 0."""


def task_version(task: str) -> int:
    """Return the number in the names of a task's environments, such as 0 of `reach_v0`.

    It is raised when the same seed and actions no longer give the same numbers (docs/reliability.md).
    """
    return VERSIONS.get(task, 0)


def module_name(task: str) -> str:
    """Return the name of a task's module in `surgical_marl`, such as `reach_v0`."""
    return f"{label(task)}_v{task_version(task)}"


def list_tasks() -> list[str]:
    """Return the names of all tasks: shipped, of installed packages, and registered."""
    return TASKS.names()


def find_task(task: str | os.PathLike[str]) -> str:
    """Return the name of a task that a person or a program names: a task file gets its absolute path, and may run.

    Raises:
        ValueError: there is no such task.
    """
    task = os.fspath(task) if isinstance(task, os.PathLike) else task
    if is_task_file(task):
        allow(task)
    else:
        TASKS.check(task)
    return absolute(task)


def scene_of(task: str) -> str:
    """Return the scene that a task is played in where none is named: its own, or "psm" if it has none."""
    return TASKS.load(find_task(task)).default_scene or "psm"
