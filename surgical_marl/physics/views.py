"""Outputs of the physics: contacts, and a view of each arm."""

from __future__ import annotations

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


class Touch(NamedTuple):
    """The hardest touch of each pair so far in a control step, [P] each.

    A physics step in which nothing touches does not change it.
    """

    penetration: Array
    """m"""
    force: Array
    """N"""


class ArmView(NamedTuple):
    """The newest state of one arm, as tasks see it. Base frame; SI units."""

    qpos: Array
    """Positions of the actuated joints, [n]."""
    qvel: Array
    command: Array
    """Position targets (or the last velocity or torque command), [n]."""
    tool_tip: Array
    """[3]"""
    nearest_tip: Array
    """From this tool tip to that of the nearest other arm, [3]; zero if there is none."""
    min_distance: Array
    """Least distance to any other arm, []; inf if there is none."""
    collision: Array
    """Whether it touched another arm or itself during the step, []."""
    contact_force: Array
    """The largest normal force on it during the step, N, []."""
