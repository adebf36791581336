"""A line search: how far to go along a step, so that the slope of a convex cost is next to nothing there."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

ENOUGH = 0.1
"""A length is good if the slope there is at most this share of that at the beginning."""
LOOKS = 10
"""Lengths that are tried at most."""


class _Tried(NamedTuple):
    """Which lengths were tried."""

    length: Array
    """The one to try next, or the last one."""
    low: Array
    """The longest that was too short."""
    high: Array
    """The shortest that was too long."""
    looks: Array
    """How many there were."""
    done: Array


def search(begin: Array, measure: Callable[[Array], tuple[Array, Array]]) -> Array:
    """Return a length at which the slope of a convex function is small.

    Newton's method on the slope, within a bracket. The first length is 1.

    Args:
        begin: slope at length 0, below 0, [].
        measure: from a length to the slope there, and by how much it grows per length.
    """

    def look(tried: _Tried) -> _Tried:
        slope, growth = measure(tried.length)
        looks = tried.looks + 1
        done, short = (jnp.abs(slope) <= -ENOUGH * begin) | (looks >= LOOKS), slope < 0
        low, high = jnp.where(short, tried.length, tried.low), jnp.where(short, tried.high, tried.length)
        length = tried.length - slope / jnp.maximum(growth, 1e-20)
        length = jnp.where(
            (length > low) & (length < high), length, jnp.where(high < jnp.inf, (low + high) / 2, 2 * low)
        )
        return _Tried(jnp.where(done, tried.length, length), low, high, looks, done)

    start = _Tried(jnp.float32(1.0), jnp.float32(0.0), jnp.float32(jnp.inf), jnp.int32(0), jnp.bool_(False))
    found: _Tried = jax.lax.while_loop(lambda tried: ~tried.done, look, start)
    return found.length
