"""Multi-agent reinforcement learning for surgical robots: every arm an agent.

    import surgical_marl as sm

    env = sm.parallel_env("reach", scene="bimanual_psm")

Importing this package is quick: JAX, MuJoCo and torch start when an environment is made.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from surgical_marl.content import list_arms, list_policies, list_scenes, list_tasks
from surgical_marl.registration import gymnasium_ids, pettingzoo_ids

if TYPE_CHECKING:
    from surgical_marl import follow_path_v0, match_image_v0, reach_v0, track_v0
    from surgical_marl.arm import load_arm
    from surgical_marl.batch import BatchedEnv
    from surgical_marl.interfaces.pettingzoo import parallel_env
    from surgical_marl.scene import load_scene

__version__ = "0.1.0"

_LAZY = {
    "BatchedEnv": "surgical_marl.batch",
    "load_arm": "surgical_marl.arm",
    "load_scene": "surgical_marl.scene",
    "parallel_env": "surgical_marl.interfaces.pettingzoo",
}

__all__ = [
    "BatchedEnv",
    "follow_path_v0",
    "list_arms",
    "list_policies",
    "list_scenes",
    "list_tasks",
    "load_arm",
    "load_scene",
    "match_image_v0",
    "parallel_env",
    "reach_v0",
    "track_v0",
]

gymnasium_ids()
pettingzoo_ids()


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    if name in ("reach_v0", "track_v0", "follow_path_v0", "match_image_v0"):
        return import_module(f"surgical_marl.{name}")
    raise AttributeError(f"module 'surgical_marl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
