"""How much of their workspaces the arms of a scene share."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.scenes.scene import Scene

SAMPLES = 500
REACHED = 1e-3
"""A point counts as reached when inverse kinematics comes this close, m."""


def shared_workspace(scene: Scene) -> float:
    """Return the share of points within one arm's reach that another arm reaches too: the mean over all pairs of arms.

    Points are tool tips at random joint positions. NaN for a single arm.
    """
    return float(cached("shared", lambda: np.array(_shared(scene)), scene.fingerprint))


def _shared(scene: Scene) -> float:
    rng, shares = np.random.default_rng(0), []
    for one, other in permutations(scene.mounts.values(), 2):
        q = rng.uniform(one.arm.lower, one.arm.upper, (SAMPLES, len(one.arm.lower)))
        world = one.arm.forward_kinematics(q)[:, :3, 3] @ one.rotation.T + one.position
        target = (world - other.position) @ other.rotation
        tip = other.arm.forward_kinematics(inverse_kinematics(other.arm, target, starts=4))[:, :3, 3]
        shares.append(np.mean(np.linalg.norm(tip - target, axis=-1) < REACHED))
    return float(np.mean(shares)) if shares else np.nan
