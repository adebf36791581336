"""Evaluation: metrics of whole episodes, in millimetres, over a fixed set of goals."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from surgical_marl.batch import BatchedEnv

MAX_BATCH = 1024  # episodes run at once; make the environment with num_envs=min(episodes, MAX_BATCH)
HOLD = 0.2  # s, how long before the end of an episode the tip must stay near the goal
THRESHOLDS_MM = (1, 2, 5)
FOLLOWING = ("track", "follow_path")  # tasks whose goal moves: the error of every step counts


class Outcome(NamedTuple):
    """One episode of each environment; all `[E, A]`.

    error: tip error at the last step (m). held: largest error of the last `HOLD` seconds (m).
    collided: whether the agent was in collision at any step. squared: mean over the episode of the
    squared error (m^2). center: largest distance of the shaft from the remote center of motion (m, NaN
    for an arm without one), at the start of every step.
    """

    error: Tensor
    held: Tensor
    collided: Tensor
    squared: Tensor
    center: Tensor


def evaluate(
    env: BatchedEnv,
    policy: Callable[[Mapping[str, Any]], Mapping[str, Any]],
    episodes: int,
    seed: int,
) -> dict[str, Any]:
    """Run a policy for a number of episodes.

    The first episode of each environment counts, however long it takes, so that short episodes are
    not over-represented. More episodes than environments are run in batches, each from its own
    seed.

    Args:
        env: the environment, with NumPy or torch arrays.
        policy: maps the observations of agents to their actions (see `learning.policy`).
        episodes: number of episodes, 1 or more.
        seed: seed of the goals and starts.

    Returns:
        The object that `surgical-marl eval --json` prints: errors in mm, rates from 0 to 1, over
        all agents and for each. `remote_center_error_mm` is the largest of all steps, None without a
        remote center.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be 1 or more, not {episodes}")
    batches = []
    for batch in range(math.ceil(episodes / env.num_envs)):
        count = min(env.num_envs, episodes - batch * env.num_envs)
        batches.append([part[:count].cpu() for part in _first_episodes(env, policy, _batch_seed(seed, batch))])
    outcome = Outcome(*(torch.cat(parts) for parts in zip(*batches, strict=True)))
    following = env.task_name in FOLLOWING
    agents = {
        agent: _metrics(Outcome(*(part[:, index : index + 1] for part in outcome)), following)
        for index, agent in enumerate(env.agents)
    }
    about = {"task": env.task_name, "scene": env.scene.name, "episodes": episodes, "seed": seed}
    return {**about, **_metrics(outcome, following), "agents": agents}


def format_table(result: Mapping[str, Any]) -> str:
    """What `evaluate` returned, as a plain-text table for people."""
    names = [name for name in result if name not in ("task", "scene", "episodes", "seed", "agents")]
    rows = {"all": result, **result["agents"]}
    width = max(len(name) for name in rows)
    columns = [max(len(_title(name)), 8) for name in names]
    lines = ["{task} in {scene}: {episodes} episodes, seed {seed}".format(**result)]
    titles = (_title(name).rjust(size) for name, size in zip(names, columns, strict=True))
    lines.append("  ".join([" " * width, *titles]))
    for label, values in rows.items():
        cells = (_cell(name, values[name]).rjust(size) for name, size in zip(names, columns, strict=True))
        lines.append("  ".join([label.ljust(width), *cells]))
    return "\n".join(lines)


def _first_episodes(env: BatchedEnv, policy: Callable[..., Mapping[str, Any]], seed: int) -> Outcome:
    observations, *_ = env.reset(seed)
    agents = list(env.agents)
    hold = max(1, round(HOLD / env.control_dt))
    running = torch.ones(env.num_envs, 1, dtype=torch.bool, device=env.device)
    error = torch.zeros(env.num_envs, len(agents), device=env.device)
    squared, length = torch.zeros_like(error), torch.zeros_like(error)
    collided = torch.zeros_like(error, dtype=torch.bool)
    center = torch.zeros_like(error, dtype=torch.float64)
    # The last errors, one slot a step; -inf where an episode is shorter than the window.
    recent = torch.full((hold, *error.shape), -torch.inf, device=env.device)
    for index in range(env.max_steps):
        center = torch.maximum(center, torch.where(running, _center_errors(env), 0.0))
        step = env.step(dict(policy(observations)))
        observations = step.observations
        now = _stack([step.infos[agent]["tip_error"] for agent in agents], env.device)
        error = torch.where(running, now, error)
        recent[index % hold] = torch.where(running, now, recent[index % hold])
        squared += torch.where(running, now.square(), 0.0)
        length += running
        collided |= running & _stack([step.infos[agent]["collision"] for agent in agents], env.device)
        done = _stack([step.terminated, step.truncated], env.device).any(-1, keepdim=True)
        running = running & ~done
        if not running.any():
            return Outcome(error, recent.amax(0), collided, squared / length, center)
    raise RuntimeError(f"{int(running.sum())} episodes did not end within max_steps = {env.max_steps}")


def _center_errors(env: BatchedEnv) -> Tensor:
    """Distance of each shaft from its remote center (m) `[E, A]`, in float64; NaN for an arm without one."""
    arms = {agent: env.scene.mounts[agent].arm for agent in env.agents}
    errors = np.full((env.num_envs, len(arms)), np.nan)
    for index, (agent, arm) in enumerate(arms.items()):
        if arm.remote_center is not None:
            errors[:, index] = arm.remote_center_error(env.qpos[:, env.scene.qpos_index(agent)].astype(float))
    return torch.from_numpy(errors).to(env.device)


def _metrics(outcome: Outcome, following: bool) -> dict[str, float | None]:
    error = 1000 * outcome.error.double().numpy()
    held = 1000 * outcome.held.double().numpy()
    center = 1000 * outcome.center.numpy()
    metrics: dict[str, float | None] = {
        "median_error_mm": float(np.median(error)),
        "mean_error_mm": float(np.mean(error)),
    }
    for threshold in THRESHOLDS_MM:
        metrics[f"success_{threshold}mm"] = float(np.mean(held < threshold))
    metrics["collision_rate"] = float(outcome.collided.any(-1).double().mean())
    metrics["remote_center_error_mm"] = None if np.isnan(center).all() else float(np.nanmax(center))
    if following:
        metrics["rmse_mm"] = 1000 * float(outcome.squared.double().mean().sqrt())
    return metrics


def _batch_seed(seed: int, batch: int) -> int:
    """A seed for each batch, not shared by neighbouring seeds; the first has the seed itself."""
    return int(np.random.SeedSequence([seed, batch]).generate_state(1)[0] >> 1) if batch else seed


def _stack(parts: list[Any], device: Any) -> Tensor:
    return torch.stack([torch.as_tensor(part, device=device) for part in parts], -1)


def _title(name: str) -> str:
    return name.removesuffix("_mm").replace("_", " ") + (" (mm)" if name.endswith("_mm") else "")


def _cell(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if name.endswith("_mm") else f"{value:.1%}"
