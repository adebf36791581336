"""Arrays in memory, as jaxprs see them: elements that are reads of one array, at places that follow a rule.

There is no class for such an array. Its elements are values like all others, so slices, transposes and arguments of
functions need no rules of their own. Where it counts, at a gather, at rows that a loop reads and at what branches and
loops return, `view` finds the array again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surgical_marl.engines.fused.elementwise import convert
from surgical_marl.engines.fused.graph import Graph, Value


@dataclass(frozen=True)
class View:
    """Elements of an array or of a table: at `base + first` and so on, with a stride for each axis."""

    op: str
    """ "read" or "lookup"."""
    source: int
    """The array, or the number of the table."""
    base: Value | None
    first: int
    strides: tuple[int, ...]
    kind: str

    def at(self, g: Graph, places: list[Value]) -> Value:
        """Return the element at a place on each axis; the places must be in range."""
        moving, index = split(g, _sum(g, self.base, self.first))
        for stride, place in zip(self.strides, places, strict=True):
            term, more = split(g, g.mul(g.constant(np.int32(stride)), convert(g, place, "i")))
            moving, index = _sum_of(g, moving, term), index + more
        where = _sum(g, moving, index)
        return convert(g, getattr(g, self.op)(self.source, where), self.kind)


def view(g: Graph, ids: np.ndarray) -> View | None:
    """Return what these values are a view of, if all of them are."""
    key = ids.shape, ids.dtype.char, ids.tobytes()  # most are asked for again and again, while loops are tried
    if key not in g.views:
        g.views[key] = _view(g, ids)
    found: View | None = g.views[key]
    return found


def _view(g: Graph, ids: np.ndarray) -> View | None:
    flat = ids.ravel().tolist()
    kind = g.kind(flat[0])
    inner = flat if kind in "fi" or _op(g, flat[0]) == "read" else [_converted(g, value) for value in flat]
    op = _op(g, inner[0])
    if op not in ("read", "lookup") or any(_op(g, value) != op for value in inner):
        return None
    source, index = g.args[inner[0]]
    base, first = split(g, index)
    places = []
    for value in inner:
        other, index = g.args[value]
        moving, place = split(g, index)
        if other != source or moving != base:
            return None
        places.append(place)
    grid = np.array(places).reshape(ids.shape)
    strides = [int(np.diff(grid, axis=k).flat[0]) if grid.shape[k] > 1 else 0 for k in range(grid.ndim)]
    rule = first + sum((stride * at for stride, at in zip(strides, np.indices(grid.shape), strict=True)), 0)
    return View(op, source, base, first, tuple(strides), kind) if np.all(grid == rule) else None


def depth(g: Graph, ids: np.ndarray) -> int:
    """Return how many of the first axes are axes of arrays in memory: 0 if there are none.

    The elements on the other axes may be in different arrays, or in none.
    """
    if all(_op(g, value) != "read" for value in ids.ravel().tolist()):
        return 0
    for axes in range(ids.ndim, 0, -1):
        found = (view(g, column) for column in _columns(ids, axes) if column.size > 1)
        if any(column is not None and column.op == "read" for column in found):
            return axes
    return 0


def pack(g: Graph, ids: np.ndarray, axes: int) -> list[Value]:
    """Return arrays that hold the elements on the first axes, one for each element of the others.

    Without axes, return the elements themselves.
    """
    return [_array(g, column.ravel()) for column in _columns(ids, axes)] if axes else ids.ravel().tolist()


def unpack(g: Graph, packed: list[Value], shape: tuple[int, ...], axes: int) -> np.ndarray:
    """Return the elements of what `pack` returned."""
    if not axes:
        return np.array(packed, np.int32).reshape(shape)
    size = int(np.prod(shape[:axes]))
    columns = [[g.read(array, g.constant(np.int32(k))) for k in range(size)] for array in packed]
    return np.array(columns, np.int32).reshape(len(packed), size).T.reshape(shape)


def _columns(ids: np.ndarray, axes: int) -> list[np.ndarray]:
    flat = ids.reshape(*ids.shape[:axes], -1)
    return [flat[..., k] for k in range(flat.shape[-1])]


def _array(g: Graph, values: np.ndarray) -> Value:
    """Return the array that the values are, or else a new one that holds them."""
    found = view(g, values)
    if found and (found.op, found.base, found.first) == ("read", None, 0):
        whole = found.strides == (1,) and g.kinds[found.source][1:] == str(values.size)
        if whole or (values.size == 1 and g.kinds[found.source][1:] == "1"):
            return found.source
    return g.array(values.tolist())


# -- indices, as a value and a constant


def split(g: Graph, index: Value) -> tuple[Value | None, int]:
    """Return an index as a value, if it has one, and a constant that is added to it."""
    if index < 0:
        return None, int(g.constants[~index])
    if g.ops[index] in ("add", "sub") and g.args[index][0] < 0:
        first, rest = g.args[index]
        return (rest if g.ops[index] == "add" else g.neg(rest)), int(g.constants[~first])
    return index, 0


def _sum(g: Graph, moving: Value | None, index: int) -> Value:
    number = g.constant(np.int32(index))
    return number if moving is None else g.add(number, moving)


def _sum_of(g: Graph, a: Value | None, b: Value | None) -> Value | None:
    return b if a is None else a if b is None else g.add(a, b)


def _op(g: Graph, value: Value) -> str:
    return g.ops[value] if value >= 0 else ""


def _converted(g: Graph, value: Value) -> Value:
    """Return the whole number in a table that words and truths are made of."""
    if _op(g, value) == "i2u" or (_op(g, value) == "ne" and g.args[value][0] < 0):
        return int(g.args[value][-1])
    return value
