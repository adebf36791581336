"""Threads in channels: a needle draws its thread along behind it, and the places that it has left hold the thread.

Along needle and thread one length counts, from the tip on. A place holds what is around it: the needle, then both, then
the thread, by springs across and by Coulomb friction along. On the thread such a spring has an end that moves with the
material, and that slips when its friction gives way: `ChannelState.along`. So nothing is searched for, and a thread
that comes near itself, or near another channel, is held where it went through.

These forces are contacts of the thread with the tissue's skin, at places inside.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.part_detection import no_end
from surgical_marl.physics.systems.channel_state import OFF, ChannelState, behind, ends_of, length_around
from surgical_marl.physics.systems.material import Material
from surgical_marl.physics.systems.needle import Arc
from surgical_marl.physics.systems.system import End, Ends, Strand
from surgical_marl.physics.tree_utils import put, when
from surgical_marl.scenes.channel_file import ChannelFile


class Sewn(NamedTuple):
    """One needle with its thread, and the tissue that they may be in."""

    about: ChannelFile
    material: Material
    position: Array
    """Of the tissue's nodes, m, [n, 3]."""
    needle: int
    """Number of the needle."""
    arc: Arc
    strand: Strand

    def followed(self, state: ChannelState) -> ChannelState:
        """Return channels as the thread is now: how far it has slipped in each place, and where it has gone through."""
        room = self.about.spacing / 2

        def of_channel(c: Array, state: ChannelState) -> ChannelState:
            last = jnp.maximum(state.total[c] - 1, 0)
            back = (state.thread[c] == self.needle) & (state.along[c, last] < -room)
            state = state._replace(needle=put(state.needle, c, jnp.where(back, self.needle, state.needle[c])))

            def of_place(i: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
                along, slip = self._at_place(state, c, i)
                return put(found[0], (c, i), along), put(found[1], (c, i), slip)

            along, slip = jax.lax.fori_loop(0, state.total[c], of_place, (state.along, state.slip))
            through = along[c, last] > self.strand.length
            along = along.at[c].set(jnp.where(through, OFF, along[c]), mode="promise_in_bounds")
            thread = jnp.where((along[c] > OFF / 2).any(), self.needle, -1)
            return state._replace(along=along, slip=slip, thread=put(state.thread, c, thread))

        def of_own(c: Array, state: ChannelState) -> ChannelState:
            return when(self._in(state, c), lambda state: of_channel(c, state), state)

        found: ChannelState = jax.lax.fori_loop(0, self.about.most, of_own, state)
        return found

    def _at_place(self, state: ChannelState, c: Array, i: Array) -> tuple[Array, Array]:
        """Return how far along the thread a place holds it, m, `OFF` if on the needle, and the spring's stretch."""
        place, before = self.material.place(self.position, state.places[c, i]), state.along[c, i]
        needle_in, s, held = state.needle[c] == self.needle, self.arc.nearest(place), before > OFF / 2
        along = jnp.where(held, before, s - self.arc.length + state.slip[c, i])
        foot, tangent = self.strand.point(along)
        stretch, most = tangent @ (place - foot), self.about.thread_friction / self.about.stiffness
        slip = jnp.clip(stretch, -most, most)
        along -= stretch - slip
        stays, passed = ~(needle_in & (along < 0) & (s < self.arc.length)), needle_in & (s > self.arc.length)
        on = jnp.where(held, stays, passed)
        return jnp.where(on, along, OFF), jnp.where(on, slip, state.slip[c, i])

    def with_holds(self, state: ChannelState, ends: Ends, number: int) -> Ends:
        """Return contacts of the thread with those in channels, in arrays with one row more than there is room for.

        Args:
            state: of the channels.
            ends: contacts so far.
            number: of the tissue's skin.
        """
        last, start = len(ends.rows.part) - 1, self.arc.length

        def of_place(c: Array, i: Array, ends: Ends) -> Ends:
            s, before = behind(self.material, state, c, i, self.arc, self.position), state.along[c, i]
            along = jnp.where(before > OFF / 2, before, s - start + state.slip[c, i])
            part, share = self.strand.at(along)
            length = length_around(self.material, state, c, i, s, start, start + self.strand.length)
            length *= jnp.asarray(self.strand.holds)[part]
            end = self._end(state.places[c, i], along, length)._replace(
                part=jnp.where(self.strand.backwards, len(self.strand.holds) - 1 - part, part),
                share=jnp.clip(jnp.where(self.strand.backwards, 1 - share, share), 0.0, 1.0),
                shape=jnp.int32(-1 - number),
            )
            there = length > 0
            row = jnp.where(there, jnp.minimum(ends.total, last), last)
            return Ends(put(ends.rows, row, end), ends.moving + (there & (ends.total < last)), ends.total + there,
                        ends.left_out)  # fmt: skip

        def of_own(c: Array, ends: Ends) -> Ends:
            places = jnp.where(self._in(state, c), state.total[c], 0)
            found: Ends = jax.lax.fori_loop(0, places, lambda i, ends: of_place(c, i, ends), ends)
            return found

        found: Ends = jax.lax.fori_loop(0, self.about.most, of_own, ends)
        return found

    def _end(self, at: Array, along: Array, length: Array) -> End:
        """Return the contact of a thread with a place in the material, which holds a length of it, m."""
        place, bound = self.material.place(self.position, at), self.about.thread_friction * length
        foot, tangent = self.strand.point(along)
        return no_end()._replace(
            depth=bound, place=place, normal=tangent, stiffness=self.about.stiffness * length, sliding=bound,
            bilateral=jnp.bool_(True), stretch=foot - place, on=self.material.spot(at),
        )  # fmt: skip

    def inside(self, state: ChannelState) -> Array:
        """Return which parts of the thread are in tissue, or less than one part away from where it goes in, [p] bool.

        Parts are numbered as in its system.
        """
        start, part = self.arc.length, self.strand.part

        def span(c: Array) -> Array:
            first, last = ends_of(self.material, state, c, self.arc, self.position)
            return jnp.where(self._in(state, c), jnp.stack([last - part, first + part]), 0.0)

        spans = jax.lax.map(span, jnp.arange(self.about.most, dtype=jnp.int32))
        parts = np.arange(len(self.strand.holds))
        middle = (jnp.where(self.strand.backwards, parts[::-1], parts) + 0.5) * part + start

        def covered(middle: Array) -> Array:
            return ((middle > spans[:, 0]) & (middle < spans[:, 1])).any()

        found: Array = jax.lax.map(covered, middle)
        return found

    def _in(self, state: ChannelState, c: Array) -> Array:
        """Return whether the needle or its thread is in a channel, [] bool."""
        return (state.needle[c] == self.needle) | (state.thread[c] == self.needle)
