"""Actions for tests."""

from __future__ import annotations

import numpy as np

from surgical_marl.envs.batch import BatchedEnv


def random_actions(env: BatchedEnv, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return an action [N, A] in [-1, 1] for each agent."""
    return {
        agent: rng.uniform(-1, 1, (env.num_envs, *env.action_space(agent).shape)).astype(np.float32)
        for agent in env.agents
    }
