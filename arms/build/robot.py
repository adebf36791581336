"""Write a URDF from numbers: links, joints and primitive shapes, in the order that they are added.

robot = Robot("psm", "da Vinci Classic patient side manipulator")
robot.link("remote_center")
robot.link("yaw_link", Inertial(1.0, (0.005, 0.005, 0.005)), [Box((0.1, 0.07, 0.12), at=(0, 0.16, 0.33))])
robot.joint("yaw", "revolute", "remote_center", "yaw_link", axis=(0, -1, 0), limits=Limits(-1.6, 1.6, 1.57, 3.3))
robot.text()
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as Xml

Vector = Sequence[float]
ZERO = (0.0, 0.0, 0.0)

MATERIALS = {
    "white": (0.88, 0.89, 0.91),
    "grey": (0.42, 0.45, 0.50),
    "dark": (0.16, 0.17, 0.20),
    "steel": (0.70, 0.73, 0.77),
    "orange": (0.93, 0.45, 0.13),
    "blue": (0.20, 0.36, 0.60),
}


@dataclass(frozen=True)
class Box:
    """A box of full lengths `size`, its centre at `at`, turned by `rpy`. Lengths in m."""

    size: Vector
    at: Vector = ZERO
    rpy: Vector = ZERO
    material: str = "grey"
    name: str = ""


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along z. As a collision shape it becomes a capsule of this length over all."""

    radius: float
    length: float
    at: Vector = ZERO
    rpy: Vector = ZERO
    material: str = "grey"
    name: str = ""


@dataclass(frozen=True)
class Sphere:
    """A sphere."""

    radius: float
    at: Vector = ZERO
    rpy: Vector = ZERO
    material: str = "grey"
    name: str = ""


Shape = Box | Cylinder | Sphere


@dataclass(frozen=True)
class Inertial:
    """Mass in kg, inertia about the centre of mass in kg m2 (xx, yy, zz and if given xy, xz, yz)."""

    mass: float
    inertia: Vector
    at: Vector = ZERO


@dataclass(frozen=True)
class Limits:
    """Position limits in rad or m, velocity and effort limits, viscous and Coulomb friction."""

    lower: float
    upper: float
    velocity: float
    effort: float
    viscous: float = 0.0
    coulomb: float = 0.0


class Robot:
    """A URDF in the making."""

    def __init__(self, name: str, comment: str) -> None:
        self._comment = comment
        self._root = Xml.Element("robot", name=name)
        for material, rgb in MATERIALS.items():
            Xml.SubElement(Xml.SubElement(self._root, "material", name=material), "color", rgba=_numbers((*rgb, 1)))

    def link(
        self, name: str, inertial: Inertial | None = None, visuals: Sequence[Shape] = (),
        collisions: Sequence[Shape] = (),
    ) -> None:  # fmt: skip
        """Adds a link. Collision shapes carry names of their own."""
        link = Xml.SubElement(self._root, "link", name=name)
        if inertial is not None:
            part = Xml.SubElement(link, "inertial")
            _place(part, inertial.at)
            Xml.SubElement(part, "mass", value=_number(inertial.mass))
            moments = (*inertial.inertia, *ZERO)[:6]
            keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
            Xml.SubElement(part, "inertia", dict(zip(keys, map(_number, moments), strict=True)))
        for shape in visuals:
            part = _shape(link, "visual", shape)
            Xml.SubElement(part, "material", name=shape.material)
        for shape in collisions:
            _shape(link, "collision", shape).set("name", shape.name)

    def joint(
        self, name: str, kind: str, parent: str, child: str, at: Vector = ZERO, rpy: Vector = ZERO,
        axis: Vector | None = None, limits: Limits | None = None, mimic: str | None = None,
    ) -> None:  # fmt: skip
        """Adds a joint: "revolute" or "prismatic" with axis and limits, or "fixed"."""
        joint = Xml.SubElement(self._root, "joint", name=name, type=kind)
        _place(joint, at, rpy)
        Xml.SubElement(joint, "parent", link=parent)
        Xml.SubElement(joint, "child", link=child)
        if axis is not None and limits is not None:
            Xml.SubElement(joint, "axis", xyz=_numbers(axis))
            keys = ("lower", "upper", "velocity", "effort")
            Xml.SubElement(joint, "limit", {key: _number(getattr(limits, key)) for key in keys})
            friction = {"damping": _number(limits.viscous), "friction": _number(limits.coulomb)}
            Xml.SubElement(joint, "dynamics", friction)
        if mimic is not None:
            Xml.SubElement(joint, "mimic", joint=mimic, multiplier="1", offset="0")

    def text(self) -> str:
        """The file's text."""
        Xml.indent(self._root)
        note = f"<!-- {self._comment}\n     Written by `python arms/build`: change it there. -->\n"
        return '<?xml version="1.0"?>\n' + note + Xml.tostring(self._root, encoding="unicode") + "\n"


def _shape(link: Xml.Element, kind: str, shape: Shape) -> Xml.Element:
    part = Xml.SubElement(link, kind)
    _place(part, shape.at, shape.rpy)
    geometry = Xml.SubElement(part, "geometry")
    if isinstance(shape, Box):
        Xml.SubElement(geometry, "box", size=_numbers(shape.size))
    elif isinstance(shape, Cylinder):
        Xml.SubElement(geometry, "cylinder", radius=_number(shape.radius), length=_number(shape.length))
    else:
        Xml.SubElement(geometry, "sphere", radius=_number(shape.radius))
    return part


def _place(part: Xml.Element, at: Vector, rpy: Vector = ZERO) -> None:
    if any(at) or any(rpy):
        Xml.SubElement(part, "origin", xyz=_numbers(at), rpy=_numbers(rpy))


def _numbers(values: Vector) -> str:
    return " ".join(map(_number, values))


def _number(value: float) -> str:
    return repr(float(value)).removesuffix(".0") if value else "0"
