"""Check whether a batch fits into memory, and turn a lack of memory into an error of one sentence."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch

from surgical_marl.envs.observations import each
from surgical_marl.machine import free_memory, lacks_memory
from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.policies.layout import Layout, zeros
from surgical_marl.runs.settings import Settings

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


def rollout_bytes(settings: Settings, env: BatchedEnv) -> int:
    """Return how many bytes of memory a stored rollout takes for one environment.

    Each step stores the observations and the state, and the actions with their means and deviations. For each agent it
    also stores a log-probability and an advantage, and a reward with its value and return. If the cost is bounded, it
    also stores the cost of each agent with its value and return.
    """
    layout = Layout(env, ALGORITHMS.load(settings.algo).grouping)
    seen = layout.stack({a: each(zeros(env.observation_space(a)), torch.from_numpy) for a in layout.agents})
    observed = sum(part.nbytes for part in (*seen.values(), zeros(env.state_space)))
    kept = 5 if settings.constraint.cost == "none" else 8
    return settings.steps_per_iteration * (observed + 4 * (3 * layout.num_actions + kept * layout.num_agents) + 1)


def check_room(settings: Settings, env: BatchedEnv) -> None:
    """Raise ValueError if a rollout alone does not fit.

    Learning needs more memory; `in_memory` reports a lack of that.
    """
    each, room = rollout_bytes(settings, env), free_memory(str(env.device))
    if room is not None and each * env.num_envs > room:
        steps = settings.steps_per_iteration
        raise ValueError(
            f"num_envs {env.num_envs} does not fit into memory: {steps} steps of one environment take {each} bytes, so "
            f"that at most {room // each} fit"
        )


@contextlib.contextmanager
def in_memory(num_envs: int) -> Iterator[None]:
    """Turn a lack of memory within this context into a ValueError that names `num_envs`."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not lacks_memory(error):
            raise
        advice = f"try num_envs={num_envs // 2}" if num_envs > 1 else "try fewer steps_per_iteration"
        raise ValueError(f"num_envs {num_envs} does not fit into memory: {advice}") from None
