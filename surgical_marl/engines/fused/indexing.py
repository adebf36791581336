"""Gather, scatter and slices at traced places, as arithmetic on indices.

Places that are known while tracing cost nothing: elements are moved. A place that is not becomes a lookup, if the array
is a table of constants, or a choice among the elements it may point to.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np

from surgical_marl.engines.fused.graph import Graph, Value

LEAST_TABLE = 16
"""Constants from this many on are looked up in memory rather than chosen one by one."""


def gather(g: Graph, shape: Any, params: Any, raw: Any, known: Any, lift: Callable[..., np.ndarray]) -> np.ndarray:
    """`lax.gather`; results as values."""
    operand, indices = raw
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    batch_axes = [axis for axis in range(len(shape)) if axis not in numbers.offset_dims]
    grid = np.indices(shape)
    batch = [grid[axis] for axis in batch_axes]
    place: list[Any] = [np.zeros(shape, int) for _ in operand.shape]  # within the slice
    free = [
        axis
        for axis in range(operand.ndim)
        if axis not in numbers.collapsed_slice_dims and axis not in numbers.operand_batching_dims
    ]
    for axis, out in zip(free, numbers.offset_dims, strict=True):
        place[axis] = grid[out]
    for axis, start in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
        place[axis] = place[axis] + batch[start]
    starts = {axis: indices[(*batch, k)] for k, axis in enumerate(numbers.start_index_map)}
    mode = str(params["mode"]).lower()
    if known[1]:
        inside = np.ones(shape, bool)
        for axis, start in starts.items():
            last = operand.shape[axis] - sizes[axis]
            inside &= (start >= 0) & (start <= last)
            place[axis] = place[axis] + np.clip(start.astype(int), 0, last)
        found = lift(operand[tuple(place)]) if known[0] else operand[tuple(place)]
        if "fill" in mode and not inside.all():
            found = np.where(inside, found, _fill(g, params, operand, known[0]))
        return found
    return _choose(g, operand, known[0], sizes, place, starts, mode, lift, params)


def dynamic_slice(
    g: Graph, shape: Any, params: Any, raw: Any, known: Any, lift: Callable[..., np.ndarray]
) -> np.ndarray:
    """`lax.dynamic_slice`; results as values."""
    operand, starts = raw[0], raw[1:]
    place = [np.asarray(axis) for axis in np.indices(shape)]
    if all(known[1:]):
        for axis, start in enumerate(starts):
            place[axis] = place[axis] + int(np.clip(int(start), 0, operand.shape[axis] - shape[axis]))
        found = operand[tuple(place)]
        return lift(found) if known[0] else found
    traced = {}
    for axis, start in enumerate(starts):
        if known[axis + 1]:
            place[axis] = place[axis] + int(np.clip(int(start), 0, operand.shape[axis] - shape[axis]))
        else:
            traced[axis] = np.broadcast_to(start, shape)
    return _choose(g, operand, known[0], shape, place, traced, "clip", lift, params)


def dynamic_update_slice(
    g: Graph, shape: Any, params: Any, raw: Any, known: Any, lift: Callable[..., np.ndarray]
) -> np.ndarray:
    """`lax.dynamic_update_slice`; results as values."""
    operand = lift(raw[0]) if known[0] else raw[0]
    update = lift(raw[1]) if known[1] else raw[1]
    out = operand.copy()
    starts = [
        _bounded(g, start, operand.shape[axis] - update.shape[axis], lift, known[axis + 2])
        for axis, start in enumerate(raw[2:])
    ]
    ranges = [
        [int(g.constants[~start])] if start < 0 else range(size - length + 1)
        for start, size, length in zip(starts, operand.shape, update.shape, strict=True)
    ]
    for corner in product(*ranges):
        here = _all_equal(g, starts, corner)
        window = tuple(slice(a, a + n) for a, n in zip(corner, update.shape, strict=True))
        pairs = zip(out[window].ravel().tolist(), update.ravel().tolist(), strict=True)
        out[window] = np.array([g.select(here, old, new) for old, new in pairs], np.int32).reshape(update.shape)
    return out


def scatter(
    combine: Callable[[Graph, Value, Value], Value],
    g: Graph,
    shape: Any,
    params: Any,
    raw: Any,
    known: Any,
    lift: Callable[..., np.ndarray],
) -> np.ndarray:
    """`lax.scatter` and its kin at known places; results as values."""
    if not known[1]:
        from surgical_marl.engines.fused.primitives import Unsupported

        raise Unsupported("a scatter to places that are not known while tracing")
    operand = lift(raw[0]) if known[0] else raw[0]
    indices = raw[1]
    updates = lift(raw[2]) if known[2] else raw[2]
    numbers = params["dimension_numbers"]
    grid = np.indices(updates.shape)
    batch = [grid[axis] for axis in range(updates.ndim) if axis not in numbers.update_window_dims]
    place: list[Any] = [np.zeros(updates.shape, int) for _ in shape]
    free = [
        axis
        for axis in range(len(shape))
        if axis not in numbers.inserted_window_dims and axis not in numbers.operand_batching_dims
    ]
    for axis, window in zip(free, numbers.update_window_dims, strict=True):
        place[axis] = grid[window]
    for axis, start in zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True):
        place[axis] = place[axis] + batch[start]
    for k, axis in enumerate(numbers.scatter_dims_to_operand_dims):
        place[axis] = place[axis] + indices[(*batch, k)].astype(int)
    inside = np.ones(updates.shape, bool)
    for axis, size in zip(place, shape, strict=True):
        inside &= (axis >= 0) & (axis < size)  # others are dropped
    flat = operand.ravel().tolist()
    targets = np.ravel_multi_index([axis[inside] for axis in place], shape) if len(shape) else np.zeros(1, int)
    for target, update in zip(targets.tolist(), updates[inside].ravel().tolist(), strict=True):
        flat[target] = combine(g, flat[target], update)
    return np.array(flat, np.int32).reshape(shape)


def _choose(
    g: Graph,
    operand: np.ndarray,
    constant: bool,
    sizes: Any,
    place: list[np.ndarray],
    starts: dict[int, np.ndarray],
    mode: str,
    lift: Callable[..., np.ndarray],
    params: Any,
) -> np.ndarray:
    """Elements of `operand` at `place + starts`, where some starts are nodes."""
    shape = place[0].shape if place else ()
    strides = np.cumprod([1, *operand.shape[:0:-1]])[::-1]
    table = np.ascontiguousarray(operand).ravel() if constant else None
    ids = None if constant else operand
    out = []
    for element in np.ndindex(shape):
        fixed = [int(axis[element]) for axis in place]
        moving, valid = {}, g.true
        for axis, start in starts.items():
            last = operand.shape[axis] - sizes[axis]
            raw = int(start[element])
            if "fill" in mode:
                fits = g.logic("and", _at_least(g, raw, 0), g.compare("le", raw, _like(g, raw, last)))
                valid = g.logic("and", valid, fits)
            moving[axis] = _bounded(g, raw, last, lift, False)
        if table is not None and operand.size >= LEAST_TABLE and operand.dtype.name in ("float32", "int32"):
            flat = g.constant(np.int32(sum(f * s for f, s in zip(fixed, strides, strict=True))))
            for axis, start in moving.items():
                step = g.constant(np.int32(strides[axis]))
                flat = g.add(flat, g.mul(step, g.unary("u2i", start) if g.kind(start) == "u" else start))
            value = g.lookup(table, flat)
        else:
            value = _choose_one(g, operand if ids is None else ids, ids is None, sizes, fixed, moving, lift)
        if valid != g.true:
            value = g.select(valid, _fill(g, params, operand, constant), value)
        out.append(value)
    return np.array(out, np.int32).reshape(shape)


def _choose_one(
    g: Graph, operand: np.ndarray, constant: bool, sizes: Any, fixed: list[int], moving: dict[int, Value], lift: Any
) -> Value:
    axes = list(moving)
    ranges = [
        [int(g.constants[~moving[axis]])] if moving[axis] < 0 else range(operand.shape[axis] - sizes[axis] + 1)
        for axis in axes
    ]
    value: Value | None = None
    for corner in product(*ranges):
        place = list(fixed)
        for axis, start in zip(axes, corner, strict=True):
            place[axis] += start
        element = operand[tuple(place)]
        element = int(lift(np.asarray(element))) if constant else int(element)
        here = _all_equal(g, [moving[axis] for axis in axes], corner)
        value = element if value is None else g.select(here, value, element)
    assert value is not None
    return value


def _all_equal(g: Graph, starts: list[Value], corner: tuple[int, ...]) -> Value:
    here = g.true
    for start, at in zip(starts, corner, strict=True):
        here = g.logic("and", here, g.compare("eq", start, _like(g, start, at)))
    return here


def _bounded(g: Graph, start: Any, last: int, lift: Callable[..., np.ndarray], known: bool) -> Value:
    """A start moved into 0 ... last."""
    value = int(lift(start)) if known else int(start)
    value = value if g.kind(value) == "u" else g.extreme("max", value, _like(g, value, 0))
    return g.extreme("min", value, _like(g, value, last))


def _at_least(g: Graph, value: Value, low: int) -> Value:
    return g.true if g.kind(value) == "u" else g.compare("ge", value, _like(g, value, low))


def _like(g: Graph, value: Value, number: int) -> Value:
    return g.constant(g.dtype(value)(number))


def _fill(g: Graph, params: Any, operand: np.ndarray, constant: bool) -> Value:
    """What stands for elements outside."""
    given = params.get("fill_value")
    dtype = operand.dtype.type if constant else (g.dtype(int(operand.flat[0])) if operand.size else np.float32)
    if given is not None:
        return g.constant(dtype(given))
    if np.dtype(dtype).kind == "f":
        return g.constant(dtype(np.nan))
    if np.dtype(dtype).kind == "b":
        return g.true
    limits = np.iinfo(dtype)
    return g.constant(dtype(limits.max if np.dtype(dtype).kind == "u" else limits.min))
