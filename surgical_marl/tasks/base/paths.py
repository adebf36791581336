"""Moving targets that a scene's arms can follow. The host draws them once, and environments look them up.

A path is a uniform cubic B-spline (`tasks/base/spline.py`) for each arm. It starts at the tool tip of the arm, at home
or in a random posture, and lasts an episode. A draw is kept only if all arms can follow it together: inverse kinematics
follows it within joint limits and joint speeds, and the arms stay apart. An environment picks a row of the table and a
time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.arm import Arm
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.scenes.scene import Scene
from surgical_marl.tasks.base import spline
from surgical_marl.tasks.base.task import Level
from surgical_marl.tasks.base.workspace import CLEARANCE, TOLERANCE, choose

ROWS = 1024
MANY_STARTS = 16384
"""Rows of a table with random starts to learn from: of `ROWS` a policy learns to know the rows instead of the way."""
DURATION = 5.0
"""Duration of a path, s."""
SEGMENTS = 50
"""Segments of a path's spline; each takes KNOT seconds."""
KNOT = DURATION / SEGMENTS
CHECKS = 25
"""Number of equally spaced times at which a path is checked."""
HEADROOM = 0.8
"""Share of a joint's `speed` that following a path may need; the rest is reserved for catching up."""
CROSSING = 0.02
"""Paths of two tips cross if they come this near to each other, m, even at different times. It is about the least
distance that two tools 8 mm thick may have at one time."""
WAYPOINTS = 5
WILD = 0.5
"""Randomness of waypoints: deviation from a circle or from a straight line, as a share of a step."""
TURNING = 4.0
"""Greatest turning rate of paths through waypoints, rad/s: their curvature is at most this divided by their speed. A
circle in `DURATION` takes 1.3 rad/s."""
SLOWEST = 0.5
"""Share of the greatest speed that the slowest of these paths has."""
AWAY = 0.25
"""Largest distance from home of a joint of a random start posture, as a share of its range."""

Draw = Callable[[np.random.Generator, int, np.ndarray, Level], np.ndarray]


def walks(rng: np.random.Generator, count: int, start: np.ndarray, level: Level) -> np.ndarray:
    """Draw random walks of the velocity, as in the paper, within bounds.

    The velocity at a knot is that at the last knot plus a normal step. Steps are so large that the walk reaches its
    greatest speed after about a second; a higher speed is cut to the greatest one. A target that would leave the ball
    of radius `extent` about its start is reflected. As the spline stays in the hull of its control points, both bounds
    hold at all times.

    Args:
        rng: source of randomness.
        count: how many.
        start: position of the target at the start, where it is at rest, [3] or for each [count, 1, 3], m.
        level: with the extent and the greatest speed.

    Returns:
        Control points [count, SEGMENTS + 3, 3], m.
    """
    offset = np.zeros((count, 3))
    velocity, control = offset, [offset, offset, offset]
    for push in rng.normal(0, level.speed * np.sqrt(KNOT), (SEGMENTS, count, 3)):
        velocity = _cut(velocity + push, level.speed)
        out = offset / np.maximum(_length(offset), 1e-9)
        outward = np.maximum((velocity * out).sum(-1, keepdims=True), 0)
        leaves = _length(offset + KNOT * velocity) > level.extent
        ahead = _cut(offset + KNOT * (velocity - np.where(leaves, 2 * outward * out, 0)), level.extent)
        velocity, offset = (ahead - offset) / KNOT, ahead
        control.append(offset)
    return start + np.stack(control, axis=1)


