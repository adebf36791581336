"""Free rigid bodies: the state of objects, the forces on them without contacts, and how they move."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

REPETITIONS = 3
"""Fixed-point iterations for the angular velocity after a step without contacts. A needle of 25 rad/s then keeps its
angular momentum to 0.1 % for a second, one of 150 rad/s to 3 %."""


MOST_TURN = 1.0
"""Largest rotation of a body in a step, rad; a faster body is slowed. Contacts are those of the start of the step, and
mean nothing after half a turn."""


class Bodies(NamedTuple):
    """The state of k free objects, in the world."""

    position: Array
    """Centres of mass, m, [k, 3]."""
    quaternion: Array
    """Orientation of the objects' frames, w, x, y, z, [k, 4]."""
    velocity: Array
    """Velocity of the centres of mass, m/s, then angular velocity, rad/s, both by the world's axes, [k, 6]."""
    acceleration: Array
    """Found by the last step, where the solver begins, [k, 6]."""


class Masses(NamedTuple):
    """Mass and inertia of k objects."""

    mass: Array
    """kg, [k]."""
    inertia: Array
    """About the centre of mass, by the axes of the object's frame, kg m2, [k, 3, 3]."""


def rotation(quaternion: Array) -> Array:
    """Return the rotation matrices [..., 3, 3] of unit quaternions [..., 4]."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def point_jacobian(offset: Array) -> Array:
    """Return the matrix [3, 6] from the velocity of a body to that of a point of it at an offset, m, [3]."""
    x, y, z = offset
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, z, -y]), jnp.stack([-z, zero, x]), jnp.stack([y, -x, zero])])
    return jnp.concatenate([jnp.eye(3), cross], 1)


def product(one: Array, other: Array) -> Array:
    """Return the product of quaternions [..., 4]: first `other`, then `one`."""
    a, u, b, v = one[..., :1], one[..., 1:], other[..., :1], other[..., 1:]
    real = a * b - jnp.sum(u * v, -1, keepdims=True)
    return jnp.concatenate([real, a * v + b * u + jnp.cross(u, v)], -1)


def conjugate(quaternion: Array) -> Array:
    """Return the inverse of unit quaternions [..., 4]."""
    return quaternion * jnp.array([1.0, -1.0, -1.0, -1.0], jnp.float32)


def turn(angle: Array) -> Array:
    """Return the quaternion [..., 4] of a rotation vector [..., 3], rad."""
    square = jnp.sum(angle * angle, -1, keepdims=True) / 4
    half = jnp.sqrt(square)
    small = square < 1e-4
    share = jnp.where(small, 0.5 - square / 12, 0.5 * jnp.sin(half) / jnp.where(small, 1.0, half))
    return jnp.concatenate([jnp.cos(half), share * angle], -1)


def turned(angle: Array, quaternion: Array) -> Array:
    """Return orientations [..., 4] after rotation vectors [..., 3] by the world's axes, as unit quaternions."""
    moved = product(turn(angle), quaternion)
    return moved / jnp.sqrt(jnp.sum(moved * moved, -1, keepdims=True))


def carried(quaternion: Array, place: Array) -> Array:
    """Return the displacement [..., 3] of points that rotations [..., 4] about the origin brought to `place` [..., 3].

    This is place - R.T @ place, without the cancellation that small rotations would suffer.
    """
    real, axis = quaternion[..., :1], quaternion[..., 1:]
    return 2 * jnp.cross(axis, real * place - jnp.cross(axis, place))


def inertias(masses: Masses, frame: Array) -> Array:
    """Return the mass matrix [6, 6] of one object by the world's axes, from its frame [3, 3]."""
    none = jnp.zeros((3, 3))
    return jnp.block([[masses.mass * jnp.eye(3), none], [none, frame @ masses.inertia @ frame.T]])


def free_acceleration(body: Bodies, masses: Masses, frame: Array, gravity: Array, dt: Any) -> Array:
    """Return the acceleration [6] of one object that touches nothing, from its frame [3, 3].

    Objects keep their angular momentum: the velocity at the end of the step is that with which the momentum is the same
    in the orientation to which it turns. It is found by repetition, and gains no energy. Torques from the start of the
    step alone would gain energy in every step.
    """
    spin = body.velocity[3:]
    momentum = frame @ (masses.inertia @ (frame.T @ spin))

    def again(_: Any, after: Array) -> Array:
        turns = rotation(turn(dt * after)) @ frame
        return turns @ _solve3(masses.inertia, turns.T @ momentum)

    after = jax.lax.fori_loop(0, REPETITIONS, again, spin)
    local = (rotation(turn(dt * after)) @ frame).T @ after
    energy, before = jnp.sum(local * (masses.inertia @ local)), jnp.sum(spin * momentum)
    after *= jnp.sqrt(jnp.minimum(before / jnp.maximum(energy, 1e-30), 1.0))
    return jnp.concatenate([gravity, (after - spin) / dt])


def moved(body: Bodies, acceleration: Array, dt: Any) -> Bodies:
    """Return one body after a step with an acceleration [6]."""
    velocity = body.velocity + dt * acceleration
    spin = jnp.sqrt(jnp.sum(velocity[3:] ** 2))
    slowed = velocity[3:] * jnp.minimum(1.0, MOST_TURN / (dt * jnp.maximum(spin, 1e-9)))
    velocity = jnp.concatenate([velocity[:3], slowed])
    return Bodies(body.position + dt * velocity[:3], turned(dt * velocity[3:], body.quaternion), velocity, acceleration)


def _solve3(matrix: Array, right: Array) -> Array:
    """Return x with matrix @ x = right, [3], by Cramer's rule."""
    a, b, c = matrix.T
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
    return rows @ right / (a @ rows[0])
