"""How the joints of an arm are driven, read from `arm.yaml`: each by its own drive, some also by a shared cable."""

from __future__ import annotations

from dataclasses import dataclass

from surgical_marl.untrusted.schema import REQUIRED, number
from surgical_marl.untrusted.values import LARGEST, LEAST

CONTROL_MODES = ("position", "velocity", "torque")


@dataclass(frozen=True)
class Drive:
    """How one joint is driven. SI units: N m/rad, N m s/rad, kg m2, rad/s, rad (or N/m, N s/m, kg, m/s, m)."""

    stiffness: float = number(REQUIRED, 0.0, LARGEST)
    damping: float = number(REQUIRED, 0.0, LARGEST)
    speed: float = number(REQUIRED, LEAST, LARGEST)
    armature: float = number(0.0, 0.0, LARGEST)
    home: float = number(0.0)
    margin: float = number(0.0, 0.0, LARGEST)
    """How far the joint limits lie inside those of the URDF. A light joint that is struck goes a little past its
    limit."""


@dataclass(frozen=True)
class TipSpeed:
    """How fast a full action of Cartesian control moves and turns the tool tip, along and about each axis."""

    translation: float = number(0.1, LEAST, LARGEST, unit="m/s")
    rotation: float = number(1.5, LEAST, LARGEST, unit="rad/s")


@dataclass(frozen=True)
class Cable:
    """A cable that couples several joints.

    The length of the cable is the sum of coefficient times position of its joints. Its own drive acts on this length,
    in addition to the drives of the joints. Units are those of a `Drive`, per unit of that length.
    """

    joints: dict[str, float] = number(REQUIRED, least=2)
    """Coefficient of each joint."""
    stiffness: float = number(REQUIRED, 0.0, LARGEST)
    damping: float = number(REQUIRED, 0.0, LARGEST)
    effort: float = number(REQUIRED, LEAST, LARGEST)
    armature: float = number(0.0, 0.0, LARGEST)

    def __post_init__(self) -> None:
        for name, value in self.joints.items():
            if value == 0:
                raise ValueError(f"the coefficient of {name!r} must not be 0")
