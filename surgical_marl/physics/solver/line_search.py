"""A line search: how far to go along a step, so that the slope of a convex cost is next to nothing there."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

ENOUGH = 0.3
"""A length is good if the slope there is at most this share of that at the beginning: the next Newton step needs no
better one."""
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
    step: Array
    """How far the next one is from the last one."""
    looks: Array
    """How many there were."""
    done: Array


def search(begin: Array, least: float, measure: Callable[[Array], tuple[Array, Array]]) -> _Tried:
    """Return a length at which the slope of a convex function is small.

    Newton's method on the slope, within a bracket, which is halved instead where a step further is more than half as
    long as the one before: from one flat end of a slope that is steep in the middle Newton's steps would lead to the
    other one, and back (W. H. Press et al., "Numerical Recipes", 3rd edition, section 9.4). The first length is 1. If
    the slope at the beginning is no more than `least`, that is taken without a look.

    Args:
        begin: slope at length 0, below 0, [].
        least: size of a slope that counts as none.
        measure: from a length to the slope there, and by how much it grows per length.
    """

    def look(tried: _Tried) -> _Tried:
        slope, growth = measure(tried.length)
        looks = tried.looks + 1
        done, short = (jnp.abs(slope) <= -ENOUGH * begin) | (looks >= LOOKS), slope < 0
        low, high = jnp.where(short, tried.length, tried.low), jnp.where(short, tried.high, tried.length)
        length = tried.length - slope / jnp.maximum(growth, 1e-20)
        nearer = (jnp.abs(length - tried.length) <= tried.step / 2) | ~short | (high == jnp.inf)
        halved = jnp.where(high < jnp.inf, (low + high) / 2, 2 * low)
        length = jnp.where((length > low) & (length < high) & nearer, length, halved)
        step = jnp.abs(length - tried.length)
        return _Tried(jnp.where(done, tried.length, length), low, high, step, looks, done)

    one, none, far = (jnp.float32(x) for x in (1.0, 0.0, jnp.inf))
    start = _Tried(one, none, far, far, jnp.int32(0), -begin <= least)
    found: _Tried = jax.lax.while_loop(lambda tried: ~tried.done, look, start)
    return found
