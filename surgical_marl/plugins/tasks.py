"""Tasks by name: the only place that finds them."""

from __future__ import annotations

from surgical_marl.plugins.registry import Registry

TASKS = Registry(
    "task",
    package="surgical_marl.tasks",
    group="surgical_marl.tasks",
    base="surgical_marl.tasks.base.task:Task",
)


def list_tasks() -> list[str]:
    """Return the names of all tasks: those that ship, of installed packages, and registered ones."""
    return TASKS.names()
