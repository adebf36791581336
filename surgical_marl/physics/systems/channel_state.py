"""The state of channels in tissue, the view that tasks have of it, and the force of what is in a channel."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.contact.spring_contact import Felt
from surgical_marl.physics.systems.material import Material
from surgical_marl.physics.systems.needle import Arc
from surgical_marl.physics.systems.system import End

POINTS = 16
"""Places of a channel at most. One that is longer than as many spacings keeps every other of them."""
OFF = -1.0
"""The length along a thread of a place that is on a needle, m: less than any other one."""
FREE, PRESSES, CUTS = 0, 1, 2
"""States of a tip: it touches nothing or is in a channel that is cut, it presses on a face, it cuts a channel."""


class Tips(NamedTuple):
    """The tips of n needles."""

    at: Array
    """Place in the material, [n, 3]."""
    face: Array
    """The face that each is at or came through: twice the axis, plus 1 if inwards is down along it; -1: none, [n]."""
    touch: Array
    """Place in the material of the point of that face that it is at, [n, 3]."""
    does: Array
    """`FREE`, `PRESSES` or `CUTS`, [n]."""
    stretch: Array
    """Of the springs of friction and cutting, m, [n, 3]."""
    pressed: Array
    """Normal force on the face in the last step, N, [n]."""


class ChannelState(NamedTuple):
    """The state of c channels with room for p places each."""

    places: Array
    """In the material, from the entry on, [c, p, 3]."""
    total: Array
    """Number of places, [c]; 0 of a channel that is not there."""
    slip: Array
    """Stretch of the springs of friction, m, [c, p]."""
    needle: Array
    """Number of the needle that is in it, [c]; -1 for none."""
    through: Array
    """True once the tip has come out at the other end, [c] bool."""
    swept: Array
    """Way of the needle across its centre line in it, m, [c]."""
    thread: Array
    """Number of the needle whose thread is in it, [c]; -1 for none."""
    along: Array
    """Distance behind that needle at which the spring of friction of each place holds the thread, m, [c, p]; `OFF` of
    places that do not hold the thread yet."""
    tips: Tips


class ChannelView(NamedTuple):
    """Channels in tissue as tasks see them, c of them."""

    entry: Array
    """Where each begins, in the world, m, [c, 3]."""
    exit: Array
    """Where it ends: where the tip came out, or as far as it is cut, in the world, m, [c, 3]."""
    entry_at_rest: Array
    """The same point of the material in the tissue's frame at rest, m, [c, 3]; `exit_at_rest` likewise."""
    exit_at_rest: Array
    depth: Array
    """Depth of the bite: of its deepest place below the upper face at rest, m, [c]."""
    swept: Array
    """Way of the needle across its centre line, m, [c]: 0 if it was driven along its arc."""
    there: Array
    """Which there are, [c] bool; all else is 0 of the others."""
    through: Array
    """True once the tip has come out at the other end, [c] bool."""
    needle: Array
    """Number of the needle that is in each, [c]; -1 for none."""
    thread: Array
    """Number of the needle whose thread is in each, [c]; -1 for none."""
    drawn: Array
    """Length of that thread that has gone in at the entry, m, [c]."""


def hold(end: End, moved: Array) -> Felt:
    """Return the force on a place of a channel that moves by this much relative to what is in it, m, [3].

    Likewise the force on a thread that moves by this much relative to the place.

    Args:
        end: `normal` is the tangent, forwards; `stretch` the offset across and the stretch along; `sliding` the largest
            force on the tissue forwards, N, and `depth` that backwards. If this is negative, nothing holds across.
        moved: displacement in the step.
    """
    whole = end.stretch + moved
    slid = end.normal @ whole
    across = whole - slid * end.normal
    most = jnp.where(slid < 0, end.sliding, jnp.maximum(end.depth, 0.0))
    secant = jnp.minimum(end.stiffness, most / jnp.maximum(jnp.abs(slid), 1e-12))
    aside = jnp.where(end.depth < 0, 0.0, end.stiffness)
    stiffness = aside * jnp.eye(3) + (secant - aside) * jnp.outer(end.normal, end.normal)
    return Felt(-aside * across - secant * slid * end.normal, stiffness, secant / end.stiffness * slid * end.normal)


def behind(material: Material, state: ChannelState, c: Array, i: Array, arc: Arc, position: Array) -> Array:
    """Return how far behind a tip a place of a channel is, m: along the needle, and on along its thread."""
    along, by_needle = state.along[c, i], arc.nearest(material.place(position, state.places[c, i]))
    return jnp.where(along > OFF / 2, arc.length + along, by_needle)


def ends_of(material: Material, state: ChannelState, c: Array, arc: Arc, position: Array) -> tuple[Array, Array]:
    """Return how far behind a tip the first and the last place of a channel are, m."""
    last = jnp.maximum(state.total[c] - 1, 0)
    return behind(material, state, c, jnp.int32(0), arc, position), behind(material, state, c, last, arc, position)


def length_around(
    material: Material, state: ChannelState, c: Array, i: Array, s: Array, start: Any, end: Any
) -> Array:  # fmt: skip
    """Return the length that a place of a channel holds, m: half the way to both neighbours.

    The last place holds all of what goes on to a tip that cuts.

    Args:
        material: of the tissue.
        state: of the channels.
        c: number of the channel.
        i: number of the place.
        s: how far the place is behind the tip, m.
        start: likewise, of the front end of what is held: of a needle or a thread.
        end: of its other end.
    """
    places, last = state.places[c], state.total[c] - 1
    back = jnp.where(i > 0, material.distance(places[i], places[jnp.maximum(i - 1, 0)]), 0.0) / 2
    onwards = material.distance(places[i], places[jnp.minimum(i + 1, POINTS - 1)]) / 2
    tip = jnp.where(state.through[c], 0.0, jnp.maximum(s, 0.0))
    ahead = jnp.where(i < last, onwards, tip)
    return jnp.maximum(jnp.minimum(end, s + back) - jnp.maximum(start, s - ahead), 0.0)
