"""Finds what touches objects and what is fixed in the world: at most `SLOTS` patches at a time.

Pairs of bodies that are far from each other cost a distance of a ball. What is found is kept in slots, so that all that
follows is in proportion to what touches, not to what could.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.bodies import Bodies, rotation
from surgical_marl.physics.patches import Patch, find_patch, no_patch
from surgical_marl.physics.shapes import Plate, Points, Segments, between_segments, on_plate
from surgical_marl.physics.tables import Meeting, Tables

SLOTS = 16
"""Patches at one time; more are counted, and not felt."""
NEAREST = 16
"""Pairs of two kinds of body that are near at one time; more are counted as patches that found no room."""
MARGIN = 2e-4
"""Distance within which a point that might touch during the step is watched, m: its stiffness grows from none there."""
AHEAD = 0.02
"""Distance up to which a point is watched, m, however fast it comes: 8 m/s in a step of 2.5 ms. What spins fast would
seem to come nearer from anywhere: by the angle times its distance."""
NEAR = MARGIN + 1e-4
"""Distance below which bodies count as touching, m."""


class Slots(NamedTuple):
    """The patches that were found, [s]."""

    patch: Patch
    number: Array
    """Of each patch in `Tables`, [s]."""
    total: Array
    """How many were found, []; more than there are slots if some found no room."""


class Way(NamedTuple):
    """How bodies move in a step with the velocities of now: a point p of one by shift + turn x p. World, [n]."""

    shift: Array
    """m, [n, 3]"""
    turn: Array
    """rad, [n, 3]"""

    def of(self, points: Points) -> Array:
        """Return by how much points come nearer along their normals in the step, if one body [] moves, m, [...]."""
        return -jnp.sum((self.shift + jnp.cross(self.turn, points.place)) * points.normal, -1)


class Joints(NamedTuple):
    """The axes of the joints of arms, [a, m]. World."""

    axis: Array
    """[a, m, 3]"""
    anchor: Array
    """A point on the axis, [a, m, 3]."""

    def columns(self, slides: Any, place: Array) -> tuple[Array, Array]:
        """Return the velocity of places [..., 3] and the angular velocity by joint velocity, [..., 3] both."""
        moving = jnp.where(slides[..., None], self.axis, jnp.cross(self.axis, place - self.anchor))
        return moving, jnp.where(slides[..., None], 0.0, self.axis)

    def bends(self, tables: Tables, speeds: Array) -> Array:
        """Return how each joint's motion at these speeds [a, m] bends with those before it, in memory, [a, m, 6].

        The sum over the joints that move a body is its acceleration without joint accelerations: as a twist about the
        world's origin, without the part that comes from turning past that origin (R. Featherstone, "Rigid Body Dynamics
        Algorithms", 2008, section 2.8).
        """

        def of_arm(row: tuple[Joints, Array, Array, Array]) -> Array:
            joints, slides, before, speed = row
            moving, turning = (x * speed[:, None] for x in joints.columns(slides, jnp.zeros(3)))
            lift, spin = before @ moving, before @ turning
            return jnp.concatenate([jnp.cross(spin, moving) + jnp.cross(lift, turning), jnp.cross(spin, turning)], -1)

        return jax.lax.map(of_arm, (self, tables.slides, tables.before, speeds))


class Placed(NamedTuple):
    """Where all bodies are and how they move."""

    position: Array
    """Centres of mass of the objects, [k, 3]."""
    frames: Array
    """Axes of their frames, [k, 3, 3]."""
    pads: Plate
    """[f]"""
    links: Segments
    """[l]"""
    ways: dict[str, Way]
    """Of what moves, by kind of body."""


class Finder:
    """Finds the patches of a scene."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self.slots = min(SLOTS, len(tables.stiffness))

    def joints(self, data: Any) -> Joints:
        """Return the axes of the arms' joints, in memory, from MJX's data with poses."""
        pad = lambda x: jnp.concatenate([x, jnp.zeros((1, 3))])[self._tables.dofs]  # noqa: E731
        return stored(Joints(pad(data.xaxis), pad(data.xanchor)))

    def find(self, data: Any, joints: Joints, qvel: Array, bodies: Bodies, dt: Any) -> Slots:
        """Return the patches between bodies that are near each other, or will be after a step.

        Args:
            data: MJX's data with the poses of the arms.
            joints: axes of the arms' joints.
            qvel: velocities of the arms' joints.
            bodies: the objects.
            dt: time over which motions are looked ahead, s.
        """
        placed = self._place(data, joints, qvel, bodies, dt)
        none, number = jnp.int32(0), 0
        slots = Slots(
            jax.tree.map(lambda x: jnp.broadcast_to(x, (self.slots, *x.shape)), no_patch()),
            jnp.zeros(self.slots, jnp.int32),
            none,
        )
        for meeting in self._tables.meetings:
            slots = self._meet(placed, meeting, number, slots)
            number += len(meeting.one)
        return slots

    def _meet(self, placed: Placed, meeting: Meeting, start: int, slots: Slots) -> Slots:
        """Return the slots with the patches of a meeting, whose numbers begin at `start`.

        Pairs that are near are listed first. Environments that run side by side then look closely at as many pairs as
        the one of them with most, and not at all that are near in any of them.
        """
        most = min(NEAREST, len(meeting.one))

        def look(found: tuple[Array, Array], pair: Array) -> tuple[tuple[Array, Array], None]:
            pairs, count = found
            near = self._is_near(placed, meeting, pair)
            pairs = pairs.at[jnp.where(near, count, most)].set(pair, mode="drop")
            return (pairs, count + near.astype(jnp.int32)), None

        none = jnp.zeros(most, jnp.int32), jnp.int32(0)
        (pairs, count), _ = jax.lax.scan(look, none, jnp.arange(len(meeting.one), dtype=jnp.int32))

        def meet(n: Array, slots: Slots) -> Slots:
            patch, touches = self._patch(placed, meeting, start, pairs[n])
            place = jnp.where(touches, slots.total, self.slots)
            put = lambda all_, one: all_.at[place].set(one, mode="drop")  # noqa: E731
            number = start + pairs[n]
            return Slots(jax.tree.map(put, slots.patch, patch), put(slots.number, number), slots.total + touches)

        if most == 1:
            return jax.lax.cond(count > 0, lambda slots: meet(jnp.int32(0), slots), lambda slots: slots, slots)
        slots = jax.lax.fori_loop(0, jnp.minimum(count, most), meet, slots)
        return slots._replace(total=slots.total + jnp.maximum(count - most, 0))

    def _is_near(self, placed: Placed, meeting: Meeting, pair: Array) -> Array:
        """Return whether two bodies may touch in the next step, []."""
        i, j = _numbers(meeting, pair)
        ways = self._ways(placed, meeting, i, j)
        if meeting.first == "objects":
            centre, bound = placed.position[i], jnp.asarray(self._tables.bound)[i]
            distance = self._distance(placed, meeting.second, j, centre) - bound
        else:
            link = row_of(self._capsules(placed, "links", i), 0)
            centre, bound = (
                (link.start + link.end) / 2,
                jnp.asarray(self._tables.link_half + self._tables.link_radius)[i],
            )
            distance = self._link_distance(placed, meeting.second, j, link)
        speed = sum(_size(way.shift + jnp.cross(way.turn, centre)) + _size(way.turn) * bound for way in ways if way)
        return distance < NEAR + jnp.minimum(speed, AHEAD)

    def _ways(self, placed: Placed, meeting: Meeting, i: Array, j: Array) -> tuple[Way, Way | None]:
        its = placed.ways.get(meeting.second)
        return row_of(placed.ways[meeting.first], i), None if its is None else row_of(its, j)

    def _patch(self, placed: Placed, meeting: Meeting, start: int, pair: Array) -> tuple[Patch, Array]:
        """Return the patch of two bodies, and whether they touch, 1 or 0."""
        points, axes = self._points(placed, meeting, pair)
        ways = self._ways(placed, meeting, *_numbers(meeting, pair))
        nearer = ways[0].of(points) - (0.0 if ways[1] is None else ways[1].of(points))
        soon = points.depth + jnp.minimum(nearer, AHEAD)
        patch = find_patch(points, soon, axes, jnp.asarray(self._tables.torsion)[start + pair])
        touches = jnp.maximum(jnp.max(points.depth), jnp.max(soon)) > -NEAR
        return patch, touches.astype(jnp.int32)

    def _points(self, placed: Placed, meeting: Meeting, pair: Array) -> tuple[Points, Array]:
        """Return all points [c, d] at which two bodies may touch, and two directions [2, 3] along which they spread."""
        i, j = _numbers(meeting, pair)
        if meeting.second in ("pads", "plates"):
            plate = self._plate(placed, meeting.second, j)
            touch, axes = lambda capsule: on_plate(capsule, plate), plate.frame[:, :2].T
        else:
            other = self._capsules(placed, meeting.second, j)
            touch, axes = lambda capsule: between_segments(capsule, other), jnp.eye(3)[:2]
        return jax.lax.map(touch, self._capsules(placed, meeting.first, i)), axes

    def depths(self, data: Any, joints: Joints, bodies: Bodies) -> Array:
        """Return how deep each pair of bodies overlaps, m, [g]; negative for a distance."""
        placed, found = self._place(data, joints, jnp.zeros(len(data.qpos)), bodies, 0.0), [jnp.zeros(0)]
        for meeting in self._tables.meetings:
            deepest = lambda pair, m=meeting: self._points(placed, m, pair)[0].depth.max()  # noqa: E731
            found.append(jax.lax.map(deepest, np.arange(len(meeting.one), dtype=np.int32)))
        return jnp.concatenate(found)

    # -- bodies

    def _place(self, data: Any, joints: Joints, qvel: Array, bodies: Bodies, dt: Any) -> Placed:
        t, turn, frames = self._tables, dt * bodies.velocity[:, 3:], rotation(bodies.quaternion)
        axes = jnp.matmul(data.geom_xmat[t.pad_geoms], jnp.asarray(t.pad_axes))
        pads = Plate(
            stored(data.geom_xpos[t.pad_geoms]), stored(axes), jnp.asarray(t.pad_half), jnp.asarray(t.pad_radius)
        )
        centre = data.geom_xpos[t.near]
        half = jnp.asarray(t.link_half)[:, None] * data.geom_xmat[t.near][:, :, 2]
        links = Segments(stored(centre - half), stored(centre + half), jnp.asarray(t.link_radius))
        ways = {"objects": stored(Way(dt * bodies.velocity[:, :3] - jnp.cross(turn, bodies.position), turn))}
        moves, columns = dt * jnp.append(qvel, 0.0)[t.dofs], joints.columns(jnp.asarray(t.slides), jnp.zeros(3))
        by_joint = stored(tuple(column * moves[..., None] for column in columns))
        for kind in t.bodies:
            own = t.arm_of[kind], t.moves[kind]
            ways[kind] = Way(*jax.lax.map(lambda row: _moved(row[0], row[1], by_joint), own))
        return Placed(stored(bodies.position), stored(frames), pads, links, ways)

    def _capsules(self, placed: Placed, kind: str, i: Array) -> Segments:
        """Return the capsules of one body, [c]."""
        t = self._tables
        if kind == "objects":
            frame, at = placed.frames[i], placed.position[i]
            start, end = (at + jnp.asarray(x)[i] @ frame.T for x in (t.start, t.end))
            return Segments(start, end, jnp.asarray(t.radius)[i])
        of = placed.links if kind == "links" else jax.tree.map(jnp.asarray, t.rods)
        return jax.tree.map(lambda x: x[i][None], of)

    def _plate(self, placed: Placed, kind: str, j: Array) -> Plate:
        return row_of(placed.pads if kind == "pads" else jax.tree.map(jnp.asarray, self._tables.plates), j)

    def _distance(self, placed: Placed, kind: str, j: Array, point: Array) -> Array:
        """Return a lower bound of the distance of a point from a body, m; exact for plates and capsules."""
        if kind == "objects":
            return _size(point - placed.position[j]) - jnp.asarray(self._tables.bound)[j]
        if kind in ("pads", "plates"):
            plate = self._plate(placed, kind, j)
            local = (point - plate.centre) @ plate.frame
            beside = local[:2] - jnp.clip(local[:2], -plate.half, plate.half)
            return jnp.sqrt(jnp.sum(beside * beside) + local[2] * local[2]) - plate.radius
        rod = row_of(self._capsules(placed, kind, j), 0)
        way = rod.end - rod.start
        share = jnp.clip((point - rod.start) @ way / jnp.maximum(way @ way, 1e-12), 0.0, 1.0)
        return _size(point - rod.start - share * way) - rod.radius

    def _link_distance(self, placed: Placed, kind: str, j: Array, link: Segments) -> Array:
        """Return a lower bound of the distance of a link from what is fixed, m; exact for rods."""
        if kind == "rods":
            return -between_segments(link, row_of(self._capsules(placed, kind, j), 0)).depth
        plate = self._plate(placed, kind, j)
        heights = jnp.stack([(end - plate.centre) @ plate.frame[:, 2] for end in (link.start, link.end)])
        beyond = jnp.maximum(jnp.min(heights), -jnp.max(heights))  # on one side of the middle plane, if above 0
        return jnp.maximum(beyond, 0.0) - plate.radius - link.radius


def _numbers(meeting: Meeting, pair: Array) -> tuple[Array, Array]:
    """Return the numbers of the two bodies of a pair."""
    return tuple(jnp.asarray(of.astype(np.int32))[pair] for of in (meeting.one, meeting.other))  # type: ignore[return-value]


def stored(tree: Any) -> Any:
    """Return the same arrays: the fused engine keeps what a loop has written in memory, where it can be looked up."""
    return jax.lax.map(lambda row: row, tree)


def _moved(arm: Array, moves: Array, joints: tuple[Array, Array]) -> tuple[Array, Array]:
    return tuple(moves @ of[arm] for of in joints)  # type: ignore[return-value]


def row_of(tree: Any, i: Array | int) -> Any:
    """Return one row of all arrays of a tree."""
    return jax.tree.map(lambda x: x[i], tree)


def _size(vector: Array) -> Array:
    return jnp.sqrt(jnp.sum(vector * vector, -1))
