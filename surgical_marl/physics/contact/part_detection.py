"""Where the parts of a system, which are capsules, touch the shapes of a scene: a list of fixed size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.broadphase import Ball, size
from surgical_marl.physics.contact.node_balls import NodeBalls, found_by_block
from surgical_marl.physics.contact.shapes import Plate, Points, Segments, between_segments, in_frame
from surgical_marl.physics.systems.system import End, Ends, Shapes, Spot
from surgical_marl.physics.tree_utils import Listed, Tree, picked, put, room, row_of
from surgical_marl.scenes.objects import Surface

NEAR = 1e-4
"""Distance below which a contact is listed, whatever moves, m."""
AHEAD = 0.005
"""Way in a step for which contacts are listed at most, m."""
STEEP = 0.5
"""Twice the sine of the angle to a plate from which on a part's end counts more than its middle."""
RIM = 0.25
"""Least stiffness of a contact with a plate, as a share: only a little of a part may lie on it, or none at its rim."""
NEAREST = 32
"""Pairs of shapes and parts that are looked at closely in a step, at most, beyond the room for contacts."""
NOWHERE = Spot(np.zeros(4, np.int32), np.zeros(4, np.float32))
"""The place on a skin of what is on none."""


class Scenery(NamedTuple):
    """All shapes in the order of their numbers, but plates apart from capsules."""

    plates: Plate
    capsules: Segments
    moves: Array
    """Largest displacement of any point in a step, m, [r]."""


class Hull(NamedTuple):
    """A plate, or a capsule: a rectangle without width. World."""

    centre: Array
    """m, [3]"""
    axes: Array
    """Directions of its sides, [2, 3]; 0 along the width of a capsule."""
    half: Array
    """Half sides, m, [2]."""
    radius: Array
    """m, []"""


class Runs(NamedTuple):
    """Balls around parts that follow each other, g of them: most parts are left out with their run."""

    balls: Ball
    """[g]"""
    first: np.ndarray
    """Number of the first part of each, and that of all parts, [g + 1]."""
    part: Callable[[Array], Ball]
    """Takes the number of a part."""


