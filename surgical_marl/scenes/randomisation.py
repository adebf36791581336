"""How much the arms of a scene may differ from their models and from what they measure: `randomisation` in its YAML."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from surgical_marl.untrusted.values import shown
from surgical_marl.yaml_file import build

SHARES = "stiffness", "damping", "friction", "object_size", "object_mass", "object_friction"
"""Ranges that are shares of a value."""


@dataclass(frozen=True)
class Randomisation:
    """Ranges of what is randomised, all zero unless given.

    All values except noise are drawn once per episode, uniformly, and separately for every joint, arm or object. Jaws
    get only other gains and friction. docs/randomisation.md has the sources of sensible values.
    """

    offset_angle: float = 0.0
    """A joint's reading is off by up to this, rad; `offset_slide`, m, for prismatic joints."""
    offset_slide: float = 0.0
    backlash_angle: float = 0.0
    """Greatest play between a joint and its motor, which has the encoder, rad. Only under position control."""
    backlash_slide: float = 0.0
    noise_angle: float = 0.0
    """Standard deviation of a reading at each step, rad."""
    noise_slide: float = 0.0
    stiffness: float = 0.0
    """Gains of the controllers are off by up to this share of their value."""
    damping: float = 0.0
    friction: float = 0.0
    """Viscous and Coulomb friction are off by up to this share of their value."""
    payload: float = 0.0
    """Greatest mass at the tool tip, kg."""
    latency: int = 0
    """Greatest number of control steps until an action acts."""
    object_shift: float = 0.0
    """Free objects begin up to this far from their place, m, along the world's x and y each."""
    object_turn: float = 0.0
    """They begin turned about the vertical by up to this, rad."""
    object_size: float = 0.0
    """All their lengths are off by up to this share. Mass grows with their cube, unless `object_mass` is given."""
    object_mass: float = 0.0
    """Their masses are off by up to this share of their value, whatever their size."""
    object_friction: float = 0.0
    """Their coefficients of friction likewise."""

    def __bool__(self) -> bool:
        return any(getattr(self, item.name) for item in fields(self))


def read_randomisation(settings: Any, path: Path) -> Randomisation:
    """Return the ranges in a scene file.

    Raises ValueError for an unknown key or a value out of range.
    """
    where = f"{path}, randomisation"
    found: Randomisation = build(Randomisation, {} if settings is None else settings, where)
    late = found.latency
    if isinstance(late, bool) or not isinstance(late, int) or not 0 <= late <= 50:
        raise ValueError(f"{where}: latency must be a whole number of control steps from 0 to 50, not {shown(late)}")
    for item in fields(found):
        value, relative = getattr(found, item.name), item.name in SHARES
        if value < 0 or (relative and value >= 1):
            good = "from 0 to less than 1" if relative else "0 or more"
            raise ValueError(f"{where}: {item.name} must be {good}, not {value:g}")
    return found
