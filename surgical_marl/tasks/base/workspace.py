"""Targets that a scene's arms can reach. The host draws them once, and environments look them up.

Targets are drawn from a normal distribution about the point in front of each arm, and a draw is kept only if every arm
reaches its target within its joint limits and in time, and if the arms stay apart both there and on the straight
joint-space path from home. An environment then picks rows of the table, so a reset costs one lookup, whatever the arm.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.arm import Arm
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.scenes.scene import Scene

TABLE_SIZE = 4096
MANY_STARTS = 32768
"""Rows of a table of starts to learn from: of `TABLE_SIZE` a policy learns to know the rows instead of the way."""
CLEARANCE = 0.01
"""Least distance between arms on the way to their targets, m."""
PATH_POINTS = 8
CROSSING_POINTS = 6
TIME = 1.5
"""Time in which arms can get to their targets at their joints' speeds, s. In an episode of `reach` half a second is
left to settle."""
MOST_BATCHES = 8
"""Greatest number of batches that are drawn in search of targets that cross."""
TOLERANCE = 1e-4
"""A target is reached when inverse kinematics comes this close, m."""
TURNED, SHIFTED = 0.1, 0.01
"""Distance of a joint that turns, rad, or slides, m, from home that is one unit of `about_home`."""


def about_home(rng: np.random.Generator, arm: Arm, off: float, rows: int) -> np.ndarray:
    """Return joint positions [rows, n] of an arm at most `off` units from home, of `TURNED` and `SHIFTED`, at random.

    The jaw stays at home.
    """
    furthest = np.where([joint.slides for joint in arm.actuated], SHIFTED, TURNED) * ~arm.moves_jaw
    return np.asarray(arm.home + off * furthest * rng.uniform(-1.0, 1.0, (rows, len(furthest))))


def target_table(scene: Scene, spread: float, crossing: float = 0.0, seed: int = 0) -> np.ndarray:
    """Return reachable, collision-free targets for all arms of a scene at once.

    Args:
        spread: standard deviation of the draws in m, the same along each axis.
        crossing: share of rows, 0 to 1, in which the straight joint-space paths of two arms from home collide if the
            arms are at different points of their paths, though all arms are apart at their targets. These targets are
            drawn about the middle between the points in front of neighbouring arms.
        seed: of the draws; the same seed gives the same table.

    Returns:
        Targets [TABLE_SIZE, arms, 3] in each arm's base frame, m. Kept on disk by content, so a second call is quick.

    Raises:
        ValueError: if fewer than one draw in a hundred can be kept.
    """
    crossing = crossing if len(scene.agents) > 1 else 0.0
    speeds = [mount.arm.speed.tolist() for mount in scene.mounts.values()]
    settings = repr(
        (TABLE_SIZE, CLEARANCE, PATH_POINTS, CROSSING_POINTS, TOLERANCE, TIME, speeds, spread, crossing, seed)
    )
    return cached("targets", lambda: _draw(scene, spread, crossing, seed), settings, scene.fingerprint)


def start_table(
    scene: Scene, spread: float, seed: int = 0, rows: int = TABLE_SIZE
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return postures to start from, and targets that all arms of a scene can reach from there.

    Targets are drawn as for `target_table`. From the posture at the targets every joint except the jaw is moved away by
    a uniform random distance, as far as its range and its speed in `TIME` allow. A draw is kept if the arms are apart
    all the way on the straight joint-space path between both, and no arm touches itself there.

    Args:
        spread: standard deviation of the targets in m, the same along each axis.
        seed: of the draws; the same seed gives the same table.
        rows: how many; a longer table begins with the rows of a shorter one.

    Returns:
        Joint positions of each agent at the start and at its target, [2, rows, n], and targets [rows, arms, 3] in each
        arm's base frame, m. Kept on disk by content.

    Raises:
        ValueError: fewer than one draw in a hundred can be kept.
    """
    settings = repr([rows, spread, seed, *(mount.arm.speed.tolist() for mount in scene.mounts.values())])
    table = cached("starts", lambda: _draw_starts(scene, spread, seed, rows), settings, scene.fingerprint)
    nq = scene.model.nq
    ends = np.stack([table[:, :nq], table[:, nq : 2 * nq]])
    ways = {agent: ends[..., scene.qpos_index(agent)] for agent in scene.agents}
    return ways, table[:, 2 * nq :].reshape(len(table), -1, 3)


