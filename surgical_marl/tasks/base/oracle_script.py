"""Scripts of the oracle: how arms do a task with objects step by step, which shows that it can be done.

A task that has one returns its steps from `Task.script`. They read what the simulation knows, and are computed on the
host for many environments at once. `surgical_marl/policies/scripted.py` moves the arms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

EARLY = -0.06
"""Time at which a jaw begins to close, as a step's `wait`, s: its tool is then 1 to 3 mm from the end of its way.

If it closed at the end, an actor that imitates the script would stop a little before that, with an open jaw.
"""


class Snapshot(NamedTuple):
    """n environments as they are now, in the world; SI units."""

    tools: Mapping[str, np.ndarray]
    """Pose of each agent's tool tip, [n, 4, 4]."""
    objects: Mapping[str, np.ndarray]
    """Pose of each free object, [n, 4, 4]."""
    held: Mapping[str, np.ndarray]
    """True for the free objects that each agent holds, [n, k] bool."""
    goal: Any
    """Fields of the goal, [n, ...] each."""
    qpos: Mapping[str, np.ndarray]
    """Positions of each agent's joints, [n, joints]."""


class Wish(NamedTuple):
    """Command to an agent in n environments."""

    tool: np.ndarray | None = None
    """Target pose of its tool tip, world, [n, 4, 4]; None to stay where it was sent last."""
    opens: float = 0.0
    """Opening of the jaw, as a share of its way; at 0 it closes, and then presses."""
    joints: np.ndarray | None = None
    """Target positions of its joints instead, [n, joints]."""
    from_home: bool = False
    """True if inverse kinematics starts from home, and not from where the joints were sent last."""


class Step(NamedTuple):
    """A step of a script: all agents go where they should and wait there."""

    plan: Callable[[Snapshot], Mapping[str, Wish]]
    """Return the wish of each agent. Agents that are not named stay, with the jaw as it is."""
    wait: float = 0.0
    """Time after all agents have arrived, s. Below 0 the next step begins while they are still on their way."""
    pace: float = 1.0
    """Speed, as a share of the joints' own."""
    good: Callable[[Snapshot], np.ndarray] | None = None
    """Return whether the step was successful, [n] bool; where not, the script goes on with the step `back`."""
    back: int | Callable[[Snapshot], np.ndarray] = 0
    """Number of a step, or a function that returns one for each environment, [n]."""
