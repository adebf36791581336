"""Objects that differ from their files: what domain randomisation changes in the tables of contacts."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.contact.contact_pairs import ContactPairs
from surgical_marl.physics.systems.rigid_motion import Masses

LENGTHS = "start", "end", "middle", "radius", "around", "bound", "centers"
"""Tables of lengths of objects, [k, ...]."""


class Factors(NamedTuple):
    """Factors of the values of k free objects, [k] each."""

    size: Array
    """All lengths, about the origin of the object's frame."""
    mass: Array
    """The mass. Moments of inertia grow by this and by the square of the size."""
    friction: Array
    """The coefficient of friction."""


def varied(tables: ContactPairs, factors: Factors) -> ContactPairs:
    """Return the tables of objects that differ from their files."""
    own: Any = copy.copy(tables)
    size, mass = factors.size, factors.mass

    def long(values: Any) -> Any:
        return size.reshape(-1, *[1] * (values.ndim - 1)) * values

    vars(own).update({name: long(getattr(tables, name)) for name in LENGTHS})
    inertia = (mass * size * size)[:, None, None] * tables.masses.inertia
    own.masses = Masses(mass * tables.masses.mass, inertia)
    # of two surfaces the geometric mean counts
    rough = jnp.sqrt(jnp.append(factors.friction, 1.0))
    own.sliding = rough[tables.first_object] * rough[tables.second_object] * tables.sliding
    found: ContactPairs = own
    return found


def grown(tables: ContactPairs, factors: Factors, frames: Array) -> Array:
    """Return by how much centres of mass move if objects with axes [k, 3, 3] get their size where they lie, m, [k, 3].

    They grow from their lowest points, and to the sides from the origins of their frames: so what lies on something
    still does.
    """
    places = [jnp.einsum("kij,kcj->kci", frames, x) for x in (tables.start, tables.end)]
    lowest = jnp.minimum(*(place[..., 2] for place in places)) - tables.radius
    away = (frames @ tables.centers[..., None])[..., 0]
    there = tables.radius > 0  # capsules that are not there have a negative radius
    height = -jnp.min(jnp.where(there, lowest, jnp.inf), 1)
    return (factors.size - 1)[:, None] * jnp.concatenate([away[:, :2], height[:, None]], 1)
