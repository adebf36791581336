"""Finds targets of tool tips that are out of reach, before a policy is trained to reach them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from surgical_marl.envs.env import Env
from surgical_marl.robots.arm import Arm
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.runtime import jax, jax_scope
from surgical_marl.scenes.scene import Mount

DRAWS = 128
"""Episodes whose targets are looked at."""
MOST = 0.05
"""Share of an arm's targets that may be out of its reach."""
NEAR = 0.001
"""A target is within reach when inverse kinematics comes this close, m."""
STARTS = 4
"""Postures from which inverse kinematics searches for a target that it does not find from home."""


def out_of_reach(env: Env) -> str | None:
    """Return a sentence about the first arm that can't reach many of its targets; None if all arms can.

    The targets are those at the start of `DRAWS` episodes. A task without targets of tool tips has none that are wrong.
    """
    if not env.task.has_targets:
        return None
    targets = _draw(env)
    for index, (agent, mount) in enumerate(env.scene.mounts.items()):
        own = targets[:, index]
        missed = _missed(mount.arm, own)
        if missed.mean() > MOST:
            example = _point(own[missed][0])
            return (
                f"{env.title}: {missed.mean():.0%} of the targets of {agent} are out of its reach, such as {example} m "
                f"in its base frame, where its tip stays within {_extent(mount.arm)} m; {_cause(mount, own)}"
            )
    return None


@jax_scope()
def _draw(env: Env) -> np.ndarray:
    """Return the targets at the start of `DRAWS` episodes, [DRAWS, arms, 3], m, each in its arm's base frame."""
    keys = np.random.default_rng(0).integers(0, 2**32, (DRAWS, 2), np.uint32)

    def start(key: Any, parameters: Any) -> Any:
        return env.task.bound(parameters["weights"], parameters["tables"]).start(key).goal

    with jax.default_device(jax.devices("cpu")[0]):
        goal = jax.jit(jax.vmap(start, (0, None)))(keys, env.parameters)
    fields = {name: np.asarray(value) for name, value in goal._asdict().items()}
    return np.asarray(env.task.targets(SimpleNamespace(**fields)), float)


def _missed(arm: Arm, targets: np.ndarray) -> np.ndarray:
    """Return which of the targets [N, 3] an arm does not reach, [N] bool."""
    missed = ~_reaches(arm, targets, 1)
    missed[missed] = ~_reaches(arm, targets[missed], STARTS)
    return missed


def _reaches(arm: Arm, targets: np.ndarray, starts: int) -> np.ndarray:
    found = np.isfinite(targets).all(-1)
    q = inverse_kinematics(arm, np.where(found[:, None], targets, 0.0), starts=starts)
    return found & (np.linalg.norm(arm.forward_kinematics(q)[:, :3, 3] - targets, axis=-1) < NEAR)


def _cause(mount: Mount, targets: np.ndarray) -> str:
    """Return what is probably wrong: targets that are within reach as points of the world were meant as such."""
    if _missed(mount.arm, mount.to_base(targets)).mean() <= MOST:
        return (
            "as points of the world they would be within its reach: bring them to its base frame with "
            "scene.mounts[agent].to_base(points)"
        )
    near = _point(mount.workspace)
    return f"the scene's point in front of it, scene.mounts[agent].workspace, is {near} m"


def _extent(arm: Arm) -> str:
    low, high = arm.reach
    return ", ".join(f"{axis} from {a:.3f} to {b:.3f}" for axis, a, b in zip("xyz", low, high, strict=True))


def _point(point: np.ndarray) -> str:
    return "[" + ", ".join(f"{value:.3f}" for value in point) + "]"
