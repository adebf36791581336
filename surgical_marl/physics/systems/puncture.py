"""The way of a needle's tip: it presses on a face, punctures it, cuts a channel and comes out, or goes back in it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.systems.channel_state import CUTS, FREE, OFF, POINTS, PRESSES, ChannelState, Tips, ends_of
from surgical_marl.physics.systems.material import Material
from surgical_marl.physics.systems.needle import Arc
from surgical_marl.physics.tree_utils import put, row_of
from surgical_marl.scenes.channel_file import ChannelFile

AHEAD = 0.002
"""Distance from a face below which the contact of a tip is listed, m."""


class Punctures(NamedTuple):
    """The constants of tips in one piece of tissue."""

    about: ChannelFile
    material: Material
    wires: tuple[float, ...]
    """Radius of each needle, m."""
    tip: float
    """Stiffness of the contact of a tip, N/m."""


class Advance:
    """The change of one needle's channels as its tip has moved in the last step."""

    def __init__(self, constants: Punctures, n: Array, arc: Arc, position: Array) -> None:
        self._about, self._material, self._wires, self._stiffness = constants
        self._n, self._arc, self._position = n, arc, position

    def after(self, state: ChannelState) -> tuple[ChannelState, Array]:
        """Return the state, and 1 if a tip would enter and there is no room for its channel."""
        n = self._n
        before = row_of(state.tips, n)
        at = self._material.locate(self._position, before.at, self._arc.tip)
        inside = self._material.there(jnp.floor(at).astype(jnp.int32))
        state, cut, front, within = self._left(state, inside)
        state = jax.lax.cond(cut >= 0, lambda: self._cut(state, cut, front, before.at, at, inside), lambda: state)
        face, touch, near = self._pressed(before, at, inside)
        presses, refused = (cut < 0) & ~within & near, jnp.int32(0)
        face = jnp.where((cut < 0) & ~within, face, -1)
        state, opened, refused = jax.lax.cond(
            presses & self._deep(face, touch),
            lambda: self._opened(state, before.pressed, touch),
            lambda: (state, jnp.int32(-1), jnp.int32(0)),
        )
        cuts = ((cut >= 0) & (front >= 0) & ~state.through[jnp.maximum(cut, 0)]) | (opened == 1)
        does = jnp.where(cuts, CUTS, jnp.where(presses & (opened < 0), PRESSES, FREE))
        start = -self._about.cutting / self._stiffness * self._arc.along
        stretch = jnp.where(opened == 1, start, before.stretch)
        own = Tips(at, face, touch, does, jnp.where(does == before.does, before.stretch, stretch), before.pressed)
        return state._replace(tips=put(state.tips, n, own)), refused

    def _left(self, state: ChannelState, inside: Array) -> tuple[ChannelState, Array, Array, Array]:
        """Return channels without those that the needle has left, and in which it is.

        Return also the number of the channel that it cuts, -1 for none, how far its tip is ahead of that channel's last
        place, m, and whether the tip is in a channel that goes on ahead of it, or at its exit.
        """
        room = self._about.spacing / 2

        def look(c: Array, found: tuple[Array, ...]) -> tuple[Array, ...]:
            count, needle, cut, front, within = found
            first, last = ends_of(self._material, state, c, self._arc, self._position)
            mine = needle[c] == self._n
            out = mine & ((~inside & (first < -room)) | (last > self._arc.length + room))
            mine &= ~out
            cuts = mine & ~state.through[c]
            return (
                count.at[c].set(jnp.where(out & (count[c] < 2), 0, count[c]), mode="promise_in_bounds"),
                needle.at[c].set(jnp.where(out, -1, needle[c]), mode="promise_in_bounds"),
                jnp.where(cuts, c, cut), jnp.where(cuts, last, front), within | (mine & (last < room)),
            )  # fmt: skip

        start = state.total, state.needle, jnp.int32(-1), jnp.float32(0.0), jnp.bool_(False)
        count, needle, cut, front, within = jax.lax.fori_loop(0, self._about.most, look, start)
        return state._replace(total=count, needle=needle), cut, front, within

    def _cut(
        self, state: ChannelState, c: Array, front: Array, before: Array, at: Array, inside: Array
    ) -> ChannelState:  # fmt: skip
        """Return the state with a place more in a channel, if the tip has come far enough, or out."""
        comes_out = ~inside & (front > 0) & ((state.total[c] > 1) | (front > self._about.spacing / 2))
        place = jnp.where(comes_out, _crossed(before, at), at)

        def longer(state: ChannelState) -> ChannelState:
            full = state.total[c] == POINTS
            other = np.minimum(2 * np.arange(POINTS), POINTS - 1)  # every other place
            places = jnp.where(full, state.places[c][other], state.places[c])
            slip = jnp.where(full, state.slip[c][other], state.slip[c])
            count = jnp.where(full, POINTS // 2, state.total[c])
            along = jnp.where(full, state.along[c][other], state.along[c])
            places, slip, along = put((places, slip, along), count, (place, jnp.float32(0.0), jnp.float32(OFF)))
            through = state.through[c] | comes_out
            names, rows = ("places", "slip", "along", "total", "through"), (places, slip, along, count + 1, through)
            own = put(tuple(getattr(state, name) for name in names), c, rows)
            return state._replace(**dict(zip(names, own, strict=True)))

        grows = comes_out | (inside & (front >= self._about.spacing))
        return jax.lax.cond(grows, longer, lambda state: state, state)

    def _pressed(self, before: Tips, at: Array, inside: Array) -> tuple[Array, Array, Array]:
        """Return the face that a tip is at, the place in the material that it is at there, and if it is near."""
        material, brick = self._material, jnp.floor(at).astype(jnp.int32)
        face, least = jnp.int32(-1), jnp.float32(jnp.inf)
        for axis in range(3):
            share = at[axis] - brick[axis]
            for number, (way, gap) in enumerate(((1, 1 - share), (-1, share))):
                gap = jnp.where(material.there(brick + way * np.eye(3, dtype=np.int32)[axis]), gap, jnp.inf)
                gap *= material.cell[axis]
                face, least = jnp.where(gap < least, 2 * axis + number, face), jnp.minimum(gap, least)
        face = jnp.where(inside, before.face, face)  # none if it did not come through one just now
        axes = np.arange(3) == face // 2
        plane = jnp.where(inside, before.touch, jnp.floor(at) + (1 - face % 2))
        touch = jnp.where(axes, plane, at)
        under = jnp.floor(touch + 0.5 * axes * (1 - 2 * (face % 2))).astype(jnp.int32)
        place, inwards = self._material.surface(self._position, face, touch)
        near = (face >= 0) & material.there(under) & (inwards @ (self._arc.tip - place) > -AHEAD)
        return face, touch, near

    def _deep(self, face: Array, touch: Array) -> Array:
        """Return whether the tip is below its face."""
        place, inwards = self._material.surface(self._position, face, touch)
        return inwards @ (self._arc.tip - place) > 0

    def _opened(self, state: ChannelState, pressed: Array, touch: Array) -> tuple[ChannelState, Array, Array]:
        """Return channels in one of which the tip goes on, or in a new one if it presses hard enough.

        Return also 1 for a new channel, 0 for another one and -1 for none, and 1 if there was no room for one.
        """
        tip, none = self._arc.tip, jnp.int32(-1)
        reach = 2 * jnp.asarray(self._wires)[self._n]

        def look(c: Array, found: tuple[Array, ...]) -> tuple[Array, ...]:
            again, empty, spare = found
            first, second = (self._material.place(self._position, state.places[c, i]) for i in (0, 1))
            idle, way = (state.needle[c] < 0) & (state.thread[c] < 0), first - tip
            near = (way @ way < reach * reach) & ((second - first) @ self._arc.along > 0) & (state.total[c] > 1)
            return (
                jnp.where(idle & near, c, again),
                jnp.where(idle & (state.total[c] == 0) & (empty < 0), c, empty),
                jnp.where(idle & (spare < 0), c, spare),
            )

        again, empty, spare = jax.lax.fori_loop(0, self._about.most, look, (none, none, none))
        new, enough = jnp.where(empty >= 0, empty, spare), pressed >= self._about.puncture
        opens = (again < 0) & (new >= 0) & enough
        c = jnp.where(again >= 0, again, jnp.maximum(new, 0))

        def first(state: ChannelState) -> ChannelState:
            keep = state.total[c], state.through[c], state.swept[c], state.places[c, 0]
            fresh = jnp.int32(1), jnp.bool_(False), jnp.float32(0.0), touch
            count, through, swept, entry = jax.tree.map(lambda a, b: jnp.where(opens, a, b), fresh, keep)
            own = (jnp.int32(self._n), count, through, swept)
            needle, count, through, swept = put((state.needle, state.total, state.through, state.swept), c, own)
            places = state.places.at[c, 0].set(entry, mode="promise_in_bounds")
            along = state.along.at[c].set(OFF, mode="promise_in_bounds")
            return state._replace(needle=needle, total=count, through=through, swept=swept, places=places,
                                  along=along)  # fmt: skip

        enters = opens | (again >= 0)
        state = jax.lax.cond(enters, first, lambda state: state, state)
        found = jnp.where(opens, 1, jnp.where(again >= 0, 0, -1))
        return state, found, (enough & ~enters).astype(jnp.int32)


def _crossed(before: Array, after: Array) -> Array:
    """Return where the way between two places in the material leaves the first one's brick."""
    way = after - before
    plane = jnp.where(way > 0, jnp.floor(before) + 1, jnp.floor(before))
    share = jnp.where(jnp.abs(way) > 1e-9, (plane - before) / jnp.where(jnp.abs(way) > 1e-9, way, 1.0), 1.0)
    return before + jnp.clip(jnp.min(share), 0.0, 1.0) * way
