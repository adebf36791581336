"""Broadphase: where the bodies of a scene are, how far they move in a step, and lower bounds of their distances."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.contact.contact_pairs import ContactPairs
from surgical_marl.physics.contact.shapes import Plate, Points, Segments, between_segments, in_frame
from surgical_marl.physics.systems.rigid_motion import Bodies, rotation
from surgical_marl.physics.tree_utils import row_of


class Displacement(NamedTuple):
    """The motion of bodies in a step at their present velocities: a point p moves by shift + turn x p. World, [n]."""

    shift: Array
    """m, [n, 3]"""
    turn: Array
    """rad, [n, 3]"""

    def approach(self, points: Points) -> Array:
        """Return how much nearer along their normals points come in the step if the first body moves, m, [...]."""
        return -jnp.sum((self.shift + jnp.cross(self.turn, points.place)) * points.normal, -1)


class Joints(NamedTuple):
    """The axes of the joints of arms, [a, m]. World."""

    axis: Array
    """[a, m, 3]"""
    anchor: Array
    """A point on the axis, [a, m, 3]."""

    def columns(self, slides: Any, place: Array) -> tuple[Array, Array]:
        """Return columns of the Jacobian at places [..., 3]: velocity and angular velocity per joint velocity.

        Args:
            slides: which joints are prismatic, [a, m].
            place: in the world, m; the last axis but one is for the joints.
        """
        moving = jnp.where(slides[..., None], self.axis, jnp.cross(self.axis, place - self.anchor))
        return moving, jnp.where(slides[..., None], 0.0, self.axis)


class Ball(NamedTuple):
    """Bounding balls of bodies, [n]. World."""

    centre: Array
    """m, [n, 3]"""
    radius: Array
    """m, [n]"""
    moves: Array
    """Largest displacement of any point of the body in a step, m, [n]."""


class Placed(NamedTuple):
    """Poses, displacements and bounding balls of all bodies."""

    position: Array
    """Centres of mass of the objects, [k, 3]."""
    frames: Array
    """Axes of their frames, [k, 3, 3]."""
    pads: Plate
    """Pads of fingers, [f]."""
    links: Segments
    """Capsules of the arms' links, [l]."""
    displacements: dict[str, Displacement]
    """Displacements by kind of body; fixed kinds have none."""
    balls: dict[str, Ball]
    """Bounding balls by kind of body."""


