"""The constants of contact with objects: which bodies of a scene can touch, their shapes and surfaces.

Patches are in the order of `ContactPairs.meetings`, and within one in that of its bodies.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product
from typing import Any, NamedTuple

import mujoco
import numpy as np

from surgical_marl.physics.contact.arm_contacts import moved_bodies
from surgical_marl.physics.contact.contact_patch import AWAY
from surgical_marl.physics.contact.shapes import Plate, Segments, plate_of_box
from surgical_marl.physics.systems.arms import joint_numbers
from surgical_marl.physics.systems.rigid_motion import Masses
from surgical_marl.robots.spec import COLLISION_GROUP, PAD_GROUP
from surgical_marl.scenes.objects import JAW, LINK, Placement, Surface
from surgical_marl.scenes.scene import Scene

ENDLESS = 10.0
"""Half side of the plate that stands for a plane, m."""
THICK = 0.01
"""Radius of that plate, m: the plane is its upper face."""
BAR = 0.003
"""Half length from which an object's capsule counts as a bar, m: a ball around it holds much that is not near it."""
SLENDER = 10
"""Half length of slender links at least, in radii."""


class Finger(NamedTuple):
    """The pad of a finger."""

    agent: str
    geom: int
    body: int


class Meeting(NamedTuple):
    """Pairs of bodies of two kinds that can touch: m patches."""

    first: str
    """Kind of the first body: "objects" or "links"."""
    one: np.ndarray
    """Numbers of the first bodies, [m]."""
    second: str
    """Kind of the second body: "pads", "links", "objects", or one of what is fixed: "plates" or "rods"."""
    other: np.ndarray
    """Numbers of the second bodies, [m]."""
    surfaces: tuple[Surface, ...]
    """Surface properties of each pair."""
    partners: int
    """Pairs of each first body: it stays the same over so many pairs in a row."""


