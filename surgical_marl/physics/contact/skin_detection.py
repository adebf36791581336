"""Where the parts of a system touch the skin of another one: the middle of a part and the nearest point of all faces.

A face between four nodes is a bilinear surface, so neighbours meet without a gap. A part touches a skin at one point at
most. So what slides from face to face keeps its friction, and no seam between faces is felt.

A part stays on the side of a skin that it came from, also where tissue is crushed so thin that its other side is
nearer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.part_detection import AHEAD, NEAR
from surgical_marl.physics.systems.system import End, Ends, Shapes, Skin, Spot
from surgical_marl.physics.tree_utils import put, row_of, when
from surgical_marl.scenes.objects import Surface

DEEPEST = 0.004
"""Greatest depth of a part in another system, m. Past it the part is not found."""
CLOSE = 2e-5
"""Distance of a part's middle from a skin, m, below which their direction is that of the face."""


class Foot(NamedTuple):
    """The point of a skin that is nearest to another point."""

    square: Array
    """Of their distance, m2, []."""
    face: Array
    """Number of the face."""
    share: Array
    """Where on it, 0 to 1 along its first and its last side, [2]."""


def add_skin_contacts(
    ends: Ends, number: int, skin: Skin, faces: np.ndarray, shapes: Shapes, met: Surface, room: int, dt: Any,
    left_out: Array | None = None,
) -> Ends:  # fmt: skip
    """Return contacts with those of the parts of a system with the skin of another one.

    Args:
        ends: contacts so far, in arrays with one row more than there is room for.
        number: of the skin.
        skin: its nodes.
        faces: nodes around each face, [f, 4].
        shapes: the parts.
        met: stiffness and friction of the contact.
        room: for contacts.
        dt: duration of a step, s.
        left_out: parts that do not touch it, [p] bool; None for none.
    """
    extent, balls = _extent(skin), _balls(skin, faces)
    radius = jnp.broadcast_to(jnp.asarray(shapes.radius), shapes.speed.shape)
    known = jnp.zeros_like(shapes.start) if shapes.side is None else shapes.side

    def meet(found: Ends, part: Array, middle: Array, radius: Array, reach: Array) -> Ends:
        foot = nearest(skin, faces, balls, middle, known[part])
        end = _end(skin, jnp.asarray(faces)[foot.face], foot, part, middle, radius)
        end = end._replace(shape=jnp.int32(-1 - number), stiffness=jnp.float32(met.stiffness),
                           sliding=jnp.float32(met.sliding))  # fmt: skip
        touches = (end.depth > -reach) & (foot.square < DEEPEST**2)
        row = jnp.where(touches, jnp.minimum(found.total, room), room)
        return Ends(
            put(found.rows, row, end), found.moving + (touches & (found.total < room)), found.total + touches,
            found.left_out,
        )  # fmt: skip

    def of_part(found: Ends, row: Any) -> tuple[Ends, None]:
        part, start, end, radius, speed, *out = row
        middle = (start + end) / 2
        inside, reach = _in_box(extent, middle, radius, speed, dt)
        if out:
            inside &= ~out[0]
        return when(inside, lambda found: meet(found, part, middle, radius, reach), found), None

    numbers = jnp.arange(len(shapes.speed), dtype=jnp.int32)
    rows = numbers, shapes.start, shapes.end, radius, shapes.speed, *([] if left_out is None else [left_out])
    found: Ends = jax.lax.scan(of_part, ends, rows)[0]
    return found


def near_skin(skin: Skin, shapes: Shapes, dt: Any) -> Array:
    """Return whether any part is in the box around a skin, or may come into it within the step, [] bool."""
    extent = _extent(skin)

    def look(found: Array, row: Any) -> tuple[Array, None]:
        start, end, radius, speed = row
        return found | _in_box(extent, (start + end) / 2, radius, speed, dt)[0], None

    radius = jnp.broadcast_to(jnp.asarray(shapes.radius), shapes.speed.shape)
    found: Array = jax.lax.scan(look, jnp.bool_(False), (shapes.start, shapes.end, radius, shapes.speed))[0]
    return found


def sides(ends: Ends, parts: int) -> Array:
    """Return the direction from a skin to each of the parts that are near one, [p, 3]; 0 for all others."""

    def note(row: Array, found: Array) -> Array:
        end = row_of(ends.rows, row)
        side = jnp.where((end.shape < 0) & ~end.bilateral, end.normal, found[end.part])
        return found.at[end.part].set(side, mode="promise_in_bounds")

    found: Array = jax.lax.fori_loop(0, ends.moving, note, jnp.zeros((parts, 3)))
    return found


