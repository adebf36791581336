"""Objects: what arms hold, look at or bump into, one YAML file each.

    needle = load_object("needle_sh")
    needle.mass                                 # kg
    position, rotation = needle.sites["tip"]

`docs/your_own_object.md` makes one. A scene says where objects are: `Scene.objects`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from surgical_marl.content import find
from surgical_marl.plugins.systems import SOFT, soft_kind
from surgical_marl.robots.rotation import matrix_of, quaternion, turned
from surgical_marl.scenes.poses import Pose
from surgical_marl.scenes.shapes import GREY, MAX_SHAPES, Material, ShapeEntry, make_shapes
from surgical_marl.scenes.shapes import Shape as Shape
from surgical_marl.untrusted.markup import check_name
from surgical_marl.untrusted.schema import REQUIRED, Place, Vector, angles, check, lengths, number, rgb, several
from surgical_marl.untrusted.values import LARGEST, LEAST, shown
from surgical_marl.yaml_file import read_as, read_yaml

MAX_SITES = 100
HEAVIEST, LIGHTEST = 1e6, 1e-12
"""Masses of a free object, kg."""
GEOMS = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "plane": mujoco.mjtGeom.mjGEOM_PLANE,
}
"""MuJoCo's geom of each kind of shape."""


@dataclass(frozen=True)
class Surface:
    """Contact properties of a surface."""

    sliding: float
    """Coefficient of sliding friction."""
    torsion: float
    """Radius in m: the torque of friction about the normal is up to sliding * torsion * normal force."""
    stiffness: float
    """Of one contact point, N/m."""

    def against(self, other: Surface) -> Surface:
        """Return the contact of two surfaces: geometric means of both frictions, and two springs in series."""
        stiffness = self.stiffness * other.stiffness / (self.stiffness + other.stiffness)
        return Surface(math.sqrt(self.sliding * other.sliding), math.sqrt(self.torsion * other.torsion), stiffness)


JAW = Surface(sliding=0.8, torsion=0.002, stiffness=7e5)
"""The inserts of a needle driver's jaw. A steel wire between them has a coefficient of 0.8 too."""
LINK = Surface(sliding=0.3, torsion=0.001, stiffness=2e5)
"""All other parts of an arm: smooth steel."""


@dataclass(frozen=True)
class Object:
    """A rigid object in a frame of its own. Lengths in m, angles in rad."""

    name: str
    description: str
    free: bool
    """True if it moves; otherwise it is fixed in the world."""
    mass: float
    """kg; 0 if the object is fixed."""
    center: np.ndarray
    """Centre of mass, m, [3]."""
    inertia: np.ndarray
    """About the centre of mass, along the object's axes, kg m2, [3, 3]."""
    friction: tuple[float, float]
    """Coefficient of sliding friction, and torsion radius in m: the torque of friction about the normal of a contact is
    up to sliding * torsion radius * normal force."""
    stiffness: float
    """Of one contact point, N/m."""
    shapes: tuple[Shape, ...]
    sites: dict[str, tuple[np.ndarray, np.ndarray]]
    """Named places: position, m, [3], and axes, [3, 3]."""
    content: bytes = field(repr=False)
    """Everything that the object is made from but materials, which only pictures show. It is a key for caches."""

    soft: Any = None
    """The content of its file if it is no rigid body, such as `ThreadFile`; it has no shapes and sites then."""

    @property
    def surface(self) -> Surface:
        """Its contact properties."""
        return Surface(*self.friction, self.stiffness)

    def height(self, rotation: np.ndarray) -> float:
        """Return how high the origin of its frame is above its lowest point, m, if its axes are `rotation` [3, 3].

        It is made of capsules and spheres.
        """
        half = [part.size[1] * abs(rotation[2] @ part.rotation[:, 2]) if part.kind == "capsule" else 0.0
                for part in self.shapes]  # fmt: skip
        return max(part.size[0] + long - rotation[2] @ part.position
                   for part, long in zip(self.shapes, half, strict=True))  # fmt: skip


@dataclass(frozen=True)
class Placement:
    """An object in a scene."""

    object: Object
    position: np.ndarray
    """Origin of the object's frame in the world, m, [3]. A free object starts here unless a task says otherwise."""
    rotation: np.ndarray
    """Axes of the object's frame in the world, [3, 3]."""

    @property
    def pose(self) -> Pose:
        """The same as a pose."""
        return Pose(self.position, quaternion(self.rotation))


@dataclass(frozen=True)
class Friction:
    """The friction of an object: its coefficient of sliding, and its torsion radius in m."""

    sliding: float = number(REQUIRED, 0.0, LARGEST)
    torsion: float = number(REQUIRED, 0.0, LARGEST, unit="m")


@dataclass(frozen=True)
class SiteEntry:
    """A named place of an object's file, in the object's frame."""

    position: Vector = lengths()
    tilt: Vector = angles()


