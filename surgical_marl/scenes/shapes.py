"""The shapes of an object: capsules, spheres, boxes and planes, read from its file.

Their distances are exact and cheap. A box stands for a plate whose edges are rounded by half of its thinnest side.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np

from surgical_marl.content import unknown
from surgical_marl.robots.rotation import matrix_of, turned
from surgical_marl.untrusted.values import LARGEST, LEAST, LONGEST, SHORTEST, as_number, check_count, shown
from surgical_marl.yaml_file import check_keys, read_mapping, read_vector

MAX_SHAPES = 400
"""Shapes of an object, each capsule of an arc counted."""
MATERIALS = ("steel", "paint", "plastic", "rubber", "cloth", "tissue")
"""What a file may say that something is made of, for pictures for people alone."""


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
    colour: tuple[float, float, float]
    """Red, green and blue, from 0 to 1."""
    volume: float
    """m3, without what overlaps in a chain of capsules; 0 for a plane."""
    material: str = ""
    """One of `MATERIALS`, for pictures for people; "" for what the colour suggests."""


def read_shapes(settings: Any, colour: np.ndarray, material: str, where: str) -> tuple[Shape, ...]:
    """Return the shapes that a list in an object's file describes.

    Args:
        settings: a list of mappings, each from one kind of shape to its sizes and place.
        colour: of shapes without a colour of their own, [3].
        material: of shapes without a material of their own.
        where: the file, for errors.

    Raises:
        ValueError: an unknown kind or key, or a bad number.
    """
    if not isinstance(settings, list) or not settings:
        raise ValueError(
            f"{where}: shapes must be a list of one shape or more ({', '.join(_READERS)}), not {shown(settings)}"
        )
    check_count(len(settings), MAX_SHAPES, "shapes", where)
    shapes: list[Shape] = []
    for number, entry in enumerate(settings):
        if not isinstance(entry, dict) or len(entry) != 1:
            raise ValueError(
                f"{where}, shape {number}: {shown(entry)} must map one of {', '.join(_READERS)} to its sizes"
            )
        ((kind, values),) = entry.items()
        if kind not in _READERS:
            raise unknown(f"shape in {where}:", kind, list(_READERS))
        shapes += _READERS[kind](_Reader(values, colour, material, f"{where}, shape {number}, {kind}"))
    check_count(len(shapes), MAX_SHAPES, "shapes", where)
    return tuple(shapes)


class _Reader:
    """Reads the values of one shape."""

    def __init__(self, values: Any, colour: np.ndarray, material: str, where: str) -> None:
        self.values, self.where = read_mapping(values, where), where
        self._colour = read_colour(self.values.get("colour"), where, colour)
        self._material = read_material(self.values.get("material"), where, material)

    def check(self, *keys: str) -> None:
        check_keys(self.values, (*keys, "colour", "material"), self.where)

    def above(self, key: str) -> float:
        return read_number(self.values.get(key), f"{self.where}, {key}", above=0.0, least=SHORTEST, most=LONGEST)

    def vector(self, key: str, default: Any = None) -> np.ndarray:
        return read_vector(self.values.get(key, default), f"{self.where}, {key}")

    def place(self) -> tuple[np.ndarray, np.ndarray]:
        return self.vector("position", [0, 0, 0]), turned(self.vector("tilt", [0, 0, 0]))

    def shape(self, kind: str, size: Any, position: np.ndarray, rotation: np.ndarray, volume: float) -> Shape:
        red, green, blue = self._colour.tolist()
        colour = red, green, blue
        return Shape(kind, np.array(size, float), position, rotation, colour, volume, self._material)


def _sphere(reader: _Reader) -> list[Shape]:
    reader.check("radius", "position")
    radius = reader.above("radius")
    return [reader.shape("sphere", [radius], reader.vector("position", [0, 0, 0]), np.eye(3), _ball(radius))]


def _capsule(reader: _Reader) -> list[Shape]:
    reader.check("radius", "from", "to")
    radius, start, end = reader.above("radius"), reader.vector("from"), reader.vector("to")
    if np.array_equal(start, end):
        raise ValueError(f"{reader.where}: from and to are the same point; a sphere has one")
    volume = math.pi * radius**2 * float(np.linalg.norm(end - start)) + _ball(radius)
    return [_between(reader, radius, start, end, volume)]


def _box(reader: _Reader) -> list[Shape]:
    reader.check("size", "position", "tilt")
    size = reader.vector("size")
    check_size(size, reader.where)
    return [reader.shape("box", size / 2, *reader.place(), volume=float(np.prod(size)))]


def _plane(reader: _Reader) -> list[Shape]:
    reader.check("position", "tilt")
    return [reader.shape("plane", [], *reader.place(), volume=0.0)]


def _arc(reader: _Reader) -> list[Shape]:
    """Return a chain of capsules whose ends lie on an arc about z, from the x axis on towards the y axis.

    Each has its share of the volume of the wire without the round ends.
    """
    reader.check("radius", "degrees", "wire", "segments", "position", "tilt")
    radius, wire, degrees = (reader.above(key) for key in ("radius", "wire", "degrees"))
    segments = reader.values.get("segments")
    if isinstance(segments, bool) or not isinstance(segments, int) or not 1 <= segments <= 360:
        raise ValueError(f"{reader.where}: segments must be a whole number from 1 to 360, not {shown(segments)}")
    if degrees > 360 or wire / 2 >= radius or degrees / segments >= 180:
        raise ValueError(
            f"{reader.where}: degrees must be up to 360 and below 180 a segment, and the wire thinner than the arc"
        )
    position, rotation = reader.place()
    angles = np.radians(np.linspace(0.0, degrees, segments + 1))
    points = position + radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1) @ rotation.T
    volume = math.pi * (wire / 2) ** 2 * radius * math.radians(degrees) / segments
    return [_between(reader, wire / 2, a, b, volume) for a, b in pairwise(points)]


def _between(reader: _Reader, radius: float, start: np.ndarray, end: np.ndarray, volume: float) -> Shape:
    quat, way = np.zeros(4), end - start
    mujoco.mju_quatZ2Vec(quat, way)
    size = [radius, float(np.linalg.norm(way)) / 2]
    return reader.shape("capsule", size, (start + end) / 2, matrix_of(quat), volume)


def _ball(radius: float) -> float:
    return 4 / 3 * math.pi * radius**3


_READERS: dict[str, Callable[[_Reader], list[Shape]]] = {
    "capsule": _capsule,
    "sphere": _sphere,
    "box": _box,
    "plane": _plane,
    "arc": _arc,
}


def read_number(
    value: Any, where: str, above: float | None = None, least: float = LEAST, most: float = LARGEST
) -> float:
    """Return a number up to `most`; raise ValueError for another value.

    It is 0 or more, or `least` at least and above `above` if that is given.
    """
    number = as_number(value, words=True)
    good = 0 <= number <= most and (above is None or (number > above and number >= least))
    if not good:
        limits = "0 or more" if above is None else f"above {above:g}"
        if math.isfinite(number) and number > 0:
            limits = f"from {0.0 if above is None else least:g} to {most:g}"
        raise ValueError(f"{where} must be a finite number {limits}, not {shown(value)}")
    return number


def check_size(size: np.ndarray, where: str) -> None:
    """Raise ValueError if a side is not above 0, or too short to be computed with."""
    if not (size >= SHORTEST).all():
        least = "above 0" if (size <= 0).any() else f"{SHORTEST:g} m or more"
        raise ValueError(f"{where}: size {size.tolist()} must be {least}")


def read_colour(value: Any, where: str, default: np.ndarray) -> np.ndarray:
    """Return red, green and blue [3], or the default for None; raise ValueError if they are not from 0 to 1."""
    if value is None:
        return default
    colour = read_vector(value, f"{where}, colour")
    if not ((colour >= 0) & (colour <= 1)).all():
        raise ValueError(f"{where}: colour {colour.tolist()} must be from 0 to 1")
    return colour


def read_material(value: Any, where: str, default: str = "") -> str:
    """Return one of `MATERIALS`, or the default for None; raise ValueError for anything else."""
    if value is None:
        return default
    if not isinstance(value, str) or value not in MATERIALS:
        raise unknown(f"material in {where}:", value, MATERIALS)
    return value
