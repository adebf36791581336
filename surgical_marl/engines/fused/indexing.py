"""Gather, scatter and slices at computed places, as arithmetic on indices.

Indices that are known while compiling cost nothing: elements are moved. Another index becomes a lookup if the array is
a table of constants or in memory, or else a selection among the elements that it may point to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from surgical_marl.engines.fused.array_view import View, depth, pack, unpack, view
from surgical_marl.engines.fused.elementwise import convert
from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.operations import KIND_OF
from surgical_marl.engines.fused.symbolic_array import AnyArray, SymbolicArray, Table, values_of

LEAST_TABLE = 16
"""Least number of constants, or of numbers, that are looked up in memory instead of being selected one by one."""

Places = list[np.ndarray]
"""For each axis of an array, where on it each element of a result comes from."""


def gather(g: Graph, shape: Any, params: Any, operand: AnyArray | Table, indices: AnyArray) -> AnyArray:
    """Do what `lax.gather` does."""
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    grid = np.indices(shape)
    batch = [grid[axis] for axis in range(len(shape)) if axis not in numbers.offset_dims]
    windows = [grid[axis] for axis in numbers.offset_dims]
    place = _windows(shape, operand, numbers.collapsed_slice_dims, numbers.operand_batching_dims, windows)
    for axis, start in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
        place[axis] = place[axis] + batch[start]
    raw = indices.ids if isinstance(indices, SymbolicArray) else indices
    starts = {axis: np.broadcast_to(raw[(*batch, k)], shape) for k, axis in enumerate(numbers.start_index_map)}
    fill = _fill(g, params, operand) if "fill" in str(params["mode"]).lower() else None
    if isinstance(indices, SymbolicArray):
        return _choose(g, operand, sizes, place, starts, fill)
    inside = np.ones(shape, bool)
    for axis, start in starts.items():
        last = operand.shape[axis] - sizes[axis]
        inside &= (start >= 0) & (start <= last)
        place[axis] = place[axis] + np.clip(start.astype(int), 0, last)
    found = _take(g, operand, place)
    return found if fill is None or inside.all() else SymbolicArray(np.where(inside, values_of(g, found), fill))


def dynamic_slice(g: Graph, shape: Any, params: Any, operand: AnyArray | Table, *starts: AnyArray) -> AnyArray:
    """Do what `lax.dynamic_slice` does."""
    place, moving = list(np.indices(shape)), {}
    for axis, start in enumerate(starts):
        if isinstance(start, SymbolicArray):
            moving[axis] = np.broadcast_to(start.ids, shape)
        else:
            place[axis] = place[axis] + int(np.clip(int(start), 0, operand.shape[axis] - shape[axis]))
    return _choose(g, operand, shape, place, moving, None) if moving else _take(g, operand, place)


def dynamic_update_slice(
    g: Graph, shape: Any, params: Any, operand: AnyArray, update: AnyArray, *starts: AnyArray
) -> AnyArray:
    """Do what `lax.dynamic_update_slice` does."""
    out, new = values_of(g, operand).copy(), values_of(g, update)
    if any(isinstance(start, SymbolicArray) for start in starts) and (out.size >= LEAST_TABLE or depth(g, out)):
        grid: Places = [np.array(axis) for axis in np.indices(new.shape)]
        corners = {}
        for axis, start in enumerate(starts):
            if isinstance(start, SymbolicArray):
                corners[axis] = np.broadcast_to(start.ids, new.shape)
            else:
                grid[axis] = grid[axis] + int(np.clip(int(start), 0, shape[axis] - new.shape[axis]))
        return _write(g, out, grid, corners, new, clip=True)
    lasts = [size - length for size, length in zip(shape, new.shape, strict=True)]
    corner = [_bounded(g, int(values_of(g, start)), last) for start, last in zip(starts, lasts, strict=True)]
    for at in _corners(g, corner, lasts):
        here = _all_equal(g, corner, at)
        window = tuple(slice(a, a + n) for a, n in zip(at, new.shape, strict=True))
        pairs = zip(out[window].ravel().tolist(), new.ravel().tolist(), strict=True)
        out[window] = np.array([g.select(here, *pair) for pair in pairs], np.int32).reshape(new.shape)
    return SymbolicArray(out)


def scatter(
    combine: Callable[[Graph, Value, Value], Value],
    g: Graph,
    shape: Any,
    params: Any,
    operand: AnyArray,
    indices: AnyArray,
    updates: AnyArray,
) -> AnyArray:
    """`lax.scatter` and its kin. A window that is not all inside is left out, or moved there.

    If all windows are promised to be inside, nothing looks whether they are.
    """
    numbers, new = params["dimension_numbers"], values_of(g, updates)
    grid = np.indices(new.shape)
    batch = [grid[axis] for axis in range(new.ndim) if axis not in numbers.update_window_dims]
    windows = [grid[axis] for axis in numbers.update_window_dims]
    place = _windows(new.shape, operand, numbers.inserted_window_dims, numbers.operand_batching_dims, windows)
    for axis, start in zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True):
        place[axis] = place[axis] + batch[start]
    clip, promised = ("clip" in str(params["mode"]).lower(), "promise" in str(params["mode"]).lower())
    if isinstance(indices, SymbolicArray):
        axes = numbers.scatter_dims_to_operand_dims
        starts = {axis: np.broadcast_to(indices.ids[(*batch, k)], new.shape) for k, axis in enumerate(axes)}
        return _write(g, values_of(g, operand), place, starts, new, clip, combine, promised)
    inside = np.ones(new.shape, bool)
    for k, axis in enumerate(numbers.scatter_dims_to_operand_dims):
        start, last = indices[(*batch, k)].astype(int), shape[axis] - 1 - place[axis].max(initial=0)
        if clip:
            start = np.clip(start, 0, last)
        inside &= (start >= 0) & (start <= last)
        place[axis] = place[axis] + start
    out = values_of(g, operand).copy()
    for element in zip(*np.nonzero(inside), strict=True) if new.ndim else [()] * int(inside):
        target = tuple(axis[element] for axis in place)
        out[target] = combine(g, int(out[target]), int(new[element]))
    return SymbolicArray(out)


def _windows(shape: Any, operand: AnyArray | Table, dropped: Any, batched: Any, windows: Places) -> Places:
    """Places within the window of each element; its axes are those that are neither dropped nor batched."""
    kept = [axis for axis in range(len(operand.shape)) if axis not in dropped and axis not in batched]
    place = [np.zeros(shape, int) for _ in operand.shape]
    for axis, window in zip(kept, windows, strict=True):
        place[axis] = window
    return place


def _take(g: Graph, operand: AnyArray | Table, place: Places) -> AnyArray:
    if isinstance(operand, SymbolicArray):
        return SymbolicArray(np.asarray(operand.ids[tuple(place)]))
    if isinstance(operand, Table):
        found = [look_up(g, operand, [int(axis[at]) for axis in place], {}) for at in np.ndindex(place[0].shape)]
        return SymbolicArray(np.array(found, np.int32).reshape(place[0].shape))
    return np.asarray(operand[tuple(place)])


# -- at indices that are not known while tracing


def _choose(
    g: Graph, operand: AnyArray | Table, sizes: Any, place: Places, starts: dict[int, np.ndarray], fill: Value | None
) -> SymbolicArray:
    """Return the elements of `operand` at `place + starts`, where the starts are values.

    A window has the size `sizes`. If it is not all inside the operand, its elements are `fill`. Without a `fill` the
    window is moved inside.
    """
    shape, lasts = place[0].shape, {axis: operand.shape[axis] - sizes[axis] for axis in starts}
    find: Callable[[list[int], dict[int, Value]], Value]
    if isinstance(operand, Table) or (isinstance(operand, np.ndarray) and operand.size >= LEAST_TABLE):
        find = partial(look_up, g, operand)
    else:
        find = partial(_read_or_choose, g, values_of(g, operand), lasts)
    out = []
    for element in np.ndindex(shape):
        moving, valid = {}, g.true
        for axis, start in starts.items():
            moving[axis] = _bounded(g, int(start[element]), lasts[axis])
            if fill is not None:
                valid = g.logic("and", valid, g.compare("eq", int(start[element]), moving[axis]))
        value = find([int(axis[element]) for axis in place], moving)
        out.append(value if fill is None else g.select(valid, fill, value))
    return SymbolicArray(np.array(out, np.int32).reshape(shape))


def look_up(g: Graph, operand: np.ndarray | Table, fixed: list[int], moving: dict[int, Value]) -> Value:
    """Return the element of a table at the places `fixed`, plus the values `moving` on some axes."""
    kind = KIND_OF[operand.dtype]
    if isinstance(operand, Table):
        number = operand.number
    else:
        number = g.table(operand.ravel() if operand.dtype.kind == "f" else operand.ravel().astype(np.int32))
    strides = np.cumprod([1, *operand.shape[:0:-1]])[::-1]
    flat = g.constant(np.int32(np.dot(fixed, strides[: len(fixed)])))
    for axis, start in moving.items():
        flat = g.add(flat, g.mul(g.constant(np.int32(strides[axis])), convert(g, start, "i")))
    return convert(g, g.lookup(number, flat), kind)


def elements_of(g: Graph, table: Table) -> SymbolicArray:
    """Return the elements of a table; what is not used costs nothing."""
    ids = [look_up(g, table, list(place), {}) for place in np.ndindex(table.shape)]
    return SymbolicArray(np.array(ids, np.int32).reshape(table.shape))


def _read_or_choose(
    g: Graph, ids: np.ndarray, lasts: dict[int, int], fixed: list[int], moving: dict[int, Value]
) -> Value:
    """Return the element at `fixed + moving`: from memory if the elements that it may be are there, or many."""
    block = ids[tuple(slice(None) if axis in moving else place for axis, place in enumerate(fixed))]
    found = view(g, block)
    if found is None or found.op != "read":
        kind = g.kind(int(block.flat[0]))
        if block.size < LEAST_TABLE or kind == "b":
            return _choose_one(g, ids, lasts, fixed, moving)
        strides = tuple(int(n) for n in np.cumprod([1, *block.shape[:0:-1]])[::-1])
        found = View("read", g.array(block.ravel().tolist()), None, 0, strides, kind)
    return found.at(g, [g.add(_like(g, moving[axis], fixed[axis]), moving[axis]) for axis in sorted(moving)])


def _choose_one(g: Graph, ids: np.ndarray, lasts: dict[int, int], fixed: list[int], moving: dict[int, Value]) -> Value:
    axes, value = list(moving), None
    for corner in _corners(g, list(moving.values()), list(lasts.values())):
        place = list(fixed)
        for axis, start in zip(axes, corner, strict=True):
            place[axis] += start
        element = int(ids[tuple(place)])
        value = element if value is None else g.select(_all_equal(g, list(moving.values()), corner), value, element)
    assert value is not None
    return value


def _corners(g: Graph, starts: Sequence[Value], lasts: Sequence[int]) -> product[tuple[int, ...]]:
    """All that the starts of a window may be."""
    return product(
        *(
            [int(g.constants[~start])] if start < 0 else range(last + 1)
            for start, last in zip(starts, lasts, strict=True)
        )
    )


def _all_equal(g: Graph, starts: Sequence[Value], corner: tuple[int, ...]) -> Value:
    here = g.true
    for start, at in zip(starts, corner, strict=True):
        here = g.logic("and", here, g.compare("eq", start, _like(g, start, at)))
    return here


def _bounded(g: Graph, start: Value, last: int) -> Value:
    """Return a start moved into the range from 0 to `last`, both included."""
    return g.extreme("min", g.extreme("max", start, _like(g, start, 0)), _like(g, start, last))


def _like(g: Graph, value: Value, number: int) -> Value:
    return g.constant(g.dtype(value)(number))


def _fill(g: Graph, params: Any, operand: AnyArray | Table) -> Value:
    """Return the value that stands for elements outside the operand."""
    dtype = np.dtype(g.dtype(int(operand.ids.flat[0])) if isinstance(operand, SymbolicArray) else operand.dtype)
    given = params.get("fill_value")
    if given is None:
        limits = np.iinfo(dtype) if dtype.kind in "iu" else None
        given = {"f": np.nan, "b": True}.get(dtype.kind) if limits is None else limits.min or limits.max
    return g.constant(dtype.type(given))


# -- writing at indices that are not known while tracing


def _write(
    g: Graph,
    ids: np.ndarray,
    place: Places,
    starts: dict[int, np.ndarray],
    new: np.ndarray,
    clip: bool,
    combine: Callable[[Graph, Value, Value], Value] = lambda g, old, new: new,
    promised: bool = False,
) -> SymbolicArray:
    """Return an array in memory with the values `new` put at `place + starts`.

    A window that is not all inside is moved there if `clip`, and left out otherwise. `promised` says that all are.
    """
    axes = max(depth(g, ids), *(axis + 1 for axis in starts))
    strides = np.cumprod([1, *ids.shape[axes - 1 : 0 : -1]])[::-1]
    arrays = pack(g, ids, axes)
    for element in np.ndindex(new.shape):
        index, valid = g.constant(np.int32(0)), g.true
        for axis in range(axes):
            start = int(starts[axis][element]) if axis in starts else g.constant(np.int32(0))
            inside = start
            if not promised:
                inside = _bounded(g, start, ids.shape[axis] - 1 - int(place[axis].max(initial=0)))
                valid = valid if clip else g.logic("and", valid, g.compare("eq", start, inside))
            at = g.add(g.constant(np.int32(place[axis][element])), convert(g, inside, "i"))
            index = g.add(index, g.mul(g.constant(np.int32(strides[axis])), at))
        column = (
            int(np.ravel_multi_index([int(p[element]) for p in place[axes:]], ids.shape[axes:]))
            if ids.ndim > axes
            else 0
        )
        old = g.read(arrays[column], index)
        value = g.select(valid, old, combine(g, old, int(new[element])))
        arrays[column] = g.update(arrays[column], index, [value])
    return SymbolicArray(unpack(g, arrays, ids.shape, axes))
