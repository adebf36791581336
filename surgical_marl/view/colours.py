"""What pictures and the page in the browser agree on: colours of agents, of goals and of geoms."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float]
"""Red, green and blue as files give them, from 0 to 1."""

AGENTS: tuple[Colour, ...] = (
    (0.10, 0.66, 0.42),
    (0.97, 0.58, 0.08),
    (0.36, 0.42, 0.95),
    (0.90, 0.30, 0.62),
    (0.20, 0.70, 0.90),
)
"""Colours of the agents of a scene, in turn."""
TEAM: Colour = (0.99, 0.85, 0.15)
"""Colour of a goal that is no single agent's."""
GOAL_RADIUS = 0.004
"""Radius of a goal's ball in m, large enough to see a tip touch it."""
_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)


def goal_colour(number: int, goals: int, agents: int) -> Colour:
    """Return the colour of a goal: that of its agent, or `TEAM` if several agents have only one."""
    return TEAM if goals == 1 < agents else AGENTS[number % len(AGENTS)]


def visual_rgba(model: mujoco.MjModel) -> NDArray[np.float32]:
    """Return the colours of all geoms, [ngeom, 4]; a geom's own rgba overrides its material's, as in MuJoCo."""
    rgba: NDArray[np.float32] = model.geom_rgba.copy()
    painted = (model.geom_matid >= 0) & (rgba == _DEFAULT_RGBA).all(axis=1)
    rgba[painted] = model.mat_rgba[model.geom_matid[painted]]
    return rgba
