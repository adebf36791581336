"""Joint velocity control: an action is the velocities of the joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from surgical_marl.control.action_term import ActionTerm, Joints, symmetric
from surgical_marl.robots.reach import Box

if TYPE_CHECKING:
    from jax import Array


class JointVelocity(ActionTerm):
    """Command each joint's velocity, up to its speed in `arm.yaml`."""

    actuators: ClassVar[Literal["position", "velocity", "torque"]] = "velocity"

    @property
    def bounds(self) -> Box:
        """Return the velocities, [size] each, rad/s or m/s."""
        return symmetric(self.arm.speed[self.joints])

    def to_commands(self, action: Array, arms: Mapping[str, Joints]) -> Array:
        """Return the velocities, [size]."""
        return action * self.bounds.high.astype(np.float32)