class Places:
    """Computes where the bodies of a scene are. Kinds of bodies are those of `ContactPairs.meetings`."""

    def __init__(self, tables: ContactPairs) -> None:
        self._tables = tables

    def joints(self, data: Any) -> Joints:
        """Return the axes of the arms' joints from MJX's data with poses."""

        def by_arm(x: Array) -> Array:
            return jnp.concatenate([x, jnp.zeros((1, 3))])[self._tables.dofs]

        return Joints(by_arm(data.xaxis), by_arm(data.xanchor))

    def place(self, data: Any, joints: Joints, qvel: Array, bodies: Bodies, dt: Any) -> Placed:
        """Return where all bodies are, and how they move in a step of `dt`, s.

        Args:
            data: MJX's data with the poses of the arms.
            joints: axes of the arms' joints.
            qvel: velocities of the arms' joints.
            bodies: the objects.
            dt: duration of a step, s.
        """
        t, turn, frames = self._tables, dt * bodies.velocity[:, 3:], rotation(bodies.quaternion)
        axes = jnp.matmul(data.geom_xmat[t.pad_geoms], jnp.asarray(t.pad_axes))
        pads = Plate(data.geom_xpos[t.pad_geoms], axes, jnp.asarray(t.pad_half), jnp.asarray(t.pad_radius))
        centre = data.geom_xpos[t.near]
        half = jnp.asarray(t.link_half)[:, None] * data.geom_xmat[t.near][:, :, 2]
        links = Segments(centre - half, centre + half, jnp.asarray(t.link_radius))
        displacements = {"objects": Displacement(dt * bodies.velocity[:, :3] - jnp.cross(turn, bodies.position), turn)}
        moves, columns = dt * jnp.append(qvel, 0.0)[t.dofs], joints.columns(jnp.asarray(t.slides), jnp.zeros(3))
        by_joint = tuple(column * moves[..., None] for column in columns)
        for kind in t.bodies:  # not in a loop: links of an arm are moved by what moves those before them, and more
            displacements[kind] = Displacement(
                *(jnp.einsum("nm,nmd->nd", t.moves[kind], of[t.arm_of[kind]]) for of in by_joint)
            )
        around = {"objects": (bodies.position, jnp.asarray(t.bound)), "pads": _around(pads), "links": _around(links)}
        around |= {"plates": _around(t.plates), "rods": _around(t.rods)}
        balls = {kind: _ball(*ball, displacements.get(kind)) for kind, ball in around.items()}
        return Placed(bodies.position, frames, pads, links, displacements, balls)

    def capsules(self, placed: Placed, kind: str, i: Array) -> Segments:
        """Return all capsules of one body, [c]; one for a link or a rod."""
        if kind == "objects":
            return jax.vmap(lambda c: self.capsule(placed, kind, i, c))(jnp.arange(self._tables.radius.shape[1]))
        return jax.tree.map(lambda x: x[None], self.capsule(placed, kind, i, jnp.int32(0)))

    def capsule(self, placed: Placed, kind: str, i: Array, c: Array) -> Segments:
        """Return one capsule of one body."""
        t = self._tables
        if kind != "objects":
            return row_of(placed.links if kind == "links" else jax.tree.map(jnp.asarray, t.rods), i)
        frame, at = placed.frames[i], placed.position[i]
        start, end = (at + frame @ jnp.asarray(x)[i, c] for x in (t.start, t.end))
        return Segments(start, end, jnp.asarray(t.radius)[i, c])

    def plate(self, placed: Placed, kind: str, j: Array) -> Plate:
        """Return the plate of one body."""
        return row_of(placed.pads if kind == "pads" else jax.tree.map(jnp.asarray, self._tables.plates), j)

    def distance(self, placed: Placed, kind: str, j: Array, point: Array) -> Array:
        """Return a lower bound of the distance of a point from a body, m; exact for plates and capsules."""
        if kind == "objects":
            return size(point - placed.position[j]) - jnp.asarray(self._tables.bound)[j]
        if kind in ("pads", "plates"):
            plate = self.plate(placed, kind, j)
            local = in_frame(point, plate)
            beside = local[:2] - jnp.clip(local[:2], -plate.half, plate.half)
            return jnp.sqrt(jnp.sum(beside * beside) + local[2] * local[2]) - plate.radius
        rod = self.capsule(placed, kind, j, jnp.int32(0))
        return size(point - nearest(rod, point)) - rod.radius

    def gaps(self, placed: Placed, kind: str, fixed: str) -> Array:
        """Return lower bounds of the distances of all objects, or links, from all fixed bodies of a kind, m, [n]."""
        t, links = self._tables, placed.links
        if kind == "links" and fixed == "plates":
            return jnp.min(_beside(jax.tree.map(lambda x: x[:, None], links), t.plates), 1)
        start, end, radius = (placed.position, placed.position, t.bound) if kind == "objects" else links
        return jnp.max(_beyond(start, end, *t.boxes[fixed]), -1) - radius

    def capsule_gap(self, placed: Placed, i: Array, kind: str, j: Array) -> Callable[[Array], Array]:
        """Return a function from a capsule of object i to a lower bound of its distance from a body, m.

        The bound is that of the capsule's bounding ball. Between long capsules and a plate it is that of a box around
        the capsule's axis, along the plate's sides: balls around the bars of a block are too large to tell which bar a
        finger is near.
        """
        t, frame, at = self._tables, placed.frames[i], placed.position[i]
        if kind not in ("pads", "plates") or not t.has_bars:

            def ball_gap(c: Array) -> Array:
                middle = at + frame @ jnp.asarray(t.middle)[i, c]
                return self.distance(placed, kind, j, middle) - jnp.asarray(t.around)[i, c]

            return ball_gap
        plate = self.plate(placed, kind, j)
        turn, place, half = plate.frame.T @ frame, in_frame(at, plate), jnp.append(plate.half, 0.0)

        def box_gap(c: Array) -> Array:
            start, end = (place + turn @ jnp.asarray(of)[i, c] for of in (t.start, t.end))
            beyond = jnp.maximum(_beyond(start, end, -half, half), 0.0)
            return size(beyond) - plate.radius - jnp.asarray(t.radius)[i, c]

        return box_gap

    def link_distance(self, placed: Placed, kind: str, j: Array, link: Segments) -> Array:
        """Return a lower bound of the distance of a link from what is fixed, m; exact for rods."""
        if kind == "rods":
            return -between_segments(link, self.capsule(placed, kind, j, jnp.int32(0))).depth
        return _beside(link, self.plate(placed, kind, j))


def _beside(link: Segments, plate: Plate) -> Array:
    """Return lower bounds of the distances of links from plates, m. Shapes of the two broadcast."""
    one, other = (jnp.sum((end - plate.centre) * plate.frame[..., 2], -1) for end in (link.start, link.end))
    beyond = jnp.maximum(jnp.minimum(one, other), -jnp.maximum(one, other))  # on one side of the middle plane, if > 0
    return jnp.maximum(beyond, 0.0) - plate.radius - link.radius


def _beyond(start: Array, end: Array, low: Any, high: Any) -> Array:
    """Return the gap between the box around a segment and another box on each axis, [3]; negative if they overlap."""
    return jnp.maximum(jnp.minimum(start, end) - high, low - jnp.maximum(start, end))


def size(vector: Array) -> Array:
    """Return the length of vectors [..., 3]."""
    return jnp.sqrt(jnp.sum(vector * vector, -1))


def nearest(segment: Segments, points: Array) -> Array:
    """Return the points [..., 3] of a segment that are nearest to points [..., 3]."""
    axis = segment.end - segment.start
    share = jnp.clip((points - segment.start) @ axis / jnp.maximum(axis @ axis, 1e-12), 0.0, 1.0)
    return segment.start + share[..., None] * axis


def between_balls(one: Ball, other: Ball) -> Array:
    """Return the distances of balls, m; negative where they overlap. Shapes of the two broadcast."""
    return size(one.centre - other.centre) - one.radius - other.radius


def _around(shapes: Plate | Segments) -> tuple[Array, Array]:
    """Return centres [n, 3] and radii [n] of the bounding balls of shapes."""
    if isinstance(shapes, Plate):
        return jnp.asarray(shapes.centre), size(jnp.asarray(shapes.half)) + shapes.radius
    return (shapes.start + shapes.end) / 2, size(shapes.end - shapes.start) / 2 + shapes.radius


def _ball(centre: Any, radius: Any, displacement: Displacement | None) -> Ball:
    moves = jnp.zeros(len(centre))
    if displacement is not None:
        shift, turn = displacement
        moves = size(shift + jnp.cross(turn, centre)) + size(turn) * radius
    return Ball(jnp.asarray(centre), jnp.asarray(radius), moves)