class PartDetection:
    """Finds the contacts of one system.

    Args:
        counts: number of shapes of each kind, in the order of their numbers: pads, links, objects, plates, rods.
        surfaces: friction and stiffness of the contact with each shape.
        room: the most contacts.
        tied: parts that do not touch some shapes, as they are fastened to these: number of the part, those of the
            first shape and of the one after the last.
    """

    def __init__(
        self,
        counts: Mapping[str, int],
        surfaces: Sequence[Surface],
        room: int,
        tied: Sequence[tuple[int, int, int]] = (),
    ) -> None:
        self._counts, self._room, self._shapes, self._tied = counts, room, sum(counts.values()), tied
        self._nearest = room + NEAREST
        self._starts = dict(zip(counts, np.cumsum([0, *counts.values()]), strict=False))
        self._stiffness = np.array([one.stiffness for one in surfaces], np.float32)
        self._sliding = np.array([one.sliding for one in surfaces], np.float32)

    def nothing(self, on: Spot | None = None) -> Ends:
        """Return an empty list of contacts, with one row more than there is room for: it takes what finds none."""
        rows = room(jax.eval_shape(lambda: no_end()._replace(on=on)), self._room + 1)
        return Ends(rows, jnp.int32(0), jnp.int32(0), jnp.int32(0))

    def find(
        self, scenery: Scenery, shapes: Shapes, first: Sequence[End], last: Sequence[End], dt: Any,
        begun: Ends | None = None,
    ) -> Ends:  # fmt: skip
        """Return the contacts, with nothing known of how ends move.

        Args:
            scenery: all shapes of others.
            shapes: of the system.
            first: ties to bodies, which come first.
            last: ties to the world, which come last.
            dt: duration of a step, s.
            begun: contacts with other systems, which come first of all; in a list made by `nothing`.
        """
        balls = shapes.clusters and shapes.clusters.nodes
        alone = begun is None and not first and not last
        if balls is not None and alone and len(scenery.plates.radius) and len(scenery.capsules.radius):
            return self._find_by_block(scenery, balls, dt)
        pairs = self._near(scenery, shapes, dt)
        found = self.nothing() if begun is None else begun
        for tie in first:
            found = self._with(found, tie, jnp.bool_(True))

        def meet(row: Array, found: Ends) -> Ends:
            return self._with(found, *self._meet(scenery, shapes, pairs.numbers[row], dt))

        if self._shapes:
            found = jax.lax.fori_loop(0, jnp.minimum(pairs.length, self._nearest), meet, found)
        for tie in last:
            found = self._with(found, tie, jnp.bool_(True))
        left_out = jnp.maximum(found.total - self._room, 0) + jnp.maximum(pairs.length - self._nearest, 0)
        return Ends(
            jax.tree.map(lambda x: x[:-1], found.rows), found.moving, jnp.minimum(found.total, self._room), left_out
        )

    def _find_by_block(self, scenery: Scenery, balls: NodeBalls, dt: Any) -> Ends:
        numbers = {
            "SHAPES": self._shapes, "FINGERS": int(self._starts["links"]), "PLATES": int(self._starts["plates"]),
            "RODS": int(self._starts["rods"]), "ROOM": self._room, "NEAREST": self._nearest, "NEAR": NEAR,
            "AHEAD": AHEAD, "RIM": RIM,
        }  # fmt: skip

        def find(scenery: Scenery, shapes: Shapes, dt: Any) -> Ends:
            return self.find(scenery, shapes, [], [], dt)

        return found_by_block(find, scenery, balls, (self._stiffness, self._sliding), numbers, dt)

    def visited(self, scenery: Scenery, shapes: Shapes, dt: Any) -> Array:
        """Return whether any shape that moves may touch a part in the step, [] bool."""
        moving, runs = int(self._starts["plates"]), _runs(shapes, dt)
        if not moving:
            return jnp.bool_(False)

        def by_shape(found: Array, row: tuple[Array, Array]) -> tuple[Array, None]:
            shape, moves = row
            hull = self._of_shape(scenery, shape, _of_plate, _of_capsule)
            return _along(runs, hull, moves, lambda _, reached, found: found | (reached & (moves > 0)), found), None

        rows = jnp.arange(moving, dtype=jnp.int32), scenery.moves[:moving]
        found: Array = jax.lax.scan(by_shape, jnp.bool_(False), rows)[0]
        return found

    def _with(self, ends: Ends, end: End, belongs: Array) -> Ends:
        """Return contacts with one more, if it belongs to them."""
        last = self._room
        if ends.rows.on is not None and end.on is None:
            end = end._replace(on=NOWHERE)
        rows = put(ends.rows, jnp.where(belongs, jnp.minimum(ends.total, last), last), end)
        moves = belongs & (end.shape < self._starts["plates"]) & (ends.total < last)
        return Ends(rows, ends.moving + moves, ends.total + belongs, ends.left_out)

    def _split(self, shape: Array) -> tuple[Array, Array, Array]:
        """Return whether a shape is a plate, its number among plates, and that among capsules."""
        first, fingers = self._starts, self._counts["pads"]
        is_plate = (shape < fingers) | ((shape >= first["plates"]) & (shape < first["rods"]))
        plate = jnp.where(shape < fingers, shape, shape - first["plates"] + fingers)
        capsule = shape - jnp.where(shape < first["plates"], fingers, fingers + self._counts["plates"])
        return is_plate, plate, capsule

    def _of_shape(
        self, scenery: Scenery, shape: Array, plate: Callable[[Plate], Any], capsule: Callable[[Segments], Any]
    ) -> Any:  # fmt: skip
        """Return the result of one of two functions, by the kind of a shape."""
        is_plate, of_plates, of_capsules = self._split(shape)

        def with_plate() -> Any:
            return plate(picked(scenery.plates, of_plates))

        def with_capsule() -> Any:
            return capsule(picked(scenery.capsules, of_capsules))

        if not len(scenery.plates.radius):
            return with_capsule()
        if not len(scenery.capsules.radius):
            return with_plate()
        return jax.lax.cond(is_plate, with_plate, with_capsule)

    def _near(self, scenery: Scenery, shapes: Shapes, dt: Any) -> Listed:
        """Return the pairs of shapes and parts that are near each other, in their order: shape * parts + part."""
        parts, none = len(shapes.speed), Listed.none(self._nearest)
        if not self._shapes:
            return none
        runs = _runs(shapes, dt)
        whole = _around(runs.balls)

        def hull_of(shape: Array) -> Hull:
            hull: Hull = self._of_shape(scenery, shape, _of_plate, _of_capsule)
            return hull

        def look(found: Listed, row: tuple[Array, Array]) -> tuple[Listed, None]:
            shape, moves = row
            return found.after(shape, _reaches(whole, hull_of(shape), moves)), None

        everything = jnp.arange(self._shapes, dtype=jnp.int32)
        near, _ = jax.lax.scan(look, Listed.none(self._shapes), (everything, scenery.moves))

        def of_shape(row: Array, found: Listed) -> Listed:
            shape = near.numbers[row]
            hull, moves = hull_of(shape), scenery.moves[shape]

            def part(number: Array, reached: Array, found: Listed) -> Listed:
                return found.after(shape * parts + number, reached)

            return _along(runs, hull, moves, part, found)

        found: Listed = jax.lax.fori_loop(0, near.length, of_shape, none)
        return found

    def _meet(self, scenery: Scenery, shapes: Shapes, pair: Array, dt: Any) -> tuple[End, Array]:
        """Return the contact of a pair, and whether it may touch in the step."""
        parts = len(shapes.speed)
        shape, part = pair // parts, pair % parts
        radius = jnp.broadcast_to(jnp.asarray(shapes.radius), (parts,))
        own, speed = Segments(shapes.start[part], shapes.end[part], radius[part]), shapes.speed[part]
        if shapes.clusters is not None:
            centre, speed = shapes.clusters.part(part)
            own = Segments(centre, centre, radius[part])
        point, weight = self._of_shape(
            scenery,
            shape,
            lambda plate: on_face(own, plate),
            lambda rod: (between_segments(own, rod), jnp.float32(1.0)),
        )
        reach = NEAR + jnp.minimum(scenery.moves[shape] + dt * speed, AHEAD)
        along = own.end - own.start
        share = jnp.clip((point.place - own.start) @ along / jnp.maximum(along @ along, 1e-12), 0.0, 1.0)
        stiffness, sliding = (jnp.asarray(x)[shape] for x in (self._stiffness, self._sliding))
        end = no_end()._replace(
            part=part, share=share, shape=shape, depth=point.depth, place=point.place, normal=point.normal,
            stiffness=weight * stiffness, sliding=sliding,
        )  # fmt: skip
        touches = point.depth > -reach
        for own_part, low, high in self._tied:
            touches &= (part != own_part) | (shape < low) | (shape >= high)
        return end, touches


