"""Names under which clients find the tasks: `surgical_marl/Reach-v0` for Gymnasium, `surgical_marl/reach-v0` for
PettingZoo, and a module for each, as PettingZoo has it: `from surgical_marl import reach_v0`.

Importing `surgical_marl` registers all of them.
"""

from __future__ import annotations

import sys
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any

from surgical_marl.content import list_tasks

FACES = "surgical_marl.interfaces"


def gymnasium_ids() -> None:
    """Registers every task with Gymnasium, for `make` and `make_vec`. Doing it twice does nothing."""
    from gymnasium.envs.registration import register, registry

    for task in list_tasks():
        name = f"surgical_marl/{''.join(part.title() for part in task.split('_'))}-v0"
        if name not in registry:
            register(
                name,
                entry_point=f"{FACES}.gymnasium:SurgicalEnv",
                vector_entry_point=f"{FACES}.gymnasium:SurgicalVectorEnv",
                kwargs={"task": task},
            )


def pettingzoo_ids() -> None:
    """Registers every task with PettingZoo, as parallel and as AEC environment. Doing it twice does nothing."""
    from pettingzoo.env_registry.registration import aec_registry, parallel_registry, register

    for task in list_tasks():
        name = f"surgical_marl/{task}-v0"
        if name not in parallel_registry:
            register("parallel", name, f"{FACES}.pettingzoo:parallel_env", kwargs={"task": task})
        if name not in aec_registry:
            register("aec", name, f"{FACES}.pettingzoo:aec_env", kwargs={"task": task})


def task_modules() -> dict[str, ModuleType]:
    """Return a module for each task by its name, such as `reach_v0`, with `parallel_env`, `env` and `raw_env`."""
    return {f"{task}_v0": _module(task) for task in list_tasks()}


def _module(task: str) -> ModuleType:
    name = f"surgical_marl.{task}_v0"
    if name not in sys.modules:
        module = ModuleType(name, f"Version 0 of the task {task}: `{task}_v0.parallel_env(scene=...)`.")
        vars(module).update(
            parallel_env=partial(_make, "parallel_env", task),
            env=partial(_make, "aec_env", task),
            raw_env=partial(_make, "aec_env", task),
        )
        sys.modules[name] = module
    return sys.modules[name]


def _make(kind: str, task: str, **options: Any) -> Any:
    # The face is imported when an environment is made: it takes seconds.
    return getattr(import_module(f"{FACES}.pettingzoo"), kind)(task, **options)
