"""Costs of a step for safe learning, beside its reward: which limits of a careful surgeon an arm breaks.

As in Safety Gymnasium (Ji et al., "Safety-Gymnasium: a unified safe reinforcement learning benchmark", 2023) each cost
is 0 or 1, and their sum is what a constraint bounds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.runtime import jnp

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.physics.views import ArmView
    from surgical_marl.robots.arm import Arm

NEAR = 0.005
"""Arms nearer than this, m, are too near: half of what targets leave between them (`workspace.CLEARANCE`), and as far
as a tool at 0.25 m/s moves in a control step."""
FORCE = 1.0
"""A harder touch, N, is too hard. Our own choice: between a graze, which is in `collision` anyway, and what an arm that
pushes reaches."""
LIMIT = 0.01
"""A joint this near to a limit, as a share of its range, is at it: as far as limits give."""
SPEED = 0.2
"""A faster tip, m/s, is too fast: as fast as the PSM's instrument slides, ten times a target's speed."""


def costs(arm: Arm, view: ArmView, tip_speed: Array) -> dict[str, Array]:
    """Which limits an arm breaks, [] bool each.

    Args:
        arm: the arm.
        view: what is seen of it.
        tip_speed: mean speed of its tool tip during the control step, m/s.

    Returns:
        `distance` to another arm, contact `force`, a joint's `limit` (the jaw's aside: a closed one rests there), tip
        `speed`.
    """
    moves = np.array([arm.jaw is None or joint.name != arm.jaw.joint for joint in arm.actuated])
    edge = LIMIT * (arm.upper - arm.lower)
    low, high = ((arm.lower + edge)[moves].astype(np.float32), (arm.upper - edge)[moves].astype(np.float32))
    q = view.qpos[np.flatnonzero(moves)]
    return {
        "distance": view.min_distance < NEAR,
        "force": view.contact_force > FORCE,
        "limit": jnp.any((q < low) | (q > high)),
        "speed": tip_speed > SPEED,
    }