def choose(
    scene: Scene, batch: Callable[[bool], tuple[np.ndarray, np.ndarray]], rows: int, crossing: float
) -> np.ndarray:
    """Return a number of rows from batches of draws, a share of which cross.

    Args:
        scene: its name is in the error message.
        batch: draws about `rows` rows and returns those that can be kept [n, ...] and which of them cross, [n] bool. If
            it is called with True, only rows that cross are needed. It is called until there are enough rows. If the
            arms never or hardly meet in a batch or in `MOST_BATCHES`, other rows replace those that cross.
        rows: how many.
        crossing: share of rows that cross, 0 to 1.

    Raises:
        ValueError: if fewer than one draw in a hundred can be kept.
    """
    wanted, drawn = round(crossing * rows), 0
    plain: list[np.ndarray] = []
    crossed: list[np.ndarray] = []
    while not (enough := sum(map(len, plain)) >= rows) or sum(map(len, crossed)) < wanted:
        if enough and drawn >= MOST_BATCHES:
            break
        found, crosses = batch(enough)
        if enough and not len(found):  # arms that never meet
            break
        plain.append(found[~crosses])
        crossed.append(found[crosses])
        drawn += 1
        if drawn >= 4 and sum(map(len, plain)) < drawn * rows / 100:
            raise ValueError(
                f"scene {scene.name!r}: fewer than 1 % of targets are within reach without collision; move the arms or "
                "their workspace points"
            )
    chosen = np.concatenate(crossed)[:wanted]
    return np.concatenate([np.concatenate(plain)[: rows - len(chosen)], chosen])


def _draw(scene: Scene, spread: float, crossing: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)

    def batch(only_crossing: bool) -> tuple[np.ndarray, np.ndarray]:
        targets = rng.normal(0.0, spread, (TABLE_SIZE, len(scene.agents), 3))
        targets += _between(scene) if only_crossing else [mount.workspace for mount in scene.mounts.values()]
        goals, good = _reach(scene, targets)
        if only_crossing:
            good &= (scene.clearance(goals) > CLEARANCE) & _cross(scene, goals)
        else:
            for share in np.linspace(0.0, 1.0, PATH_POINTS + 1)[1:]:
                way = {a: (1 - share) * scene.mounts[a].arm.home + share * q for a, q in goals.items()}
                good &= scene.clearance(way) > CLEARANCE
        return targets[good], np.full(good.sum(), only_crossing)

    return choose(scene, batch, TABLE_SIZE, crossing)


def _draw_starts(scene: Scene, spread: float, seed: int, rows: int) -> np.ndarray:
    """Return postures and targets of `start_table` side by side, [rows, 2 nq + 3 arms]."""
    rng = np.random.default_rng(seed)

    def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
        targets = rng.normal(0.0, spread, (TABLE_SIZE, len(scene.agents), 3))
        targets += [mount.workspace for mount in scene.mounts.values()]
        goals, good = _reach(scene, targets, np.inf)
        starts = {agent: _away(rng, mount.arm, goals[agent]) for agent, mount in scene.mounts.items()}
        left = _stay_apart(scene, starts, goals, np.flatnonzero(good))
        ends = scene.full_qpos(starts), scene.full_qpos(goals)
        found = np.concatenate([*ends, targets.reshape(len(targets), -1)], -1)[left]
        return found, np.zeros(len(found), bool)

    return choose(scene, batch, rows, 0.0)


def _stay_apart(
    scene: Scene, starts: dict[str, np.ndarray], goals: dict[str, np.ndarray], rows: np.ndarray
) -> np.ndarray:
    """Return the rows in which arms stay apart, and do not touch themselves, on straight paths of joints.

    Paths are looked at in ever smaller steps, until no two tips come as near to each other between two points as the
    arms have been: with `PATH_POINTS` alone, arms as large as STARs move by 0.2 m in between and may meet there.

    Args:
        scene: the scene.
        starts: joint positions [N, n] of each agent.
        goals: joint positions [N, n] of each agent at the paths' ends.
        rows: the rows of N to look at.
    """
    least = np.full(len(next(iter(goals.values()))), np.inf)
    shares, pieces = np.linspace(0.0, 1.0, PATH_POINTS + 1), PATH_POINTS
    kept, step = [], _farthest(scene, starts, goals, shares)
    while len(rows):
        for share in shares:
            way = _part_way(starts, goals, share, rows)
            least[rows] = np.minimum(least[rows], scene.clearance(way))
            rows = rows[(least[rows] > CLEARANCE) & (scene.clearance(way, within=True) > 0)]
        sure = least[rows] >= step[rows] / 2  # between two points an arm is at most half a step from one of them
        kept.append(rows[sure])
        rows, step, shares, pieces = rows[~sure], step / 2, (np.arange(pieces) + 0.5) / pieces, 2 * pieces
    return np.sort(np.concatenate(kept)) if kept else rows