def on_face(part: Segments, plate: Plate) -> tuple[Points, Array]:
    """Return where a capsule touches a plate, and the share of its length that lies on the plate's face.

    It is the middle of that length: it does not run from one end to the other as a part that is pinched by two plates
    tilts a little, which would throw a light part about. The end that goes in counts where a part stands steeply.
    """
    start, end = in_frame(part.start, plate), in_frame(part.end, plate)
    way = end - start
    flat = jnp.where(jnp.abs(way[:2]) < 1e-9, 1e-9, way[:2])
    one, other = (-plate.half - start[:2]) / flat, (plate.half - start[:2]) / flat
    first = jnp.clip(jnp.max(jnp.minimum(one, other)), 0.0, 1.0)
    last = jnp.clip(jnp.min(jnp.maximum(one, other)), 0.0, 1.0)
    steep = jnp.abs(way[2]) / jnp.sqrt(jnp.maximum(way @ way, 1e-18))
    to_end = jnp.where(jnp.abs(start[2]) < jnp.abs(end[2]), -0.5, 0.5) * jnp.clip(2 * steep - STEEP, 0.0, 1.0)
    over = jnp.maximum(last - first, 0.0)
    share = (first + last) / 2 + over * to_end
    point = start + share * way
    off = point - jnp.append(jnp.clip(point[:2], -plate.half, plate.half), 0.0)
    length = jnp.sqrt(jnp.maximum(off @ off, 1e-18))
    depth, normal = part.radius + plate.radius - length, plate.frame @ (off / length)
    place = plate.centre + plate.frame @ point - (part.radius - depth / 2) * normal
    return Points(depth, place, normal), jnp.maximum(over, RIM)


def no_end() -> End:
    """Return a contact with nothing."""
    zero, number, vector = jnp.float32(0.0), jnp.int32(0), jnp.zeros(3)
    return End(number, zero, number, zero, vector, vector, zero, zero, jnp.bool_(False), vector, vector)


def _runs(shapes: Shapes, dt: Any) -> Runs:
    """Return the runs of a system's parts: its clusters, or about as many as a run has parts."""
    parts, clusters = len(shapes.speed), shapes.clusters
    if clusters is not None:
        radius = jnp.broadcast_to(jnp.asarray(shapes.radius), (parts,))
        moves = jnp.broadcast_to(dt * clusters.fastest, clusters.radius.shape)

        def sphere(number: Array) -> Ball:
            centre, speed = clusters.part(number)
            return Ball(centre, radius[number], dt * speed)

        return Runs(Ball(clusters.centre, clusters.radius, moves), clusters.first, sphere)
    length = int(np.ceil(np.sqrt(parts)))
    first = np.append(np.arange(0, parts, length), parts).astype(np.int32)
    balls, up_to = _balls(shapes, length, dt)
    return Runs(row_of(up_to, first[1:] - 1), first, lambda number: row_of(balls, number))