class ContactPairs:
    """Constants of a scene with objects.

    A number that stands for no body is the number of bodies of that kind, so that what is written there is dropped.
    """

    def __init__(self, scene: Scene) -> None:
        model = scene.model
        free = scene.free_objects
        self.names, self.count = tuple(free), len(free)
        self.arms, self.dofs = len(scene.agents), joint_numbers(scene)
        """Number of arms, and degrees of freedom of each, [a, m]: `joint_numbers`."""
        self.most = self.dofs.shape[1]
        self.fingers = tuple(
            Finger(agent, int(g), int(model.geom_bodyid[g]))
            for agent in scene.agents
            for g in np.flatnonzero(model.geom_group == PAD_GROUP)
            if model.geom(int(g)).name.startswith(f"{agent}/")
        )
        owners = [finger.agent for finger in self.fingers]
        numbers = {a: [f for f, owner in enumerate(owners) if owner == name] for a, name in enumerate(scene.agents)}
        self.jaws = {arm: (own[0], own[1]) for arm, own in numbers.items() if len(own) == 2}
        """Number of an arm -> its two fingers."""
        self.near, self.bare = _near(scene)
        self._read_free(free)
        self._read_links(model)
        self._read_fixed({n: place for n, place in scene.objects.items() if not place.object.free})
        self._read_joints(model, scene.agents)
        self._number(free)

    def _read_free(self, free: dict[str, Placement]) -> None:
        most = max((len(place.object.shapes) for place in free.values()), default=1)
        shape = (self.count, most)
        self.start, self.end = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
        """Ends of the capsules of the objects, from the centre of mass, by the axes of the object's frame, [k, c,
        3]."""
        self.radius = np.full(shape, 2 * AWAY, np.float32)  # of capsules that are not there
        for o, place in enumerate(free.values()):
            for c, part in enumerate(place.object.shapes):
                half = part.size[1] * part.rotation[:, 2] if part.kind == "capsule" else np.zeros(3)
                middle = part.position - place.object.center
                self.start[o, c], self.end[o, c], self.radius[o, c] = middle - half, middle + half, part.size[0]
        ends = np.maximum(*(np.linalg.norm(x, axis=-1) for x in (self.start, self.end)))
        self.bound = (ends + self.radius).max(1, initial=0.0)
        """Radius of a ball about the centre of mass that holds the object, m, [k]."""
        self.middle = (self.start + self.end) / 2
        self.around = np.linalg.norm(self.end - self.start, axis=-1) / 2 + self.radius
        """Radius of a ball about the middle of each capsule that holds it, m, [k, c]."""
        self.has_bars = bool((self.around - self.radius > BAR).any())
        objects = [place.object for place in free.values()]
        self.masses = Masses(
            np.array([thing.mass for thing in objects], np.float32),  # type: ignore[arg-type]
            np.array([thing.inertia for thing in objects], np.float32).reshape(-1, 3, 3),  # type: ignore[arg-type]
        )
        self.centers = np.array([thing.center for thing in objects], np.float32).reshape(-1, 3)

    def _read_links(self, model: mujoco.MjModel) -> None:
        plates = [plate_of_box(model.geom_size[finger.geom]) for finger in self.fingers]

        def single(values: Any, shape: tuple[int, ...]) -> np.ndarray:
            return np.array(values, np.float32).reshape(shape)

        self.pad_geoms = np.array([finger.geom for finger in self.fingers], int)
        self.pad_axes = single([axes for axes, _, _ in plates], (-1, 3, 3))
        self.pad_half = single([half for _, half, _ in plates], (-1, 2))
        self.pad_radius = single([radius for _, _, radius in plates], (-1,))
        capsule = model.geom_type[self.near] == mujoco.mjtGeom.mjGEOM_CAPSULE
        self.link_half = single(np.where(capsule, model.geom_size[self.near, 1], 0.0), (-1,))
        self.link_radius = single(model.geom_size[self.near, 0], (-1,))
        self.slender = np.flatnonzero(self.link_half > SLENDER * self.link_radius)
        """Numbers of links that are long and thin."""
        pads = np.array([finger.body for finger in self.fingers], int)
        self.bodies = {"pads": pads, "links": model.geom_bodyid[self.near]}
        """The model's bodies of each kind of thing that an arm has."""

    def _read_fixed(self, fixed: dict[str, Placement]) -> None:
        """Set the plates and the rods, which are capsules, of all fixed objects: each is a body of its own."""
        parts = [(part, place) for place in fixed.values() for part in place.object.shapes]
        flat = [(part, place) for part, place in parts if part.kind in ("box", "plane")]
        thin = [(part, place) for part, place in parts if part.kind in ("capsule", "sphere")]
        self.plates = Plate(*_stacked([_plate(*each) for each in flat], (3,), (3, 3), (2,), ()))  # type: ignore[arg-type]
        self.rods = Segments(*_stacked([_segment(*each) for each in thin], (3,), (3,), ()))  # type: ignore[arg-type]
        self.boxes = {
            "plates": _box(*_spans(self.plates)),
            "rods": _box(self.rods.start, self.rods.end, self.rods.radius),
        }
        """Two corners [2, 3] of a box that holds all fixed bodies of a kind. World, m."""
        self._fixed_surfaces = {
            kind: [place.object.surface for _, place in of] for kind, of in (("plates", flat), ("rods", thin))
        }

    def _read_joints(self, model: mujoco.MjModel, agents: tuple[str, ...]) -> None:
        """Set which joints are prismatic, and which joints of an arm move its bodies of each kind."""
        self.slides = np.append(model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE, False)[self.dofs]
        self.arm_of, self.moves = {}, {}
        """Arm of each body by kind, and which of that arm's joints move it, [m]."""
        for kind, bodies in self.bodies.items():
            self.arm_of[kind], self.moves[kind] = self.joints_of(model, agents, bodies)

    def joints_of(
        self, model: mujoco.MjModel, agents: tuple[str, ...], bodies: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Return the arm that each of some bodies of arms is on, [n], and which of its joints move it, [n, m]."""
        moved = np.pad(moved_bodies(model), ((0, 0), (0, 1)))
        arms = np.array([agents.index(name) for name in _owners(model, bodies)], int)
        return arms, np.take_along_axis(moved[bodies], self.dofs[arms], 1).astype(np.float32)

    def _number(self, free: dict[str, Placement]) -> None:
        """Set the number of each patch, the bodies that it is between, and how their surfaces feel."""
        own = [place.object.surface for place in free.values()]
        self.surfaces = {"objects": own, **self._fixed_surfaces}
        """Surfaces of free bodies and of fixed ones, by kind."""
        felt = {"pads": [JAW] * len(self.fingers), "links": [LINK] * len(self.near), "objects": own,
                **self._fixed_surfaces}  # fmt: skip
        objects, fingers, links = range(self.count), range(len(self.fingers)), range(len(self.near))
        fixed = {kind: range(len(surfaces)) for kind, surfaces in self._fixed_surfaces.items()}
        products = [
            ("objects", objects, "pads", fingers),
            ("objects", objects, "links", self.bare.tolist()),
            *(("objects", objects, kind, all_) for kind, all_ in fixed.items()),
            *(("links", links, kind, all_) for kind, all_ in fixed.items()),
        ]
        pairs = [(first, second, list(product(one, other)), len(other)) for first, one, second, other in products]
        pairs.insert(2 + len(fixed), ("objects", "objects", list(combinations(objects, 2)), 1))
        self.meetings = tuple(
            Meeting(first, np.array([a for a, _ in which]), second, np.array([b for _, b in which]),
                    tuple(felt[first][a].against(felt[second][b]) for a, b in which), partners)
            for first, second, which, partners in pairs if which
        )  # fmt: skip
        surfaces = [surface for meeting in self.meetings for surface in meeting.surfaces]
        self.sliding, self.torsion, self.stiffness = (
            np.array([getattr(surface, of) for surface in surfaces], np.float32)
            for of in ("sliding", "torsion", "stiffness")
        )
        ends = [[(m.first, m.one) for m in self.meetings], [(m.second, m.other) for m in self.meetings]]

        def numbers(end: list[tuple[str, np.ndarray]], kind: str, none: int) -> np.ndarray:
            own = (n if of == kind else np.full(len(n), none) for of, n in end)
            return np.concatenate([np.zeros(0, int), *own])

        self.first_object, self.second_object = (numbers(end, "objects", self.count) for end in ends)
        self.finger = numbers(ends[1], "pads", len(self.fingers))
        self.grip = {
            (int(o), int(f)): g
            for g, (o, f) in enumerate(zip(self.first_object, self.finger, strict=True))
            if f < len(self.fingers)
        }
        """(object, finger) -> its patch."""
        self.owner, self.pulls = np.full(len(surfaces), self.arms), np.zeros((len(surfaces), self.most), np.float32)
        """The arm that each patch is on, and the sign with which it moves with that arm's joints, [m]."""
        self.sign = np.zeros(len(surfaces), np.float32)
        """1 if the first body of a patch is on an arm, -1 if the second one is."""
        for end, sign in zip(ends, (1.0, -1.0), strict=True):
            for kind in self.bodies:
                of = numbers(end, kind, -1)
                on = of >= 0
                self.sign[on] = sign
                self.owner[on], self.pulls[on] = self.arm_of[kind][of[on]], sign * self.moves[kind][of[on]]


def _near(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the geoms of links that come near objects, and which of these have no pad, which an object meets instead.

    They are the links that the first three joints all move.
    """
    model, found = scene.model, []
    for agent, mount in scene.mounts.items():
        held = {pad.link for pad in mount.arm.jaw.pads} if mount.arm.jaw else set()
        for geom in np.flatnonzero(model.geom_group == COLLISION_GROUP):
            name, body = model.geom(int(geom)).name, int(model.geom_bodyid[geom])
            if name.startswith(f"{agent}/") and _depth(model, body) >= 3:
                found.append((int(geom), model.body(body).name.split("/")[1] in held))
    return np.array([geom for geom, _ in found], int), np.flatnonzero([not holds for _, holds in found])


def _owners(model: mujoco.MjModel, bodies: np.ndarray) -> list[str]:
    """Return the agents whose bodies these are."""
    return [model.body(int(body)).name.split("/")[0] for body in bodies]


def _stacked(rows: list[tuple[Any, ...]], *shapes: tuple[int, ...]) -> Iterator[np.ndarray]:
    """Return an array for each column of some rows; `shapes` are those of one row."""
    for k, shape in enumerate(shapes):
        yield np.array([row[k] for row in rows], np.float32).reshape(-1, *shape)


def _depth(model: mujoco.MjModel, body: int) -> int:
    """Return how many joints move a body."""
    count = 0
    while body > 0:
        count += int(model.body_jntnum[body])
        body = int(model.body_parentid[body])
    return count


def _plate(part: Any, place: Placement) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return centre, frame, half sides of the core and radius of a box or plane in the world."""
    axes, half, radius, centre = np.eye(3), np.full(2, ENDLESS), THICK, np.array([0.0, 0.0, -THICK])
    if part.kind == "box":
        axes, half, radius = plate_of_box(part.size)
        centre = np.zeros(3)
    frame = place.rotation @ part.rotation @ axes
    return place.position + place.rotation @ (part.position + part.rotation @ centre), frame, half, radius


def _spans(plates: Plate) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return two opposite corners of boxes that hold the cores of plates, [n, 3] both, and their radii [n]."""
    half = (np.abs(plates.frame[..., :2]) @ plates.half[..., None])[..., 0]
    return plates.centre - half, plates.centre + half, plates.radius


def _box(one: Any, other: Any, radius: Any) -> np.ndarray:
    """Return two corners [2, 3] of the box about all that lies within a radius of the lines between points [n, 3]."""
    low, high = np.minimum(one, other) - radius[:, None], np.maximum(one, other) + radius[:, None]
    return np.stack([low.min(0, initial=np.inf), high.max(0, initial=-np.inf)]).astype(np.float32)


def _segment(part: Any, place: Placement) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the ends and the radius of a capsule or sphere in the world."""
    centre, axes = place.position + place.rotation @ part.position, place.rotation @ part.rotation
    half = part.size[1] * axes[:, 2] if part.kind == "capsule" else np.zeros(3)
    return centre - half, centre + half, float(part.size[0])
