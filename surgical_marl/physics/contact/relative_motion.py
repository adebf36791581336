"""Relative motion of the two bodies of a contact, by motions of arms and objects."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.friction_cone import Cone
from surgical_marl.physics.solver.problem import Contact


class RelativeMotion:
    """Finds the twists of contacts in one scene with k objects. `dofs` [a, m] is as for `ContactSolver`."""

    def __init__(self, dofs: np.ndarray, objects: int) -> None:
        self._dofs, self._objects = dofs, objects

    def of(self, contact: Contact, arms: Array, objects: Array) -> Array:
        """Return the twist [6] of a contact by motions of arms (`by_arm`) and of objects (`by_object`)."""
        found = objects[contact.first]
        if self._objects > 1:
            found -= _moved_to(objects[contact.second], contact.offset)
        if not len(self._dofs):
            return found
        whole: Array = jax.lax.cond(
            contact.arm < len(self._dofs), lambda: found + contact.by_joints(arms[contact.arm]), lambda: found
        )
        return whole

    def by_arm(self, joints: Array) -> Array:
        """Return values of all joints [n] as rows of arms, [a, m]; 0 where an arm has fewer joints."""
        return jnp.append(joints, 0.0)[np.minimum(self._dofs, len(joints))]

    def by_object(self, each: Array) -> Array:
        """Return values of objects [k, ...] with a row of zeros for "no object", [k + 1, ...]."""
        return jnp.concatenate([each, jnp.zeros((1, *each.shape[1:]))])


def bends(columns: Array, places: Array) -> Array:
    """Return the acceleration of places on a link whose joints do not accelerate, m/s2, [n, 3].

    `columns` [6, m] are the twists that its joints, one after the other, give it about the origin of the places: each
    joint is moved by those before it (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 2.8).
    """
    moving, turning = columns[:3].T, columns[3:].T
    lift = spin = straight = curved = jnp.zeros(3)
    for move, turn_ in zip(moving, turning, strict=True):
        straight = straight + jnp.cross(spin, move) + jnp.cross(lift, turn_)
        curved = curved + jnp.cross(spin, turn_)
        lift, spin = lift + move, spin + turn_
    straight = straight + jnp.cross(spin, lift)
    return straight + jnp.cross(curved, places) + jnp.cross(spin, jnp.cross(spin, places))


def moved_cone(contact: Contact) -> Cone:
    """Return the cone for the second object: rows negated, and moved to that object's centre of mass.

    Rows are moved before they are squared: in float32 a curvature about one body's centre, moved to that of a small
    one, would be wrong by more than the small one's inertia.
    """
    shift, cone = _shift(contact.offset), contact.cone
    return cone._replace(normal=-cone.normal @ shift, along=-cone.along @ shift)


def _shift(offset: Array) -> Array:
    """Return the matrix [6, 6] of `_moved_to`."""
    return jax.vmap(lambda unit: _moved_to(unit, offset), out_axes=1)(jnp.eye(6))


def _moved_to(twist: Array, offset: Array) -> Array:
    """Return the twist [6] at a place from that of a body whose centre of mass is `offset` [3] away."""
    return jnp.concatenate([twist[:3] - jnp.cross(twist[3:], offset), twist[3:]])
