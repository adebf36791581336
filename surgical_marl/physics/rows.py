"""Rows of trees of arrays, which loops over bodies and contacts read one at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array


def row_of(tree: Any, i: Array | int) -> Any:
    """Return one row of all arrays of a tree."""
    return jax.tree.map(lambda x: x[i], tree)


def stored(tree: Any) -> Any:
    """Return the same arrays: the fused engine keeps what a loop has written in memory, where it can be looked up."""
    return jax.lax.map(lambda row: row, tree)


def absent(tree: Any) -> Any:
    """Return arrays like those of a tree. They hold nothing that may be read before it is written; a number is 0."""
    empty = getattr(jax.lax, "empty", jnp.zeros)  # JAX before 0.7 has no other
    return jax.tree.map(lambda x: (empty if x.shape else jnp.zeros)(x.shape, x.dtype), tree)


def room(tree: Any, rows: int) -> Any:
    """Return arrays for `rows` trees like this one, as `absent` does."""
    return absent(jax.tree.map(lambda x: jax.ShapeDtypeStruct((rows, *x.shape), x.dtype), tree))


def filled(row: Callable[[Array], Any], found: Array, rows: int) -> Any:
    """Return arrays for `rows` trees, of which the first `found` are `row(0)`, `row(1)` and so on."""
    shape = jax.eval_shape(lambda: row(jnp.int32(0)))

    def note(n: Array, all_: Any) -> Any:
        return jax.tree.map(lambda x, own: x.at[n].set(own), all_, row(n))

    return jax.lax.fori_loop(0, found, note, room(shape, rows))
