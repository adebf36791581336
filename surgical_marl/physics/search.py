"""A line search: how far to go along a step, so that the slope of a convex cost is next to nothing there."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.problem import Point


class Search(NamedTuple):
    """A step from a start along a way, and which lengths of it were tried."""

    start: Point
    way: Point
    length: Array
    low: Array
    """The longest length that was too short."""
    high: Array
    """The shortest one that was too long."""
    slope: Array
    """Of the cost along the way, at the start."""
    looks: Array
    """How many were tried."""

    def here(self) -> Point:
        return jax.tree.map(lambda x, way: x + self.length * way, self.start, self.way)

    def at(self, here: Point) -> Search:
        return self._replace(start=here)

    def begin(self, here: Point, way: Point, slope: Array) -> Search:
        """Return the search along a new way."""
        zero = jnp.float32(0.0)
        return Search(here, way, jnp.float32(1.0), zero, jnp.float32(jnp.inf), slope, jnp.int32(0))

    def look(self, slope: Array, growth: Array) -> Search:
        """Return the search with the length that comes next: Newton's method on the slope, within a bracket."""
        short = slope < 0
        low, high = jnp.where(short, self.length, self.low), jnp.where(short, self.high, self.length)
        length = self.length - slope / jnp.maximum(growth, 1e-20)
        inside = jnp.where(short, length < high, length > low)
        length = jnp.where(inside, length, jnp.where(high < jnp.inf, (low + high) / 2, 2 * low))
        return self._replace(length=length, low=low, high=high, looks=self.looks + 1)
