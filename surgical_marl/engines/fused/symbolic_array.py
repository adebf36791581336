"""The arrays that jaxprs are interpreted on: known ones, and ones whose elements are values of a graph."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.operations import DTYPES, KIND_OF


class SymbolicArray:
    """An array whose elements are values of a graph: `ids` int32 of its shape."""

    __slots__ = ("ids",)

    def __init__(self, ids: np.ndarray) -> None:
        self.ids = ids

    @property
    def shape(self) -> tuple[int, ...]:
        return self.ids.shape


class Table:
    """An argument that all environments share and that stays in memory: its elements can only be looked up.

    `number` is that of a table of the graph.
    """

    __slots__ = ("dtype", "number", "shape")

    def __init__(self, number: int, shape: tuple[int, ...], dtype: np.dtype) -> None:
        self.number, self.shape, self.dtype = number, shape, dtype


AnyArray = np.ndarray | SymbolicArray
"""A numpy array if all its elements are known."""

Rule = Callable[..., AnyArray | list[AnyArray]]
"""The rule of a primitive: rule(graph, shape of the result, parameters, *operands) gives its results."""


class Unsupported(ValueError):
    """The function uses what the fused engine has no kernel code for, at `place` in the source."""

    def __init__(self, what: str, place: str = "") -> None:
        super().__init__(f"{what} at {place}" if place else what)
        self.what, self.place = what, place


def kind_of(dtype: Any) -> str:
    """Return the kind of values of a dtype.

    Raises:
        Unsupported: there is no kind for this dtype.
    """
    dtype = np.dtype(dtype)
    if dtype not in KIND_OF:
        raise Unsupported(f"arrays of {dtype.name}")
    return KIND_OF[dtype]


def dtype_of(graph: Graph, array: AnyArray | Table) -> Any:
    """Return the dtype of an array; float32 if it is empty."""
    if not isinstance(array, SymbolicArray):
        return array.dtype
    return DTYPES[graph.kind(int(array.ids.flat[0]))] if array.ids.size else np.float32


def values_of(graph: Graph, array: AnyArray | Table) -> np.ndarray:
    """Return the values of an array: of a known one they are constants."""
    if isinstance(array, SymbolicArray):
        return array.ids
    if isinstance(array, Table):
        raise Unsupported("more of a table than a look-up")
    array = np.asarray(array)
    kind_of(array.dtype)
    return np.array(graph.constants_of(array), np.int32).reshape(array.shape)


def array_of(graph: Graph, ids: np.ndarray, dtype: Any) -> AnyArray:
    """Return a numpy array if all values are constants, and otherwise a `SymbolicArray`."""
    flat = ids.ravel().tolist()
    if flat and max(flat) >= 0:
        return SymbolicArray(ids)
    return np.array([graph.constants[~i] for i in flat], np.dtype(dtype)).reshape(ids.shape)


def each(function: Callable[..., Value], g: Graph, shape: tuple[int, ...], *arrays: AnyArray) -> SymbolicArray:
    """`function(graph, *values)` of the elements, which are broadcast to `shape`."""
    columns = [_elements(g, array, shape) for array in arrays]
    flat = [function(g, *elements) for elements in zip(*columns, strict=True)]
    return SymbolicArray(np.array(flat, np.int32).reshape(shape))


def _elements(g: Graph, array: AnyArray, shape: tuple[int, ...]) -> list[Value]:
    """Return the values of an array, broadcast to a shape, in a row."""
    if isinstance(array, SymbolicArray):
        if array.ids.size == 1:
            return [array.ids.item()] * math.prod(shape)
        return (array.ids if array.ids.shape == shape else np.broadcast_to(array.ids, shape)).ravel().tolist()
    if array.shape == shape or array.size == 1:
        kind_of(array.dtype)
        values = g.constants_of(array)
        return values if len(values) > 1 else values * math.prod(shape)
    return np.broadcast_to(values_of(g, array), shape).ravel().tolist()
