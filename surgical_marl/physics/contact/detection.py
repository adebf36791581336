"""Collision detection of objects, and of links with fixed bodies: at most `SLOTS` patches; more are only counted.

A pair of bodies that are far apart costs the distance of two balls. Patches are kept in slots, so the cost of all later
work grows with the bodies that touch, not with those that could.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics import skip
from surgical_marl.physics.contact.broadphase import Ball, Displacement, Joints, Placed, Places, between_balls
from surgical_marl.physics.contact.contact_pairs import ContactPairs, Meeting
from surgical_marl.physics.contact.contact_patch import BLEND, TILT, TILT_IN_JAW, Patch, find_patch, no_patch
from surgical_marl.physics.contact.shapes import Points, Segments, between_segments, on_plate
from surgical_marl.physics.systems.rigid_motion import Bodies
from surgical_marl.physics.systems.sleeping import Company, company, moving
from surgical_marl.physics.tree_utils import Listed, put, room, row_of, when
from surgical_marl.scenes.object_contacts import SLOTS

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
    """Number of each patch in `ContactPairs`, [s]."""
    total: Array
    """Number of patches, []; more than there are slots if some found no room."""
    company: Company
    """Neighbours of the objects."""
    awake: Array
    """Objects that are not at rest, [k] bool: objects at rest have no patches."""

    @property
    def found(self) -> Array:
        """Number of slots in use, []; the slots after them hold nothing."""
        return jnp.minimum(self.total, len(self.number))


class Detection:
    """Finds the patches of a scene."""

    def __init__(self, tables: ContactPairs) -> None:
        self._tables, self._places = tables, Places(tables)
        self.slots = min(SLOTS, len(tables.stiffness))

    def joints(self, data: Any) -> Joints:
        """Return the axes of the arms' joints from MJX's data with poses."""
        return self._places.joints(data)

    def find(self, data: Any, joints: Joints, qvel: Array, bodies: Bodies, dt: Any) -> Slots:
        """Return the patches between bodies that are near each other, or will be after a step.

        Args:
            data: MJX's data with the poses of the arms.
            joints: axes of the arms' joints.
            qvel: velocities of the arms' joints.
            bodies: the objects.
            dt: time over which motions are looked ahead, s.
        """
        placed = self._places.place(data, joints, qvel, bodies, dt)
        near = company(placed, self._tables.slender, _reach)
        awake, none = near.spread(moving(bodies)) | (not skip.enabled("sleeping")), jnp.int32(0)
        number, rows = 0, self.slots + 1  # what finds no room goes to the last one
        slots = Slots(room(jax.eval_shape(no_patch), rows), jnp.zeros(rows, jnp.int32), none, near, awake)
        for meeting in self._tables.meetings:
            slots = self._meet(placed, meeting, number, slots)
            number += len(meeting.one)
        patch, numbers = jax.tree.map(lambda x: x[:-1], (slots.patch, slots.number))
        return slots._replace(patch=patch, number=numbers)

    def _meet(self, placed: Placed, meeting: Meeting, start: int, slots: Slots) -> Slots:
        """Return the slots with the patches of a meeting, whose numbers begin at `start`.

        Pairs that are near are listed first. Environments run in lockstep: with a list the narrow phase takes as many
        rounds as the longest list of any environment; without one it would visit each pair that is near in any.
        """
        most = min(NEAREST, len(meeting.one))
        pairs, count = self._near_pairs(placed, meeting, slots.awake, most)

        def meet(n: Array, slots: Slots) -> Slots:
            patch, touches = self._patch(placed, meeting, start, pairs[n])
            place = jnp.where(touches, jnp.minimum(slots.total, self.slots), self.slots)
            kept = put((slots.patch, slots.number), place, (patch, start + pairs[n]))
            total = slots.total + touches.astype(jnp.int32)
            return slots._replace(patch=kept[0], number=kept[1], total=total)

        if most == 1:
            return when(count > 0, lambda slots: meet(jnp.int32(0), slots), slots)
        slots = jax.lax.fori_loop(0, jnp.minimum(count, most), meet, slots)
        return slots._replace(total=slots.total + jnp.maximum(count - most, 0))

    def _near_pairs(self, placed: Placed, meeting: Meeting, awake: Array, most: int) -> Listed:
        """Return the numbers of pairs that may touch in the next step, at most so many.

        The partners of a first body are visited in a loop, unless all are far from it or it is an object at rest. That
        test is made for all first bodies at once: a loop that tests one at a time takes ten times as long on a GPU,
        which waits for the memory in each round.
        """
        one, other = (of.astype(np.int32).reshape(-1, meeting.partners) for of in (meeting.one, meeting.other))
        near = self._perhaps_near(placed, meeting, one[:, 0], other)
        if meeting.first == "objects":
            near &= awake[one[:, 0], None]

        def of_one(found: Listed, row: Any) -> tuple[Listed, None]:
            number, i, others, near = row

            def look(found: Listed, partner: Any) -> tuple[Listed, None]:
                k, j, near = partner
                near = jax.lax.cond(near, lambda: self._is_near(placed, meeting, i, j), lambda: jnp.bool_(False))
                return found.after(meeting.partners * number + k, near), None

            partners = jnp.arange(meeting.partners), others, near
            return _if_any(near, lambda found: jax.lax.scan(look, found, partners)[0], found), None

        rows = jnp.arange(len(one)), one[:, 0], other, near
        return _if_any(near, lambda found: jax.lax.scan(of_one, found, rows)[0], Listed.none(most))

    def _perhaps_near(self, placed: Placed, meeting: Meeting, one: np.ndarray, other: np.ndarray) -> Array:
        """Return which of bodies `one` [n] may touch each of its partners `other` [n, p] in the next step, [n, p].

        The bounding balls decide. A body that may be near any fixed body of a kind counts as near all of them.
        """
        balls, partners = row_of(placed.balls[meeting.first], one), row_of(placed.balls[meeting.second], other)
        if meeting.second in self._tables.boxes:
            gaps = self._places.gaps(placed, meeting.first, meeting.second)[one]
            return jnp.broadcast_to((gaps < _reach(balls))[:, None], other.shape)
        own = Ball(*(x[:, None] for x in balls))
        return between_balls(own, partners) < _reach(own, partners)

    def _is_near(self, placed: Placed, meeting: Meeting, i: Array, j: Array) -> Array:
        """Return whether two bodies i and j may touch in the next step, []."""
        one, other = row_of(placed.balls[meeting.first], i), row_of(placed.balls[meeting.second], j)
        reach = _reach(one, other)

        def looked_at(_: None) -> Array:
            if meeting.first == "objects":
                return self._places.distance(placed, meeting.second, j, one.centre) - one.radius < reach
            link = self._places.capsule(placed, "links", i, jnp.int32(0))
            return self._places.link_distance(placed, meeting.second, j, link) < reach

        if meeting.second not in self._tables.boxes:  # `_perhaps_near` has compared their balls
            return looked_at(None)
        return jax.lax.cond(between_balls(one, other) < reach, looked_at, lambda _: jnp.bool_(False), None)

    def _displacements(
        self, placed: Placed, meeting: Meeting, i: Array, j: Array
    ) -> tuple[Displacement, Displacement | None]:  # fmt: skip
        """Return the displacements of two bodies in the step; None for a second one that is fixed."""
        second = placed.displacements.get(meeting.second)
        return row_of(placed.displacements[meeting.first], i), None if second is None else row_of(second, j)

    def _patch(self, placed: Placed, meeting: Meeting, start: int, pair: Array) -> tuple[Patch, Array]:
        """Return the patch of two bodies, and whether they touch."""
        i, j = _numbers(meeting, pair)
        touch, axes = self._touch(placed, meeting.second, j)
        first, second = self._displacements(placed, meeting, i, j)
        capsules, count = self._near_capsules(placed, meeting, i, j)

        def look(n: Array) -> tuple[Points, Array]:
            points = touch(self._places.capsule(placed, meeting.first, i, capsules[n]))
            nearer = first.approach(points) - (0.0 if second is None else second.approach(points))
            return points, points.depth + jnp.minimum(nearer, AHEAD)

        torsion, middle = jnp.asarray(self._tables.torsion)[start + pair], placed.balls[meeting.first].centre[i]
        centre = middle if meeting.first == "objects" and meeting.second != "pads" else None
        patch = find_patch(look, count, self._tables.radius.shape[1], middle, axes, _tilt(meeting), torsion, centre)
        return patch, patch.reach > -NEAR

    def _near_capsules(self, placed: Placed, meeting: Meeting, i: Array, j: Array) -> Listed:
        """Return the numbers of a body's capsules that may have a part in a patch.

        A capsule is left out if it is farther away than a capsule that touches by more than a tilt can make up for: its
        angle, times the distance between places of the two.
        """
        c = self._tables.radius.shape[1]
        if meeting.first != "objects" or c == 1:
            return Listed(jnp.zeros(1, jnp.int32), jnp.int32(1))
        one, other = (row_of(placed.balls[kind], n) for kind, n in (("objects", i), (meeting.second, j)))
        # places between the surfaces of both are that far from each other at most, but for half of their distances
        spread, tilt = 2 * jnp.minimum(one.radius, other.radius), _tilt(meeting)
        reach = (_reach(one, other) + tilt * spread + BLEND) / (1 - tilt)
        gap = self._places.capsule_gap(placed, i, meeting.second, j)

        def look(found: Listed, capsule: Array) -> tuple[Listed, None]:
            return found.after(capsule, gap(capsule) < reach), None

        return jax.lax.scan(look, Listed.none(c), jnp.arange(c, dtype=jnp.int32))[0]

    def _touch(self, placed: Placed, kind: str, j: Array) -> tuple[Callable[[Segments], Points], Array]:
        """Return a function from a capsule to the points [d] where it may touch a body, and axes of tilts, [2, 3]."""
        if kind in ("pads", "plates"):
            plate = self._places.plate(placed, kind, j)
            return lambda capsule: on_plate(capsule, plate), plate.frame[:, :2].T
        other = self._places.capsules(placed, kind, j)
        return lambda capsule: between_segments(capsule, other), jnp.eye(3)[:2]

    def depths(self, data: Any, joints: Joints, bodies: Bodies) -> Array:
        """Return how deep each pair of bodies overlaps, m, [g]; negative for a distance."""
        placed, found = self._places.place(data, joints, jnp.zeros(len(data.qpos)), bodies, 0.0), [jnp.zeros(0)]
        for meeting in self._tables.meetings:

            def deepest(pair: Array, meeting: Meeting = meeting) -> Array:
                i, j = _numbers(meeting, pair)
                touch, _ = self._touch(placed, meeting.second, j)
                return jnp.max(jax.lax.map(touch, self._places.capsules(placed, meeting.first, i)).depth)

            found.append(jax.lax.map(deepest, np.arange(len(meeting.one), dtype=np.int32)))
        return jnp.concatenate(found)


def _reach(*balls: Ball) -> Array:
    """Return the distance below which bodies may touch in the next step, m."""
    return NEAR + jnp.minimum(sum(ball.moves for ball in balls), AHEAD)


def _tilt(meeting: Meeting) -> float:
    """Return by how much bodies are tilted to find the rim of their contact, rad."""
    return TILT_IN_JAW if meeting.second == "pads" else TILT


def _if_any(near: Array, change: Callable[[Any], Any], found: Any) -> Any:
    """Return `change(found)` if anything is near, else `found`."""
    return skip.cond("far_pairs", near.any(), change, lambda found: found, found)


def _numbers(meeting: Meeting, pair: Array) -> tuple[Array, Array]:
    """Return the numbers of the two bodies of a pair."""
    return tuple(jnp.asarray(of.astype(np.int32))[pair] for of in (meeting.one, meeting.other))  # type: ignore[return-value]
