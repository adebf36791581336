"""What arms, objects and their contacts leave to be solved, and its solution."""

from __future__ import annotations

from typing import NamedTuple

from jax import Array

from surgical_marl.physics.cone import Cone
from surgical_marl.physics.solver import JointRows, Rows


class Contact(NamedTuple):
    """A patch between bodies: what resists their relative acceleration. Batches [s]."""

    cone: Cone
    first: Array
    """Number of its object, [], at whose centre of mass the twist is taken; that of no object if there is none."""
    second: Array
    """Number of the other object, []."""
    offset: Array
    """From the origin of the twist to the centre of mass of the other object, m, [3]."""
    arm: Array
    """Number of the arm that it is on, []."""
    jacobian: Array
    """Twist by velocity of that arm's joints, [6, m]."""


class Problem(NamedTuple):
    """What is to be solved: a arms with m joints each at most, k objects, s contacts."""

    mass: Array
    """Mass matrices of the arms with the implicit parts of other forces, lower halves, [a, m (m + 1) / 2]."""
    smooth: Array
    """Sums of all other forces on the arms, [a, m]."""
    joints: JointRows
    """Friction and limits of joints, [a, m]."""
    between: Rows
    """Contacts of arms with arms; their Jacobian is [r, a, m]."""
    overlap: Array
    """Whether any arms overlap, []: if not, there is nothing in `between`."""
    masses: Array
    """Mass matrices of the objects, [k, 6, 6]."""
    free: Array
    """Accelerations of the objects without contacts, [k, 6]."""
    contacts: Contact
    total: Array
    """How many contacts there are, []; no more than there is room for."""


class Pressed(NamedTuple):
    """The forces of contacts, [s]."""

    normal: Array
    """Of all points together, N, [s]."""
    friction: Array
    """N, [s, 3]."""
    sides: Array
    """Which points press, and whether friction slips: bits, [s]."""


SLIPS = 1 << 8
"""The bit of `Pressed.sides` for friction that slips."""


class Solution(NamedTuple):
    """Accelerations of arms [a, m] and objects [k, 6], forces of contacts and of arms on arms."""

    arms: Array
    objects: Array
    pressed: Pressed
    between: Array


class Point(NamedTuple):
    """Accelerations of arms [a, m] and objects [k, 6], or ways between two such points."""

    arms: Array
    objects: Array
