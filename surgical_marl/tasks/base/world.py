"""What the functions of a task are given."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.physics.views import ArmView


class World(NamedTuple):
    """What the functions of a task are given: one environment after a step."""

    arms: Mapping[str, ArmView]
    """What is seen of each agent's arm."""
    goal: Any
    sensed: Mapping[str, Array] = {}
    """What `Task.sense` made of the pictures, by the names in `Task.senses`."""
