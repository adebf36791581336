"""Rows of trees of arrays, which loops over bodies and contacts read one at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

Tree = TypeVar("Tree")


def when(needed: Array, change: Callable[[Tree], Tree], state: Tree) -> Tree:
    """Return `change(state)` where it is needed, [] bool, else the state."""
    found: Tree = jax.lax.cond(needed, change, lambda state: state, state)
    return found


def for_each(needed: Array, change: Callable[[Tree, Array], Tree], state: Tree) -> Tree:
    """Return a state after `change(state, n)`, one after the other, for each number n that is needed, [n] bool."""

    def one(state: Tree, row: tuple[Array, Array]) -> tuple[Tree, None]:
        n, needed = row
        return when(needed, lambda state: change(state, n), state), None

    return jax.lax.scan(one, state, (jnp.arange(len(needed)), needed))[0] if len(needed) else state


def row_of(tree: Any, i: Array | np.ndarray | int) -> Any:
    """Return one row of all arrays of a tree, or several of them, if `i` is an array of their numbers."""
    return jax.tree.map(lambda x: x[i], tree)


def picked(tree: Any, i: Array) -> Any:
    """Return one row of all arrays of a tree, as `row_of` does, out of one flat array.

    Of an array with few rows the fused engine would have all rows in registers, to select one of them. A long array it
    has in memory, and loads one row of it.
    """
    arrays, structure = jax.tree.flatten(tree)
    flat = jnp.concatenate([x.reshape(len(x), -1) for x in arrays], 1)
    width, ends = flat.shape[1], np.cumsum([x[0].size for x in arrays])
    row = jax.lax.dynamic_slice(flat.ravel(), (width * i,), (width,))
    parts = jnp.split(row, ends[:-1])
    return jax.tree.unflatten(structure, [part.reshape(x.shape[1:]) for part, x in zip(parts, arrays, strict=True)])


def put(tree: Any, i: Any, row: Any) -> Any:
    """Return the arrays of a tree with another row: at a number, or at one for each of the first axes, within them."""
    return jax.tree.map(lambda x, own: x.at[i].set(own, mode="promise_in_bounds"), tree, row)


def add(tree: Any, i: Any, row: Any) -> Any:
    """Return the arrays of a tree with more in one row, as `put` does."""
    return jax.tree.map(lambda x, own: x.at[i].add(own, mode="promise_in_bounds"), tree, row)


def empty_like(tree: Any) -> Any:
    """Return arrays like those of a tree. They hold nothing that may be read before it is written; a number is 0."""
    empty = getattr(jax.lax, "empty", jnp.zeros)  # JAX before 0.7 has no other
    return jax.tree.map(lambda x: (empty if x.shape else jnp.zeros)(x.shape, x.dtype), tree)


def room(tree: Any, rows: int) -> Any:
    """Return arrays for `rows` trees like this one, as `empty_like` does."""
    return empty_like(jax.tree.map(lambda x: jax.ShapeDtypeStruct((rows, *x.shape), x.dtype), tree))


class Listed(NamedTuple):
    """Some of n numbers."""

    numbers: Array
    """The first `length` of [n + 1]; what does not belong to the list goes to the last place."""
    length: Array

    @classmethod
    def none(cls, most: int) -> Listed:
        """Return an empty list with room for so many numbers."""
        return cls(room(jnp.int32(0), most + 1), jnp.int32(0))

    def after(self, number: Array, belongs: Array) -> Listed:
        """Return the list with one more number if it belongs to it. One that finds no room is only counted."""
        last = len(self.numbers) - 1
        place = jnp.where(belongs, jnp.minimum(self.length, last), last)
        return Listed(put(self.numbers, place, number), self.length + belongs.astype(jnp.int32))


def filled(row: Callable[[Array], Any], found: Array, rows: int) -> Any:
    """Return arrays for `rows` trees, of which the first `found` are `row(0)`, `row(1)` and so on."""
    shape = jax.eval_shape(lambda: row(jnp.int32(0)))

    def note(n: Array, all_: Any) -> Any:
        return put(all_, n, row(n))

    return jax.lax.fori_loop(0, found, note, room(shape, rows))