@dataclass(frozen=True, kw_only=True)
class ObjectFile:
    """The content of an object's file. Its `repr` is a key for caches, so it has no materials."""

    description: str = ""
    free: bool
    mass: float | None = number(None, LEAST, LARGEST, unit="kg")
    density: float | None = number(None, LEAST, LARGEST, unit="kg/m3")
    friction: Friction
    stiffness: float = number(REQUIRED, LEAST, LARGEST, unit="N/m")
    colour: Vector | None = rgb()
    material: Material | None = field(default=None, repr=False)
    shapes: tuple[ShapeEntry, ...] = several("shapes", MAX_SHAPES, least=1)
    sites: dict[str, SiteEntry] = several("sites", MAX_SITES)

    def __post_init__(self) -> None:
        given = [key for key in ("mass", "density") if getattr(self, key) is not None]
        if not self.free and given:
            raise ValueError(f"a fixed object has no {given[0]}; leave it out, or say free: true")
        if self.free and len(given) != 1:
            raise ValueError("a free object needs either its mass (kg) or its density (kg/m3)")
        if self.free and any(shape.plane for shape in self.shapes):
            raise ValueError("a plane has no end, so it can't be part of a free object; take capsules")
        if self.free and any(shape.box for shape in self.shapes):
            raise ValueError("a box can't be part of a free object; build it of capsules, with round edges")


def load_object(name: str | Path, colour: Any = None) -> Object:
    """Read an object by a shipped name (`list_objects()`) or the path of a YAML file.

    Args:
        name: what to read.
        colour: red, green and blue from 0 to 1, for the file's own `colour`.

    Raises:
        ValueError: the name is unknown, or the file lacks something or has a bad value.
    """
    path = find("objects", name)
    check_name(path.stem, "an object's file")
    settings = read_yaml(path)
    if (kind := settings.get("kind")) is not None:
        return _soft(path, settings, kind)
    about = read_as(ObjectFile, path)
    painted = check(Place("colour"), colour, Vector | None, rgb().metadata) or about.colour or GREY
    shapes = make_shapes(about.shapes, painted, about.material or "", Place("shapes", path))
    density = about.density or _density(about.mass, shapes)
    try:
        mass, center, inertia = _inertia(shapes, density, about.free)
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"{path}: its shapes are too small or too far apart: {' '.join(str(error).split())}") from None
    if about.free and not LIGHTEST <= mass <= HEAVIEST:
        raise ValueError(f"{path}: a free object must weigh from {LIGHTEST:g} to {HEAVIEST:g} kg, not {mass:g}")
    return Object(
        name=path.stem,
        description=about.description,
        free=about.free,
        mass=mass,
        center=center,
        inertia=inertia,
        friction=(about.friction.sliding, about.friction.torsion),
        stiffness=about.stiffness,
        shapes=shapes,
        sites={name: (np.array(site.position), turned(site.tilt)) for name, site in about.sites.items()},
        content=repr((path.stem, about, painted)).encode(),
    )


def _soft(path: Path, settings: Any, kind: Any) -> Object:
    """Return an object that is no rigid body, from the content of its file."""
    if kind not in SOFT:
        raise ValueError(f"{Place('kind', path).at(settings)} must be {' or '.join(SOFT)}, not {shown(kind)}")
    about = check(Place(file=path), settings, soft_kind(kind).file)
    friction = about.friction.sliding, about.friction.torsion
    content = repr((path.stem, about)).encode()
    return Object(path.stem, about.description, True, about.mass, np.zeros(3), np.zeros((3, 3)), friction,
                  about.stiffness, (), {}, content, about)  # fmt: skip


def _density(mass: float | None, shapes: tuple[Shape, ...]) -> float:
    """Return the mean density, kg/m3; 0 for a fixed object, which has no mass."""
    return mass / sum(shape.volume for shape in shapes) if mass else 0.0


def _inertia(shapes: tuple[Shape, ...], density: float, free: bool) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass, centre of mass [3] and moments of inertia [3, 3] of the shapes, as MuJoCo computes them."""
    if not free:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    mass = density * sum(shape.volume for shape in shapes)
    for shape in shapes:  # of 1 kg in all: MuJoCo takes a body of less than 1e-15 kg for one without mass
        add_shape(body, shape, mass=shape.volume * density / mass)
    model = spec.compile()
    axes = matrix_of(model.body_iquat[1])
    return mass, model.body_ipos[1].copy(), mass * axes @ np.diag(model.body_inertia[1]) @ axes.T


def add_shape(body: Any, shape: Shape, **rest: Any) -> None:
    """Add a shape to a body of an MjSpec as a geom with the rest of its attributes."""
    size = [0.0, 0.0, 1.0] if shape.kind == "plane" else [*shape.size, 0.0, 0.0][:3]
    body.add_geom(type=GEOMS[shape.kind], size=size, pos=shape.position, quat=quaternion(shape.rotation), **rest)
