"""Finds tasks by name; no other module does."""

from __future__ import annotations

from surgical_marl.plugins.registry import Registry

TASKS = Registry(
    "task",
    package="surgical_marl.tasks",
    group="surgical_marl.tasks",
    base="surgical_marl.tasks.base.task:Task",
)


def list_tasks() -> list[str]:
    """Return the names of all tasks: shipped ones, those of installed packages, and registered ones."""
    return TASKS.names()


def scenes_for(task: str) -> list[str]:
    """Return the names of the shipped scenes that a task is meant for."""
    from surgical_marl.scenes.placing import scenes_without_objects  # it imports MuJoCo

    scenes = TASKS.load(task).scenes
    return scenes_without_objects() if scenes is None else list(scenes)
