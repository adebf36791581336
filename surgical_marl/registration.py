"""Ids under which Gymnasium and PettingZoo find the tasks: `surgical_marl/Reach-v0` and `surgical_marl/reach-v0`.

Importing `surgical_marl` registers both.
"""

from __future__ import annotations

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