def _around(balls: Ball) -> Ball:
    """Return a ball around balls."""

    def widen(found: Any, ball: Ball) -> tuple[Any, None]:
        low, high, most = found
        low, high = jnp.minimum(low, ball.centre - ball.radius), jnp.maximum(high, ball.centre + ball.radius)
        return (low, high, jnp.maximum(most, ball.moves)), None

    first = balls.centre[0], balls.centre[0], jnp.float32(0.0)
    low, high, most = jax.lax.scan(widen, first, balls)[0]
    return Ball((low + high) / 2, size(high - low) / 2, most)


def _along(runs: Runs, hull: Hull, moves: Array, part: Callable[[Array, Array, Tree], Tree], found: Tree) -> Tree:
    """Return what `part(number, reached, found)` makes of each part of the runs that a shape may touch in the step.

    Args:
        runs: of a system.
        hull: of the shape.
        moves: its displacement in the step, m.
        part: is told the number of a part, and whether the shape may touch it.
        found: what it begins with.
    """

    def of_run(found: Tree, row: tuple[Ball, Array, Array]) -> tuple[Tree, None]:
        ball, first, last = row

        def one(number: Array, found: Tree) -> Tree:
            return part(number, _reaches(runs.part(number), hull, moves), found)

        return jax.lax.fori_loop(first, jnp.where(_reaches(ball, hull, moves), last, first), one, found), None

    rows = runs.balls, jnp.asarray(runs.first[:-1]), jnp.asarray(runs.first[1:])
    after: Tree = jax.lax.scan(of_run, found, rows)[0]
    return after


def _balls(shapes: Shapes, run: int, dt: Any) -> tuple[Ball, Ball]:
    """Return a ball around each part, and one around the parts of its run up to it, [p]. Runs have so many parts."""
    parts = len(shapes.speed)

    def part(before: Any, row: Any) -> tuple[Any, tuple[Ball, Ball]]:
        (low, high, fastest), (number, start, end, radius, speed) = before, row
        own_low, own_high = jnp.minimum(start, end) - radius, jnp.maximum(start, end) + radius
        goes_on = number % run > 0
        low = jnp.where(goes_on, jnp.minimum(low, own_low), own_low)
        high = jnp.where(goes_on, jnp.maximum(high, own_high), own_high)
        fastest = jnp.where(goes_on, jnp.maximum(fastest, speed), speed)
        own = Ball((start + end) / 2, size(end - start) / 2 + radius, dt * speed)
        return (low, high, fastest), (own, Ball((low + high) / 2, size(high - low) / 2, dt * fastest))

    radius, numbers = jnp.broadcast_to(jnp.asarray(shapes.radius), (parts,)), jnp.arange(parts, dtype=jnp.int32)
    rows, zero = (numbers, shapes.start, shapes.end, radius, shapes.speed), jnp.zeros(3)
    found: tuple[Ball, Ball] = jax.lax.scan(part, (zero, zero, jnp.float32(0.0)), rows)[1]
    return found


def _of_plate(plate: Plate) -> Hull:
    """Return the hull of a plate."""
    return Hull(plate.centre, plate.frame[:, :2].T, plate.half, plate.radius)


def _of_capsule(capsule: Segments) -> Hull:
    """Return the hull of a capsule."""
    way, middle = capsule.end - capsule.start, (capsule.start + capsule.end) / 2
    length = size(way)
    axes = jnp.stack([way / jnp.maximum(length, 1e-12), jnp.zeros(3)])
    return Hull(middle, axes, jnp.stack([length / 2, jnp.zeros_like(length)]), capsule.radius)


def _reaches(ball: Ball, hull: Hull, moves: Array) -> Array:
    """Return whether a ball may touch a shape that moves so far in the step, m."""
    off = ball.centre - hull.centre
    flat = hull.axes @ off
    beside, above = flat - jnp.clip(flat, -hull.half, hull.half), off - flat @ hull.axes
    gap = jnp.sqrt(beside @ beside + above @ above) - hull.radius - ball.radius
    return gap < NEAR + jnp.minimum(moves + ball.moves, AHEAD)
