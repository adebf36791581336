"""The rules of JAX's primitives: from operands, arrays of values, to results.

Arithmetic goes element by element through the graph (`scalars.py`, `linear.py`); primitives that move elements are
numpy indexing on the values (here and in `indexing.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from surgical_marl.engines.fused import elementary, linear
from surgical_marl.engines.fused.array_view import unpack
from surgical_marl.engines.fused.elementwise import ELEMENTWISE, bitcast, convert, extreme, logic, round_
from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.indexing import dynamic_slice, dynamic_update_slice, gather, scatter
from surgical_marl.engines.fused.operations import FOLD
from surgical_marl.engines.fused.symbolic_array import (
    AnyArray,
    Rule,
    SymbolicArray,
    Unsupported,
    array_of,
    each,
    kind_of,
    values_of,
)
from surgical_marl.engines.fused.threefry import threefry


def _convert(g: Graph, shape: Any, params: Any, x: AnyArray) -> AnyArray:
    dtype = np.dtype(params["new_dtype"])
    if isinstance(x, np.ndarray) and not (x.dtype.kind == "f" and dtype.kind in "iu"):
        return x.astype(dtype)
    return each(partial(convert, to=kind_of(dtype)), g, shape, x)


def _bitcast(g: Graph, shape: Any, params: Any, x: AnyArray) -> AnyArray:
    if isinstance(x, np.ndarray):
        return np.asarray(x.view(params["new_dtype"]))
    return each(partial(bitcast, to=kind_of(params["new_dtype"])), g, shape, x)


# -- moving elements


def _move(function: Callable[..., np.ndarray]) -> Rule:
    """Return a rule that only moves elements, as `function(shape, params, array)` does."""

    def rule(g: Graph, shape: Any, params: Any, x: AnyArray, *rest: AnyArray) -> AnyArray:
        if isinstance(x, SymbolicArray):
            return SymbolicArray(np.asarray(function(shape, params, x.ids)))
        return np.asarray(function(shape, params, np.asarray(x)))

    return rule


def _broadcast(shape: Any, params: Any, x: np.ndarray) -> np.ndarray:
    middle = [1] * len(shape)
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        middle[axis] = size
    return np.broadcast_to(x.reshape(middle), shape)


def _slice(shape: Any, params: Any, x: np.ndarray) -> np.ndarray:
    strides = params["strides"] or [1] * x.ndim
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return x[tuple(slice(a, b, c) for a, b, c in bounds)]


def _join(function: Callable[..., np.ndarray]) -> Rule:
    def rule(g: Graph, shape: Any, params: Any, *xs: AnyArray) -> AnyArray:
        if any(isinstance(x, SymbolicArray) for x in xs):
            return SymbolicArray(function(params, [values_of(g, x) for x in xs]))
        return function(params, [np.asarray(x) for x in xs])

    return rule


def _split(g: Graph, shape: Any, params: Any, x: AnyArray) -> list[AnyArray]:
    ends = np.cumsum(params["sizes"])[:-1]
    if isinstance(x, SymbolicArray):
        return [SymbolicArray(part) for part in np.split(x.ids, ends, params["axis"])]
    return list(np.split(x, ends, params["axis"]))


def _unstack(g: Graph, shape: Any, params: Any, x: AnyArray) -> list[AnyArray]:
    array = x.ids if isinstance(x, SymbolicArray) else x
    parts = [array.take(k, params["axis"]) for k in range(array.shape[params["axis"]])]
    return [SymbolicArray(np.asarray(part)) if isinstance(x, SymbolicArray) else part for part in parts]


def _pad(g: Graph, shape: Any, params: Any, x: AnyArray, value: AnyArray) -> AnyArray:
    symbolic = isinstance(x, SymbolicArray) or isinstance(value, SymbolicArray)
    source, fill = (values_of(g, x), values_of(g, value)) if symbolic else (np.asarray(x), np.asarray(value))
    out = np.broadcast_to(fill, shape).copy()
    target, taken = [], []
    for size, (low, _, gap), length in zip(source.shape, params["padding_config"], shape, strict=True):
        place = low + np.arange(size) * (gap + 1)
        inside = (place >= 0) & (place < length)
        target.append(place[inside])
        taken.append(np.flatnonzero(inside))
    out[np.ix_(*target)] = source[np.ix_(*taken)]
    return SymbolicArray(out) if symbolic else out


def _iota(g: Graph, shape: Any, params: Any) -> AnyArray:
    middle = [1] * len(shape)
    middle[params["dimension"]] = shape[params["dimension"]]
    return np.broadcast_to(np.arange(shape[params["dimension"]]).reshape(middle), shape)


def _empty(g: Graph, shape: Any, params: Any) -> AnyArray:
    """Return arrays that hold nothing yet, along the first axis."""
    length, size = shape[0] if shape else 1, int(np.prod(shape[1:], dtype=int))
    kind = f"{kind_of(params['dtype'])}{length}"
    return SymbolicArray(unpack(g, [g.fresh("empty", kind=kind) for _ in range(size)], shape, min(len(shape), 1)))


# -- random numbers


def _threefry(g: Graph, shape: Any, params: Any, *xs: AnyArray) -> list[AnyArray]:
    def number(k: int) -> Value:
        return g.constant(np.uint32(k))

    def rotate(word: Value, distance: int) -> Value:
        left, right = g.binary("shl", word, number(distance)), g.binary("shr", word, number(32 - distance))
        return g.logic("or", left, right)

    columns = [np.broadcast_to(values_of(g, x), shape).ravel().tolist() for x in xs]
    pairs = [
        threefry((k0, k1), (c0, c1), g.add, partial(g.logic, "xor"), rotate, number)
        for k0, k1, c0, c1 in zip(*columns, strict=True)
    ]
    return [SymbolicArray(np.array(half, np.int32).reshape(shape)) for half in zip(*pairs, strict=True)]


def _iota_pair(g: Graph, shape: Any, params: Any) -> list[AnyArray]:
    """Return the high and the low words of each element's number."""
    count = np.arange(int(np.prod(shape)), dtype=np.uint32).reshape(shape)
    return [np.zeros_like(count), count]