def loops_and_lines(rng: np.random.Generator, count: int, start: np.ndarray, level: Level) -> np.ndarray:
    """Draw cubic splines through random waypoints, passed once at constant speed: even rows closed, odd ones open.

    Waypoints of a closed path lie near a circle through `start` in a random plane. Waypoints of an open path follow one
    another from `start` with random turns. The curve is scaled about its start, so that passing it takes `DURATION` at
    its own speed, between `SLOWEST` and all of `level.speed`, and is sampled anew at equal arc length. A path is kept
    if it stays in the ball of radius `extent` about the start and turns no faster than `TURNING`. Arguments and result
    are those of `walks`.

    Raises:
        ValueError: no more than one path in a hundred can be kept.
    """
    control = np.empty((count, SEGMENTS + 3, 3))
    for first, waypoints, closed in ((0, _around, True), (1, _onwards, False)):
        rows, kept, drawn = range(first, count, 2), np.empty((0, SEGMENTS + 3, 3)), 0
        while len(kept) < len(rows):
            shape, length = spline.equal_steps(spline.through(waypoints(rng, count), closed), SEGMENTS)
            speed = rng.uniform(SLOWEST, 1, count) * level.speed
            path = spline.through(shape * (speed * DURATION / length)[:, None, None], closed)
            inside = (_length(path)[..., 0] <= level.extent).all(-1)
            kept = np.concatenate([kept, path[inside & (spline.curvature(path) * speed <= TURNING)]])
            drawn += count
            if len(kept) < drawn / 100:
                raise ValueError(
                    f"paths of {1000 * level.speed * DURATION:.3g} mm don't fit within {1000 * level.extent:.3g} mm"
                )
        control[first::2] = kept[: len(rows)]
    return start + control


