"""The forces of a patch with Coulomb friction, as functions of how fast its two bodies part: gradient and curvature.

A contact is a stiff spring along its normal, and friction a stiff spring or damper that slips when its force reaches
the friction coefficient times the normal force. All forces are those at the end of the step: an implicit step can not
overshoot, however light an object is. They are the gradient of a convex function of the acceleration: the forces of a
patch are the nearest ones in its friction cone to those that would stick. docs/physics.md says more.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.tree_utils import when

_FIRST, _SECOND = np.tril_indices(6)


class Springs(NamedTuple):
    """Resistance of a patch of s points to relative acceleration, at the end of the step."""

    stiff: Array
    """Normal force of each point falls by this per acceleration apart, kg, [s]."""
    rub: Array
    """Friction that sticks falls by this per acceleration along the surface, kg, []."""
    coefficient: Array
    """Friction coefficient, []."""


class Cone(NamedTuple):
    """The contact of two bodies at s points.

    A twist is the velocity [3] of one body relative to the other at an origin, and the relative angular velocity [3].
    """

    normal: Array
    """Speed along the normal of each point by twist, [s, 6]."""
    along: Array
    """Rows of friction, by twist, [3, 6]: two speeds along the surface, and the spin about the normal times the
    patch's radius."""
    springs: Springs


class Parting(NamedTuple):
    """Relative acceleration of the two bodies at a patch."""

    normal: Array
    """Along the normal of each point, [s]."""
    along: Array
    """Along the rows of `Cone.along`, [3]."""


class Stuck(NamedTuple):
    """The forces that a patch would have without its bounds: the trial forces, before projection on the cone."""

    push: Array
    """Along the normal of each point, N, [s]; negative where the spring would pull."""
    pull: Array
    """Friction, N, [3]."""


class Forces(NamedTuple):
    """The forces of a patch."""

    normal: Array
    """N, [s]."""
    friction: Array
    """N, [3]."""
    slips: Array
    """True if friction is at its bound, []."""
    direction: Array
    """Unit vector of friction, [3]."""
    left: Array
    """Friction as a share of the trial friction, []."""


def parting(cone: Cone, twist: Array) -> Parting:
    """Return the relative acceleration at a patch, of two bodies that accelerate by a twist [6]."""
    return Parting(cone.normal @ twist, cone.along @ twist)


def stretched(springs: Springs, stuck: Stuck, by: Parting) -> Stuck:
    """Return the trial forces once the bodies accelerate by so much more."""
    return Stuck(stuck.push - springs.stiff * by.normal, stuck.pull - springs.rub * by.along)


def nearest(springs: Springs, stuck: Stuck) -> Forces:
    """Return the forces in the friction cone that are nearest to trial forces, in the metric of the springs.

    Where friction slips, its trial is reduced by `rub` times an unknown `amount`, and the normal forces grow by `mu
    stiff amount`. The amount is the root of a concave function, piecewise linear with a corner at each point: Newton's
    method from the far end never overshoots.
    """
    (stiff, rub, mu), (push, pull) = springs, stuck
    size = jnp.sqrt(jnp.sum(pull * pull))

    def step(_: Array, amount: Array) -> Array:
        raised = push + mu * stiff * amount
        presses = raised > 0
        excess = size - rub * amount - mu * jnp.sum(jnp.where(presses, raised, 0.0))
        slope = rub + mu**2 * jnp.sum(jnp.where(presses, stiff, 0.0))
        return jnp.maximum(amount + excess / slope, 0.0)

    amount = jax.lax.fori_loop(0, len(stiff), step, size / rub)
    raised = push + mu * stiff * amount
    left = jnp.where((raised > 0).any(), jnp.maximum(size - rub * amount, 0.0), 0.0)
    size = jnp.maximum(size, 1e-20)
    direction = pull / size
    return Forces(jnp.maximum(raised, 0.0), left * direction, amount > 0, direction, left / size)


def presses(felt: Forces) -> Array:
    """Return whether a patch presses at any point, [] bool."""
    return (felt.normal > 0).any()


def wrench(cone: Cone, felt: Forces) -> Array:
    """Return the force on the first body and the torque about the origin, [6]."""
    return felt.normal @ cone.normal + felt.friction @ cone.along


def curvature(cone: Cone, felt: Forces) -> Array:
    """Return the Hessian of a contact's cost, by which the wrench falls per twist: lower half, row by row, [21]."""
    pressed, rub, soft, ahead, across = _gives(cone.springs, felt)
    lower = jnp.sum((pressed[:, None] * cone.normal)[:, _FIRST] * cone.normal[:, _SECOND], 0)
    lower += rub * across * jnp.sum(cone.along[:, _FIRST] * cone.along[:, _SECOND], 0)

    def slipping(lower: Array) -> Array:
        rubs, raised = felt.direction @ cone.along, cone.springs.coefficient * (pressed @ cone.normal)
        mixed = rub * rubs - raised / 2
        lower += rub * (ahead - across) * rubs[_FIRST] * rubs[_SECOND]
        return lower + soft * (raised[_FIRST] * mixed[_SECOND] + raised[_SECOND] * mixed[_FIRST])

    return when(felt.slips, slipping, lower)


def between(cone: Cone, other: Cone, felt: Forces) -> Array:
    """Return by how much the wrench falls per acceleration of another body, [6, 6].

    `other` is the cone with its twists at that body's origin. With that of the same body this is `curvature`, whole.
    """
    pressed, rub, soft, ahead, across = _gives(cone.springs, felt)
    (rubs, raised), (its, its_raised) = (
        (felt.direction @ own.along, cone.springs.coefficient * (pressed @ own.normal)) for own in (cone, other)
    )
    mixed, its_mixed = rub * rubs - raised / 2, rub * its - its_raised / 2
    whole = (pressed[:, None] * cone.normal).T @ other.normal
    whole += rub * (across * cone.along.T @ other.along + (ahead - across) * jnp.outer(rubs, its))
    return whole + soft * (jnp.outer(raised, its_mixed) + jnp.outer(mixed, its_raised))


def falls(springs: Springs, felt: Forces, by: Parting) -> tuple[Array, Array]:
    """Return the directional derivative of forces, negated: by how much normal forces [s] and friction [3] fall.

    Args:
        springs: of the contact.
        felt: its forces.
        by: the direction, as relative acceleration.
    """
    pressed, rub, soft, ahead, across = _gives(springs, felt)
    rubs, raised = rub * (felt.direction @ by.along), springs.coefficient * (pressed @ by.normal)
    normal = pressed * (by.normal + springs.coefficient * soft * (rubs - raised))
    return normal, rub * across * by.along + ((ahead - across) * rubs + soft * rub * raised) * felt.direction


def _gives(springs: Springs, felt: Forces) -> tuple[Array, Array, Array, Array, Array]:
    """Return the elements of the forces' derivative by acceleration.

    In order: stiffness of points that press, [s]; `rub` of a patch that presses, []; the change of `amount` (see
    `nearest`) per force, 0 if nothing slips, []; and the shares of `rub` that are left along the friction's direction
    and across it, [] each.
    """
    presses = felt.normal > 0
    pressed = jnp.where(presses, springs.stiff, 0.0)
    grown = springs.coefficient**2 * jnp.sum(pressed)
    soft = jnp.where(felt.slips, 1 / (springs.rub + grown), 0.0)
    ahead, across = jnp.where(felt.slips, grown * soft, 1.0), jnp.where(felt.slips, felt.left, 1.0)
    return pressed, jnp.where(presses.any(), springs.rub, 0.0), soft, ahead, across
