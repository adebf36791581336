"""A control of another package: an action is how deep the tool should be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from surgical_marl.control.action_term import ActionTerm, Joints
from surgical_marl.robots.reach import Box


class Depth(ActionTerm):
    """Command where the joint that slides is within its limits; the other joints stay."""

    @property
    def bounds(self) -> Box:
        """Return the limits of the joint that slides, m, [1] each."""
        slides = [joint.slides for joint in self.arm.actuated]
        return Box(self.arm.lower[slides], self.arm.upper[slides])

    def to_commands(self, action: Any, arms: Mapping[str, Joints]) -> Any:
        """Return the position targets of all joints but the jaw, [k]."""
        slides = np.array([self.arm.actuated[joint].slides for joint in self.joints])
        low, high = self.bounds
        return arms[self.agent].command[self.joints].at[slides].set(low + (action + 1) / 2 * (high - low))