def _farthest(
    scene: Scene, starts: dict[str, np.ndarray], goals: dict[str, np.ndarray], shares: np.ndarray
) -> np.ndarray:
    """Return the farthest ways of all tips from one point of the paths to the next, added up, [N], m."""
    total = np.zeros(len(next(iter(goals.values()))))
    for agent, mount in scene.mounts.items():
        ends = {agent: starts[agent]}, {agent: goals[agent]}
        ways = np.stack([_part_way(*ends, share, np.arange(len(total)))[agent] for share in shares])
        tips = mount.arm.forward_kinematics(ways)[..., :3, 3]
        total += np.linalg.norm(np.diff(tips, axis=0), axis=-1).max(0)
    return total


def _part_way(
    starts: dict[str, np.ndarray], goals: dict[str, np.ndarray], share: float, rows: np.ndarray
) -> dict[str, np.ndarray]:
    """Return joint positions [rows, n] of each agent where it has gone a share of its path."""
    return {agent: (1 - share) * starts[agent][rows] + share * goal[rows] for agent, goal in goals.items()}


def _away(rng: np.random.Generator, arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return joint positions [N, n] from which an arm can move to `q` in `TIME`; the jaw stays."""
    furthest = TIME * arm.speed * ~arm.moves_jaw
    return rng.uniform(np.maximum(q - furthest, arm.lower), np.minimum(q + furthest, arm.upper))


def reach(arm: Arm, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint positions at targets [n, 3] in the base frame, m, and whether the arm gets there, [n] bool."""
    q = inverse_kinematics(arm, targets, starts=1)
    return q, np.linalg.norm(arm.forward_kinematics(q)[:, :3, 3] - targets, axis=-1) < TOLERANCE


def _reach(scene: Scene, targets: np.ndarray, time: float = TIME) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the joint positions at targets, and whether all agents get there from home in time.

    Args:
        scene: the scene of the agents.
        targets: [N, arms, 3], each in its arm's base frame, m.
        time: greatest time of the way from home, s.

    Returns:
        Joint positions [N, n] of each agent at its targets, and [N] bool: whether all agents get to theirs in `time`.
    """
    good, goals = np.ones(len(targets), dtype=bool), {}
    for i, agent in enumerate(scene.agents):
        arm = scene.mounts[agent].arm
        goals[agent], reached = reach(arm, targets[:, i])
        good &= reached & (np.abs(goals[agent] - arm.home) <= time * arm.speed).all(-1)
    return goals, good


def _cross(scene: Scene, goals: dict[str, np.ndarray]) -> np.ndarray:
    """Return where two arms collide at any two points of their straight paths, with the others at home, [N] bool."""
    least = np.full(len(next(iter(goals.values()))), np.inf)
    shares = np.linspace(0.0, 1.0, CROSSING_POINTS)[:, None]
    for one, other in combinations(scene.agents, 2):
        way = {}
        for agent, mount in scene.mounts.items():
            path = mount.arm.home + shares * (goals[agent] - mount.arm.home)[:, None]
            way[agent] = {one: path[:, :, None], other: path[:, None]}.get(agent, mount.arm.home)
        least = np.minimum(least, scene.clearance(way).min((1, 2)))
    return least < 0


def _between(scene: Scene) -> np.ndarray:
    """Return the middle between the workspace points of each arm and the next, in the arm's base frame, [arms, 3]."""
    mounts = list(scene.mounts.values())
    world = np.array([mount.rotation @ mount.workspace + mount.position for mount in mounts])
    middle = (world + np.roll(world, -1, axis=0)) / 2
    return np.array([(point - mount.position) @ mount.rotation for point, mount in zip(middle, mounts, strict=True)])
