"""Whether a run fits into memory, and what does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from surgical_marl.engines.common import free_memory
from surgical_marl.interfaces.rsl_rl import RslRlVecEnv
from surgical_marl.learning.config import Settings


def check_room(settings: Settings, env: RslRlVecEnv) -> None:
    """ValueError if not even the rollout fits: what a step stores, for all environments and steps."""
    groups: list[Any] = list(env.get_observations().values())
    observed = sum(group[0].nbytes for group in groups)
    # an action with its mean and standard deviation; reward, value, return, advantage and log-probability
    step = observed + 4 * (3 * env.num_actions + 5 * env.layout.num_agents)
    rollout, room = settings.steps_per_iteration * step, free_memory(env.device)
    if room is not None and rollout * env.num_envs > room:
        raise ValueError(
            f"num_envs {env.num_envs} does not fit into memory: the rollout of one environment takes {rollout} bytes, "
            f"so that at most {room // rollout} fit"
        )


@contextmanager
def fitting(settings: Settings) -> Iterator[None]:
    """ValueError if a GPU runs out of memory meanwhile."""
    try:
        yield
    except torch.OutOfMemoryError:
        raise ValueError(
            f"num_envs {settings.num_envs} with ppo.mini_batches {settings.ppo.mini_batches} does not fit into the "
            f"GPU's memory: num_envs {settings.num_envs // 2} takes half of it, and ppo.mini_batches "
            f"{2 * settings.ppo.mini_batches} half of what learning takes"
        ) from None
