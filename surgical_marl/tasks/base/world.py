"""The input of a task's functions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.physics.outputs import ArmView, ObjectView


class World(NamedTuple):
    """The input of a task's functions: one environment after a step."""

    arms: Mapping[str, ArmView]
    """The view of each agent's arm."""
    goal: Any
    sensed: Mapping[str, Array] = {}
    """The numbers that `Task.sense` computed from the pictures, by the names in `Task.senses`."""
    objects: Mapping[str, ObjectView] = {}
    """The view of each free object of the scene."""
    systems: Mapping[str, Any] = {}
    """The view of each system of a plug-in in the scene."""
    messages: Array | tuple[()] = ()
    """Message of each arm in the last step, [arms, K]; () without messages, and where rewards are computed."""
    changes: Mapping[str, Array] = {}
    """Each agent's action less its last one, [n], without messages; only where rewards are computed."""
