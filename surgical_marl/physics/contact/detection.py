"""Finds what touches objects and what is fixed in the world: at most `SLOTS` patches at a time; more are counted.

Pairs of bodies that are far from each other cost a distance of a ball. What is found is kept in slots, so that all that
follows is in proportion to what touches, not to what could.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics import skip
from surgical_marl.physics.contact.broadphase import Ball, Joints, Placed, Places, Way, between_balls
from surgical_marl.physics.contact.contact_pairs import ContactPairs, Meeting
from surgical_marl.physics.contact.contact_patch import BLEND, TILT, TILT_IN_JAW, Patch, find_patch, no_patch
from surgical_marl.physics.contact.shapes import Points, Segments, between_segments, on_plate
from surgical_marl.physics.systems.rigid_motion import Bodies
from surgical_marl.physics.systems.sleeping import Company, company, moving
from surgical_marl.physics.tree_utils import Listed, put, room, row_of
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
    """Of each patch in `ContactPairs`, [s]."""
    total: Array
    """How many there are, []; more than there are slots if some found no room."""
    company: Company
    """What is near the objects."""
    awake: Array
    """Which objects are not at rest, [k] bool: those at rest have no patches."""

    @property
    def found(self) -> Array:
        """How many found room, []: what is in slots beyond is nothing."""
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

        Pairs that are near are listed first. Environments that run side by side then look closely at as many pairs as
        the one of them with most, and not at all that are near in any of them.
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
            return jax.lax.cond(count > 0, lambda slots: meet(jnp.int32(0), slots), lambda slots: slots, slots)
        slots = jax.lax.fori_loop(0, jnp.minimum(count, most), meet, slots)
        return slots._replace(total=slots.total + jnp.maximum(count - most, 0))

    def _near_pairs(self, placed: Placed, meeting: Meeting, awake: Array, most: int) -> Listed:
        """Return the numbers of pairs that may touch in the next step, at most so many.

        What the first bodies may meet is gone through for each of them, but not for one that is far from all of it, and
        not for an object at rest. All of them are asked that at once: loops that ask one at a time take ten times as
        long on a GPU, which waits for the memory in each round.
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

        Balls around both tell it. One that may be near any fixed body of a kind counts as near all of them.
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

    def _ways(self, placed: Placed, meeting: Meeting, i: Array, j: Array) -> tuple[Way, Way | None]:
        its = placed.ways.get(meeting.second)
        return row_of(placed.ways[meeting.first], i), None if its is None else row_of(its, j)

    def _patch(self, placed: Placed, meeting: Meeting, start: int, pair: Array) -> tuple[Patch, Array]:
        """Return the patch of two bodies, and whether they touch."""
        i, j = _numbers(meeting, pair)
        touch, axes = self._touch(placed, meeting.second, j)
        ways, (capsules, count) = self._ways(placed, meeting, i, j), self._near_capsules(placed, meeting, i, j)

        def look(n: Array) -> tuple[Points, Array]:
            points = touch(self._places.capsule(placed, meeting.first, i, capsules[n]))
            nearer = ways[0].of(points) - (0.0 if ways[1] is None else ways[1].of(points))
            return points, points.depth + jnp.minimum(nearer, AHEAD)

        torsion, middle = jnp.asarray(self._tables.torsion)[start + pair], placed.balls[meeting.first].centre[i]
        centre = middle if meeting.first == "objects" and meeting.second != "pads" else None
        patch = find_patch(look, count, self._tables.radius.shape[1], middle, axes, _tilt(meeting), torsion, centre)
        return patch, patch.reach > -NEAR

    def _near_capsules(self, placed: Placed, meeting: Meeting, i: Array, j: Array) -> Listed:
        """Return the numbers of a body's capsules that may have a part in a patch.

        A capsule has none that is farther away than the one that touches by more than tilting can make up for: by the
        angle, times the way from a place of the one to a place of the other.
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
        """Return what finds where a capsule may touch a body, [d], and two axes [2, 3] along which they spread."""
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
    """Return what was found, changed if anything is near."""
    return skip.cond("far_pairs", near.any(), change, lambda found: found, found)


def _numbers(meeting: Meeting, pair: Array) -> tuple[Array, Array]:
    """Return the numbers of the two bodies of a pair."""
    return tuple(jnp.asarray(of.astype(np.int32))[pair] for of in (meeting.one, meeting.other))  # type: ignore[return-value]
