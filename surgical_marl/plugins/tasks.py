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


def register_task(name: str, cls: type) -> None:
    """Make a subclass of `surgical_marl.tasks.base.task.Task` known by a name, in this program.

    Its ids for Gymnasium and PettingZoo and its module, such as `my_task_v0`, are there at once. A package declares its
    own by the entry-point group `surgical_marl.tasks` instead (docs/your_own_task.md).

    Raises:
        ValueError: the name belongs to another class, or the class is not a subclass of `Task`.
    """
    from surgical_marl.interfaces.registration import register_ids

    TASKS.register(name, cls)
    register_ids()
