"""Reductions over axes, products of matrices, and triangular systems, element by element."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import numpy as np

from surgical_marl.engines.fused.elementwise import convert
from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.symbolic_array import AnyArray, Rule, SymbolicArray, each, kind_of, values_of


def least(dtype: np.dtype) -> Any:
    """Return the least value that a dtype holds. It is the maximum of no elements."""
    return np.iinfo(dtype).min if dtype.kind in "iu" else {"f": -np.inf, "b": False}[dtype.kind]


def most(dtype: np.dtype) -> Any:
    """Return the greatest value that a dtype holds. It is the minimum of no elements."""
    return np.iinfo(dtype).max if dtype.kind in "iu" else {"f": np.inf, "b": True}[dtype.kind]


def reduction(function: Callable[..., Value], of_none: Callable[[np.dtype], Any]) -> Rule:
    """`lax.reduce_sum` and its kin; `of_none` is the result of no elements of a dtype."""

    def rule(g: Graph, shape: Any, params: Any, x: AnyArray) -> AnyArray:
        ids, axes = values_of(g, x), params["axes"]
        if not ids.size:
            return np.full(shape, of_none(x.dtype if isinstance(x, np.ndarray) else np.dtype(np.float32)))
        kept = [axis for axis in range(ids.ndim) if axis not in axes]
        rows = ids.transpose([*kept, *axes]).reshape(int(np.prod(shape)), -1)
        flat = [reduce(partial(function, g), row) for row in rows.tolist()]
        return SymbolicArray(np.array(flat, np.int32).reshape(shape))

    return rule


def arg_extreme(op: str) -> Rule:
    """`lax.argmin` for "lt", `lax.argmax` for "gt": of equal ones the first."""

    def rule(g: Graph, shape: Any, params: Any, x: AnyArray) -> AnyArray:
        (axis,) = params["axes"]
        rows = np.moveaxis(values_of(g, x), axis, -1).reshape(int(np.prod(shape)), -1)
        flat = []
        for row in rows.tolist():
            best, index = row[0], g.constant(np.int32(0))
            for k, value in enumerate(row[1:], 1):
                better = g.compare(op, value, best)
                best, index = g.select(better, best, value), g.select(better, index, g.constant(np.int32(k)))
            flat.append(convert(g, index, kind_of(params["index_dtype"])))
        return SymbolicArray(np.array(flat, np.int32).reshape(shape))

    return rule


def top_k(g: Graph, shape: Any, params: Any, x: AnyArray) -> list[AnyArray]:
    """`lax.top_k`: the k largest and where they were; of equal ones the first."""
    ids, axis = values_of(g, x), params.get("axis", -1)
    rows = np.moveaxis(ids, axis, -1)
    best = [_largest(g, row, params["k"]) for row in rows.reshape(-1, rows.shape[-1]).tolist()]
    found = np.array(best, np.int32).reshape(*rows.shape[:-1], params["k"], 2)
    return [SymbolicArray(np.moveaxis(found[..., part], -1, axis)) for part in range(2)]


def _largest(g: Graph, row: list[Value], count: int) -> list[tuple[Value, ...]]:
    """Values with their places, each put ahead of the first that is smaller."""

    def choose(condition: Value, other: tuple[Value, ...], chosen: tuple[Value, ...]) -> tuple[Value, ...]:
        return tuple(g.select(condition, a, b) for a, b in zip(other, chosen, strict=True))

    best: list[tuple[Value, ...]] = []
    for place, value in enumerate(row):
        new = (value, g.constant(np.int32(place)))
        ahead = [g.compare("gt", value, held[0]) for held in best] + [g.true] * (len(best) < count)
        # it stays where it is ahead of nothing; elsewhere those that it is ahead of move on by one
        slots = zip([*best, new], [new, *best], [g.false, *ahead], ahead, strict=False)
        best = [choose(here, held, choose(moved, new, last)) for held, last, moved, here in slots]
    return best


def cumulative(function: Callable[..., Value]) -> Rule:
    """`lax.cumsum` and its kin."""

    def rule(g: Graph, shape: Any, params: Any, x: AnyArray) -> AnyArray:
        ids = np.moveaxis(values_of(g, x), params["axis"], 0).copy()
        ids = ids[::-1] if params["reverse"] else ids
        for k in range(1, len(ids)):
            ids[k] = each(function, g, ids[k].shape, SymbolicArray(ids[k - 1]), SymbolicArray(ids[k])).ids
        return SymbolicArray(np.moveaxis(ids[::-1] if params["reverse"] else ids, 0, params["axis"]))

    return rule


def dot(g: Graph, shape: Any, params: Any, x: AnyArray, y: AnyArray) -> AnyArray:
    """`lax.dot_general`; products with zeros are left out."""
    (left, right), (left_batch, right_batch) = params["dimension_numbers"]
    a, b = _matrices(values_of(g, x), left_batch, left), _matrices(values_of(g, y), right_batch, right)
    zero, out = g.constant(g.dtype(int(a.flat[0]))(0)) if a.size else g.zero, []
    for rows, columns in zip(a.tolist(), b.tolist(), strict=True):
        for row in rows:
            terms = [(k, value) for k, value in enumerate(row) if value != zero]
            for column in columns:
                products = [g.mul(value, column[k]) for k, value in terms if column[k] != zero]
                out.append(reduce(g.add, products, zero))
    return SymbolicArray(np.array(out, np.int32).reshape(shape))


def _matrices(ids: np.ndarray, batch: Any, contracted: Any) -> np.ndarray:
    """As [batch, free, contracted]."""
    free = [axis for axis in range(ids.ndim) if axis not in (*batch, *contracted)]
    sizes = [int(np.prod([ids.shape[axis] for axis in axes], dtype=int)) for axes in (batch, free, contracted)]
    return ids.transpose([*batch, *free, *contracted]).reshape(sizes)


def cholesky(g: Graph, shape: Any, params: Any, x: AnyArray) -> AnyArray:
    """`lax.linalg.cholesky_p`: the lower factor, of the lower half."""
    ids = values_of(g, x).reshape(-1, *shape[-2:])
    out = np.full(ids.shape, g.zero, np.int32)
    for a, factor in zip(ids.tolist(), out, strict=True):
        rows: list[list[Value]] = [[] for _ in a]
        for j in range(len(a)):
            diagonal = g.unary("sqrt", _less_products(g, a[j][j], rows[j], rows[j]))
            inverse = g.div(g.one, diagonal)
            for i in range(j + 1, len(a)):
                rows[i].append(g.mul(_less_products(g, a[i][j], rows[i], rows[j]), inverse))
            rows[j].append(diagonal)
        for i, row in enumerate(rows):
            factor[i, : i + 1] = row
    return SymbolicArray(out.reshape(shape))


def triangular_solve(g: Graph, shape: Any, params: Any, x: AnyArray, y: AnyArray) -> AnyArray:
    """`lax.linalg.triangular_solve`."""
    a, b = values_of(g, x), values_of(g, y)
    if a.ndim > 2:
        parts = zip(a.reshape(-1, *a.shape[-2:]), b.reshape(-1, *b.shape[-2:]), strict=True)
        solved = [triangular_solve(g, q.shape, params, SymbolicArray(p), SymbolicArray(q)) for p, q in parts]
        return SymbolicArray(np.stack([values_of(g, part) for part in solved]).reshape(shape))
    a = a.T if params["transpose_a"] else a
    low = params["lower"] != params["transpose_a"]
    if not params["left_side"]:  # x a = b is a^T x^T = b^T
        a, b, low = a.T, b.T, not low
    rows, n = a.tolist(), len(a)
    out = b.copy()
    for column in out.T:
        for i in range(n) if low else range(n - 1, -1, -1):
            done = slice(0, i) if low else slice(i + 1, n)
            rest = _less_products(g, int(column[i]), rows[i][done], column[done].tolist())
            column[i] = rest if params["unit_diagonal"] else g.mul(rest, g.div(g.one, rows[i][i]))
    return SymbolicArray(out if params["left_side"] else out.T)


def _less_products(g: Graph, value: Value, a: list[Value], b: list[Value]) -> Value:
    """Return `value - a . b`."""
    for p, q in zip(a, b, strict=True):
        value = g.sub(value, g.mul(p, q))
    return value
