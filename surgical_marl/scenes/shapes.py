"""The shapes of an object: capsules, spheres, boxes and planes, read from its file.

Their distances are exact and cheap. A box stands for a plate whose edges are rounded by half of its thinnest side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal, get_args

import mujoco
import numpy as np

from surgical_marl.robots.rotation import matrix_of, turned
from surgical_marl.untrusted.schema import REQUIRED, Place, Vector, angles, extent, lengths, number, rgb
from surgical_marl.untrusted.values import SHORTEST, check_count

MAX_SHAPES = 400
"""Shapes of an object, each capsule of an arc counted."""
Material = Literal["steel", "paint", "plastic", "rubber", "cloth", "tissue"]
"""Materials that a file may name, for pictures for people alone."""
MATERIALS: tuple[str, ...] = get_args(Material)
GREY: Vector = (0.7, 0.7, 0.72)
"""The colour of what has none."""


@dataclass(frozen=True)
class Shape:
    """A solid part of an object."""

    kind: str
    """"sphere", "capsule", "box" or "plane"."""
    size: np.ndarray
    """m: [radius] of a sphere, [radius, half length along z] of a capsule, three half sides of a box, [] of a plane."""
    position: np.ndarray
    """Its middle in the object's frame, m, [3]."""
    rotation: np.ndarray
    """Its axes in the object's frame, [3, 3]. A plane's normal is its z axis."""
    volume: float
    """m3, without what overlaps in a chain of capsules; 0 for a plane."""
    colour: Vector = GREY
    """Red, green and blue, from 0 to 1."""
    material: str = ""
    """One of `MATERIALS`, for pictures for people; "" for what the colour suggests."""


@dataclass(frozen=True, kw_only=True)
class _Look:
    """The look of a shape; that of the object where it is None."""

    colour: Vector | None = rgb()
    material: Material | None = field(default=None, repr=False)
    """Not a part of the object's key for caches, because only pictures show it."""


@dataclass(frozen=True, kw_only=True)
class Sphere(_Look):
    """A ball."""

    radius: float = extent()
    position: Vector = lengths()

    def shapes(self) -> list[Shape]:
        """Return the sphere alone."""
        return [Shape("sphere", np.array([self.radius]), np.array(self.position), np.eye(3), _ball(self.radius))]


@dataclass(frozen=True, kw_only=True)
class Capsule(_Look):
    """A cylinder from one point to another with round ends."""

    radius: float = extent()
    from_: Vector = lengths(REQUIRED)
    to: Vector = lengths(REQUIRED)

    def __post_init__(self) -> None:
        if self.from_ == self.to:
            raise ValueError("from and to are the same point; a sphere has one")

    def shapes(self) -> list[Shape]:
        """Return the capsule alone."""
        start, end = np.array(self.from_), np.array(self.to)
        volume = math.pi * self.radius**2 * float(np.linalg.norm(end - start)) + _ball(self.radius)
        return [_between(self.radius, start, end, volume)]


@dataclass(frozen=True, kw_only=True)
class Box(_Look):
    """A plate whose edges are rounded by half of its thinnest side."""

    size: Vector = extent()
    """Sides."""
    position: Vector = lengths()
    tilt: Vector = angles()

    def shapes(self) -> list[Shape]:
        """Return the box alone."""
        volume = float(np.prod(self.size))
        return [Shape("box", np.array(self.size) / 2, np.array(self.position), turned(self.tilt), volume)]


@dataclass(frozen=True, kw_only=True)
class Plane(_Look):
    """A plane without end; its normal is z."""

    position: Vector = lengths()
    tilt: Vector = angles()

    def shapes(self) -> list[Shape]:
        """Return the plane alone."""
        return [Shape("plane", np.zeros(0), np.array(self.position), turned(self.tilt), 0.0)]


@dataclass(frozen=True, kw_only=True)
class Arc(_Look):
    """A bent wire, as a chain of capsules whose ends lie on an arc about z, from the x axis towards the y axis."""

    radius: float = extent()
    wire: float = extent()
    """Diameter."""
    degrees: float = number(REQUIRED, SHORTEST, 360.0)
    segments: int = number(REQUIRED, 1, 360)
    position: Vector = lengths()
    tilt: Vector = angles()

    def __post_init__(self) -> None:
        if self.wire / 2 >= self.radius or self.degrees / self.segments >= 180:
            raise ValueError("degrees must be below 180 a segment, and the wire thinner than the arc")

    def shapes(self) -> list[Shape]:
        """Return the capsules; each has its share of the volume of the wire without the round ends."""
        angle = np.radians(np.linspace(0.0, self.degrees, self.segments + 1))
        circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
        points = self.position + self.radius * circle @ turned(self.tilt).T
        volume = math.pi * (self.wire / 2) ** 2 * self.radius * math.radians(self.degrees) / self.segments
        return [_between(self.wire / 2, a, b, volume) for a, b in pairwise(points)]


@dataclass(frozen=True)
class ShapeEntry:
    """A shape in an object's file: one kind, with its sizes and its place."""

    capsule: Capsule | None = None
    sphere: Sphere | None = None
    box: Box | None = None
    plane: Plane | None = None
    arc: Arc | None = None

    def __post_init__(self) -> None:
        if sum(part is not None for part in vars(self).values()) != 1:
            raise ValueError(f"it must map one of {', '.join(vars(self))} to its sizes")

    @property
    def given(self) -> Capsule | Sphere | Box | Plane | Arc:
        """The kind that is given."""
        return next(part for part in vars(self).values() if part is not None)


def make_shapes(entries: Sequence[ShapeEntry], colour: Vector, material: str, place: Place) -> tuple[Shape, ...]:
    """Return the shapes of an object.

    Args:
        entries: shapes of its file.
        colour: of shapes without a colour of their own.
        material: of shapes without a material of their own, or "".
        place: of the entries in the file, for errors.

    Raises:
        ValueError: more than `MAX_SHAPES`.
    """
    shapes = [
        replace(shape, colour=part.colour or colour, material=part.material or material)
        for part in (entry.given for entry in entries)
        for shape in part.shapes()
    ]
    check_count(len(shapes), MAX_SHAPES, "shapes", place)
    return tuple(shapes)


def _between(radius: float, start: np.ndarray, end: np.ndarray, volume: float) -> Shape:
    quat, way = np.zeros(4), end - start
    mujoco.mju_quatZ2Vec(quat, way)
    size = np.array([radius, float(np.linalg.norm(way)) / 2])
    return Shape("capsule", size, (start + end) / 2, matrix_of(quat), volume)


def _ball(radius: float) -> float:
    return 4 / 3 * math.pi * radius**3
