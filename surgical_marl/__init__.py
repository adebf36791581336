"""Multi-agent reinforcement learning for surgical robots: every arm is an agent.

    import surgical_marl as sm

    env = sm.parallel_env("reach", scene="bimanual_psm")

Importing this package is quick: JAX, MuJoCo and torch start when an environment is made.
"""

import os
import sys


def _reason_to_refuse() -> str:
    """Return why nothing works here, or an empty text. Python 3.6 can read this file up to its end, too."""
    if sys.version_info < (3, 11):  # noqa: UP036  # pip looks at it, but a folder on PYTHONPATH comes without pip
        return "surgical_marl needs Python 3.11 or newer, and this is Python {}.{}.{}".format(*sys.version_info)
    try:
        os.getcwd()
    except OSError:  # PettingZoo and MKL ask for it when they are imported
        return "the working folder does not exist any more: change to another one"
    return ""


_reason = _reason_to_refuse()
if _reason:
    if os.path.basename(sys.argv[0]) in ("surgical-marl", "-m"):  # a command, which needs no traceback
        sys.stderr.write("surgical-marl: " + _reason + "\n")
        sys.exit(2)
    raise ImportError(_reason)

from importlib import import_module
from typing import TYPE_CHECKING, Any

from surgical_marl.content import list_arms, list_objects, list_policies, list_scenes
from surgical_marl.interfaces.registration import register_ids, register_task
from surgical_marl.plugins.adapters import list_adapters, register_adapter
from surgical_marl.plugins.algorithms import list_algorithms, register_algorithm
from surgical_marl.plugins.controls import list_controls, register_control
from surgical_marl.plugins.systems import list_systems, register_system
from surgical_marl.plugins.tasks import list_tasks, module_name
from surgical_marl.runtime import note_forks

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.interfaces.jax_env import jax_env
    from surgical_marl.interfaces.pettingzoo import parallel_env
    from surgical_marl.report.notebook import Report, Video
    from surgical_marl.robots.arm import load_arm
    from surgical_marl.scenes.load import load_scene
    from surgical_marl.scenes.objects import load_object
    from surgical_marl.tasks.base.task import Task, TipTask

__version__ = "0.2.0"

_LAZY = {
    "BatchedEnv": "surgical_marl.envs.batch",
    "Report": "surgical_marl.report.notebook",
    "Video": "surgical_marl.report.notebook",
    "jax_env": "surgical_marl.interfaces.jax_env",
    "load_arm": "surgical_marl.robots.arm",
    "load_object": "surgical_marl.scenes.objects",
    "load_scene": "surgical_marl.scenes.load",
    "Task": "surgical_marl.tasks.base.task",
    "TipTask": "surgical_marl.tasks.base.task",
    "parallel_env": "surgical_marl.interfaces.pettingzoo",
}

__all__ = [
    "BatchedEnv",
    "Report",
    "Task",
    "TipTask",
    "Video",
    "jax_env",
    "list_adapters",
    "list_algorithms",
    "list_arms",
    "list_controls",
    "list_objects",
    "list_policies",
    "list_scenes",
    "list_systems",
    "list_tasks",
    "load_arm",
    "load_object",
    "load_scene",
    "parallel_env",
    "register_adapter",
    "register_algorithm",
    "register_control",
    "register_system",
    "register_task",
]

register_ids()
note_forks()


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'surgical_marl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, *map(module_name, list_tasks()), "__version__"]
