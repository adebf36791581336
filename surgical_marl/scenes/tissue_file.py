"""The file of soft tissue: an object's file with `kind: tissue`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from surgical_marl.scenes.channel_file import ChannelFile
from surgical_marl.scenes.objects import Friction
from surgical_marl.untrusted.schema import REQUIRED, Vector, number, rgb, several
from surgical_marl.untrusted.values import shown

MOST = 1000
"""Bricks of a piece of tissue."""
OVERLOAD = 8.0
"""Greatest force of one shape that tissue should bear, N. It is our own choice: a closed jaw presses on the edge of a
flap of 5 mm with 5 to 7 N, and with up to 13 N where it takes more of it."""
Side = Literal["left", "right", "front", "back", "bottom"]
"""Borders that can be held, in the tissue's frame: where x is least, largest, where y is so, and where z is least."""


@dataclass(frozen=True, kw_only=True)
class TissueFile:
    """The content of a tissue's file. Its `repr` is a key for caches."""

    kind: Literal["tissue"]
    description: str = ""
    size: Vector = number(REQUIRED, 1e-4, 1.0, unit="m")
    cells: Vector = number(REQUIRED, 1, MOST)
    """Bricks along x, y and z."""
    grid: tuple[str, ...] = several("rows of bricks", MOST, empty=tuple)
    """The bricks that are there, seen from above: a text for each row along x, the last y first; "." is none."""
    young: float = number(REQUIRED, 100.0, 1e8, unit="Pa")
    poisson: float = number(0.4287, 0.0, 0.49)
    density: float = number(1000.0, 100.0, 2e4, unit="kg/m3")
    damping: float = number(0.002, 0.0, 1.0, unit="s")
    """Stress of damping per rate of strain, relative to stress per strain."""
    fixed: tuple[Side, ...] = several("borders", 5, empty=tuple)
    """Borders that do not move."""
    springs: dict[str, float] | None = number(None, 1.0, 1e12, unit="N/m3")
    """Borders on springs: stiffness per area."""
    friction: Friction
    stiffness: float = number(5e3, 100.0, 1e5, unit="N/m")
    """Of one contact point."""
    tears: float | None = number(None, 1.01, 10.0)
    """Stretch, as a ratio of lengths, past which tissue counts as torn. It holds on nevertheless."""
    channels: ChannelFile | None = None
    """The forces on needles that go through; none does without this."""
    colour: Vector = rgb((0.75, 0.35, 0.33))

    def __post_init__(self) -> None:
        if any(count != int(count) for count in self.cells) or np.prod(self.cells) > MOST:
            raise ValueError(
                f"cells must be three whole numbers, at most {MOST:,} bricks in all, not {shown(list(self.cells))}"
            )
        if unknown := [name for name in self.springs or () if name not in get_args(Side)]:
            raise ValueError(f"springs must name borders, of {', '.join(get_args(Side))}, not {shown(unknown[0])}")
        if both := [name for name in self.fixed if name in (self.springs or ())]:
            raise ValueError(f"the border {both[0]} is fixed and on springs; leave out one of both")
        columns, rows = int(self.cells[0]), int(self.cells[1])
        if self.grid and (len(self.grid) != rows or any(len(row) != columns for row in self.grid)):
            raise ValueError(
                f"grid must have {rows} rows of {columns} characters, as cells say, not {shown(list(self.grid))}"
            )
        if not self.present.any():
            raise ValueError("grid must have a brick, not only dots")
        if not self.fixed and not self.springs:
            raise ValueError(f"tissue must be held: give fixed or springs for one of {', '.join(get_args(Side))}")

    @property
    def present(self) -> np.ndarray:
        """Which bricks are there, [nx, ny, nz] bool."""
        found = np.ones([int(count) for count in self.cells], bool)
        if self.grid:
            seen = np.array([[cell != "." for cell in row] for row in self.grid[::-1]])
            found &= seen.T[:, :, None]
        return found

    @property
    def mass(self) -> float:
        """Return its mass, kg."""
        return float(self.density * np.prod(self.size) * self.present.mean())
