"""Commands of actions, for tests of the physics alone."""

from collections.abc import Callable
from typing import Any

from surgical_marl.control.controller import Controller
from surgical_marl.physics.simulator import Simulator


def commander(simulator: Simulator) -> Callable[..., Any]:
    """Return a function: a physical state and actions -> the state with the next commands."""
    scene = simulator.scene
    return Controller(scene, scene.control, dt=simulator.control_dt).apply
