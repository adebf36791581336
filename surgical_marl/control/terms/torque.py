"""Joint torque control: an action is the torques of the joints, or the forces of those that slide."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from surgical_marl.control.action_term import ActionTerm, Joints, symmetric
from surgical_marl.robots.reach import Box

if TYPE_CHECKING:
    from jax import Array


class JointTorque(ActionTerm):
    """Command each joint's torque, up to its effort in the URDF."""

    actuators: ClassVar[Literal["position", "velocity", "torque"]] = "torque"

    @property
    def bounds(self) -> Box:
        """Return the torques, [size] each, N m or N."""
        return symmetric(np.array([self.arm.actuated[joint].effort for joint in self.joints]))

    def to_commands(self, action: Array, arms: Mapping[str, Joints]) -> Array:
        """Return the torques, [size]."""
        return action * self.bounds.high.astype(np.float32)
