"""Where the parts of a system, which are capsules, touch the shapes of a scene: a list of fixed size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.broadphase import nearest, size
from surgical_marl.physics.contact.shapes import Plate, Points, Segments, between_segments, in_frame
from surgical_marl.physics.systems.system import Clusters, End, Ends, Shapes
from surgical_marl.physics.tree_utils import Listed, Tree, picked, put, room
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


class Scenery(NamedTuple):
    """All shapes in the order of their numbers, but plates apart from capsules."""

    plates: Plate
    capsules: Segments
    moves: Array
    """Largest displacement of any point in a step, m, [r]."""


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

    def find(
        self, scenery: Scenery, shapes: Shapes, first: Sequence[End], last: Sequence[End], dt: Any
    ) -> Ends:  # fmt: skip
        """Return the contacts, with nothing known of how ends move.

        Args:
            scenery: all shapes of others.
            shapes: of the system.
            first: ties to bodies, which come first.
            last: ties to the world, which come last.
            dt: duration of a step, s.
        """
        pairs = self._near(scenery, shapes, dt)
        rows = room(jax.eval_shape(_no_end), self._room + 1)  # a contact that finds no room goes to the last one
        found = Ends(rows, jnp.int32(0), jnp.int32(0), jnp.int32(0))
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

    def _with(self, ends: Ends, end: End, belongs: Array) -> Ends:
        """Return contacts with one more, if it belongs to them."""
        last = self._room
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
        radius = jnp.broadcast_to(jnp.asarray(shapes.radius), (parts,))
        rows, clusters = (shapes.start, shapes.end, radius, shapes.speed), shapes.clusters

        def widen(found: Any, row: Any) -> tuple[Any, None]:
            (low, high, fastest), (start, end, radius, speed) = found, row
            low = jnp.minimum(low, jnp.minimum(start, end) - radius)
            high = jnp.maximum(high, jnp.maximum(start, end) + radius)
            return (low, high, jnp.maximum(fastest, speed)), None

        bounds: Any = rows
        fastest = jnp.float32(0.0)
        if clusters is not None:
            still = np.zeros(len(clusters.radius), np.float32)
            bounds, fastest = (clusters.centre, clusters.centre, clusters.radius, still), clusters.fastest
        first = bounds[0][0]
        (low, high, fastest), _ = jax.lax.scan(widen, (first, first, fastest), bounds)
        centre, around = (low + high) / 2, size(high - low) / 2

        def look(found: Listed, shape: Array) -> tuple[Listed, None]:
            reach = around + NEAR + jnp.minimum(scenery.moves[shape] + dt * fastest, AHEAD)
            gap = self._of_shape(
                scenery, shape, lambda plate: _from_plate(centre, plate), lambda rod: _from_capsule(centre, rod)
            )
            return found.after(shape, gap < reach), None

        everything = jnp.arange(self._shapes, dtype=jnp.int32)
        near, _ = jax.lax.scan(look, Listed.none(self._shapes), everything)

        def of_shape(row: Array, found: Listed) -> Listed:
            shape = near.numbers[row]
            moves = scenery.moves[shape]

            def along(gap: Callable[[Array], Array]) -> Listed:
                def reached(centre: Array, radius: Array, speed: Array) -> Array:
                    return gap(centre) < radius + NEAR + jnp.minimum(moves + dt * speed, AHEAD)

                def part(found: Listed, row: Any) -> tuple[Listed, None]:
                    number, start, end, radius, speed = row
                    middle, half = (start + end) / 2, size(end - start) / 2 + radius
                    return found.after(shape * parts + number, reached(middle, half, speed)), None

                def sphere(number: Array, middle: Array, speed: Array, found: Listed) -> Listed:
                    return found.after(shape * parts + number, reached(middle, radius[number], speed))

                if clusters is not None:
                    return _of_clusters(clusters, reached, sphere, found)
                return jax.lax.scan(part, found, (jnp.arange(parts, dtype=jnp.int32), *rows))[0]

            listed: Listed = self._of_shape(
                scenery, shape, lambda plate: along(lambda x: _from_plate(x, plate)),
                lambda rod: along(lambda x: _from_capsule(x, rod)),
            )  # fmt: skip
            return listed

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
        end = _no_end()._replace(
            part=part, share=share, shape=shape, depth=point.depth, place=point.place, normal=point.normal,
            stiffness=weight * stiffness, sliding=sliding,
        )  # fmt: skip
        touches = point.depth > -reach
        for own_part, low, high in self._tied:
            touches &= (part != own_part) | (shape < low) | (shape >= high)
        return end, touches


def _of_clusters(
    clusters: Clusters, reached: Callable[[Array, Array, Array], Array], sphere: Callable[..., Tree], found: Tree
) -> Tree:  # fmt: skip
    """Return what `sphere(number, centre, speed, found)` makes of each sphere in a cluster that is reached."""

    def cluster(found: Tree, row: Any) -> tuple[Tree, None]:
        centre, radius, first, last = row
        last = jnp.where(reached(centre, radius, clusters.fastest), last, first)
        return jax.lax.fori_loop(first, last, lambda n, found: sphere(n, *clusters.part(n), found), found), None

    runs = jnp.asarray(clusters.first[:-1]), jnp.asarray(clusters.first[1:])
    after: Tree = jax.lax.scan(cluster, found, (clusters.centre, clusters.radius, *runs))[0]
    return after


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


def _no_end() -> End:
    """Return a contact with nothing."""
    zero, number, vector = jnp.float32(0.0), jnp.int32(0), jnp.zeros(3)
    return End(number, zero, number, zero, vector, vector, zero, zero, jnp.bool_(False), vector, vector)


def _from_plate(point: Array, plate: Plate) -> Array:
    """Return the distance of a point from a plate, m."""
    local = in_frame(point, plate)
    beside = local[:2] - jnp.clip(local[:2], -plate.half, plate.half)
    return jnp.sqrt(beside @ beside + local[2] * local[2]) - plate.radius


def _from_capsule(point: Array, capsule: Segments) -> Array:
    """Return the distance of a point from a capsule, m."""
    return size(point - nearest(capsule, point)) - capsule.radius
