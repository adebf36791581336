"""Costs of a step for safe learning, beside its reward: which safety limits an arm breaks.

As in Safety Gymnasium (Ji et al., "Safety-Gymnasium: a unified safe reinforcement learning benchmark", 2023) each cost
is 0 or 1, and their sum is what a constraint bounds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.runtime import jnp

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.physics.outputs import ArmView
    from surgical_marl.robots.arm import Arm

NEAR = 0.005
"""Least distance between arms, m: half the clearance of targets (`workspace.CLEARANCE`), and the way that a tool at
0.25 m/s moves in a control step."""
FORCE = 1.0
"""Greatest contact force but for a grip, N. It is our own choice: more than that of a graze, which `collision` reports
anyway, and less than that of an arm that pushes."""
LIMIT = 0.01
"""A joint that is this near to a limit, as a share of its range, is at the limit."""
SPEED = 0.2
"""Greatest speed of a tip, m/s: that of the PSM's insertion, and ten times a target's speed."""


def costs(arm: Arm, view: ArmView, tip_speed: Array) -> dict[str, Array]:
    """Return which limits an arm breaks, [] bool each.

    Args:
        arm: the arm.
        view: the arm's state after the step.
        tip_speed: mean speed of its tool tip during the control step, m/s.

    Returns:
        `distance` to another arm, contact `force` (except that of a grip), a joint's `limit` (except the jaw's, because
        a closed jaw rests there), tip `speed`.
    """
    moves = ~arm.moves_jaw
    edge = LIMIT * (arm.upper - arm.lower)
    low, high = ((arm.lower + edge)[moves].astype(np.float32), (arm.upper - edge)[moves].astype(np.float32))
    q = view.qpos[np.flatnonzero(moves)]
    return {
        "distance": view.min_distance < NEAR,
        "force": view.bump_force > FORCE,
        "limit": jnp.any((q < low) | (q > high)),
        "speed": tip_speed > SPEED,
    }