def nearest(skin: Skin, faces: np.ndarray, balls: Array, point: Array, side: Any) -> Foot:
    """Return the nearest point of a skin to a point [3], on faces that are not beyond `DEEPEST`.

    If the point has come through the face on its own side, it is the nearest point on faces of that side. `side` is a
    direction from the skin, [3]; 0 if none is known.
    """

    def look(best: tuple[Foot, Foot, Array], row: Any) -> tuple[tuple[Foot, Foot, Array], None]:
        number, nodes, ball = row
        off = point - ball[:3]

        def nearer() -> tuple[Foot, Foot, Array]:
            any_, own, behind = best
            corners = skin.position[nodes]
            share = _share(corners, point)
            way, out = point - _at(corners, share), jnp.cross(*_sides(corners, share))
            new = Foot(way @ way, number, share)
            mine = (out @ side >= 0) & (new.square < own.square)
            behind = jnp.where(mine, out @ way < 0, behind)
            return _either(new.square < any_.square, new, any_), _either(mine, new, own), behind

        # (a + b)^2 <= 2 a^2 + 2 b^2: no square root is needed to pass over what is too far
        return jax.lax.cond(off @ off < 2 * (ball[3] + best[1].square), nearer, lambda: best), None

    start = Foot(jnp.float32(DEEPEST**2), jnp.int32(0), jnp.zeros(2))
    rows = jnp.arange(len(faces), dtype=jnp.int32), jnp.asarray(faces, jnp.int32), balls
    (any_, own, behind), _ = jax.lax.scan(look, (start, start, jnp.bool_(False)), rows)
    return _either(behind, own, any_)


def _either(first: Array, one: Foot, other: Foot) -> Foot:
    """Return one foot or the other."""
    return jax.tree.map(lambda a, b: jnp.where(first, a, b), one, other)


def _end(skin: Skin, nodes: Array, foot: Foot, part: Array, middle: Array, radius: Array) -> End:
    """Return the contact of a part's middle with the nearest point of a skin."""
    corners, (s, t), none = skin.position[nodes], foot.share, jnp.zeros(3)
    weights = jnp.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t])
    place, along, across = weights @ corners, *_sides(corners, foot.share)
    face = jnp.cross(along, across)
    face = face / jnp.sqrt(jnp.maximum(face @ face, 1e-30))
    way = middle - place
    side, far = jnp.where(way @ face < 0, -1.0, 1.0), jnp.sqrt(jnp.maximum(way @ way, 1e-18))
    normal = jnp.where(far > CLOSE, side / far * way, face)
    zero = jnp.float32(0.0)
    return End(part, jnp.float32(0.5), jnp.int32(0), radius - side * far, place, normal, zero, zero, jnp.bool_(False),
               none, none, Spot(nodes, weights))  # fmt: skip


def _share(corners: Array, point: Array) -> Array:
    """Return where on a face [4, 3] its nearest point to a point is, [2]: by Gauss and Newton, then side by side."""
    share = jnp.full(2, 0.5)
    for _ in range(2):
        along, across = _sides(corners, share)
        off = point - _at(corners, share)
        a, b, c = along @ along, along @ across, across @ across
        p, q = along @ off, across @ off
        moved = jnp.stack([c * p - b * q, a * q - b * p]) / jnp.maximum(a * c - b * b, 1e-6 * a * c + 1e-30)
        share = jnp.clip(share + moved, 0.0, 1.0)
    for k in range(2):  # at the rim of a face only the other share is free
        way = _sides(corners, share)[k]
        moved = way @ (point - _at(corners, share)) / jnp.maximum(way @ way, 1e-30)
        share = share.at[k].set(jnp.clip(share[k] + moved, 0.0, 1.0))
    return share


def _at(corners: Array, share: Array) -> Array:
    a, b, c, d = corners
    s, t = share
    return a + s * (b - a) + t * (d - a + s * (a - b + c - d))


def _sides(corners: Array, share: Array) -> tuple[Array, Array]:
    """Return the derivatives of a face's points by both shares, [3] each."""
    a, b, c, d = corners
    (s, t), twist = share, a - b + c - d
    return b - a + t * twist, d - a + s * twist


def _in_box(
    extent: tuple[Array, Array, Array], middle: Array, radius: Array, speed: Array, dt: Any
) -> tuple[Array, Array]:
    """Return whether a part may touch the box around a skin in the step, and how far ahead that looks, m."""
    low, high, fastest = extent
    reach = NEAR + jnp.minimum(dt * (speed + fastest), AHEAD)
    return jnp.max(jnp.maximum(low - middle, middle - high)) < radius + reach, reach


def _extent(skin: Skin) -> tuple[Array, Array, Array]:
    """Return the corners of the box around a skin, m, [3] each, and the largest speed of a node, m/s."""

    def widen(found: Any, row: Any) -> tuple[Any, None]:
        (low, high, most), (place, velocity) = found, row
        return (jnp.minimum(low, place), jnp.maximum(high, place), jnp.maximum(most, velocity @ velocity)), None

    start = skin.position[0], skin.position[0], jnp.float32(0.0)
    (low, high, most), _ = jax.lax.scan(widen, start, (skin.position, skin.velocity))
    return low, high, jnp.sqrt(most)


def _balls(skin: Skin, faces: np.ndarray) -> Array:
    """Return the ball around each face: its centre and the square of its radius, [f, 4]."""

    def ball(nodes: Array) -> Array:
        corners = skin.position[nodes]
        centre = jnp.mean(corners, 0)
        off = corners - centre
        return jnp.append(centre, jnp.max(jnp.sum(off * off, -1)))

    found: Array = jax.lax.map(ball, jnp.asarray(faces, jnp.int32))
    return found
