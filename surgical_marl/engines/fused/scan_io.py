"""The rows that a loop reads and writes: `xs` and `ys` of a scan.

A row that a loop reads is looked up by the loop's counter: in a table if the rows are constants, in memory otherwise.
Of a row that a loop writes, each element goes to an array of its own. So elements that are the same in all rows cost
nothing, and neither do those that nobody reads.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from surgical_marl.engines.fused.array_view import View, depth, unpack, view
from surgical_marl.engines.fused.graph import Graph, Loop, Value
from surgical_marl.engines.fused.indexing import look_up
from surgical_marl.engines.fused.symbolic_array import AnyArray, SymbolicArray, Table, array_of, dtype_of, values_of

Row = Callable[[Value], AnyArray]
"""The row of an array at a place that may not be known while tracing."""

_Element = Callable[[Value], Value]


def row_reader(g: Graph, rows: AnyArray | Table) -> Row:
    """Return how the rows of an array are read. Values are put into memory here, before the loop that reads them."""
    shape = rows.shape[1:]
    dtype = dtype_of(g, rows)
    if isinstance(rows, SymbolicArray):
        elements = [_of_values(g, rows, place) for place in np.ndindex(shape)]
    elif isinstance(rows, Table):
        elements = [_of_table(g, rows, place) for place in np.ndindex(shape)]
    else:
        elements = [_of_constants(g, rows, place) for place in np.ndindex(shape)]

    def row(at: Value) -> AnyArray:
        ids = [element(at) for element in elements]
        return array_of(g, np.array(ids, np.int32).reshape(shape), dtype)

    return row


def _of_table(g: Graph, table: np.ndarray | Table, place: tuple[int, ...]) -> _Element:
    return lambda at: look_up(g, table, [0, *place], {0: at})


def _of_constants(g: Graph, rows: np.ndarray, place: tuple[int, ...]) -> _Element:
    """Look in a table of all rows, unless the element is the same in all of them, or counts them."""
    column = np.moveaxis(rows, 0, -1)[place]
    if (column == column[0]).all():
        return lambda at: g.constant(column[0])
    step = int(column[1]) - int(column[0])
    if column.dtype == np.int32 and (np.diff(column.astype(np.int64)) == step).all():
        return lambda at: g.add(g.constant(column[0]), g.mul(g.constant(np.int32(step)), at))
    return _of_table(g, rows, place)


def _of_values(g: Graph, rows: SymbolicArray, place: tuple[int, ...]) -> _Element:
    """Read rows from the array in memory that they are in, or from a new array made of them.

    The array holds more than the loop's own rows if there are rows within rows, which another loop may read.
    """
    column = np.moveaxis(rows.ids, 0, -1)[place]
    first = int(column[0])
    if (column == first).all():
        return lambda at: first
    found = view(g, column)
    if found is None:
        block = rows.ids[..., place[-1]] if place else rows.ids
        start = int(np.ravel_multi_index(place[:-1], block.shape[1:])) if place[:-1] else 0
        array = g.array(block.ravel().tolist())
        found = View("read", array, None, start, (block[0].size,), g.kind(first))
    return lambda at: found.at(g, [at])


class RowWriter:
    """Puts the rows of a loop into memory. `rows` are its values of one row of each array.

    Values below `before` are older than the loop, and so are the same in all rows.
    """

    def __init__(self, g: Graph, number: int, before: Value, rows: list[AnyArray]) -> None:
        self._g, self._number, self._before, self._rows = g, number, before, rows
        self._written: dict[tuple[Value, ...], int] = {}
        """Values that are put into an array in each round -> the number of the array among the loop's phis."""
        for row in rows:
            for values in self._columns(row):
                if values and max(values) >= before and values not in self._written:
                    self._put(values)

    def _loop(self) -> Loop:
        loop = self._g.groups[self._number]
        assert isinstance(loop, Loop)
        return loop

    def _columns(self, row: AnyArray) -> list[tuple[Value, ...]]:
        """Return what goes into one array each: an element, or all elements of an array in memory."""
        ids = values_of(self._g, row)
        size = int(np.prod(ids.shape[: depth(self._g, ids)], dtype=int))
        return [tuple(column) for column in ids.reshape(size, -1).T.tolist()]

    def _put(self, values: tuple[Value, ...]) -> None:
        g, loop = self._g, self._loop()
        assert loop.counter is not None
        kind, self._written[values] = f"{g.kind(values[0])}{len(values) * loop.length}", len(loop.phis)
        phi = g.fresh("phi", self._number, len(loop.phis), kind=kind)
        loop.phis.append(phi)
        loop.starts.append(g.fresh("empty", kind=kind))
        loop.nexts.append(g.update(phi, g.mul(g.constant(np.int32(len(values))), loop.counter), list(values)))

    def leave(self) -> list[AnyArray]:
        """Return all rows of each array."""
        return [self._stacked(row) for row in self._rows]

    def _stacked(self, row: AnyArray) -> AnyArray:
        columns, length = [self._all(values) for values in self._columns(row)], self._loop().length
        together = np.array(columns, np.int32).reshape(len(columns), -1 if columns else length).T
        return array_of(self._g, together.reshape(length, *row.shape), dtype_of(self._g, row))

    def _all(self, values: tuple[Value, ...]) -> list[Value]:
        loop = self._loop()
        if values not in self._written:
            return list(values) * loop.length
        return unpack(self._g, [loop.outs[self._written[values]]], (len(values) * loop.length,), 1).tolist()
