"""Newton's method on convex functions: the loop over steps, and the line search within a step.

All problems of this folder are of that kind: an arm alone and arms with contacts as rows (`constraint_rows.py`), arms
that one object joins (`joined_arms.py`), arms and bodies with friction cones (`contact_solver.py`), and point masses.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

ENOUGH = 0.3
"""A length is good if the slope there is at most this share of that at the beginning: the next Newton step needs no
better one."""
LOOKS = 10
"""Lengths that are tried at most."""


def newton(step: Callable[[Any, Array], tuple[Any, Array]], start: Any, most: int, steady: int = 1) -> Any:
    """Return the state after at most `most` Newton steps, fewer if `steady` of them in a row report convergence.

    Args:
        step: from a state and the number of steps before to the next state, and whether no other step is needed, [].
        start: the first state, a tree of arrays.
        most: steps at most. One step is taken without a loop.
        steady: steps in a row that need no other one, after which the search stops.
    """
    if most == 1:
        return step(start, jnp.int32(0))[0]

    def going(loop: Any) -> Array:
        _, settled, count = loop
        return (settled < steady) & (count < most)

    def iterate(loop: Any) -> Any:
        state, settled, count = loop
        state, last = step(state, count)
        return state, jnp.where(last, settled + 1, 0), count + 1

    return jax.lax.while_loop(going, iterate, (start, jnp.int32(0), jnp.int32(0)))[0]


class Tried(NamedTuple):
    """The lengths that a line search has tried."""

    length: Array
    """The one to try next, or the one that was found."""
    low: Array
    """The longest that was too short."""
    high: Array
    """The shortest that was too long."""
    step: Array
    """Distance of the next one from the last one."""
    looks: Array
    """Number of lengths tried."""
    done: Array


def line_search(
    begin: Array,
    least: float,
    measure: Callable[[Array], tuple[Array, Array]],
    looks: int = LOOKS,
    enough: float = ENOUGH,
) -> Tried:
    """Return a length at which the slope of a convex function is small.

    Newton's method on the slope, within a bracket, which is halved instead where a step further is more than half as
    long as the one before: from one flat end of a slope that is steep in the middle Newton's steps would lead to the
    other one, and back (W. H. Press et al., "Numerical Recipes", 3rd edition, section 9.4). The first length is 1. If
    the slope at the beginning is no more than `least`, that is taken without a look.

    Args:
        begin: slope at length 0, below 0, [].
        least: size of a slope that counts as none.
        measure: from a length to the slope there, and by how much it grows per length.
        looks: lengths that are tried at most. One is tried without a loop.
        enough: share of the slope at the beginning at which a length is good.
    """

    def look(tried: Tried) -> Tried:
        slope, growth = measure(tried.length)
        good, short = jnp.abs(slope) <= -enough * begin, slope < 0
        low, high = jnp.where(short, tried.length, tried.low), jnp.where(short, tried.high, tried.length)
        length = tried.length - slope / jnp.maximum(growth, 1e-20)
        nearer = (jnp.abs(length - tried.length) <= tried.step / 2) | ~short | (high == jnp.inf)
        halved = jnp.where(high < jnp.inf, (low + high) / 2, 2 * low)
        inside = jnp.where(short, length < high, length > low)  # from a bound, it can only lead inwards
        length = jnp.where(inside & nearer, length, halved)
        step, count = jnp.abs(length - tried.length), tried.looks + 1
        return Tried(jnp.where(good, tried.length, length), low, high, step, count, good | (count >= looks))

    one, none, far = (jnp.float32(x) for x in (1.0, 0.0, jnp.inf))
    start = Tried(one, none, far, far, jnp.int32(0), -begin <= least)
    if looks == 1:
        return look(start)
    found: Tried = jax.lax.while_loop(lambda tried: ~tried.done, look, start)
    return found
