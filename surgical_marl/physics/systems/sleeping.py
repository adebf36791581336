"""Sleeping: an object that lies still with nothing moving near it keeps its pose until something comes near.

An object whose velocity and acceleration are zero, all six numbers of both, is at rest. Objects begin with the
acceleration of gravity, so none is at rest before a step has found what bears it. MuJoCo calls this sleeping.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.broadphase import Ball, Placed, between_balls, nearest, size
from surgical_marl.physics.systems.rigid_motion import Bodies

SLOW = 1e-4
"""Speed below which each point of an object has to be to come to rest, m/s. What lies still has less than a hundredth
of it, from rounding errors."""
UNFORCED = 0.01
"""Acceleration likewise, m/s2: a thousandth of gravity's. What tips over, or turns back as it rocks, has more."""


class Company(NamedTuple):
    """Neighbours that keep objects awake."""

    arms: Array
    """Objects that an arm is near, [k] bool."""
    objects: Array
    """Pairs of objects that are near each other, [k, k] bool."""

    def spread(self, awake: Array) -> Array:
        """Return which objects are awake, [k] bool: those of `awake`, those near an arm, and all their neighbours."""
        awake |= self.arms
        for _ in range(len(awake) - 1):
            awake |= (self.objects & awake).any(1)
        return awake


def company(placed: Placed, slender: np.ndarray, reach: Callable[..., Array]) -> Company:
    """Return which arms and objects are near each object.

    Args:
        placed: where all bodies are.
        slender: numbers of long, thin links, such as shafts of instruments. They are compared by their axes: a ball
            around a shaft would keep all objects under it awake.
        reach: takes two balls or rows of balls; returns the distance below which bodies may touch in the next step, m.
    """
    objects, links = placed.balls["objects"], placed.balls["links"]
    own = Ball(*(x[:, None] for x in objects))
    by_pad, by_link, by_object = (
        between_balls(own, ball) < reach(own, ball) for ball in (placed.balls["pads"], links, objects)
    )
    shafts, around = (jax.tree.map(lambda x: x[slender], of) for of in (placed.links, links))
    offset = own.centre - jax.vmap(nearest, (0, None), 1)(shafts, objects.centre)
    by_link = by_link.at[:, slender].set(size(offset) - shafts.radius - own.radius < reach(own, around))
    return Company(by_pad.any(1) | by_link.any(1), by_object)


def moving(bodies: Bodies) -> Array:
    """Return which objects have a velocity or an acceleration, [k] bool."""
    return (jnp.concatenate([bodies.velocity, bodies.acceleration], -1) != 0).any(-1)


def settled(bodies: Bodies, bound: Any, near: Company) -> Bodies:
    """Return the objects after a step: those slow enough, and with no neighbour awake, get zero velocity and rest.

    Args:
        bodies: after the step.
        bound: radius of a ball about the centre of mass that holds the object, m, [k].
        near: their neighbours.
    """
    fast = jnp.zeros(len(bodies.position), bool)
    for rate, most in ((bodies.velocity, SLOW), (bodies.acceleration, UNFORCED)):
        fast |= size(rate[:, :3]) + bound * size(rate[:, 3:]) >= most
    awake = near.spread(fast)[:, None]
    still = (jnp.where(awake, rate, 0.0) for rate in (bodies.velocity, bodies.acceleration))
    return Bodies(bodies.position, bodies.quaternion, *still)
