"""Joint positions that bring an arm's tool tip to a position or a pose.

    q = inverse_kinematics(arm, pose)                       # pose [..., 4, 4]: position and orientation
    q = inverse_kinematics(arm, position)                   # position [..., 3]: the joints stay near the start
    q = inverse_kinematics(arm, pose, start=q, starts=1)    # follow a path: from the last joint positions only

The code is the same for numpy and, compiled, for JAX.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from surgical_marl.robots.arm import Arm

LENGTH = 0.05
"""Weight of an orientation error relative to a position error, m/rad: 0.1 degrees count about as much as 0.1 mm."""
CLOSE = 1e-5
"""Below this error (m, or rad times `LENGTH`) solutions are equally good, and the one nearest the start is taken."""
PULL = 0.2
"""Share of the way back to the start that a step takes where the target leaves the joints free."""
STEP = 0.2
"""The longest step of a joint, a share of its range: for longer steps the linear model of the arm is wrong."""
FAR = 0.5
"""A longer error (m) counts as this long: far targets make the steps oscillate (S. Buss and J. Kim, Selectively damped
least squares for inverse kinematics, 2005)."""
LEAST_DAMPING = 1e-7
"""Damping in m2. It keeps steps finite at a singularity, and is too small to slow the last steps."""
SETTLED = 1e-13
"""A search in numpy ends where a step moves no joint by more, a share of its range. Rounding moves them by 1e-15."""
CANDIDATES = 1024
"""Number of configurations spread over the joint ranges. A search also starts from those nearest to the target."""

Step = Callable[[Any, Any, Any, Any], Any]


def inverse_kinematics(
    arm: Arm, targets: Any, start: Any = None, *, starts: int = 8, iterations: int = 20, length: float = LENGTH
) -> Any:
    """Return joint positions within the limits that bring the tool tip to `targets`.

    Damped least squares (S. Buss, "Introduction to inverse kinematics with Jacobian transpose, pseudoinverse and
    damped least squares methods", 2004) in joint coordinates that are shares of their ranges. The damping falls with
    the square of the error (T. Sugihara, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt
    method", IEEE Transactions on Robotics 27, 2011). A joint that would leave its range rests at the limit. The search
    runs from `start` and from the configurations of a fixed Halton set whose tips are nearest to the target. In JAX it
    always takes `iterations` steps, so it runs under `jax.jit` and `jax.vmap`; call it from a compiled function there.
    In numpy it ends earlier where steps no longer move the joints.

    Args:
        arm: the arm.
        targets: positions [..., 3] of the tool tip in m or its poses [..., 4, 4], in the base frame. A numpy or a JAX
            array; the result is of the same kind.
        start: joint positions [n] or [..., n] in rad (m for prismatic joints) to start from; `arm.home` by default.
            For positions the joints stay near it where they can.
        starts: from how many configurations to search, `start` among them. 1 is enough for targets near `start` and for
            nearly all positions. The time is proportional to this number.
        iterations: steps from each, at most.
        length: weight of an orientation error relative to a position error, m/rad.

    Returns:
        Joint positions [..., n] in the order of `arm.actuated`: the solution nearest to `start` among those that are
        equally good. Joints that don't move the tip stay at `start`. For a target out of reach the result is close to
        the best that a search found: compare `forward_kinematics` with the target.

    Raises:
        ValueError: if targets or start have a shape that does not fit, or fewer than one start is asked for.
    """
    targets, start, xp = _check(arm, targets, start)
    if starts < 1:
        raise ValueError(f"starts must be at least 1, not {starts}")
    lower, scale = arm.lower, arm.upper - arm.lower
    begin = (start - lower) / scale
    seeds = _seeds(arm, targets, begin, starts, length)
    targets = targets[..., None, :] if targets.shape[-1] == 3 else targets[..., None, :, :]
    pull = PULL * (targets.shape[-1] == 3)

    def step(i: Any, share: Any, target: Any, first: Any) -> Any:
        error, jacobian = _residual(arm, lower + share * scale, target, length)
        # the last half of the steps only has to reach the target
        rest = pull * (2 * i < iterations) * (first - share)
        return _step(share, error, jacobian * scale, rest).astype(share.dtype)

    search = _search_each if xp is np else _search_all
    shares = search(step, seeds, targets, begin[..., None, :], iterations, (iterations + 1) // 2 if pull else 0)
    error, _ = _residual(arm, lower + shares * scale, targets, length)
    error = xp.linalg.vector_norm(error, axis=-1)
    away = xp.linalg.vector_norm(shares - begin[..., None, :], axis=-1)
    # Less than 1 for a solution at any distance from the start, more than 1 for anything else.
    rank = xp.where(error < CLOSE, away / (1 + away), 1 + error)
    best = xp.argmin(rank, axis=-1)[..., None, None]
    q = lower + scale * xp.take_along_axis(shares, best, axis=-2)[..., 0, :]
    return xp.clip(q, arm.lower, arm.upper).astype(start.dtype)


def _check(arm: Arm, targets: Any, start: Any) -> tuple[Any, Any, Any]:
    """Return targets and start [..., n] as float arrays of one kind, and the namespace of that kind."""
    start = arm.home if start is None else start
    arrays = [x if hasattr(x, "__array_namespace__") else np.asarray(x, dtype=float) for x in (targets, start)]
    xp = next((x.__array_namespace__() for x in arrays if not isinstance(x, np.ndarray)), np)
    targets, start = map(xp.asarray, arrays)
    dtype = xp.float64 if xp is np else xp.result_type(targets.dtype, xp.float32)
    targets, start = targets.astype(dtype), start.astype(dtype)
    n = len(arm.actuated)
    if targets.shape[-2:] != (4, 4) and targets.shape[-1:] != (3,):
        raise ValueError(f"targets must be positions [..., 3] or poses [..., 4, 4], not of shape {targets.shape}")
    batch = targets.shape[:-1] if targets.shape[-1] == 3 else targets.shape[:-2]
    try:
        start = xp.broadcast_to(start, (*batch, n))
    except ValueError:
        raise ValueError(
            f"start of shape {start.shape} does not fit the {n} joints of arm {arm.name!r} and targets of shape "
            f"{targets.shape}"
        ) from None
    return targets, xp.clip(start, arm.lower, arm.upper).astype(dtype), xp


def _seeds(arm: Arm, targets: Any, begin: Any, starts: int, length: float) -> Any:
    """Return the starts of searches [..., starts, n], in shares of the ranges: `begin` and the best candidates."""
    xp = begin.__array_namespace__()
    first = begin[..., None, :]
    if starts == 1:
        return first
    shares, positions, rotations = _candidates(arm)
    known = positions if targets.shape[-1] == 3 else np.concatenate([positions, length * rotations], -1)
    wanted = targets
    if targets.shape[-1] == 4:
        turn = targets[..., :3, :3]
        wanted = xp.concatenate([targets[..., :3, 3], length * turn.reshape(*turn.shape[:-2], 9)], -1)
    # Squared distance without the terms that are the same for all candidates.
    distance = np.sum(known**2, -1) - 2 * wanted @ known.T
    near = xp.argsort(distance, axis=-1)[..., : starts - 1]
    moves = np.any(arm.jacobian(arm.home) != 0, axis=0)
    others = xp.where(moves, xp.asarray(shares)[near], first)
    return xp.concatenate([first, others], -2).astype(begin.dtype)


def _residual(arm: Arm, q: Any, targets: Any, length: float) -> tuple[Any, Any]:
    """Return the error from the tip to the targets, and its Jacobian.

    The error is [..., 3] for target points. For target poses it is [..., 6], and the last three are rotation vectors
    times `length`.
    """
    pose, jacobian = arm.pose_and_jacobian(q)
    xp = pose.__array_namespace__()
    if targets.shape[-1] == 3:
        return targets - pose[..., :3, 3], jacobian[..., :3, :]
    turn = targets[..., :3, :3] @ xp.matrix_transpose(pose[..., :3, :3])
    error = xp.concatenate([targets[..., :3, 3] - pose[..., :3, 3], length * rotation_vector(turn)], -1)
    return error, xp.concatenate([jacobian[..., :3, :], length * jacobian[..., 3:, :]], -2)


def rotation_vector(turn: Any) -> Any:
    """Return axis times angle in rad, [..., 3], of rotation matrices [..., 3, 3].

    At half a turn the axis may be wrong.
    """
    xp = turn.__array_namespace__()
    # The chord is exact in float32 too. The cosine is not for small angles, and the sine is not for angles near half a
    # turn.
    chord = xp.linalg.vector_norm(turn - np.eye(3), axis=(-2, -1), keepdims=True)[..., 0]
    angle = 2 * xp.arcsin(xp.clip(chord / 8**0.5, 0.0, 1.0))
    axis = xp.stack(
        [turn[..., 2, 1] - turn[..., 1, 2], turn[..., 0, 2] - turn[..., 2, 0], turn[..., 1, 0] - turn[..., 0, 1]], -1
    )
    axis = axis + 1e-6 * (angle > 3)  # at half a turn the vector vanishes; any axis reduces the error from there
    return angle * axis / xp.maximum(xp.linalg.vector_norm(axis, axis=-1, keepdims=True), 1e-12)


def _step(share: Any, error: Any, jacobian: Any, pull: Any) -> Any:
    """Return joint coordinates after one step of damped least squares from joint coordinates `share` in [0, 1]."""
    xp = share.__array_namespace__()
    transposed = xp.matrix_transpose(jacobian)
    downhill = (transposed @ error[..., None])[..., 0]
    # Joints that press against a limit are left out, so that the other joints take over their part.
    held = ((share <= 0) & (downhill < 0)) | ((share >= 1) & (downhill > 0))
    jacobian = xp.where(held[..., None, :], 0.0, jacobian)
    transposed = xp.matrix_transpose(jacobian)
    # In addition to Sugihara's damping, one that keeps the matrix regular in spite of rounding (needed in float32).
    least = LEAST_DAMPING + share.shape[-1] * xp.finfo(share.dtype).eps * xp.sum(jacobian**2, axis=(-2, -1))
    error = error * xp.minimum(1.0, FAR / xp.maximum(xp.linalg.vector_norm(error, axis=-1, keepdims=True), 1e-12))
    damping = least + 0.5 * xp.sum(error**2, axis=-1)
    square = transposed @ jacobian + damping[..., None, None] * np.eye(share.shape[-1])
    rest = error[..., None] - jacobian @ pull[..., None]
    change = pull + xp.linalg.solve(square, transposed @ rest)[..., 0]
    return xp.clip(share + xp.clip(change, -STEP, STEP), 0.0, 1.0)


def _search_all(step: Step, shares: Any, targets: Any, begin: Any, iterations: int, free: int) -> Any:
    """Take all steps of all searches, in JAX as one loop, which compiles in the time of a single step.

    Args:
        step: (number of a step, joint coordinates, targets, where searches began) -> the next joint coordinates.
        shares: joint coordinates to start from, [..., starts, n].
        targets: [..., 1, 3] or [..., 1, 4, 4].
        begin: [..., 1, n].
        iterations: steps.
        free: from which step on nothing pulls a search back to where it began.
    """
    from jax import lax

    return lax.fori_loop(0, iterations, lambda i, now: step(i, now, targets, begin), shares)


def _search_each(step: Step, shares: Any, targets: Any, begin: Any, iterations: int, free: int) -> Any:
    """Do what `_search_all` does, but end each search when it has settled: most of them need a third of the steps."""
    many = shares.shape[:-1]
    flat = shares.reshape(-1, shares.shape[-1]).copy()
    kind = targets.shape[begin.ndim - 1 :]
    targets = np.broadcast_to(targets, (*many, *kind)).reshape(-1, *kind)
    begin = np.broadcast_to(begin, shares.shape).reshape(flat.shape)
    going = np.arange(len(flat))
    for i in range(iterations):
        if not len(going):
            break
        before = flat[going]
        flat[going] = after = step(i, before, targets[going], begin[going])
        if i >= free:
            going = going[np.abs(after - before).max(-1) > SETTLED]
    return flat.reshape(shares.shape)


@lru_cache(maxsize=64)
def _halton(count: int, dimensions: int) -> np.ndarray:
    """Return the first points of the Halton sequence after the origin, [count, dimensions] in (0, 1)."""
    from scipy.stats import qmc  # scipy takes 0.3 s to import, and most searches start from one place

    return np.asarray(qmc.Halton(dimensions, scramble=False).fast_forward(1).random(count))


def _candidates(arm: Arm) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return configurations of the arm, with the position and the rotation of the tool tip in each.

    Configurations [m, n] are shares of the joint ranges. Positions are [m, 3], rotations [m, 9].
    """
    shares = _halton(CANDIDATES, len(arm.actuated))
    poses = arm.forward_kinematics(arm.lower + shares * (arm.upper - arm.lower))
    return shares, poses[:, :3, 3], poses[:, :3, :3].reshape(-1, 9)
