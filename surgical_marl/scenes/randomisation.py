"""How much the arms of a scene may differ from their models and from what they measure: `randomisation` in its YAML."""

from __future__ import annotations

from dataclasses import dataclass, fields

from surgical_marl.untrusted.schema import number
from surgical_marl.untrusted.values import LARGEST

SHARE = 0.999
"""The largest share of a value by which it may be off."""


@dataclass(frozen=True)
class Randomisation:
    """Ranges of what is randomised, all zero unless given.

    All values except noise are drawn once per episode, uniformly, and separately for every joint, arm or object. Jaws
    get only other gains and friction. docs/randomisation.md has the sources of sensible values.
    """

    offset_angle: float = number(0.0, 0.0, LARGEST, unit="rad")
    """A joint's reading is off by up to this, rad; `offset_slide`, m, for prismatic joints."""
    offset_slide: float = number(0.0, 0.0, LARGEST, unit="m")
    backlash_angle: float = number(0.0, 0.0, LARGEST, unit="rad")
    """Greatest play between a joint and its motor, which has the encoder, rad. Only under position control."""
    backlash_slide: float = number(0.0, 0.0, LARGEST, unit="m")
    noise_angle: float = number(0.0, 0.0, LARGEST, unit="rad")
    """Standard deviation of a reading at each step, rad."""
    noise_slide: float = number(0.0, 0.0, LARGEST, unit="m")
    stiffness: float = number(0.0, 0.0, SHARE)
    """Gains of the controllers are off by up to this share of their value."""
    damping: float = number(0.0, 0.0, SHARE)
    friction: float = number(0.0, 0.0, SHARE)
    """Viscous and Coulomb friction are off by up to this share of their value."""
    payload: float = number(0.0, 0.0, LARGEST, unit="kg")
    """Greatest mass at the tool tip, kg."""
    latency: int = number(0, 0, 50, unit="control steps")
    """Greatest number of control steps until an action acts."""
    object_shift: float = number(0.0, 0.0, LARGEST, unit="m")
    """Free objects begin up to this far from their place, m, along the world's x and y each."""
    object_turn: float = number(0.0, 0.0, LARGEST, unit="rad")
    """They begin turned about the vertical by up to this, rad."""
    object_size: float = number(0.0, 0.0, SHARE)
    """All their lengths are off by up to this share. Mass grows with their cube, unless `object_mass` is given."""
    object_mass: float = number(0.0, 0.0, SHARE)
    """Their masses are off by up to this share of their value, whatever their size."""
    object_friction: float = number(0.0, 0.0, SHARE)
    """Their coefficients of friction likewise."""

    def __bool__(self) -> bool:
        return any(getattr(self, item.name) for item in fields(self))
