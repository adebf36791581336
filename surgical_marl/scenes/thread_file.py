"""The file of a suture thread: an object's file with `kind: thread`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from surgical_marl.scenes.objects import Friction
from surgical_marl.untrusted.schema import REQUIRED, Vector, number, rgb

MATERIALS = {"nylon": (2.0e9, 1140.0), "silk": (8.7e9, 1250.0)}
"""Young's modulus, Pa, and density, kg/m3, of what threads are made of."""
FEWEST, MOST = 3, 200
"""Nodes of a thread."""
THINNEST, THICKEST = 1e-5, 5e-3
"""Diameter, m."""


@dataclass(frozen=True)
class Coil:
    """A flat spiral, as which a thread begins."""

    radius: float = number(0.01, 1e-3, 1.0, unit="m")
    """Of the outermost turn."""
    pitch: float = number(0.001, 1e-4, 0.1, unit="m")
    """Distance of neighbouring turns."""


@dataclass(frozen=True, kw_only=True)
class ThreadFile:
    """The content of a thread's file. Its `repr` is a key for caches."""

    kind: Literal["thread"]
    description: str = ""
    length: float = number(REQUIRED, 1e-3, 2.0, unit="m")
    diameter: float = number(REQUIRED, THINNEST, THICKEST, unit="m")
    material: Literal["nylon", "silk"] | None = None
    young: float | None = number(None, 1e3, 1e12, unit="Pa")
    density: float | None = number(None, 100.0, 2e4, unit="kg/m3")
    nodes: int = number(40, FEWEST, MOST)
    friction: Friction
    stiffness: float = number(1e4, 100.0, 1e5, unit="N/m")
    """Of one contact point."""
    drag: float = number(2.0, 0.0, 1e3, unit="1/s")
    """Of the air: force per mass and speed."""
    strength: float | None = number(None, 1e-3, 1e3, unit="N")
    """Tension at which it tears; it never does if this is not given."""
    coil: Coil | None = None
    """The thread begins as a coil; without this as a straight line along x."""
    colour: Vector = rgb((0.25, 0.2, 0.55))

    def __post_init__(self) -> None:
        own = [key for key in ("young", "density") if getattr(self, key) is not None]
        if self.material and own:
            raise ValueError(f"a thread of {self.material} has its {own[0]} from there; leave out one of both")
        if not self.material and len(own) < 2:
            raise ValueError(
                f"a thread needs its material, {' or '.join(MATERIALS)}, or young (Pa) and density (kg/m3)"
            )
        if (edge := self.length / (self.nodes - 1)) < self.diameter:
            most = int(self.length / self.diameter) + 1
            raise ValueError(f"nodes must be at most {most}, so that edges are longer than thick, not {self.nodes}"
                             f" ({1000 * edge:.3g} mm)")  # fmt: skip
        if self.coil and self.coil.pitch < self.diameter:
            raise ValueError(f"coil.pitch must be at least the diameter {self.diameter:g} m, not {self.coil.pitch:g}")
        if self.coil and self.length > self.coil_length:
            raise ValueError(f"a coil of this radius and pitch holds {self.coil_length:.3g} m, not {self.length:g}")

    @property
    def elasticity(self) -> tuple[float, float]:
        """Young's modulus, Pa, and density, kg/m3."""
        if self.material:
            return MATERIALS[self.material]
        assert self.young is not None and self.density is not None
        return self.young, self.density

    @property
    def mass(self) -> float:
        """Return its mass, kg."""
        return self.elasticity[1] * math.pi * self.diameter**2 / 4 * self.length

    @property
    def coil_length(self) -> float:
        """Length of the coil as far as it is wider than two edges, m."""
        assert self.coil
        inner = max(2 * self.length / (self.nodes - 1), self.coil.pitch)
        return math.pi * max(self.coil.radius**2 - inner**2, 0.0) / self.coil.pitch

    def path(self) -> np.ndarray:
        """Return where the nodes are at the start, m, [n, 3]: from the origin along x, or in a coil from there."""
        edge, n = self.length / (self.nodes - 1), self.nodes
        if not self.coil:
            return np.arange(n)[:, None] * [edge, 0.0, 0.0]
        angle, points = 0.0, []
        for _ in range(n):
            radius = self.coil.radius - self.coil.pitch * angle / (2 * math.pi)
            points.append([radius * math.cos(angle), radius * math.sin(angle), 0.0])
            angle = self._next_angle(angle, edge)
        return np.array(points) - points[0]

    def _next_angle(self, angle: float, edge: float) -> float:
        """Return the angle at which the coil is an edge's length further, straight: edges begin unstretched."""
        assert self.coil
        pitch, outer = self.coil.pitch, self.coil.radius

        def place(angle: float) -> complex:
            return (outer - pitch * angle / (2 * math.pi)) * complex(math.cos(angle), math.sin(angle))

        low, high = angle, angle + math.pi / 2
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if abs(place(middle) - place(angle)) < edge else (low, middle)
        return high
