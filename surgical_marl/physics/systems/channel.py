"""Channels in tissue: where needles go through it, and hold it and are held.

A tip presses on a face of the tissue. Where its normal force passes `puncture`, a channel opens: a list of places in
the material, from the entry on, one each time the tip has cut its way by `spacing`, up to the exit. Against the tip
acts `cutting` as long as it advances. Tissue holds a needle at these places: by springs across its centre line, and by
Coulomb friction along it, both in proportion to the length of the needle around the place. A needle that goes back
leaves the channel behind, and may be driven along it again without cutting.

All these forces are rows of the tissue's contacts, so needle and tissue feel them in the same step. Where the needle is
in the tissue or its tip touches it, other contacts of both are left out.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.spring_contact import Felt, feel
from surgical_marl.physics.systems.brick_grid import BrickGrid
from surgical_marl.physics.systems.channel_state import (
    CUTS,
    FREE,
    OFF,
    POINTS,
    ChannelState,
    ChannelView,
    Tips,
    behind,
    ends_of,
    hold,
    length_around,
)
from surgical_marl.physics.systems.channel_thread import Sewn
from surgical_marl.physics.systems.material import Material
from surgical_marl.physics.systems.needle import Arc, Needle
from surgical_marl.physics.systems.puncture import Advance, Punctures
from surgical_marl.physics.systems.system import End, Ends, Followed, Spot, Strand
from surgical_marl.physics.tree_utils import put, room, row_of
from surgical_marl.scenes.channel_file import ChannelFile

SHARP = 1.0
"""Coefficient of friction of a tip that presses: it digs in rather than that it slides down a dent."""


class Channels:
    """The constants of channels in one piece of tissue.

    Its rows have numbers of parts after those of the tissue's surface points: places of all channels, then tips that
    cut, then tips that press.
    """

    def __init__(
        self, about: ChannelFile, needles: tuple[Needle, ...], grid: BrickGrid, points: int, tip: float
    ) -> None:
        """Collect the constants.

        Args:
            about: content of the file.
            needles: that may go through.
            grid: mesh of the tissue.
            points: number of its surface points.
            tip: stiffness of the contact of a tip, N/m.
        """
        self.about, self.needles, self.material = about, needles, Material(grid)
        self.first, self.tip = points, tip
        """The first number of these parts; from `pressing` on they are tips that press."""
        self._cutting = points + about.most * POINTS
        self.pressing = self._cutting + len(needles)
        self._punctures = Punctures(about, self.material, tuple(needle.wire for needle in needles), tip)
        self._clear = 0.6 * float(max(grid.cell[:2]))  # surface points are half a brick apart

    @property
    def rows(self) -> int:
        """Room for rows: two full channels and the tips."""
        return 2 * POINTS + len(self.needles)

    def start(self) -> ChannelState:
        """Return no channels."""
        c, n = self.about.most, len(self.needles)
        number, flat, zero = jnp.full(c, -1, jnp.int32), jnp.zeros((n, 3)), jnp.zeros(n)
        tips = Tips(flat - 1, jnp.full(n, -1, jnp.int32), flat, jnp.zeros(n, jnp.int32), flat, zero)
        return ChannelState(jnp.zeros((c, POINTS, 3)), 0 * number, jnp.zeros((c, POINTS)), number,
                            jnp.zeros(c, bool), jnp.zeros(c), number, jnp.full((c, POINTS), OFF), tips)  # fmt: skip

    # -- rows of contacts

    def own(self, end: End) -> Array:
        """Return whether a row is of a channel or a tip."""
        return end.part >= self.first

    def spot(self, state: ChannelState, end: End) -> Spot:
        """Return the nodes of the point of such a row."""
        places = jnp.concatenate([state.places.reshape(-1, 3), state.tips.at, state.tips.touch])
        return self.material.spot(places[jnp.maximum(end.part - self.first, 0)])

    def feel(self, end: End, moved: Array) -> Felt:
        """Return the force of any contact of the tissue whose point moves by this much, m, [3]."""
        touches = (end.part < self.first) | (end.part >= self.pressing)
        pressed = feel(end._replace(bilateral=end.bilateral & (end.part < self.first)), moved)
        return jax.tree.map(lambda a, b: jnp.where(touches, a, b), pressed, hold(end, moved))

    def remember(self, state: ChannelState, ends: Ends, moved: Any, went: Any) -> ChannelState:
        """Return the state after a step.

        Points of rows move by `moved(row, end)` relative to needles, m, and needles there by `went(row, end)`.
        """
        c, n = self.about.most, len(self.needles)

        def note(row: Array, found: Any) -> Any:
            end = row_of(ends.rows, row)
            felt, way, inside = self.feel(end, moved(row, end)), went(row, end), end.stiffness / self.about.stiffness
            aside = way - end.normal * (end.normal @ way)
            part = jnp.where(self.own(end), end.part - self.first, c * POINTS + 2 * n)
            return put(found, part, (felt.stretch, felt.force @ end.normal, end.normal @ felt.stretch,
                                     inside * jnp.sqrt(aside @ aside), inside))  # fmt: skip

        size = c * POINTS + 2 * n + 1
        start = jnp.zeros((size, 3)), *[jnp.zeros(size)] * 4
        stretch, force, *of_places = jax.lax.fori_loop(0, ends.moving, note, start)
        slip, way, inside = (x[: c * POINTS].reshape(c, POINTS) for x in of_places)
        cuts, presses = slice(c * POINTS, c * POINTS + n), slice(c * POINTS + n, c * POINTS + 2 * n)
        tips = state.tips._replace(stretch=stretch[cuts] + stretch[presses], pressed=force[presses])
        swept = state.swept + way.sum(1) / jnp.maximum(inside.sum(1), 1e-9)
        return state._replace(slip=slip, swept=swept, tips=tips)

    # -- a step begins

    def follow(
        self, state: ChannelState, position: Array, ends: Ends, bodies: Followed, dt: Any
    ) -> tuple[ChannelState, Ends]:  # fmt: skip
        """Return channels as the needles are now, and the tissue's contacts with those of channels first.

        Args:
            state: of the channels after the last step.
            position: of the tissue's nodes, m, [n, 3].
            ends: other contacts of the tissue.
            bodies: the needles.
            dt: duration of a step, s.
        """
        each = [self._arc(bodies, n) for n in range(len(self.needles))]
        arcs: Arc = jax.tree.map(lambda *parts: jnp.stack(parts), *each)
        for n, strand in enumerate(bodies.strands):
            if strand:
                state = self.sewn(position, bodies, n, strand).followed(state)
        bodies = bodies._replace(strands=())
        most = len(ends.rows.part)
        rows = room(jax.tree.map(lambda x: x[0], ends.rows), most + 1)
        start = Ends(rows, jnp.int32(0), jnp.int32(0), ends.left_out)

        def of_needle(n: Array, now: tuple[ChannelState, Ends]) -> tuple[ChannelState, Ends]:
            arc = row_of(arcs, n)
            state, refused = Advance(self._punctures, n, arc, position).after(now[0])
            found = self._of_needle(state, n, arc, position, now[1], row_of(bodies, n), dt)
            return state, found._replace(left_out=found.left_out + refused)

        state, found = jax.lax.fori_loop(0, len(self.needles), of_needle, (state, start))
        found = self._with_others(state, arcs, position, found, ends, bodies)
        rows, total = jax.tree.map(lambda x: x[:-1], found.rows), jnp.minimum(found.total, most)
        left_out = found.left_out + jnp.maximum(found.total - most, 0)
        return state, Ends(rows, jnp.minimum(found.moving, most), total, left_out)

    def sewn(self, position: Array, bodies: Followed, n: int, strand: Strand) -> Sewn:
        """Return a needle and its thread, in tissue whose nodes are there, m, [n, 3]."""
        return Sewn(self.about, self.material, position, n, self._arc(bodies, n), strand)

    def _arc(self, bodies: Followed, n: int) -> Arc:
        return self.needles[n].at(bodies.origin[n], bodies.axes[n], bodies.size[n])

    def _of_needle(
        self, state: ChannelState, n: Array, arc: Arc, position: Array, ends: Ends, body: Followed, dt: Any
    ) -> Ends:
        """Return contacts with those of one needle's channels and of its tip."""

        def row(part: Any, place: Array, **rest: Any) -> End:
            still = jax.tree.map(lambda x: jnp.zeros_like(x[0]), ends.rows)
            shift = dt * (body.velocity[:3] + jnp.cross(body.velocity[3:], place - body.centre))
            own = still._replace(part=jnp.int32(part), shape=jnp.int32(body.shape), bilateral=jnp.bool_(True))
            return own._replace(place=place, shift=shift, **rest)

        def of_channel(c: Array, ends: Ends) -> Ends:
            def of_place(i: Array, ends: Ends) -> Ends:
                place = self.material.place(position, state.places[c, i])
                s = behind(self.material, state, c, i, arc, position)
                foot, tangent = arc.point(s)
                inside = length_around(self.material, state, c, i, s, 0.0, arc.length)
                off = place - foot
                bound = self.about.friction * inside
                end = row(
                    self.first + c * POINTS + i, foot, depth=bound, normal=tangent,
                    stiffness=self.about.stiffness * inside, sliding=bound,
                    stretch=off + (state.slip[c, i] - tangent @ off) * tangent,
                )  # fmt: skip
                return _after(ends, end, inside > 0, True)

            found: Ends = jax.lax.fori_loop(0, state.total[c], of_place, ends)
            return found

        def of_own(c: Array, ends: Ends) -> Ends:
            return jax.lax.cond(state.needle[c] == n, lambda ends: of_channel(c, ends), lambda ends: ends, ends)

        ends = jax.lax.fori_loop(0, self.about.most, of_own, ends)
        tips = row_of(state.tips, n)
        place, inwards = self.material.surface(position, tips.face, tips.touch)
        presses = row(
            self.pressing + n, arc.tip, depth=inwards @ (arc.tip - place), normal=inwards,
            stiffness=jnp.float32(self.tip), sliding=jnp.float32(SHARP), stretch=tips.stretch,
        )  # fmt: skip
        cuts = row(
            self._cutting + n, arc.tip, depth=jnp.float32(-1.0), normal=arc.along,
            stiffness=jnp.float32(self.tip), sliding=jnp.float32(self.about.cutting),
            stretch=(tips.stretch @ arc.along) * arc.along,
        )  # fmt: skip
        end = jax.tree.map(lambda a, b: jnp.where(tips.does == CUTS, a, b), cuts, presses)
        return _after(ends, end, tips.does != FREE, True)

    def _with_others(
        self, state: ChannelState, arcs: Arc, position: Array, found: Ends, ends: Ends, bodies: Followed
    ) -> Ends:
        """Return contacts of channels, then all others but those of needles where these are in tissue."""

        def span(c: Array) -> Array:
            arc = row_of(arcs, jnp.maximum(state.needle[c], 0))
            first, last = ends_of(self.material, state, c, arc, position)
            return jnp.stack([last - self._clear, first + self._clear])

        spans = jax.lax.map(span, jnp.arange(self.about.most, dtype=jnp.int32))

        def add(row: Array, found: Ends) -> Ends:
            end, keeps = row_of(ends.rows, row), jnp.bool_(True)
            for n in range(len(self.needles)):
                s, first = row_of(arcs, n).nearest(end.place), bodies.shape[n]
                inside = (state.needle == n) & (s > spans[:, 0]) & (s < spans[:, 1])
                mine = (end.shape >= first) & (end.shape < first + bodies.shapes[n])
                keeps &= ~(mine & ((s < self._clear) | inside.any()))
            return _after(found, end, keeps, row < ends.moving)

        return jax.lax.fori_loop(0, ends.total, add, found)

    # -- outputs

    def view(self, state: ChannelState, position: Array) -> ChannelView:
        """Return all channels as tasks see them, by the positions of the tissue's nodes, m, [n, 3]."""
        height = self.material.cells[2] * self.material.cell[2]

        def one(row: tuple[Array, Array]) -> tuple[Array, ...]:
            places, total = row
            ends = places[0], places[jnp.maximum(total - 1, 0)]
            depth = jnp.where(np.arange(POINTS) < total, height - places[:, 2] * self.material.cell[2], 0.0)
            now, rest = (
                [of(at) for at in ends] for of in (lambda at: self.material.place(position, at), self._at_rest)
            )
            return tuple(jnp.where(total > 0, x, 0.0) for x in (*now, *rest, jnp.max(depth)))

        entry, exit_, entry_at_rest, exit_at_rest, depth = jax.lax.map(one, (state.places, state.total))
        there = state.total > 0
        swept, through = jnp.where(there, state.swept, 0.0), state.through & there
        drawn = jnp.where(there, jnp.maximum(state.along[:, 0], 0.0), 0.0)
        return ChannelView(
            entry, exit_, entry_at_rest, exit_at_rest, depth, swept, there, through, state.needle, state.thread, drawn
        )

    def _at_rest(self, at: Array) -> Array:
        return at * self.material.cell


def _after(ends: Ends, end: End, belongs: Array, moving: Any) -> Ends:
    """Return contacts with one more, if it belongs to them. One that finds no room goes to the last row."""
    last = len(ends.rows.part) - 1
    rows = put(ends.rows, jnp.where(belongs, jnp.minimum(ends.total, last), last), end)
    return Ends(rows, ends.moving + (belongs & moving), ends.total + belongs, ends.left_out)
