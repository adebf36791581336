"""The constants of contact with objects: which bodies of a scene can touch, their shapes and surfaces.

Patches are in the order of `Tables.meetings`, and within one in that of its bodies.
"""

from __future__ import annotations

from itertools import combinations, product
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl.physics.bodies import Masses
from surgical_marl.physics.patches import AWAY
from surgical_marl.physics.shapes import Plate, Segments, plate_of_box
from surgical_marl.robots.spec import COLLISION_GROUP, PAD_GROUP
from surgical_marl.scenes.objects import JAW, LINK, Placement, Surface

ENDLESS = 10.0
"""Half side of the plate that stands for a plane, m."""
THICK = 0.01
"""Radius of that plate, m: the plane is its upper face."""


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
    """Kind of the second body: "pads", "links", "objects" or "fixed"."""
    other: np.ndarray
    """Numbers of the second bodies, [m]; all the same for a fixed one."""
    surfaces: tuple[Surface, ...]
    """How each pair feels."""


class Tables:
    """Constants of a scene with objects, or of its objects alone."""

    def __init__(self, scene: Any, arms: bool = True) -> None:
        model = scene.model
        free = scene.free_objects
        self.names, self.count = tuple(free), len(free)
        self.fingers = tuple(
            Finger(agent, int(g), int(model.geom_bodyid[g]))
            for agent in scene.agents
            for g in np.flatnonzero(model.geom_group == PAD_GROUP)
            if arms and model.geom(int(g)).name.startswith(f"{agent}/")
        )
        owners = [finger.agent for finger in self.fingers]
        numbers = {a: [f for f, owner in enumerate(owners) if owner == name] for a, name in enumerate(scene.agents)}
        self.jaws = {arm: (own[0], own[1]) for arm, own in numbers.items() if len(own) == 2}
        """Number of an arm -> its two fingers."""
        self.near, self.bare = _near(scene) if arms else (np.zeros(0, int), np.zeros(0, int))
        self._read_free(free)
        self._read_links(model)
        self._read_fixed({n: place for n, place in scene.objects.items() if not place.object.free})
        self._number(free, model, scene.agents)

    # -- shapes where they are now

    def segments(self, position: Array, frames: Array) -> Segments:
        """Return the capsules of the objects [k, c] in the world; those that pad an object with fewer are far away."""
        start, end = (
            position[:, None] + jnp.matmul(jnp.asarray(x), jnp.swapaxes(frames, -1, -2))
            for x in (self._start, self._end)
        )
        return Segments(start, end, jnp.asarray(self._radius))

    def pads(self, data: Any) -> Plate:
        """Return the plates of all fingers, [f]."""
        geoms = np.array([finger.geom for finger in self.fingers], int)
        frame = jnp.matmul(data.geom_xmat[geoms], jnp.asarray(self._pad_axes))
        return Plate(data.geom_xpos[geoms], frame, jnp.asarray(self._pad_half), jnp.asarray(self._pad_radius))

    def links(self, data: Any) -> Segments:
        """Return the capsules of the other links that come near objects, [l]."""
        centre, axis = data.geom_xpos[self.near], data.geom_xmat[self.near][:, :, 2]
        half = jnp.asarray(self._link_half)[:, None]
        return Segments(centre - half * axis, centre + half * axis, jnp.asarray(self._link_radius))

    # -- set up

    def _read_free(self, free: dict[str, Placement]) -> None:
        most = max((len(place.object.shapes) for place in free.values()), default=1)
        shape = (self.count, most)
        self._start, self._end = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
        self._radius = np.full(shape, 2 * AWAY, np.float32)  # of capsules that are not there
        for o, place in enumerate(free.values()):
            for c, part in enumerate(place.object.shapes):
                if part.kind not in ("capsule", "sphere"):
                    name = place.object.name
                    raise ValueError(
                        f"object {name!r}: a free object is made of capsules and spheres, not a {part.kind}"
                    )
                half = part.size[1] * part.rotation[:, 2] if part.kind == "capsule" else np.zeros(3)
                middle = part.position - place.object.center
                self._start[o, c], self._end[o, c], self._radius[o, c] = middle - half, middle + half, part.size[0]
        objects = [place.object for place in free.values()]
        self.masses = Masses(
            np.array([thing.mass for thing in objects], np.float32),  # type: ignore[arg-type]
            np.array([thing.inertia for thing in objects], np.float32).reshape(-1, 3, 3),  # type: ignore[arg-type]
        )
        self.centers = np.array([thing.center for thing in objects], np.float32).reshape(-1, 3)

    def _read_links(self, model: mujoco.MjModel) -> None:
        plates = [plate_of_box(model.geom_size[finger.geom]) for finger in self.fingers]
        single = lambda values, shape: np.array(values, np.float32).reshape(shape)  # noqa: E731
        self._pad_axes = single([axes for axes, _, _ in plates], (-1, 3, 3))
        self._pad_half = single([half for _, half, _ in plates], (-1, 2))
        self._pad_radius = single([radius for _, _, radius in plates], (-1,))
        capsule = model.geom_type[self.near] == mujoco.mjtGeom.mjGEOM_CAPSULE
        self._link_half = single(np.where(capsule, model.geom_size[self.near, 1], 0.0), (-1,))
        self._link_radius = single(model.geom_size[self.near, 0], (-1,))
        pads = np.array([finger.body for finger in self.fingers], int)
        self.bodies = {"pads": pads, "links": model.geom_bodyid[self.near]}
        """The model's bodies of each kind of thing that an arm has."""

    def _read_fixed(self, fixed: dict[str, Placement]) -> None:
        self.fixed: list[Plate | Segments] = []
        """The plates of every fixed object that has any, and its capsules."""
        self._fixed_surfaces: list[Surface] = []
        for place in fixed.values():
            parts = place.object.shapes
            flat = [_plate(part, place) for part in parts if part.kind in ("box", "plane")]
            thin = [_segment(part, place) for part in parts if part.kind in ("capsule", "sphere")]
            for kind, found in ((Plate, flat), (Segments, thin)):
                if found:
                    self.fixed.append(kind(*(np.array(x, np.float32) for x in zip(*found, strict=True))))  # type: ignore[arg-type]
                    self._fixed_surfaces.append(place.object.surface)

    def _number(self, free: dict[str, Placement], model: mujoco.MjModel, agents: tuple[str, ...]) -> None:
        """Set the number of each patch, the bodies that it is between, and how their surfaces feel."""
        own = [place.object.surface for place in free.values()]
        felt = {"pads": [JAW] * len(self.fingers), "links": [LINK] * len(self.near), "objects": own,
                "fixed": self._fixed_surfaces}  # fmt: skip
        objects, fingers, links = (range(count) for count in (self.count, len(self.fingers), len(self.near)))
        pairs = [
            ("objects", "pads", list(product(objects, fingers))),
            ("objects", "links", list(product(objects, self.bare.tolist()))),
            *(("objects", "fixed", [(o, i) for o in objects]) for i in range(len(self.fixed))),
            ("objects", "objects", list(combinations(objects, 2))),
            *(("links", "fixed", [(n, i) for n in links]) for i in range(len(self.fixed))),
        ]
        self.meetings = tuple(
            Meeting(first, np.array([a for a, _ in which]), second, np.array([b for _, b in which]),
                    tuple(felt[first][a].against(felt[second][b]) for a, b in which))
            for first, second, which in pairs if which
        )  # fmt: skip
        ends = [(m.first, m.one) for m in self.meetings], [(m.second, m.other) for m in self.meetings]
        (self.first_object, self.first_body), (self.second_object, self.second_body) = map(self._ends, ends)
        surfaces = [surface for meeting in self.meetings for surface in meeting.surfaces]
        each = lambda of: np.array([getattr(surface, of) for surface in surfaces], np.float32)  # noqa: E731
        self.sliding, self.torsion, self.stiffness = each("sliding"), each("torsion"), each("stiffness")
        owner = lambda body: agents.index(model.body(int(body)).name.split("/")[0]) if body >= 0 else -1  # noqa: E731
        self.owner = np.array([owner(max(pair)) for pair in zip(self.first_body, self.second_body, strict=True)], int)
        """The arm that a patch is on, by its number; -1 if it is on none."""
        pads = [(o, f) for o, f in product(objects, fingers)]
        self.grip = {pair: g for g, pair in enumerate(pads)}
        """(object, finger) -> its patch."""
        self.remembers = np.arange(len(surfaces)) < len(pads)

    def _ends(self, ends: list[tuple[str, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
        """Return the objects and the model's bodies at one end of all patches, [g] each; -1 where it is neither."""
        objects, links = [np.zeros(0, int)], [np.zeros(0, int)]
        for kind, numbers in ends:
            neither = np.full(len(numbers), -1)
            objects.append(numbers if kind == "objects" else neither)
            links.append(self.bodies[kind][numbers] if kind in self.bodies else neither)
        return np.concatenate(objects), np.concatenate(links)


def _near(scene: Any) -> tuple[np.ndarray, np.ndarray]:
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


def _segment(part: Any, place: Placement) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the ends and the radius of a capsule or sphere in the world."""
    centre, axes = place.position + place.rotation @ part.position, place.rotation @ part.rotation
    half = part.size[1] * axes[:, 2] if part.kind == "capsule" else np.zeros(3)
    return centre - half, centre + half, float(part.size[0])
