"""The problem that arms, objects and their contacts leave to be solved, and its solution."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.friction_cone import Cone, Forces, Springs, Stuck
from surgical_marl.physics.solver.constraint_rows import JointRows, Rows
from surgical_marl.physics.tree_utils import Listed


class Contact(NamedTuple):
    """A patch between bodies: what resists their relative acceleration."""

    cone: Cone
    first: Array
    """Number of its object, [], at whose centre of mass the twist is taken; that of no object if there is none."""
    second: Array
    """Number of the other object, []."""
    offset: Array
    """From the origin of the twist to the centre of mass of the other object, m, [3]."""
    arm: Array
    """Number of the arm that it is on, []."""
    origin: Array
    """Origin of the twist, in the world, m, [3]."""
    pulls: Array
    """The sign with which it moves with each of that arm's joints, [m]; 0 for joints that do not move it."""
    moving: Array
    """Velocity of what is at the world's origin by velocity of each of these joints, [m, 3]."""
    turning: Array
    """Angular velocity likewise, [m, 3]."""

    def by_joints(self, motion: Array) -> Array:
        """Return the twist [6] by a motion of the arm's joints [m]."""
        own = self.pulls * motion
        spin = own @ self.turning
        return jnp.concatenate([own @ self.moving + jnp.cross(spin, self.origin), spin])

    @property
    def jacobian(self) -> Array:
        """Twist by velocity of the arm's joints, [6, m]."""
        moving = self.moving + jnp.cross(self.turning, self.origin)
        return (self.pulls[:, None] * jnp.concatenate([moving, self.turning], -1)).T


class Contacts(NamedTuple):
    """Contacts, [s]."""

    second: Array
    """Number of the other object, [s]."""
    springs: Springs
    """[s]"""
    stuck: Stuck
    """Without acceleration, [s]."""
    felt: Forces
    """Without acceleration, [s]."""
    pressing: Listed
    """Contacts that press, without acceleration."""
    on_arm: Array
    """Arms that have contacts, [a] bool."""
    at: Callable[[Array], Contact]
    """Makes one of them by its number, wherever it is needed: that takes less time than to load it from memory."""


class AttachmentRows(NamedTuple):
    """Bilateral constraints between a body and a link of an arm each: w linear springs in six directions."""

    body: np.ndarray
    """Number of the body, [w]."""
    arm: np.ndarray
    """Number of the arm, [w]."""
    active: Array
    """[w] bool"""
    jacobian: Array
    """Twist of the body relative to the link, at the body's centre of mass, by velocity of the arm's joints,
    [w, 6, m]."""
    wrench: Array
    """Force and torque on the body without any acceleration, N and N m, [w, 6]."""
    stiffness: Array
    """Force and torque fall by this per relative acceleration, kg and kg m2, [6, 6]."""

    def relative(self, n: int, point: Point) -> Array:
        """Return the acceleration [6] of a body relative to the link that it is attached to."""
        return point.objects[self.body[n]] + self.jacobian[n] @ point.arms[self.arm[n]]

    def growth(self, direction: Point) -> Array:
        """Return how much the slope of the cost of all active attachments grows per length of a direction, []."""
        total = jnp.float32(0.0)
        for n in range(len(self.body)):
            by = self.relative(n, direction)
            total += jnp.where(self.active[n], by @ self.stiffness @ by, 0.0)
        return total

    def slope(self, here: Point, direction: Point) -> Array:
        """Return the slope of their cost along a direction at a point, []."""
        total = jnp.float32(0.0)
        for n in range(len(self.body)):
            felt = self.wrench[n] - self.stiffness @ self.relative(n, here)
            total -= jnp.where(self.active[n], felt @ self.relative(n, direction), 0.0)
        return total


class Problem(NamedTuple):
    """The equations of a arms with m joints each at most, k objects and s contacts."""

    mass: Array
    """Mass matrices of the arms with the implicit parts of other forces, lower halves, [a, m (m + 1) / 2]."""
    smooth: Array
    """Sums of all other forces on the arms, [a, m]."""
    joints: JointRows
    """Friction and limits of joints, [a, m]."""
    start: Array
    """Accelerations at which friction of joints is what it was at the end of the step before, [a, m]."""
    between: Rows
    """Contacts of arms with arms; their Jacobian is [r, a, m]."""
    overlap: Array
    """True if any arms overlap, []: if not, there is nothing in `between`."""
    masses: Array
    """Mass matrices of the objects, [k, 6, 6]."""
    free: Array
    """Accelerations of the objects without contacts, [k, 6]."""
    contacts: Contacts
    total: Array
    """Number of contacts, []; no more than there is room for."""
    attachments: AttachmentRows | None = None
    """None in a scene without any."""


def no_arms() -> tuple[Array, Array, JointRows, Array, Rows, Array]:
    """Return the first fields of a `Problem` without arms."""
    none, rows = jnp.zeros((0, 0)), Rows(jnp.zeros((0, 0, 0)), *[jnp.zeros(0)] * 4)
    return none, none, JointRows(*[none] * len(JointRows._fields)), none, rows, jnp.bool_(False)


class Pressed(NamedTuple):
    """The forces of contacts, [s]."""

    normal: Array
    """Normal force of all points together, N, [s]."""
    friction: Array
    """N, [s, 3]."""
    slips: Array
    """Contacts whose friction is at its bound, [s] bool."""

    @classmethod
    def of(cls, felt: Forces) -> Pressed:
        """Return what is kept of the forces of one contact."""
        return cls(jnp.sum(felt.normal), felt.friction, felt.slips)


class Solution(NamedTuple):
    """Accelerations of arms [a, m] and objects [k, 6], forces of contacts and of arms on arms."""

    arms: Array
    objects: Array
    pressed: Pressed
    between: Array


class Point(NamedTuple):
    """Accelerations of arms [a, m] and objects [k, 6], or directions between two such points."""

    arms: Array
    objects: Array

    def ahead(self, direction: Point, length: Array) -> Point:
        """Return the point at a length of a direction from here."""
        return Point(self.arms + length * direction.arms, self.objects + length * direction.objects)
