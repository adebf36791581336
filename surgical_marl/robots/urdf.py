"""Reads untrusted URDFs as plain data, without opening anything outside the arm's folder.

    robot = read_urdf(folder / "arm.urdf")

`surgical_marl.robots.arm.load_arm` reads a whole arm.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Element

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.description import (
    SHAPES,
    Inertial,
    Limit,
    Link,
    Matrix,
    Mimic,
    Robot,
    RobotJoint,
    Shape,
    Vector,
    from_json,
    to_json,
)
from surgical_marl.robots.safe_xml import parse_xml, write_xml
from surgical_marl.robots.urdf_faults import MAX_FAULTS, xml_faults
from surgical_marl.untrusted.files import is_file, read_bytes
from surgical_marl.untrusted.schema import Faults

if TYPE_CHECKING:
    from yourdfpy import urdf as yourdf

MAX_URDF = 10_000_000
"""Bytes; more is a mistake or an attack."""


def read_urdf(path: Path) -> Robot:
    """Read a URDF file; lengths in m, angles in rad, meshes by the names that it gives them.

    Links have the names that `link_name` gives them. The result of yourdfpy is kept on disk, keyed by the content of
    the file, because importing yourdfpy takes longer than the rest of loading a scene.

    Raises:
        ValueError: not there, too large, no XML, a DOCTYPE (so entities never expand), or a tag that lacks something or
            has an invalid number. If more than one thing is wrong, the error is a `Faults`.
    """
    if not is_file(path):
        raise ValueError(f"there is no URDF file {path}")
    data = read_bytes(path, MAX_URDF)

    def compute() -> np.ndarray:
        return np.frombuffer(to_json(_parse(data, path)).encode(), np.uint8)

    return from_json(cached("urdf", compute, data).tobytes())


def link_name(name: Any) -> Any:
    """Return the name of a link that a file calls `name`: "world", which MuJoCo reserves for the ground, is changed."""
    return "world_link" if name == "world" else name


def _parse(data: bytes, path: Path) -> Robot:
    document = parse_xml(data, path, "URDF")
    _simplify_still_joints(document.root)
    if faults := list(islice(xml_faults(document, path), MAX_FAULTS)):
        raise Faults(faults)
    import yourdfpy

    try:
        text = io.BytesIO(write_xml(document.root))
        return _plain(yourdfpy.URDF.load(text, build_scene_graph=False, load_meshes=False).robot)
    except Exception as error:  # yourdfpy passes on any exception of float() and of its own code
        raise ValueError(f"{path} is not a URDF that can be read: {' '.join(str(error).split())}") from None


def _simplify_still_joints(root: Element) -> None:
    """Remove from joints without an axis what says how they move: exporters fill it with zeros, and nobody reads it."""
    for joint in root.findall("joint"):
        if joint.get("type") in ("fixed", "floating"):
            for part in [part for part in joint if part.tag not in ("origin", "parent", "child")]:
                joint.remove(part)


def _plain(robot: yourdf.Robot) -> Robot:
    """Return the same robot as plain data."""
    colors = {material.name: material.color.rgba for material in robot.materials if material.color is not None}
    return Robot(robot.name, tuple(_link(link, colors) for link in robot.links), tuple(map(_joint, robot.joints)))


def _link(link: yourdf.Link, colors: Mapping[str, Any]) -> Link:
    inertial = None
    if (given := link.inertial) is not None:
        inertial = Inertial(float(given.mass), _matrix(given.inertia), _pose(given.origin))
    visuals = tuple(_shape(visual, _color(visual.material, colors)) for visual in link.visuals)
    return Link(link_name(link.name), inertial, visuals, tuple(_shape(part, None) for part in link.collisions))


def _shape(part: yourdf.Visual | yourdf.Collision, rgba: Vector | None) -> Shape:
    kind = next(kind for kind in SHAPES if getattr(part.geometry, kind) is not None)
    shape = getattr(part.geometry, kind)
    match kind:
        case "box":
            size = shape.size
        case "cylinder":
            size = shape.radius, shape.length
        case "sphere":
            size = shape.radius
        case _:
            size = np.broadcast_to(1.0 if shape.scale is None else shape.scale, 3)
    return Shape(kind, _vector(size), _pose(part.origin), part.name, rgba, getattr(shape, "filename", None))


def _color(material: yourdf.Material | None, colors: Mapping[str, Any]) -> Vector | None:
    """Return the colour of a material, or None if it has none.

    The colour may be given elsewhere in the URDF, under the material's name.
    """
    if material is None:
        return None
    rgba = material.color.rgba if material.color is not None else colors.get(material.name)
    return None if rgba is None else _vector(rgba)


def _joint(joint: yourdf.Joint) -> RobotJoint:
    mimic, dynamics = joint.mimic, joint.dynamics
    limits = joint.limit and (joint.limit.lower, joint.limit.upper, joint.limit.velocity, joint.limit.effort)
    return RobotJoint(
        name=joint.name,
        type=joint.type,
        parent=link_name(joint.parent),
        child=link_name(joint.child),
        origin=_pose(joint.origin),
        axis=_vector(joint.axis),
        limit=Limit(*limits) if limits and None not in limits else None,
        mimic=mimic and Mimic(mimic.joint, mimic.multiplier, mimic.offset),
        damping=float((dynamics and dynamics.damping) or 0.0),  # yourdfpy leaves these two as text
        friction=float((dynamics and dynamics.friction) or 0.0),
    )


def _pose(origin: np.ndarray | None) -> Matrix:
    return _matrix(np.eye(4) if origin is None else origin)


def _matrix(array: np.ndarray) -> Matrix:
    return tuple(map(_vector, array))


def _vector(array: Any) -> Vector:
    return tuple(np.ravel(array).astype(float).tolist())
