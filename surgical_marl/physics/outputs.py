"""Outputs of the physics: contacts, and a view of each arm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from jax import Array


class Contacts(NamedTuple):
    """The pairs of geoms that can touch, in the order of `Scene.pairs`, [P] each."""

    distance: Array
    """Signed distance in the newest state, m."""
    penetration: Array
    """The deepest overlap during the control step, m; 0 without any."""
    force: Array
    """The largest normal force during the control step, N."""
    overflow: Array
    """Largest number of overlapping pairs in one physics step beyond the contacts that are computed, []."""


class Touch(NamedTuple):
    """The hardest touch of each pair so far in a control step, [P] each.

    A physics step in which nothing touches does not change it.
    """

    penetration: Array
    """m"""
    force: Array
    """N"""
    handled: Array
    """The largest force of an object or of a fixed thing on each arm, N, and the largest one that is not a finger's on
    a free object, [2, a]; [2, 0] in a scene without objects."""
    overflow: Array
    """The same as in `Contacts`, []."""


class Handled(NamedTuple):
    """The grip of an arm on one object."""

    force: Array
    """Normal forces of its fingers on the object at the end of the step, together, N, []."""
    holding: Array
    """True if it has held the object for a while: both fingers press from opposite sides, []."""
    slip: Array
    """Distance that the object has slid along its fingers since they touched it, m, []."""


class ObjectView(NamedTuple):
    """The newest state of a free object, in the world; SI units."""

    position: Array
    """Origin of its frame, [3]."""
    rotation: Array
    """Axes of its frame, [3, 3]."""
    velocity: Array
    """Velocity of the centre of mass, then angular velocity, [6]."""
    size: Array | float = 1.0
    """Factor of all its lengths, []; 1 unless the scene randomises sizes. Sites are at this times their
    places in the object's file."""


class ArmView(NamedTuple):
    """The newest state of one arm, as tasks see it. Base frame; SI units."""

    qpos: Array
    """Positions of the actuated joints, [n]."""
    qvel: Array
    command: Array
    """Position targets (or the last velocity or torque command), [n]."""
    tool_tip: Array
    """[3]"""
    tool_axes: Array
    """Axes of the tool's frame, columns, [3, 3]: a jaw closes along y and points along z."""
    nearest_tip: Array
    """From this tool tip to that of the nearest other arm, [3]; zero if there is none."""
    min_distance: Array
    """Least distance to any other arm, []; inf if there is none."""
    collision: Array
    """True if it touched another arm or itself during the step, []."""
    contact_force: Array
    """The largest normal force on it during the step, N, []."""
    bump_force: Array
    """The same without forces of its fingers on free objects: a grip is no bump."""
    contact_overflow: Array
    """`Contacts.overflow` of the whole scene."""
    handles: Mapping[str, Handled] = {}
    """Its grip on each free object of the scene."""
