"""The jaw of an arm: which joint moves it, and the plates of its fingers that hold objects."""

from __future__ import annotations

from dataclasses import dataclass

from surgical_marl.robots.description import Matrix, Vector
from surgical_marl.robots.rotation import turned
from surgical_marl.robots.urdf import link_name
from surgical_marl.untrusted.schema import REQUIRED, angles, extent, lengths, number, several
from surgical_marl.untrusted.schema import Vector as Vector3
from surgical_marl.untrusted.values import LONGEST

MAX_PADS = 100
"""Pads of a jaw."""


@dataclass(frozen=True)
class Pad:
    """A plate of a finger, by which a jaw holds objects."""

    link: str
    size: Vector
    """Sides, m, [3]."""
    position: Vector
    """Middle in the link's frame, m, [3]."""
    rotation: Matrix
    """Axes in the link's frame, [3, 3]."""


@dataclass(frozen=True)
class Jaw:
    """A jaw. One command, open or closed, moves `joint` and the joints that mimic it."""

    joint: str
    open: float
    closed: float
    pads: tuple[Pad, ...] = ()
    """The plates of the fingers; without them the jaw holds nothing."""


@dataclass(frozen=True)
class PadEntry:
    """A plate of a finger in an `arm.yaml`: its sides, and its place in the frame of its link."""

    size: Vector3 = extent()
    position: Vector3 = lengths()
    tilt: Vector3 = angles()


@dataclass(frozen=True)
class JawEntry:
    """A jaw in an `arm.yaml`; pads by link."""

    joint: str
    open: float = number(REQUIRED, -LONGEST, LONGEST, unit="rad or m")
    closed: float = number(REQUIRED, -LONGEST, LONGEST, unit="rad or m")
    pads: dict[str, PadEntry] = several("pads", MAX_PADS)

    def make(self) -> Jaw:
        """Return the jaw."""
        pads = (
            Pad(link_name(link), pad.size, pad.position, tuple(map(tuple, turned(pad.tilt).tolist())))
            for link, pad in self.pads.items()
        )
        return Jaw(self.joint, self.open, self.closed, tuple(pads))
