"""Blocks: small JAX functions over every primitive that the fused engine knows."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from surgical_marl.physics.tree_utils import room
from tests.helpers.fused_rows import ROWS

COUNT = 21
"""Environments: not a whole number of vectors, so that some lanes hold nothing but zeros."""

Arrays = Any

# A block takes and gives arrays [3] of these sorts:
# e  floats that are multiples of 1/8 up to 8: arithmetic on them is exact, so that what jumps, such as floor or a
#    comparison, jumps in JAX and in a kernel alike
# s  floats of about -1 to 1, from functions that make no error larger, so that a program of many stays comparable
# i, u, b  int32, uint32, bool
SORTS = {"e": np.float32, "s": np.float32, "i": np.int32, "u": np.uint32, "b": np.bool_}

Block = tuple[str, str, Callable[..., Any]]  # sorts of the arguments, sort of the result, function

RNG = np.random.default_rng(1)
REALS = (RNG.integers(-64, 65, (5, 8)) / 8).astype(np.float32)  # tables
WHOLES = RNG.integers(-(2**31), 2**31, 40).astype(np.int32)
WORDS = RNG.integers(0, 2**32, 40).astype(np.uint32)
TRUTHS = RNG.random(40) < 0.5
PLACES = np.array([2, 0, 1])

ARITHMETIC: dict[str, Block] = {
    "add": ("ee", "e", lax.add),
    "add whole": ("ii", "i", lax.add),
    "add words": ("uu", "u", lax.add),
    "sub": ("ee", "e", lax.sub),
    "sub words": ("uu", "u", lax.sub),
    "mul": ("ee", "e", lambda x, y: x * y / 8),
    "mul whole": ("ii", "i", lax.mul),
    "mul words": ("uu", "u", lax.mul),
    "div": ("ee", "s", lambda x, y: x / (y * y + 1) / 8),
    "div by constants": ("e", "s", lambda x: x / np.float32([16, -24, 11])),
    "div whole": ("ii", "i", lax.div),
    "div words": ("uu", "u", lax.div),
    "floor divide": ("ii", "i", lambda x, y: x // jnp.where(y == 0, 3, y)),
    "rem": ("ee", "e", lambda x, y: lax.rem(x, jnp.where(y == 0, 1.0, y))),
    "rem whole": ("ii", "i", lax.rem),
    "rem words": ("uu", "u", lax.rem),
    "mod": ("ii", "i", lambda x, y: x % jnp.where(y == 0, 3, y)),
    "neg": ("e", "e", lax.neg),
    "neg whole": ("i", "i", lax.neg),
    "neg words": ("u", "u", lax.neg),
    "abs": ("e", "e", lax.abs),
    "abs whole": ("i", "i", lax.abs),
    "sign": ("e", "e", lax.sign),
    "sign whole": ("i", "i", lax.sign),
    "sign words": ("u", "u", lax.sign),
    "floor": ("e", "e", lax.floor),
    "ceil": ("e", "e", lax.ceil),
    "round away": ("e", "e", lambda x: lax.round(2 * x, lax.RoundingMethod.AWAY_FROM_ZERO) / 2),
    "round even": ("e", "e", lambda x: lax.round(2 * x, lax.RoundingMethod.TO_NEAREST_EVEN) / 2),
    "square": ("e", "e", lambda x: lax.square(x) / 8),
    "cube": ("s", "s", lambda x: lax.integer_pow(x, 3) / 3),
    "power -2": ("s", "s", lambda x: lax.integer_pow(1.5 + x * x, -2)),
    "max": ("ee", "e", lax.max),
    "max whole": ("ii", "i", lax.max),
    "max words": ("uu", "u", lax.max),
    "max truths": ("bb", "b", lax.max),
    "min": ("ee", "e", lax.min),
    "min whole": ("ii", "i", lax.min),
    "min words": ("uu", "u", lax.min),
    "min truths": ("bb", "b", lax.min),
    "clamp": ("ee", "e", lambda x, y: lax.clamp(np.float32(-1), x, lax.abs(y))),
    "clamp whole": ("ii", "i", lambda x, y: lax.clamp(-5, x, lax.max(y, -5))),
    "select": ("bee", "e", lambda b, x, y: lax.select_n(b, x, y)),
    "select truths": ("bbb", "b", lambda b, x, y: lax.select_n(b, x, y)),
    "select of three": ("iuuu", "u", lambda i, *cases: lax.select_n(lax.clamp(0, i, 2), *cases)),
    "lt": ("ee", "b", lax.lt),
    "le": ("ii", "b", lax.le),
    "gt": ("uu", "b", lax.gt),
    "ge": ("ee", "b", lax.ge),
    "eq": ("ii", "b", lambda x, y: lax.eq(x & 3, y & 3)),
    "ne": ("uu", "b", lambda x, y: lax.ne(x & 1, y & 1)),
    "compare truths": ("bb", "b", lambda x, y: (x < y) ^ (x <= y) ^ ((x > y) & (x >= y)) ^ ((x == y) | (x != y))),
    "is_finite": ("e", "b", lambda x: lax.is_finite(1 / x)),
    "isnan": ("e", "b", lambda x: jnp.isnan(x / x)),
    "and": ("bb", "b", lax.bitwise_and),
    "or": ("bb", "b", lax.bitwise_or),
    "xor": ("bb", "b", lax.bitwise_xor),
    "not": ("b", "b", lax.bitwise_not),
    "and whole": ("ii", "i", lax.bitwise_and),
    "or words": ("uu", "u", lax.bitwise_or),
    "xor whole": ("ii", "i", lax.bitwise_xor),
    "not words": ("u", "u", lax.bitwise_not),
    "shift left": ("iu", "i", lambda x, y: lax.shift_left(x, (y % 40).astype(jnp.int32))),
    "shift right": ("uu", "u", lambda x, y: lax.shift_right_logical(x, y % 40)),
    "shift right whole": ("iu", "i", lambda x, y: lax.shift_right_logical(x, (y % 40).astype(jnp.int32))),
    "shift sign": ("iu", "i", lambda x, y: lax.shift_right_arithmetic(x, (y % 40).astype(jnp.int32))),
    "shift sign of words": ("uu", "u", lambda x, y: lax.shift_right_arithmetic(x, y % 40)),
}

FUNCTIONS: dict[str, Block] = {
    "to smooth": ("e", "s", lambda x: x / 8),
    "mean": ("ss", "s", lambda x, y: (x + y) / 2),
    "product": ("ss", "s", lambda x, y: x * y / 2),
    "sin": ("s", "s", lax.sin),
    "cos": ("s", "s", lax.cos),
    "tan": ("s", "s", lambda x: lax.tan(x / 2)),
    "acos": ("s", "s", lambda x: lax.acos(x / 2) / 3),
    "asin": ("s", "s", lambda x: lax.asin(x / 2)),
    "atan2": ("ss", "s", lambda x, y: lax.atan2(x, y + 2.5) + lax.atan2(-x, y - 2.5) / 4),
    "tanh": ("s", "s", lax.tanh),
    "exp": ("s", "s", lambda x: lax.exp(x) / 4),
    "log": ("s", "s", lambda x: lax.log(2 + x)),
    "log1p": ("s", "s", lambda x: lax.log1p(x * x / 2)),
    "logistic": ("s", "s", lax.logistic),
    "sqrt": ("s", "s", lambda x: lax.sqrt(1 + x * x) / 2),
    "rsqrt": ("s", "s", lambda x: lax.rsqrt(1 + x * x)),
    "erf_inv": ("s", "s", lambda x: lax.erf_inv(x / 2)),
    "pow": ("ss", "s", lambda x, y: lax.pow(1.5 + x / 2, y) / 4),
    "pow whole": ("si", "s", lambda x, i: lax.pow(1.5 + x / 2, i & 3) / 8),
    "pow constants": ("s", "s", lambda x: lax.pow(1.5 + x / 2, np.float32([3, -0.3, 0.5])) / 8),
    "relu": ("s", "s", jax.nn.relu),
    "gradient": ("s", "s", lambda x: jax.grad(lambda x: (jnp.sin(x) * x + jnp.cos(x)).sum())(x) / 2),
    "gradient of one's own": ("s", "s", lambda x: own_gradient(x)),
    "batching of one's own": ("s", "s", lambda x: own_batching(x)),
    "stop_gradient": ("s", "s", lax.stop_gradient),
    "copy": ("e", "e", jnp.copy),
    "optimization_barrier": ("eu", "e", lambda x, y: lax.optimization_barrier((x, y))[0]),
    "checkpoint": ("s", "s", jax.checkpoint(lambda x: jnp.sin(x))),
    "convert": ("e", "i", lambda x: x.astype(jnp.int32)),
    "convert to words": ("e", "u", lambda x: x.astype(jnp.uint32)),
    "convert to truths": ("i", "b", lambda x: (x & 2).astype(bool)),
    "convert whole": ("i", "e", lambda x: (x >> 28).astype(jnp.float32)),
    "convert large": ("iu", "s", lambda x, y: (x.astype(jnp.float32) / 2.0**31 + y.astype(jnp.float32) / 2.0**32) / 2),
    "convert truths": ("b", "u", lambda x: x.astype(jnp.uint32)),
    "truths as floats": ("b", "e", lambda x: x.astype(jnp.float32)),
    "words as whole": ("u", "i", lambda x: x.astype(jnp.int32)),
    "whole as words": ("i", "u", lambda x: x.astype(jnp.uint32)),
    "bits": ("e", "u", lambda x: lax.bitcast_convert_type(abs(x) + 1, jnp.uint32)),
    "bits as whole": ("e", "i", lambda x: lax.bitcast_convert_type(abs(x) + 1, jnp.int32)),
    "float of bits": ("u", "e", lambda x: lax.bitcast_convert_type((x >> 9) | 0x3F800000, jnp.float32)),
    "float of whole": ("i", "e", lambda x: lax.bitcast_convert_type((x & 0x7FFFFF) | 0x3F800000, jnp.float32)),
    "cast words": ("u", "i", lambda x: lax.bitcast_convert_type(x, jnp.int32)),
}


@jax.custom_vjp
def own_gradient(x: Arrays) -> Arrays:
    return jnp.cos(x)


@jax.custom_batching.custom_vmap
def own_batching(x: Arrays) -> Arrays:
    return jnp.sin(x)


own_batching.def_vmap(lambda size, batched, x: (jnp.sin(x), True))
own_gradient.defvjp(lambda x: (own_gradient(x), None), lambda _, y: (y,))


def outer(x: Arrays, y: Arrays) -> Arrays:
    return x[:, None] - y[None, :]


MOVES: dict[str, Block] = {
    "reshape": ("ee", "e", lambda x, y: outer(x, y).reshape(9)[1:8:3]),
    "squeeze": ("i", "i", lambda x: lax.squeeze(x.reshape(1, 3, 1), (0, 2))),
    "expand_dims": ("bu", "u", lambda b, x: lax.select_n(lax.expand_dims(b, (0,)), x[None], x[None] + 1)[0]),
    "transpose": ("ee", "e", lambda x, y: outer(x, y).T[0]),
    "rev": ("u", "u", lambda x: lax.rev(x, (0,))),
    "broadcast": ("i", "i", lambda x: lax.broadcast_in_dim(x[1], (3,), ()) - x),
    "slice": ("ee", "e", lambda x, y: lax.slice(outer(x, y), (0, 1), (3, 2), (1, 1))[:, 0]),
    "tile": ("b", "b", lambda x: jnp.tile(x, (2, 2))[1, 2:5]),
    "concatenate": ("eu", "e", lambda x, u: jnp.concatenate([x[1:], np.float32([7]), x])[1:4]),
    "stack": ("ii", "i", lambda x, y: jnp.stack([x, y, np.arange(3)], 1)[2]),
    "split": ("uu", "u", lambda x, y: jnp.concatenate(jnp.split(jnp.concatenate([x, y]), [1, 4])[1:])[2:]),
    "unstack": ("ee", "e", lambda x, y: sum(jnp.unstack(outer(x, y), axis=1)) / 4),
    "pad": ("ie", "i", lambda x, y: lax.pad(x, np.int32(5), [(-1, 2, 1)])[:3]),
    "pad by a value": ("ue", "u", lambda x, y: lax.pad(np.uint32([1, 2]), x[0], [(1, 0, 0)])),
    "room": ("e", "e", lambda x: lax.fori_loop(0, 3, lambda k, y: y.at[k].set(x[2 - k] / 2), room(x[0], 3))),
    "iota": ("e", "e", lambda x: x + lax.broadcasted_iota(jnp.float32, (3, 3), 1)[2] / 4),
    "sum": ("ee", "e", lambda x, y: outer(x, y).sum(0) / 4),
    "sum whole": ("i", "i", lambda x: x - x.sum()),
    "product": ("u", "u", lambda x: x + x.prod()),
    "largest": ("ee", "e", lambda x, y: outer(x, y).max(1) / 2),
    "smallest": ("i", "i", lambda x: x - x.min()),
    "largest truth": ("bb", "b", lambda x, y: (x[:, None] & y).max(1)),
    "all": ("bb", "b", lambda x, y: (x[:, None] | y).all(0)),
    "any": ("bb", "b", lambda x, y: (x[:, None] & y).any(0)),
    "all bits": ("i", "i", lambda x: x ^ lax.reduce(x, np.int32(-1), lax.bitwise_and, (0,))),
    "argmin": ("e", "i", lambda x: jnp.argmin(outer(x, x[::-1]), 0)),
    "argmax": ("uu", "i", lambda x, y: jnp.argmax(outer(x, y) & 3, 1)),
    "argmax of truths": ("bb", "i", lambda x, y: jnp.argmax(x[:, None] ^ y, 1)),
    "argmax as words": ("e", "u", lambda x: x.astype(jnp.uint32) + lax.argmax(x, 0, jnp.uint32)),
    "cumsum": ("e", "e", lambda x: jnp.cumsum(x) / 4),
    "cumsum back": ("i", "i", lambda x: lax.cumsum(x, reverse=True)),
    "cumprod": ("u", "u", lambda x: lax.cumprod(x)),
    "cummax": ("ee", "e", lambda x, y: lax.cummax(outer(x, y), axis=1, reverse=True)[1] / 2),
    "cummin": ("i", "i", lambda x: lax.cummin(x)),
    "sort of constants": ("i", "i", lambda x: x + jnp.argsort(np.array([3, 1, 2]))),
    "top_k": ("ee", "e", lambda x, y: lax.top_k(outer(x, y).ravel(), 3)[0] / 2),
    "top_k places": ("bi", "i", lambda b, x: lax.top_k(jnp.where(b, -jnp.inf, (x & 1).astype(float)), 3)[1]),
    "top_k of words": ("u", "u", lambda x: lax.top_k(x & 1, 2)[1][0].astype(jnp.uint32) + x),
    "top_k on an axis": ("ii", "i", lambda x, y: lax.top_k(outer(x, y), 2, axis=0)[0][1]),
    "dot": ("ss", "s", lambda x, y: outer(x, y) @ x / 9),
    "dot whole": ("ii", "i", lambda x, y: outer(x, y) @ x),
    "dot in batches": ("ss", "s", lambda x, y: jnp.einsum("bij,bj,ci->bc", outer(x, y).reshape(3, 3, 1), x[:, None],
                                                          outer(y, x))[0] / 12),
    "dot with zeros": ("s", "s", lambda x: np.float32([[0, 1, 0], [0.5, 0, 0.5], [0, 0, 0]]) @ x),
    "cholesky": ("ss", "s", lambda x, y: lax.linalg.cholesky(positive(x, y)).reshape(9)[3:6] / 4),
    "cholesky in batches": ("ss", "s", lambda x, y: jnp.linalg.cholesky(
        jnp.stack([positive(x, y), positive(y, x)]))[1, 2] / 4),
    "random bits": ("u", "u", lambda x: jax.random.bits(x[:2], (3,))),
    "random uniform": ("u", "s", lambda x: jax.random.uniform(x[1:], (3,), minval=-1)),
    "random normal": ("u", "s", lambda x: jax.random.normal(x[:2], (3,)) / 8),
    "randint": ("u", "i", lambda x: jax.random.randint(x[:2], (3,), -5, 77)),
    "fold_in": ("ui", "u", lambda x, i: jnp.append(jax.random.fold_in(x[1:], i[0]), x[0])),
    "split keys": ("u", "u", lambda x: jax.random.split(x[:2], 3).ravel()[1:4]),
    "typed keys": ("ub", "u", lambda x, b: typed_keys(x, b)),
}  # fmt: skip


def positive(x: Arrays, y: Arrays) -> Arrays:
    """A positive definite matrix."""
    return x[:, None] * x / 4 + y[:, None] * y / 4 + 2 * np.eye(3, dtype=np.float32)


def typed_keys(x: Arrays, b: Arrays) -> Arrays:
    keys = jax.random.split(jax.random.wrap_key_data(x[:2]), 4).reshape(2, 2)
    key = jnp.where(b[0], keys[0, 1], lax.cond(b[1], lambda: keys[1, 0], lambda: jax.random.fold_in(keys[0, 0], 3)))
    picked = lax.dynamic_index_in_dim(keys[0], b[2].astype(jnp.int32), keepdims=False)
    return jax.random.bits(key, (3,)) ^ jax.random.key_data(picked)[0]


def solve(left: bool, lower: bool, turn: bool, unit: bool, x: Arrays, y: Arrays) -> Arrays:
    a = outer(x, y) / 4 + (0 if unit else 2 * np.eye(3, dtype=np.float32))
    b = outer(y, x)[:, :2] / 4
    b = b if left else b.T
    return lax.linalg.triangular_solve(
        a, b, left_side=left, lower=lower, transpose_a=turn, unit_diagonal=unit
    ).reshape(6)[1:4] / 2  # fmt: skip


MOVES |= {
    f"solve {left}{lower}{turn}{unit}": ("ss", "s", partial(solve, left, lower, turn, unit))
    for left in (False, True) for lower in (False, True) for turn in (False, True) for unit in (False, True)
    if lower or not unit
}  # fmt: skip

INDEXING: dict[str, Block] = {
    "element": ("ei", "e", lambda x, i: x[i % 3]),
    "element, clipped": ("ui", "u", lambda x, i: x.at[(i >> 28)].get(mode="clip")),
    "element, or a fill": ("ei", "e", lambda x, i: x.at[(i >> 28)].get(mode="fill", fill_value=0.5)),
    "whole or a fill": ("i", "i", lambda x: jnp.take(x, x >> 29, mode="fill")),
    "word or a fill": ("ui", "u", lambda x, i: jnp.take(x, i >> 29, mode="fill")),
    "truth or a fill": ("bi", "b", lambda x, i: jnp.take(x, i >> 29, mode="fill")),
    "element, promised": ("eu", "e", lambda x, i: x.at[i % 3].get(mode="promise_in_bounds")),
    "known places": ("e", "e", lambda x: x[PLACES] + x.at[np.array([1, 7, -9])].get(mode="fill", fill_value=1)),
    "known places, clipped": ("u", "u", lambda x: x.at[np.array([5, 1, -7])].get(mode="clip")),
    "rows": ("eei", "e", lambda x, y, i: outer(x, y)[i % 3][1]),
    "cells": ("eeiu", "e", lambda x, y, i, u: outer(x, y)[i % 3, (u % 3).astype(int)] / 2),
    "along": ("eei", "e", lambda x, y, i: jnp.take_along_axis(outer(x, y), i[None] % 3, 0)[0] / 2),
    "table": ("u", "e", lambda i: jnp.asarray(REALS).ravel()[i % 40]),
    "table of two axes": ("ui", "e", lambda u, i: jnp.asarray(REALS)[i % 5, (u % 8).astype(int)]),
    "rows of a table": ("i", "e", lambda i: jnp.asarray(REALS)[i % 5][:, 2]),
    "table, clipped": ("i", "i", lambda i: jnp.asarray(WHOLES).at[i >> 25].get(mode="clip")),
    "table, or a fill": ("i", "i", lambda i: jnp.asarray(WHOLES).at[i >> 25].get(mode="fill", fill_value=-1)),
    "table of words": ("u", "u", lambda i: jnp.asarray(WORDS)[i % 40]),
    "table of truths": ("u", "b", lambda i: jnp.asarray(TRUTHS)[i % 40]),
    "small table": ("i", "e", lambda i: jnp.asarray(REALS)[1, :3][i % 3]),
    "window": ("eei", "e", lambda x, y, i: lax.dynamic_slice(jnp.concatenate([x, y]), (i[0] >> 28,), (3,))),
    "window of a matrix": ("eei", "e", lambda x, y, i: lax.dynamic_slice(
        outer(x, y), (i[0] >> 29, 1), (2, 2)).ravel()[:3] / 2),
    "window of a table": ("i", "e", lambda i: lax.dynamic_slice(
        jnp.asarray(REALS), (i[1] >> 28, i[0] >> 28), (1, 3))[0]),
    "known window": ("u", "u", lambda x: lax.dynamic_slice(jnp.tile(x, 2), (np.int32(9),), (3,))),
    "update": ("eei", "e", lambda x, y, i: lax.dynamic_update_slice(x, y[:2], (i[0] >> 28,))),
    "update a matrix": ("uui", "u", lambda x, y, i: lax.dynamic_update_slice(
        outer(x, y), y[:2, None], (i[0] >> 29, i[1] >> 29))[1]),
    "update truths": ("bbi", "b", lambda x, y, i: lax.dynamic_update_index_in_dim(x, y[0], i[2] % 3, 0)),
    "known update": ("ii", "i", lambda x, y: lax.dynamic_update_slice(np.arange(3, dtype=np.int32), y[1:], (1,))),
    "scatter": ("ee", "e", lambda x, y: x.at[PLACES[:2]].set(y[:2])),
    "scatter outside": ("uu", "u", lambda x, y: x.at[np.array([5, -1, -7, 1])].set(y[0], mode="drop")),
    "scatter, clipped": ("uu", "u", lambda x, y: x.at[np.array([5, -9])].set(y[1:], mode="clip")),
    "scatter truths": ("bb", "b", lambda x, y: x.at[PLACES].set(y)),
    "scatter a scalar": ("e", "e", lambda x: x.at[1].set(3.0)),
    "scatter columns": ("ee", "e", lambda x, y: outer(x, y).at[:, np.array([0, 2])].set(x[:, None])[1] / 2),
    "scatter-add": ("ee", "e", lambda x, y: x.at[np.array([1, 1, 0])].add(y) / 4),
    "scatter-add rows": ("ii", "i", lambda x, y: outer(x, y).at[np.array([2, 9, 2])].add(outer(y, x))[2]),
    "scatter windows": ("ii", "i", lambda x, y: windows(x, y, "drop")),
    "scatter windows, clipped": ("ii", "i", lambda x, y: windows(x, y, "clip")),
    "no elements": ("e", "e", lambda x: x + x[:0].sum() + x[:0].prod() + jnp.concatenate([x[:0], x])
                    + jnp.zeros((3, 0)) @ x[:0] + lax.max(x[:0].max(initial=-1), 1.0) + x[:0].min(initial=2)),
    "no whole elements": ("ib", "i", lambda x, b: x + x[:0].max(initial=3) + b[:0].all() + b[:0].any()
                          + x.at[np.zeros(0, int)].add(x[:0]).sum()),
}  # fmt: skip


def windows(x: Arrays, y: Arrays, mode: str) -> Arrays:
    """Windows of two elements, some of which reach out."""
    numbers = lax.ScatterDimensionNumbers((1,), (), (0,))
    return lax.scatter_add(x, np.array([[2], [-1], [0]]), outer(x, y)[:, :2], numbers, mode=mode)


BLOCKS = {
    f"{group}: {name}": block
    for group, blocks in {"a": ARITHMETIC, "f": FUNCTIONS, "m": MOVES, "r": ROWS, "x": INDEXING}.items()
    for name, block in blocks.items()
}


def random_arrays(seed: int) -> dict[str, list[np.ndarray]]:
    """Two arrays [COUNT, 3] of each sort."""
    rng = np.random.default_rng(seed)
    draw: dict[str, Callable[[], np.ndarray]] = {
        "e": lambda: rng.integers(-24, 25, (COUNT, 3)) / 8,
        "s": lambda: rng.uniform(-1, 1, (COUNT, 3)),
        "i": lambda: rng.integers(-(2**31), 2**31, (COUNT, 3)) >> rng.integers(0, 32, (COUNT, 3)),
        "u": lambda: rng.integers(0, 2**32, (COUNT, 3)) >> rng.integers(0, 32, (COUNT, 3)),
        "b": lambda: rng.random((COUNT, 3)) < 0.5,
    }
    return {sort: [draw[sort]().astype(SORTS[sort]) for _ in range(2)] for sort in SORTS}


def apply_block(name: str, pool: dict[str, list[Arrays]], choices: tuple[int, ...]) -> Arrays:
    """The result of a block on arrays of a pool, brought back to what its sort allows."""
    sorts, sort, function = BLOCKS[name]
    result = function(*(pool[s][choice % len(pool[s])] for s, choice in zip(sorts, choices, strict=False)))
    assert result.shape == (3,) and result.dtype == SORTS[sort], (name, result)
    if sort == "e":
        result = lax.clamp(np.float32(-8), jnp.round(result * 8) / 8, np.float32(8))
    return result


def all_blocks(first: str, pool: dict[str, list[Arrays]]) -> dict[str, Arrays]:
    return {name: apply_block(name, pool, (0, 1, 0, 1)) for name in BLOCKS if name.startswith(first)}
