"""The content of a URDF as plain data: links, joints and shapes, with lengths in m and angles in rad.

All numbers are tuples, so two descriptions compare with `==`, and `from_json(to_json(robot)) == robot`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

MOVING = ("revolute", "prismatic")
"""Types of joints that move."""
SHAPES = ("box", "cylinder", "sphere", "mesh")

Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]
"""Rows."""


@dataclass(frozen=True)
class Inertial:
    """Mass in kg, moments of inertia [3, 3] in kg m2, and the pose [4, 4] of the centre of mass in the link."""

    mass: float
    inertia: Matrix
    origin: Matrix


@dataclass(frozen=True)
class Shape:
    """A visual or collision shape of a link."""

    kind: str
    """One of `SHAPES`."""
    size: Vector
    """Three sides of a box, radius and length of a cylinder, radius of a sphere, scale of a mesh along x, y and z."""
    origin: Matrix
    """Pose in the link, [4, 4]."""
    name: str | None
    rgba: Vector | None
    """Colour, each from 0 to 1; None if the URDF gives none."""
    mesh: str | None
    """The file of a mesh."""


@dataclass(frozen=True)
class Link:
    """A rigid body."""

    name: str
    inertial: Inertial | None
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]


@dataclass(frozen=True)
class Limit:
    """Range, greatest speed and greatest effort of a joint: rad, rad/s and N m (prismatic: m, m/s and N)."""

    lower: float
    upper: float
    velocity: float
    effort: float


@dataclass(frozen=True)
class Mimic:
    """A joint's position is `multiplier` times that of another, plus `offset`."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class RobotJoint:
    """The joint between a link and its parent."""

    name: str
    type: str
    """One of `MOVING`, or "fixed"; a URDF may have others, but an arm may not."""
    parent: str
    child: str
    origin: Matrix
    """Pose in the parent, [4, 4]."""
    axis: Vector
    limit: Limit | None
    """None if the URDF lacks any of its numbers."""
    mimic: Mimic | None
    damping: float
    """Viscous friction, effort per velocity."""
    friction: float
    """Coulomb friction, effort."""


@dataclass(frozen=True)
class Robot:
    """All links and joints of a URDF, in its order."""

    name: str
    links: tuple[Link, ...]
    joints: tuple[RobotJoint, ...]


def to_json(robot: Robot) -> str:
    """Return the robot as JSON, with all digits."""
    return json.dumps(asdict(robot))


def from_json(text: str | bytes) -> Robot:
    """Return the robot that `to_json` wrote."""
    data = json.loads(text)
    return Robot(data["name"], tuple(map(_link, data["links"])), tuple(map(_joint, data["joints"])))


def _link(data: Mapping[str, Any]) -> Link:
    visuals, collisions = (tuple(_record(Shape, shape) for shape in data[key]) for key in ("visuals", "collisions"))
    return Link(data["name"], _record(Inertial, data["inertial"]), visuals, collisions)


def _joint(data: Mapping[str, Any]) -> RobotJoint:
    parts = {"limit": _record(Limit, data["limit"]), "mimic": _record(Mimic, data["mimic"])}
    joint: RobotJoint = _record(RobotJoint, {**data, **parts})
    return joint


def _record(cls: type, data: Mapping[str, Any] | None) -> Any:
    return None if data is None else cls(**{key: _tuples(value) for key, value in data.items()})


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
