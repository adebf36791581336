"""Finds tasks by name; no other module does."""

from __future__ import annotations

from surgical_marl.plugins.registry import Registry

TASKS = Registry(
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
    return f"{task}_v{task_version(task)}"


def list_tasks() -> list[str]:
    """Return the names of all tasks: shipped ones, those of installed packages, and registered ones."""
    return TASKS.names()


def scene_of(task: str) -> str:
    """Return the scene that a task is played in where none is named: its own, or "psm" if it has none."""
    return TASKS.load(task).default_scene or "psm"


def scenes_for(task: str) -> list[str]:
    """Return the names of the shipped scenes that a task is meant for."""
    from surgical_marl.scenes.placing import scenes_without_objects  # it imports MuJoCo

    scenes = TASKS.load(task).scenes
    return scenes_without_objects() if scenes is None else list(scenes)