RULES: dict[str, Rule] = {
    "convert_element_type": _convert,
    "bitcast_convert_type": _bitcast,
    "integer_pow": lambda g, shape, params, x: each(partial(elementary.power, y=params["y"]), g, shape, x),
    "round": lambda g, shape, params, x: each(partial(round_, **params), g, shape, x),
    "copy": _move(lambda shape, params, x: x),
    "copy_p": _move(lambda shape, params, x: x),
    "stop_gradient": _move(lambda shape, params, x: x),
    "optimization_barrier": lambda g, shape, params, *xs: list(xs),
    "reshape": _move(lambda shape, params, x: x.reshape(shape)),
    "squeeze": _move(lambda shape, params, x: x.reshape(shape)),
    "expand_dims": _move(lambda shape, params, x: x.reshape(shape)),
    "transpose": _move(lambda shape, params, x: x.transpose(params["permutation"])),
    "rev": _move(lambda shape, params, x: np.flip(x, params["dimensions"])),
    "broadcast_in_dim": _move(_broadcast),
    "slice": _move(_slice),
    "tile": _move(lambda shape, params, x: np.tile(x, params["reps"])),
    "concatenate": _join(lambda params, xs: np.concatenate(xs, params["dimension"])),
    "stack": _join(lambda params, xs: np.stack(xs, params.get("axis", 0))),
    "split": _split,
    "unstack": _unstack,
    "pad": _pad,
    "empty": _empty,
    "iota": _iota,
    "iota_2x32_shape": _iota_pair,
    "gather": gather,
    "dynamic_slice": dynamic_slice,
    "dynamic_update_slice": dynamic_update_slice,
    "scatter": partial(scatter, lambda g, old, new: new),
    "scatter-add": partial(scatter, Graph.add),
    "scatter_add": partial(scatter, Graph.add),
    "reduce_sum": linear.reduction(Graph.add, lambda dtype: 0),
    "reduce_prod": linear.reduction(Graph.mul, lambda dtype: 1),
    "reduce_max": linear.reduction(extreme("max"), linear.least),
    "reduce_min": linear.reduction(extreme("min"), linear.most),
    "reduce_and": linear.reduction(logic("and"), lambda dtype: ~dtype.type(0)),
    "reduce_or": linear.reduction(logic("or"), lambda dtype: 0),
    "argmin": linear.arg_extreme("lt"),
    "argmax": linear.arg_extreme("gt"),
    "top_k": linear.top_k,
    "cumsum": linear.cumulative(Graph.add),
    "cumprod": linear.cumulative(Graph.mul),
    "cummax": linear.cumulative(extreme("max")),
    "cummin": linear.cumulative(extreme("min")),
    "dot_general": linear.dot,
    "cholesky": linear.cholesky,
    "triangular_solve": linear.triangular_solve,
    "threefry2x32": _threefry,
}
"""Primitives that look at parameters or shapes: rule(graph, shape, params, *operands)."""


_KNOWN: dict[str, Callable[..., Any]] = {
    name: FOLD[name]
    for name in (
        "add", "sub", "mul", "neg", "abs", "sqrt", "floor", "ceil", "max", "min", "lt", "le", "gt", "ge", "eq", "ne",
        "and", "or", "xor", "not",
    )
} | {"select_n": lambda which, *cases: np.choose(which.astype(int), cases, mode="clip"), "add_any": np.add}  # fmt: skip
"""Primitives that numpy computes on whole arrays as the graph would element by element."""


def apply(g: Graph, name: str, avals: list[Any], params: dict[str, Any], xs: list[AnyArray]) -> list[AnyArray]:
    """Return the results of a primitive.

    Raises:
        Unsupported: the primitive has no rule.
    """
    shape, dtype = avals[0].shape, avals[0].dtype
    if 0 in shape and all(0 in aval.shape for aval in avals):
        return [np.zeros(aval.shape, aval.dtype) for aval in avals]
    if name in _KNOWN and not any(isinstance(x, SymbolicArray) for x in xs):
        with np.errstate(all="ignore"):
            return [np.broadcast_to(np.asarray(_KNOWN[name](*xs), dtype), shape)]
    if name in ELEMENTWISE:
        return [array_of(g, each(ELEMENTWISE[name], g, shape, *xs).ids, dtype)]
    if name not in RULES:
        raise Unsupported(f"the primitive {name}")
    results = RULES[name](g, shape, params, *xs)
    results = results if isinstance(results, list) else [results]
    return [
        array_of(g, x.ids, aval.dtype) if isinstance(x, SymbolicArray) else np.asarray(x, aval.dtype)
        for x, aval in zip(results, avals, strict=True)
    ]
