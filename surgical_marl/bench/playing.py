"""States that the policy of a task comes to: the start of the motion `policy`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from surgical_marl.bench.workload import Workload
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.policies.acting import forget
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.team import SAME, check_same
from surgical_marl.scenes.timing import DECIMATION

NOISE = 0.13
"""Standard deviation of the noise on actions: that of `needle_handover` at the end of a training."""


def policy_of(workload: Workload) -> str:
    """Return the name of the policy that plays.

    Raises:
        ValueError: none ships for this task and scene, or it was trained with other options.
    """
    name = f"{workload.task}-{Path(workload.scene).stem}"
    check_same(name, {key: getattr(workload, key) for key in SAME})
    return name


def played(
    player: str, workload: Workload, count: int, laps: int, paths: list[str], rng: np.random.Generator
) -> tuple[list[np.ndarray], list[dict[str, np.ndarray]]]:
    """Let a policy play, with noise, and stop each environment anywhere in its episode.

    Args:
        player: the policy's name, as `policy_of` gives it.
        workload: which task, and which scene.
        count: how many environments play, n.
        laps: for how many control steps actions are noted.
        paths: names of the parts of the carry to return.
        rng: draws the noise, and where environments stop.

    Returns:
        Those parts where the environments stop, [n, ...] each, and the actions from there: agent -> [n, its actions],
        one mapping for each of the `laps`.
    """
    options = replace(workload, decimation=DECIMATION).of_environment()
    env = BatchedEnv(**options, num_envs=count, device=workload.where)
    policy = load_policy(player, env)
    stops = rng.integers(0, max(1, env.max_steps - laps), count)
    observations, *_ = env.reset(seed=0)
    forget(policy)
    parts = [np.array(env.engine.read(path, "numpy")) for path in paths]
    actions = [{a: np.zeros((count, *env.action_space(a).shape), np.float32) for a in env.agents} for _ in range(laps)]
    for step in range(int(stops.max()) + laps):
        if (here := stops == step).any():
            for part, path in zip(parts, paths, strict=True):
                part[here] = env.engine.read(path, "numpy")[here]
        acting = {}
        for agent, values in policy(observations).items():
            acting[agent] = np.clip(values + rng.normal(0.0, NOISE, values.shape), -1, 1).astype(np.float32)
        for lap, noted in enumerate(actions):
            now = stops + lap == step
            for agent, values in acting.items():
                noted[agent][now] = values[now]
        outcome = env.step(acting)
        observations = outcome.observations
        forget(policy, outcome.terminated | outcome.truncated)
    env.close()
    return parts, actions