def _around(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return waypoints near a circle, [count, WAYPOINTS + 1, 3]; the first and the last are the origin."""
    angle = 2 * np.pi * np.arange(WAYPOINTS) / WAYPOINTS
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    ring = ring * rng.uniform(1 - WILD, 1 + WILD, (count, WAYPOINTS, 1))
    ring[..., 2] = rng.normal(0, WILD, (count, WAYPOINTS))
    turn = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    ring = (ring - ring[:, :1]) @ turn
    return np.concatenate([ring, ring[:, :1]], axis=1)


def _onwards(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return waypoints of open paths, [count, WAYPOINTS, 3]; the first is the origin."""
    direction = rng.normal(size=(WAYPOINTS - 1, count, 3))
    direction[1:] *= WILD
    for last, following in pairwise(direction):
        last /= _length(last)
        following += last / np.sqrt(3)
    direction[-1] /= _length(direction[-1])
    way = np.cumsum(direction * rng.uniform(1 - WILD, 1 + WILD, (WAYPOINTS - 1, count, 1)), axis=0)
    return np.concatenate([np.zeros((1, count, 3)), way]).swapaxes(0, 1)


def path_table(
    scene: Scene, draw: Draw, level: Level, seed: int = 0, start: str = "home", rows: int = ROWS
) -> dict[str, np.ndarray]:
    """Return paths that all arms of a scene can follow at once.

    Args:
        draw: `walks` or `loops_and_lines`.
        level: extent, greatest speed, and the share of rows in which two paths cross.
        seed: of the draws; the same seed gives the same table.
        start: "home", or "random" for postures in which each joint but the jaw is up to `AWAY` of its range from home.
        rows: how many.

    Returns:
        `paths`, control points [rows, SEGMENTS + 3, arms, 3] in each arm's base frame, m; with random starts also
        `postures` [rows, nq], `qpos` of the scene. Kept on disk by content.

    Raises:
        ValueError: if fewer than one draw in a hundred can be kept.
    """
    numbers = (rows, DURATION, SEGMENTS, CHECKS, HEADROOM, CROSSING, WAYPOINTS, WILD, TURNING, SLOWEST, CLEARANCE, AWAY)
    settings = repr((draw.__name__, level, seed, numbers, start))
    speeds = repr([mount.arm.speed.tolist() for mount in scene.mounts.values()])
    table = cached("paths", lambda: _draw(scene, draw, level, seed, start, rows), settings, speeds, scene.fingerprint)
    nq = scene.model.nq
    paths = table[:, nq:].reshape(len(table), SEGMENTS + 3, -1, 3)
    return {"paths": paths} if start == "home" else {"paths": paths, "postures": table[:, :nq]}


def _draw(scene: Scene, draw: Draw, level: Level, seed: int, start: str, rows: int) -> np.ndarray:
    """Return postures and paths of `path_table` side by side, [rows, nq + control points]."""
    rng, mounts = np.random.default_rng(seed), scene.mounts

    def batch(only_crossing: bool) -> tuple[np.ndarray, np.ndarray]:
        begin = {agent: _begin(rng, mount.arm, ROWS, start) for agent, mount in mounts.items()}
        tips = [mounts[agent].arm.forward_kinematics(q)[:, None, :3, 3] for agent, q in begin.items()]
        table = np.stack([draw(rng, ROWS, tip, level) for tip in tips], axis=2)
        cross = _cross(scene, table)
        if only_crossing:
            table, begin, cross = table[cross], {agent: q[cross] for agent, q in begin.items()}, cross[cross]
        fine = _can_follow(scene, table, begin)
        flat = table.reshape(len(table), (SEGMENTS + 3) * len(mounts) * 3)  # there may be no row
        return np.concatenate([scene.full_qpos(begin), flat], -1)[fine], cross[fine]

    return choose(scene, batch, rows, level.crossing if len(mounts) > 1 else 0.0)


def _begin(rng: np.random.Generator, arm: Arm, count: int, start: str) -> np.ndarray:
    """Return joint positions [count, n] that an arm starts from; the jaw is always as at home."""
    if start == "home":
        return np.tile(arm.home, (count, 1))
    furthest = AWAY * (arm.upper - arm.lower) * ~arm.moves_jaw
    return rng.uniform(
        np.maximum(arm.home - furthest, arm.lower), np.minimum(arm.home + furthest, arm.upper), (count, len(arm.home))
    )


def _points(table: np.ndarray) -> np.ndarray:
    """Return the targets at the times of the checks, [N, CHECKS + 1, arms, 3]."""
    curves = np.moveaxis(table, 2, 1)
    return np.moveaxis(spline.evaluate(curves, np.linspace(0, SEGMENTS, CHECKS + 1)), 1, 2)


def _can_follow(scene: Scene, table: np.ndarray, begin: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return which rows of a table all arms can follow from joint positions [N, n] of each agent, [N] bool."""
    points, q = _points(table), dict(begin)
    fine = (scene.clearance(q) > CLEARANCE) & (scene.clearance(q, within=True) > 0)
    for moment in range(1, CHECKS + 1):
        for i, (agent, mount) in enumerate(scene.mounts.items()):
            arm, last = mount.arm, q[agent]
            q[agent] = inverse_kinematics(arm, points[:, moment, i], last, starts=1, iterations=6)
            missed = np.linalg.norm(arm.forward_kinematics(q[agent])[:, :3, 3] - points[:, moment, i], axis=-1)
            fastest = HEADROOM * arm.speed
            fine &= (missed < TOLERANCE) & (np.abs(q[agent] - last) <= fastest * DURATION / CHECKS).all(-1)
        fine &= (scene.clearance(q) > CLEARANCE) & (scene.clearance(q, within=True) > 0)
    return fine


def _cross(scene: Scene, table: np.ndarray) -> np.ndarray:
    """Return in which rows the paths of two arms come near each other, [N] bool."""
    world = [
        p @ m.rotation.T + m.position
        for p, m in zip(np.moveaxis(_points(table), 2, 0), scene.mounts.values(), strict=True)
    ]
    cross = np.zeros(len(table), dtype=bool)
    for i, one in enumerate(world):
        for other in world[:i]:
            apart = np.linalg.norm(one[:, :, None] - other[:, None], axis=-1)
            cross |= (apart < CROSSING).any(axis=(1, 2))
    return cross


def _cut(vectors: np.ndarray, most: float) -> np.ndarray:
    """Return vectors [..., 3] shortened to a length of at most `most`."""
    return np.asarray(vectors * np.minimum(1, most / np.maximum(_length(vectors), 1e-9)))


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=-1, keepdims=True)
