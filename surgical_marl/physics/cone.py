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

_FIRST, _SECOND = np.tril_indices(6)


class Cone(NamedTuple):
    """The contact of two bodies at s points.

    A twist is the velocity [3] of one body relative to the other at an origin, and the relative angular velocity [3].
    """

    normal: Array
    """Speed along the normal of each point by twist, [s, 6]."""
    stiff: Array
    """Normal force per acceleration, [s]."""
    push: Array
    """Normal force without acceleration, N, [s]."""
    along: Array
    """Speed in two directions along the surface, and about the normal times the patch's radius, by twist, [3, 6]."""
    rub: Array
    """Friction per acceleration, []."""
    pull: Array
    """Friction without acceleration, N, [3]."""
    coefficient: Array
    """Friction coefficient, []."""


class Forces(NamedTuple):
    """The forces of a patch."""

    normal: Array
    """N, [s]."""
    friction: Array
    """N, [3]."""
    slips: Array
    """Whether friction is at its bound, [] bool."""
    way: Array
    """Unit vector of friction, [3]."""
    left: Array
    """Share of the friction that would stick, []."""


def forces(cone: Cone, twist: Array) -> Forces:
    """Return the forces at an acceleration of the two bodies [6]."""
    return nearest(cone, cone.push - cone.stiff * (cone.normal @ twist), cone.pull - cone.rub * (cone.along @ twist))


def nearest(cone: Cone, push: Array, pull: Array) -> Forces:
    """Return the forces in the cone that are nearest to those that stick: normal ones [s] and friction [3].

    Where friction slips it gives way by an unknown amount, and the normal forces grow with it. It is the root of a
    concave function, piecewise linear with a corner at each point: Newton's method from the far end never overshoots.
    """
    mu, rub, stiff = cone.coefficient, cone.rub, cone.stiff
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
    way = pull / size
    return Forces(jnp.maximum(raised, 0.0), left * way, amount > 0, way, left / size)


def wrench(cone: Cone, felt: Forces) -> Array:
    """Return the force on the first body and the torque about the origin, [6]."""
    return felt.normal @ cone.normal + felt.friction @ cone.along


def curvature(cone: Cone, felt: Forces) -> Array:
    """Return by how much the wrench falls per acceleration: the lower half of a matrix [6, 6], row by row, [21]."""
    pressed, rub, soft, ahead, across = _gives(cone, felt)
    rubs = felt.way @ cone.along
    turning = across * cone.along[:, _FIRST] * cone.along[:, _SECOND]
    raised = cone.coefficient * (pressed @ cone.normal)
    mixed = rub * rubs - raised / 2
    lower = (pressed[:, None] * cone.normal)[:, _FIRST] * cone.normal[:, _SECOND]
    lower = jnp.sum(lower, 0) + rub * (jnp.sum(turning, 0) + (ahead - across) * rubs[_FIRST] * rubs[_SECOND])
    lower += soft * (raised[_FIRST] * mixed[_SECOND] + raised[_SECOND] * mixed[_FIRST])
    return lower


def between(cone: Cone, other: Cone, felt: Forces) -> Array:
    """Return by how much the wrench falls per acceleration of another body, [6, 6].

    `other` is the cone with its twists at that body's origin. With that of the same body this is `curvature`, whole.
    """
    pressed, rub, soft, ahead, across = _gives(cone, felt)
    (rubs, raised), (its, its_raised) = (
        (felt.way @ own.along, own.coefficient * (pressed @ own.normal)) for own in (cone, other)
    )
    mixed, its_mixed = rub * rubs - raised / 2, rub * its - its_raised / 2
    whole = (pressed[:, None] * cone.normal).T @ other.normal
    whole += rub * (across * cone.along.T @ other.along + (ahead - across) * jnp.outer(rubs, its))
    return whole + soft * (jnp.outer(raised, its_mixed) + jnp.outer(mixed, its_raised))


def fall(cone: Cone, felt: Forces, normal: Array, along: Array) -> Array:
    """Return by how much the forces' power along a way falls per length of it, []: `curvature` on that way alone.

    Args:
        cone: the contact.
        felt: its forces.
        normal: acceleration along the normal of each point per length, [s].
        along: acceleration along the surface and about the normal, as in `Cone.along`, [3].
    """
    pressed, rub, soft, ahead, across = _gives(cone, felt)
    rubs, raised = felt.way @ along, cone.coefficient * (pressed @ normal)
    turning = across * jnp.sum(along * along) + (ahead - across) * rubs**2
    return jnp.sum(pressed * normal**2) + rub * turning + soft * raised * (2 * rub * rubs - raised)


def _gives(cone: Cone, felt: Forces) -> tuple[Array, Array, Array, Array, Array]:
    """Return by how much forces fall per acceleration.

    Those along the normals of points that press, [s]; friction that sticks, []; the amount by which friction that slips
    gives way per force, []; and the shares of friction that are left along its own direction and across it, [].
    """
    presses = felt.normal > 0
    pressed = jnp.where(presses, cone.stiff, 0.0)
    grown = cone.coefficient**2 * jnp.sum(pressed)
    soft = jnp.where(felt.slips, 1 / (cone.rub + grown), 0.0)
    ahead, across = jnp.where(felt.slips, grown * soft, 1.0), jnp.where(felt.slips, felt.left, 1.0)
    return pressed, jnp.where(presses.any(), cone.rub, 0.0), soft, ahead, across
