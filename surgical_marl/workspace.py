"""Targets that a scene's arms can reach: drawn on the host once, looked up by the environments.

Targets are drawn from a normal distribution about the point in front of each arm, and a draw is kept only if every arm
reaches its target within its joint limits, and if the arms stay apart both there and on the straight joint-space path
from home. An environment then picks rows of the table, so a reset costs one lookup, whatever the arm.
"""

from __future__ import annotations

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.inverse_kinematics import inverse_kinematics
from surgical_marl.scene import Scene

TABLE_SIZE = 4096
CLEARANCE = 0.01
"""Arms stay this far apart on the way to their targets, m."""
PATH_POINTS = 8
TOLERANCE = 1e-4
"""A target is reached when inverse kinematics comes this close, m."""


def target_table(scene: Scene, spread: float, seed: int = 0) -> np.ndarray:
    """Reachable, collision-free targets for all arms of a scene at once.

    Args:
        spread: standard deviation of the draws in m, the same along each axis.
        seed: of the draws; the same seed gives the same table.

    Returns:
        Targets [TABLE_SIZE, arms, 3] in each arm's base frame, m. Kept on disk by content, so a second call is quick.

    Raises:
        ValueError: if fewer than one draw in a hundred can be kept.
    """
    settings = repr((TABLE_SIZE, CLEARANCE, PATH_POINTS, TOLERANCE, spread, seed))
    return cached("targets", settings, scene.fingerprint, lambda: _draw(scene, spread, seed))


def _draw(scene: Scene, spread: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    kept: list[np.ndarray] = []
    drawn = 0
    while sum(map(len, kept)) < TABLE_SIZE:
        targets = rng.normal(0.0, spread, (TABLE_SIZE, len(scene.agents), 3))
        targets += np.stack([scene.mounts[agent].workspace for agent in scene.agents])
        kept.append(targets[_fits(scene, targets)])
        drawn += TABLE_SIZE
        if drawn >= 4 * TABLE_SIZE and sum(map(len, kept)) < drawn / 100:
            raise ValueError(
                f"scene {scene.name!r}: fewer than 1 % of targets within {spread} m of the workspace points are "
                "reachable without collision; move the arms or their workspace points"
            )
    return np.concatenate(kept)[:TABLE_SIZE]


def _fits(scene: Scene, targets: np.ndarray) -> np.ndarray:
    """Which rows of targets [N, arms, 3] every arm reaches with clearance on the way, [N] bool."""
    good = np.ones(len(targets), dtype=bool)
    goals: dict[str, np.ndarray] = {}
    for i, agent in enumerate(scene.agents):
        arm = scene.mounts[agent].arm
        goals[agent] = inverse_kinematics(arm, targets[:, i], starts=1)
        reached = arm.forward_kinematics(goals[agent])[:, :3, 3]
        good &= np.linalg.norm(reached - targets[:, i], axis=-1) < TOLERANCE
    for share in np.linspace(0.0, 1.0, PATH_POINTS + 1)[1:]:
        way = {agent: (1 - share) * scene.mounts[agent].arm.home + share * goals[agent] for agent in scene.agents}
        good &= scene.clearance(way) > CLEARANCE
    return good
