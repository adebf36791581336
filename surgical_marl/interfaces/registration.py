"""Names under which Gymnasium and PettingZoo find the tasks.

Gymnasium has `surgical_marl/Reach-v0`, and PettingZoo has `surgical_marl/reach-v0`. Each task also has a module, as
is the custom in PettingZoo: `from surgical_marl import reach_v0`.

Importing `surgical_marl` registers all of them. Where nothing has imported it, as in a process that a library started,
the package stands in Gymnasium's id: `surgical_marl:surgical_marl/Reach-v0`.

The number is that of `surgical_marl.plugins.tasks.task_version`. Where it was raised, Gymnasium and PettingZoo say that
an older id is out of date, and older modules say it when they are asked for an environment.
"""

from __future__ import annotations

import sys
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any

from surgical_marl.plugins.tasks import TASKS, VERSIONS, list_tasks, module_name, task_version

PACKAGE = "surgical_marl"
FACES = f"{PACKAGE}.interfaces"


def register_ids() -> None:
    """Register every task with Gymnasium and with PettingZoo, and make its module. Doing it twice does nothing."""
    for task in list_tasks():
        _gymnasium(task)
        _pettingzoo(task)
        for older in range(task_version(task)):
            _module(f"{task}_v{older}", partial(_outdated, f"{task}_v{older}", task))
        _module(module_name(task), partial(_make, task))


def register_task(name: str, cls: type, version: int = 0) -> None:
    """Make a subclass of `surgical_marl.tasks.base.task.Task` known by a name, in this program.

    Its ids for Gymnasium and PettingZoo and its module, such as `my_task_v0`, are there at once. A package declares its
    own by the entry-point group `surgical_marl.tasks` instead (docs/your_own_task.md).

    Args:
        name: such as "my_task".
        cls: the class.
        version: the number in the ids and the name of the module. Raise it when the task's numbers change.

    Raises:
        ValueError: the name belongs to another class, the class is not a subclass of `Task`, or the version is no whole
            number of at least 0.
    """
    if isinstance(version, bool) or not isinstance(version, int) or version < 0:
        raise ValueError(f"the version of the task {name!r} must be a whole number of at least 0, not {version!r}")
    TASKS.register(name, cls)
    VERSIONS[name] = version
    register_ids()


def _gymnasium(task: str) -> None:
    from gymnasium.envs.registration import register, registry

    name = f"{PACKAGE}/{''.join(part.title() for part in task.split('_'))}-v{task_version(task)}"
    if name not in registry:
        register(
            name,
            entry_point=f"{FACES}.gymnasium:SurgicalEnv",
            vector_entry_point=f"{FACES}.gymnasium_vector:SurgicalVectorEnv",
            kwargs={"task": task},
        )


def _pettingzoo(task: str) -> None:
    try:
        from pettingzoo.env_registry.registration import aec_registry, parallel_registry, register
    except ModuleNotFoundError:  # PettingZoo has ids since 1.27; the modules work with all
        return
    name = f"{PACKAGE}/{task}-v{task_version(task)}"
    if name not in parallel_registry:
        register("parallel", name, f"{FACES}.pettingzoo:parallel_env", kwargs={"task": task})
    if name not in aec_registry:
        register("aec", name, f"{FACES}.pettingzoo:aec_env", kwargs={"task": task})


def _module(name: str, make: Any) -> None:
    """Add a module such as `surgical_marl.reach_v0`, with `parallel_env`, `env` and `raw_env`."""
    if f"{PACKAGE}.{name}" in sys.modules:
        return
    module = ModuleType(f"{PACKAGE}.{name}", f"A version of a task: `{name}.parallel_env(scene=...)`.")
    faces = {"parallel_env": "parallel_env", "env": "aec_env", "raw_env": "aec_env"}
    vars(module).update({face: partial(make, function) for face, function in faces.items()})
    sys.modules[module.__name__] = module
    setattr(sys.modules[PACKAGE], name, module)


def _make(task: str, function: str, **options: Any) -> Any:
    # The face is imported when an environment is made: it takes seconds.
    return getattr(import_module(f"{FACES}.pettingzoo"), function)(task, **options)


def _outdated(name: str, task: str, function: str, **options: Any) -> Any:
    raise ValueError(f"{name} is out of date: use {module_name(task)}, and see CHANGELOG.md for what changed")
