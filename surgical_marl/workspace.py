"""Targets that a scene's arms can reach: drawn on the host once, looked up by the environments.

Targets are drawn from a normal distribution about the point in front of each arm, and a draw is kept only if every arm
reaches its target within its joint limits, and if the arms stay apart both there and on the straight joint-space path
from home. An environment then picks rows of the table, so a reset costs one lookup, whatever the arm.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.inverse_kinematics import inverse_kinematics
from surgical_marl.scene import Scene

TABLE_SIZE = 4096
CLEARANCE = 0.01
"""Arms stay this far apart on the way to their targets, m."""
PATH_POINTS = 8
MOST_BATCHES = 40
TOLERANCE = 1e-4
"""A target is reached when inverse kinematics comes this close, m."""


def target_table(scene: Scene, spread: float, crossing: float = 0.0, seed: int = 0) -> np.ndarray:
    """Reachable, collision-free targets for all arms of a scene at once.

    Args:
        spread: standard deviation of the draws in m, the same along each axis.
        crossing: share of rows, 0 to 1, in which arms touch on the straight joint-space path from home, though they
            are apart at their targets.
        seed: of the draws; the same seed gives the same table.

    Returns:
        Targets [TABLE_SIZE, arms, 3] in each arm's base frame, m. Kept on disk by content, so a second call is quick.

    Raises:
        ValueError: if fewer than one draw in a hundred can be kept.
    """
    crossing = crossing if len(scene.agents) > 1 else 0.0
    settings = repr((TABLE_SIZE, CLEARANCE, PATH_POINTS, TOLERANCE, spread, crossing, seed))
    return cached("targets", settings, scene.fingerprint, lambda: _draw(scene, spread, crossing, seed))


def choose(scene: Scene, batch: Callable[[], tuple[np.ndarray, np.ndarray]], rows: int, crossing: float) -> np.ndarray:
    """So many rows from batches of draws, a share of them crossing.

    Args:
        scene: for the message.
        batch: draws, and gives those that can be kept [n, ...] and which of these cross, [n] bool. Called until there
            are enough, or until `MOST_BATCHES` show that arms don't meet: then others stand in for those that cross.
        rows: how many.
        crossing: share of rows that cross, 0 to 1.

    Raises:
        ValueError: if batches are all but empty.
    """
    wanted = round(crossing * rows)
    kept: dict[bool, list[np.ndarray]] = {False: [], True: []}
    count = lambda cross: sum(map(len, kept[cross]))  # noqa: E731
    for drawn in range(1, MOST_BATCHES + 1):
        found, crosses = batch()
        for cross in kept:
            kept[cross].append(found[crosses == cross])
        if count(False) >= rows - wanted and count(True) >= wanted:
            break
        if drawn >= 4 and count(False) < drawn * rows / 100:
            raise ValueError(
                f"scene {scene.name!r}: fewer than 1 % of targets are within reach without collision; move the arms or "
                "their workspace points"
            )
    plain, crossed = np.concatenate(kept[False]), np.concatenate(kept[True])[:wanted]
    if len(plain) + len(crossed) < rows:
        raise ValueError(f"scene {scene.name!r}: too few targets are within reach without collision; move the arms or "
                         "their workspace points")  # fmt: skip
    return np.concatenate([plain[: rows - len(crossed)], crossed])


def _draw(scene: Scene, spread: float, crossing: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)

    def batch() -> tuple[np.ndarray, np.ndarray]:
        targets = rng.normal(0.0, spread, (TABLE_SIZE, len(scene.agents), 3))
        targets += np.stack([scene.mounts[agent].workspace for agent in scene.agents])
        reached, on_the_way, there = _clearances(scene, targets)
        crosses = on_the_way < 0
        good = reached & (there > CLEARANCE) & (crosses | (on_the_way > CLEARANCE))
        return targets[good], crosses[good]

    return choose(scene, batch, TABLE_SIZE, crossing)


def _clearances(scene: Scene, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For rows of targets [N, arms, 3]: whether every arm reaches its own, and the least distance of two arms on the
    straight joint-space path from home and at its end, m; [N] each."""
    reached = np.ones(len(targets), dtype=bool)
    goals: dict[str, np.ndarray] = {}
    for i, agent in enumerate(scene.agents):
        arm = scene.mounts[agent].arm
        goals[agent] = inverse_kinematics(arm, targets[:, i], starts=1)
        tips = arm.forward_kinematics(goals[agent])[:, :3, 3]
        reached &= np.linalg.norm(tips - targets[:, i], axis=-1) < TOLERANCE
    least = there = np.full(len(targets), np.inf)
    for share in np.linspace(0.0, 1.0, PATH_POINTS + 1)[1:]:
        way = {agent: (1 - share) * scene.mounts[agent].arm.home + share * goals[agent] for agent in scene.agents}
        there = scene.clearance(way)
        least = np.minimum(least, there)
    return reached, least, there
