"""The state of channels in tissue, the view that tasks have of it, and the force of what is in a channel."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.contact.spring_contact import Felt
from surgical_marl.physics.systems.system import End

POINTS = 16
"""Places of a channel at most. One that is longer than as many spacings keeps every other of them."""
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


def hold(end: End, moved: Array) -> Felt:
    """Return the force on a place of a channel that moves by this much relative to what is in it, m, [3].

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
