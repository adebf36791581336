"""What moves each arm of a scene but for contacts, and how it moves if it touches nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.solver.cholesky import packed
from surgical_marl.physics.solver.constraint_rows import JointRows, relax, rows_of, solve, solve_positive
from surgical_marl.physics.systems.dynamics import ITERATIONS


class ArmForces(NamedTuple):
    """What moves a arms with m joints each, [a, ...]; or one of them."""

    mass: Array
    """Mass matrices, m (m + 1) / 2 elements of the lower half, [a, ...]."""
    implicit: Array
    """Mass matrices with the parts of other forces that a step takes implicitly, likewise."""
    smooth: Array
    """Sums of all forces except constraint forces, [a, m]."""
    joints: JointRows
    """Friction and limits, [a, m]."""
    start: Array
    """Accelerations to begin with, those of the step before, [a, m]."""


def padded(kinds: Sequence[ArmForces], numbers: Sequence[np.ndarray], there: np.ndarray) -> ArmForces:
    """Return what moves all arms.

    Args:
        kinds: what moves the arms of each type.
        numbers: which of all arms these are, [n] for each type.
        there: which joints each arm has, [a, m]. For others nothing pushes joints with a mass of 1.
    """
    if len(kinds) == 1:
        return kinds[0]
    a, m = there.shape
    lower, none = np.zeros((a, m * (m + 1) // 2), np.float32), jnp.zeros((a, m))
    lower[:, np.diag(packed(m))] = ~there
    mass = jnp.asarray(lower)
    all_ = ArmForces(mass, mass, none, JointRows(*[none] * len(JointRows._fields)), none)
    for own, arms in zip(kinds, numbers, strict=True):
        all_ = jax.tree.map(lambda x, its, arms=arms: x.at[arms, : its.shape[1]].set(its), all_, own)
    return all_


def relaxed(arms: ArmForces) -> Array:
    """Return accelerations [a, m] from where these begin, relaxed with regard to friction and limits."""
    found: Array = jax.lax.map(_relaxed, arms)
    return found


def apart(arms: ArmForces) -> tuple[Array, Array]:
    """Return the accelerations of arms that touch nothing, and those with what is implicit, [a, m] each."""

    def one(arm: ArmForces) -> tuple[Array, Array]:
        qacc, _ = solve(_whole(arm.mass), arm.smooth, rows_of(arm.joints), _relaxed(arm), *ITERATIONS)
        return qacc, _changed(arm, qacc)

    found: tuple[Array, Array] = jax.lax.map(one, arms)
    return found


def changes(arms: ArmForces, qacc: Array) -> Array:
    """Return accelerations [a, m] with what is implicit, from those without: see `Dynamics.step`."""
    found: Array = jax.lax.map(lambda row: _changed(*row), (arms, qacc))
    return found


def _relaxed(arm: ArmForces) -> Array:
    return relax(_whole(arm.mass), arm.smooth, arm.joints, arm.start)


def _changed(arm: ArmForces, qacc: Array) -> Array:
    return solve_positive(_whole(arm.implicit), _whole(arm.mass) @ qacc)


def _whole(lower: Any) -> Array:
    """Return a symmetric matrix from its lower half."""
    m = round((np.sqrt(8 * len(lower) + 1) - 1) / 2)
    found: Array = lower[packed(m)]
    return found
