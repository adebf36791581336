"""The part of a tissue's file about needles that go through it: `channels:`."""

from __future__ import annotations

from dataclasses import dataclass

from surgical_marl.untrusted.schema import number


@dataclass(frozen=True)
class ChannelFile:
    """The forces on a needle in tissue. Those of puncture and cutting are those of needles in soft tissue."""

    most: int = number(4, 1, 16)
    """Channels at a time."""
    puncture: float = number(0.4, 1e-4, 100.0, unit="N")
    """Normal force of a tip at which it enters."""
    cutting: float = number(0.1, 0.0, 100.0, unit="N")
    """Against a tip that advances in tissue."""
    friction: float = number(20.0, 0.0, 1e4, unit="N/m")
    """Along the needle, per length that is in tissue."""
    thread_friction: float = number(20.0, 0.0, 1e4, unit="N/m")
    """Along the thread behind it, likewise."""
    stiffness: float = number(1e5, 100.0, 1e7, unit="N/m2")
    """Of the springs across needle and thread, and of friction before it slips, per length that is in tissue."""
    spacing: float = number(1e-3, 1e-4, 0.01, unit="m")
    """Distance of the points at which tissue holds needle and thread."""
