"""Joint position control: an action moves the position targets of the joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.control.action_term import ActionTerm, Joints, lead_limit, symmetric
from surgical_marl.robots.reach import Box
from surgical_marl.runtime import jnp

if TYPE_CHECKING:
    from jax import Array


class JointPosition(ActionTerm):
    """Move each position target at up to the speed of its joint in `arm.yaml`, within the joint's limits.

    A target leads its joint by no more than `lead_limit`.
    """

    @property
    def bounds(self) -> Box:
        """Return the speeds of the targets, [size] each, rad/s or m/s."""
        return symmetric(self.arm.speed[self.joints])

    def to_commands(self, action: Array, arms: Mapping[str, Joints]) -> Array:
        """Return the next position targets, [size]."""
        arm, most = self.arm, lead_limit(self.arm)[self.joints]
        now, last = (part[self.joints] for part in arms[self.agent])
        step = arm.speed[self.joints].astype(np.float32) * np.float32(self.dt)
        low, high = (end[self.joints].astype(np.float32) for end in (arm.lower, arm.upper))
        return jnp.clip(now + jnp.clip(last + action * step - now, -most, most), low, high)

    def action_of(self, change: np.ndarray, arms: Mapping[str, Joints]) -> np.ndarray:
        """Return the numbers that move the targets by `change` in a step, [N, size]."""
        return np.asarray(change[:, self.joints] / (self.dt * self.arm.speed[self.joints]))
