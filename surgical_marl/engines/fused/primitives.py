"""What each JAX primitive does to arrays of values.

A traced array is a numpy array, if all its elements are known, or `Symbolic`. A rule takes the equation's parameters, its
result's shape and the traced operands, and returns the traced result. Moving elements about is numpy indexing on the
values; arithmetic goes element by element through the graph.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import numpy as np

from surgical_marl.engines.fused import elementary
from surgical_marl.engines.fused.graph import FOLD, KINDS, Graph, Value
from surgical_marl.engines.fused.indexing import dynamic_slice, dynamic_update_slice, gather, scatter


class Symbolic:
    """An array whose elements are values of a graph: `ids` int32 of its shape."""

    __slots__ = ("ids",)

    def __init__(self, ids: np.ndarray) -> None:
        self.ids = ids

    @property
    def shape(self) -> tuple[int, ...]:
        return self.ids.shape


Traced = np.ndarray | Symbolic
Rule = Callable[..., Traced | list[Traced]]


class Unsupported(ValueError):
    """The function uses what the fused engine has no kernel code for."""


def lift(graph: Graph, array: Traced) -> np.ndarray:
    """The values of a traced array, known or not."""
    if isinstance(array, Symbolic):
        return array.ids
    array = np.asarray(array)
    if array.dtype.name not in KINDS:
        raise Unsupported(f"arrays of {array.dtype.name}")
    flat = [graph.constant(element) for element in array.ravel()]
    return np.array(flat, np.int32).reshape(array.shape)


def lower(graph: Graph, ids: np.ndarray, dtype: Any) -> Traced:
    """A numpy array if all values are constants."""
    if ids.size and ids.max() >= 0:
        return Symbolic(ids)
    flat = [graph.constants[~i] for i in ids.ravel().tolist()]
    return np.array(flat, np.dtype(dtype)).reshape(ids.shape)


# -- element by element


def _elementwise(function: Callable[..., Value], g: Graph, shape: tuple[int, ...], *arrays: Traced) -> np.ndarray:
    columns = [np.broadcast_to(lift(g, array), shape).ravel().tolist() for array in arrays]
    flat = [function(g, *elements) for elements in zip(*columns, strict=True)]
    return np.array(flat, np.int32).reshape(shape)


def _op(name: str) -> Callable[..., Value]:
    return lambda g, *args: g.unary(name, *args) if len(args) == 1 else g.binary(name, *args)


def _compare(name: str) -> Callable[..., Value]:
    return lambda g, a, b: g.compare(name, a, b)


def _logic(name: str) -> Callable[..., Value]:
    return lambda g, a, b: g.logic(name, a, b)


def _extreme(name: str) -> Callable[..., Value]:
    return lambda g, a, b: g.extreme(name, a, b)


def _sign(g: Graph, a: Value) -> Value:
    zero, one = (g.constant(g.dtype(a)(k)) for k in (0, 1))
    below = zero if g.kind(a) == "u" else g.select(g.compare("lt", a, zero), zero, g.neg(one))
    return g.select(g.compare("gt", a, zero), below, one)


def _clamp(g: Graph, low: Value, a: Value, high: Value) -> Value:
    return g.extreme("min", g.extreme("max", a, low), high)


def _round(g: Graph, a: Value, *, rounding_method: Any) -> Value:
    if int(rounding_method) == 1:
        return g.unary("rint", a)
    size = g.unary("floor", g.add(g.unary("abs", a), g.constant(np.float32(0.5))))  # halves away from zero
    return g.select(g.compare("lt", a, g.zero), size, g.neg(size))


def _tanh(g: Graph, a: Value) -> Value:
    return g.unary("tanh", a)


def _logistic(g: Graph, a: Value) -> Value:
    return g.div(g.one, g.add(g.one, elementary.exponential(g, g.neg(a))))


def _shift(name: str) -> Callable[..., Value]:
    def shift(g: Graph, a: Value, b: Value) -> Value:
        if g.is_constant(b, 0):
            return a
        if b < 0 and not 0 <= int(g.constants[~b]) < 32:  # C leaves it undefined, JAX doesn't
            return g.binary("sar", a, g.constant(g.dtype(b)(31))) if name == "sar" else g.constant(g.dtype(a)(0))
        if b >= 0:
            count = g.unary("i2u", b) if g.kind(b) == "i" else b
            inside = g.compare("lt", count, g.constant(np.uint32(32)))
            safe = g.select(inside, g.constant(np.uint32(31 if name == "sar" else 0)), count)
            safe = g.unary("u2i", safe) if g.kind(a) == "i" else safe
            moved = g.binary(name, a, safe)
            return moved if name == "sar" else g.select(inside, g.constant(g.dtype(a)(0)), moved)
        return g.binary(name, a, b)

    return shift


def _shift_logical(g: Graph, a: Value, b: Value) -> Value:
    if g.kind(a) == "u":
        return _shift("shr")(g, a, b)
    count = g.unary("i2u", b)
    return g.unary("u2i", _shift("shr")(g, g.unary("i2u", a), count))


def _shift_arithmetic(g: Graph, a: Value, b: Value) -> Value:
    return _shift("sar" if g.kind(a) == "i" else "shr")(g, a, b)


def _power(g: Graph, a: Value, b: Value) -> Value:
    exponent = float(g.constants[~b]) if b < 0 else None
    if exponent is not None and exponent == int(exponent) and abs(exponent) <= 8:
        return elementary.power(g, a, int(exponent))
    if exponent == 0.5:
        return g.unary("sqrt", a)
    if g.kind(b) == "i":
        b = g.unary("i2f", b)
    return g.binary("pow", a, b)


def _select_n(g: Graph, which: Value, *cases: Value) -> Value:
    if g.kind(which) == "b":
        return g.select(which, *cases)
    value = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        value = g.select(g.compare("le", which, g.constant(np.int32(k))), value, cases[k])
    return value


ELEMENTWISE: dict[str, Callable[..., Value]] = {
    "add": Graph.add, "add_any": Graph.add, "sub": Graph.sub, "mul": Graph.mul, "div": Graph.div, "neg": Graph.neg,
    "rem": _op("rem"), "abs": _op("abs"), "sqrt": _op("sqrt"), "floor": _op("floor"), "ceil": _op("ceil"),
    "log": _op("log"), "tan": _op("tan"), "acos": _op("acos"), "asin": _op("asin"), "atan2": _op("atan2"),
    "is_finite": _op("isfinite"), "sin": elementary.sine, "cos": elementary.cosine, "exp": elementary.exponential,
    "erf_inv": elementary.inverse_error, "tanh": _tanh, "logistic": _logistic, "pow": _power, "sign": _sign,
    "rsqrt": lambda g, a: g.div(g.one, g.unary("sqrt", a)), "square": lambda g, a: g.mul(a, a),
    "log1p": lambda g, a: g.unary("log", g.add(g.one, a)), "max": _extreme("max"), "min": _extreme("min"),
    "clamp": _clamp, "lt": _compare("lt"), "le": _compare("le"), "gt": _compare("gt"), "ge": _compare("ge"),
    "eq": _compare("eq"), "ne": _compare("ne"), "and": _logic("and"), "or": _logic("or"), "xor": _logic("xor"),
    "not": Graph.invert, "shift_left": _shift("shl"), "shift_right_logical": _shift_logical,
    "shift_right_arithmetic": _shift_arithmetic, "select_n": _select_n,
}  # fmt: skip
"""Primitives without parameters that matter: their values from those of the operands."""

_KNOWN = {
    name: FOLD[name]
    for name in [
        "add",
        "sub",
        "mul",
        "div",
        "neg",
        "abs",
        "sqrt",
        "floor",
        "ceil",
        "rem",
        "max",
        "min",
        "lt",
        "le",
        "gt",
        "ge",
        "eq",
        "ne",
        "and",
        "or",
        "xor",
        "not",
    ]
} | {"select_n": lambda which, *cases: np.choose(which.astype(int), cases), "add_any": np.add}
"""Those that numpy computes on whole arrays as the graph would element by element."""


def convert(g: Graph, a: Value, to: str) -> Value:
    """A value as another kind, as C converts."""
    kind = g.kind(a)
    if kind == to:
        return a
    if to == "b":
        return g.compare("ne", a, g.constant(g.dtype(a)(0)))
    if kind == "b":
        dtype = {"f": np.float32, "i": np.int32, "u": np.uint32}[to]
        return g.select(a, g.constant(dtype(0)), g.constant(dtype(1)))
    return g.unary(f"{kind}2{to}", a)


def _convert(g: Graph, shape: Any, params: Any, x: Traced) -> Traced:
    dtype = np.dtype(params["new_dtype"])
    if not isinstance(x, Symbolic):
        return x.astype(dtype)
    if dtype.name not in KINDS:
        raise Unsupported(f"arrays of {dtype.name}")
    return lower(g, _elementwise(partial(convert, to=KINDS[dtype.name]), g, shape, x), dtype)


def _bitcast(g: Graph, shape: Any, params: Any, x: Traced) -> Traced:
    to = KINDS[np.dtype(params["new_dtype"]).name]
    if not isinstance(x, Symbolic):
        return x.view(params["new_dtype"])

    def cast(g: Graph, a: Value) -> Value:
        kind = g.kind(a)
        if kind == to:
            return a
        if kind == "f":
            bits = g.unary("bits", a)
            return bits if to == "u" else g.unary("u2i", bits)
        bits = g.unary("i2u", a) if kind == "i" else a
        return g.unary("float", bits) if to == "f" else g.unary("u2i", a)

    return Symbolic(_elementwise(cast, g, shape, x))


# -- moving elements


def _move(function: Callable[..., np.ndarray]) -> Rule:
    """A rule that only moves elements: `function(shape, params, array)`."""

    def rule(g: Graph, shape: Any, params: Any, x: Traced, *rest: Traced) -> Traced:
        if isinstance(x, Symbolic):
            return Symbolic(np.asarray(function(shape, params, x.ids)))
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
    def rule(g: Graph, shape: Any, params: Any, *xs: Traced) -> Traced:
        if any(isinstance(x, Symbolic) for x in xs):
            return Symbolic(function(params, [lift(g, x) for x in xs]))
        return function(params, [np.asarray(x) for x in xs])

    return rule


def _split(g: Graph, shape: Any, params: Any, x: Traced) -> list[Traced]:
    ends = np.cumsum(params["sizes"])[:-1]
    if isinstance(x, Symbolic):
        return [Symbolic(part) for part in np.split(x.ids, ends, params["axis"])]
    return list(np.split(x, ends, params["axis"]))


def _unstack(g: Graph, shape: Any, params: Any, x: Traced) -> list[Traced]:
    array = x.ids if isinstance(x, Symbolic) else x
    parts = [array.take(k, params["axis"]) for k in range(array.shape[params["axis"]])]
    return [Symbolic(np.asarray(part)) if isinstance(x, Symbolic) else part for part in parts]


def _pad(g: Graph, shape: Any, params: Any, x: Traced, value: Traced) -> Traced:
    dtype = x.dtype if isinstance(x, np.ndarray) else None
    symbolic = isinstance(x, Symbolic) or isinstance(value, Symbolic)
    source, fill = (lift(g, x), lift(g, value)) if symbolic else (x, value)
    out = np.broadcast_to(fill, shape).copy()
    target, taken = [], []
    for size, (low, _, gap), length in zip(source.shape, params["padding_config"], shape, strict=True):
        place = low + np.arange(size) * (gap + 1)
        inside = (place >= 0) & (place < length)
        target.append(place[inside])
        taken.append(np.flatnonzero(inside))
    out[np.ix_(*target)] = source[np.ix_(*taken)]
    return Symbolic(out) if symbolic else out.astype(dtype)


# -- reductions and linear algebra


def _reduce(function: Callable[..., Value], empty: Callable[..., Any] = np.sum) -> Rule:
    def rule(g: Graph, shape: Any, params: Any, x: Traced) -> Traced:
        ids, axes = lift(g, x), params["axes"]
        if not ids.size:
            return np.asarray(empty(np.asarray(x), tuple(axes)))
        kept = [axis for axis in range(ids.ndim) if axis not in axes]
        rows = ids.transpose([*kept, *axes]).reshape(int(np.prod(shape)), -1)
        flat = [reduce(partial(function, g), row) for row in rows.tolist()]
        return Symbolic(np.array(flat, np.int32).reshape(shape))

    return rule


def _arg_extreme(op: str) -> Rule:
    def rule(g: Graph, shape: Any, params: Any, x: Traced) -> Traced:
        (axis,) = params["axes"]
        rows = np.moveaxis(lift(g, x), axis, -1).reshape(int(np.prod(shape)), -1)
        flat = []
        for row in rows.tolist():
            best, index = row[0], g.constant(np.int32(0))
            for k, value in enumerate(row[1:], 1):
                better = g.compare(op, value, best)
                best, index = g.select(better, best, value), g.select(better, index, g.constant(np.int32(k)))
            flat.append(convert(g, index, KINDS[np.dtype(params["index_dtype"]).name]))
        return Symbolic(np.array(flat, np.int32).reshape(shape))

    return rule


def _top_k(g: Graph, shape: Any, params: Any, x: Traced) -> list[Traced]:
    """The k largest, one after the other; of equal ones the first."""
    rows = lift(g, x).reshape(-1, lift(g, x).shape[-1])
    values, places = [], []
    for row in rows.tolist():
        rest, low = list(row), g.constant(g.dtype(row[0])(-np.inf if g.kind(row[0]) == "f" else np.iinfo(np.int32).min))
        for _ in range(params["k"]):
            best, index = rest[0], g.constant(np.int32(0))
            for k, value in enumerate(rest[1:], 1):
                better = g.compare("gt", value, best)
                best, index = g.select(better, best, value), g.select(better, index, g.constant(np.int32(k)))
            values.append(best)
            places.append(index)
            rest = [
                g.select(g.compare("eq", index, g.constant(np.int32(k))), value, low) for k, value in enumerate(rest)
            ]
    return [Symbolic(np.array(found, np.int32).reshape(shape)) for found in (values, places)]


def _cumulative(function: Callable[..., Value]) -> Rule:
    def rule(g: Graph, shape: Any, params: Any, x: Traced) -> Traced:
        ids = np.moveaxis(lift(g, x), params["axis"], 0).copy()
        ids = ids[::-1] if params["reverse"] else ids
        for k in range(1, len(ids)):
            ids[k] = _elementwise(function, g, ids[k].shape, Symbolic(ids[k - 1]), Symbolic(ids[k]))
        return Symbolic(np.moveaxis(ids[::-1] if params["reverse"] else ids, 0, params["axis"]))

    return rule


def _dot(g: Graph, shape: Any, params: Any, x: Traced, y: Traced) -> Traced:
    (left, right), (left_batch, right_batch) = params["dimension_numbers"]
    a, b = lift(g, x), lift(g, y)
    size = int(np.prod([a.shape[axis] for axis in left], dtype=int))
    batch = int(np.prod([a.shape[axis] for axis in left_batch], dtype=int))
    a_free = [axis for axis in range(a.ndim) if axis not in (*left, *left_batch)]
    b_free = [axis for axis in range(b.ndim) if axis not in (*right, *right_batch)]
    heights = [int(np.prod([z.shape[axis] for axis in free], dtype=int)) for z, free in ((a, a_free), (b, b_free))]
    rows = a.transpose([*left_batch, *a_free, *left]).reshape(batch, heights[0], size)
    columns = b.transpose([*right_batch, *b_free, *right]).reshape(batch, heights[1], size)
    out = []
    zero = g.zero
    for z in range(batch):
        others = columns[z].tolist()
        for row in rows[z].tolist():
            terms = [(k, value) for k, value in enumerate(row) if value != zero]
            for column in others:
                total = zero
                for k, value in terms:
                    if column[k] != zero:
                        total = g.add(total, g.mul(value, column[k]))
                out.append(total)
    return Symbolic(np.array(out, np.int32).reshape(shape))


def _cholesky(g: Graph, shape: Any, params: Any, x: Traced) -> Traced:
    ids = lift(g, x).reshape(-1, *shape[-2:])
    out = np.full(ids.shape, g.zero, np.int32)
    for a, lower_half in zip(ids.tolist(), out, strict=True):
        rows: list[list[Value]] = [[] for _ in a]
        for j in range(len(a)):
            rest = a[j][j]
            for value in rows[j]:
                rest = g.sub(rest, g.mul(value, value))
            diagonal = g.unary("sqrt", rest)
            inverse = g.div(g.one, diagonal)
            for i in range(j + 1, len(a)):
                rest = a[i][j]
                for p, q in zip(rows[i], rows[j], strict=True):
                    rest = g.sub(rest, g.mul(p, q))
                rows[i].append(g.mul(rest, inverse))
                lower_half[i, j] = rows[i][j]
            rows[j].append(diagonal)
            lower_half[j, j] = diagonal
    return Symbolic(out.reshape(shape))


def _triangular_solve(g: Graph, shape: Any, params: Any, x: Traced, y: Traced) -> Traced:
    a, b = lift(g, x), lift(g, y)
    if a.ndim > 2:
        parts = zip(a.reshape(-1, *a.shape[-2:]), b.reshape(-1, *b.shape[-2:]), strict=True)
        solved = [_triangular_solve(g, q.shape, params, Symbolic(p), Symbolic(q)) for p, q in parts]
        return Symbolic(np.stack([lift(g, part) for part in solved]).reshape(shape))
    a = a.T if params["transpose_a"] else a
    low = params["lower"] != params["transpose_a"]
    if not params["left_side"]:  # x a = b is a^T x^T = b^T
        a, b, low = a.T, b.T, not low
    rows, n = a.tolist(), len(a)
    out = b.copy()
    for column in out.T:
        for i in range(n) if low else range(n - 1, -1, -1):
            rest = int(column[i])
            for k in range(i) if low else range(i + 1, n):
                rest = g.sub(rest, g.mul(rows[i][k], int(column[k])))
            column[i] = rest if params["unit_diagonal"] else g.mul(rest, g.div(g.one, rows[i][i]))
    return Symbolic(out if params["left_side"] else np.ascontiguousarray(out.T))


def _threefry(g: Graph, shape: Any, params: Any, *xs: Traced) -> list[Traced]:
    """The block cipher of JAX's random numbers: Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011."""
    columns = [np.broadcast_to(lift(g, x), shape).ravel().tolist() for x in xs]
    pairs = [_threefry_block(g, *words) for words in zip(*columns, strict=True)]
    return [Symbolic(np.array(half, np.int32).reshape(shape)) for half in zip(*pairs, strict=True)]


def _threefry_block(g: Graph, key0: Value, key1: Value, x0: Value, x1: Value) -> tuple[Value, Value]:
    number = lambda k: g.constant(np.uint32(k))  # noqa: E731
    keys = [key0, key1, g.logic("xor", g.logic("xor", key0, key1), number(0x1BD11BDA))]
    x0, x1 = g.add(x0, keys[0]), g.add(x1, keys[1])
    for block in range(5):
        for turn in ((13, 15, 26, 6), (17, 29, 16, 24))[block % 2]:
            x0 = g.add(x0, x1)
            turned = g.logic("or", g.binary("shl", x1, number(turn)), g.binary("shr", x1, number(32 - turn)))
            x1 = g.logic("xor", turned, x0)
        x0 = g.add(x0, keys[(block + 1) % 3])
        x1 = g.add(g.add(x1, keys[(block + 2) % 3]), number(block + 1))
    return x0, x1


def _iota(g: Graph, shape: Any, params: Any) -> Traced:
    middle = [1] * len(shape)
    middle[params["dimension"]] = shape[params["dimension"]]
    return np.broadcast_to(np.arange(shape[params["dimension"]], dtype=params["dtype"]).reshape(middle), shape)


def _iota_pair(g: Graph, shape: Any, params: Any) -> list[Traced]:
    """The high and low words of each element's number."""
    count = np.arange(int(np.prod(shape)), dtype=np.uint32).reshape(shape)
    return [np.zeros_like(count), count]


def _indexed(function: Callable[..., np.ndarray]) -> Rule:
    """A rule of `indexing.py`: its result takes the dtype of the first operand."""

    def rule(g: Graph, shape: Any, params: Any, *xs: Traced) -> Traced:
        first = xs[0]
        raw = [x.ids if isinstance(x, Symbolic) else x for x in xs]
        known = [isinstance(x, np.ndarray) for x in xs]
        ids = function(g, shape, params, raw, known, partial(lift, g))
        return Symbolic(ids) if isinstance(first, Symbolic) else lower(g, ids, first.dtype)

    return rule


RULES: dict[str, Rule] = {
    "convert_element_type": _convert,
    "bitcast_convert_type": _bitcast,
    "integer_pow": lambda g, shape, params, x: Symbolic(
        _elementwise(lambda g, a: elementary.power(g, a, params["y"]), g, shape, x)
    ),
    "round": lambda g, shape, params, x: Symbolic(_elementwise(partial(_round, **params), g, shape, x)),
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
    "iota": _iota,
    "iota_2x32_shape": _iota_pair,
    "gather": _indexed(gather),
    "dynamic_slice": _indexed(dynamic_slice),
    "dynamic_update_slice": _indexed(dynamic_update_slice),
    "scatter": _indexed(partial(scatter, lambda g, old, new: new)),
    "scatter-add": _indexed(partial(scatter, Graph.add)),
    "scatter_add": _indexed(partial(scatter, Graph.add)),
    "reduce_sum": _reduce(Graph.add),
    "reduce_prod": _reduce(Graph.mul, np.prod),
    "reduce_max": _reduce(_extreme("max"), partial(np.max, initial=-np.inf)),
    "reduce_min": _reduce(_extreme("min"), partial(np.min, initial=np.inf)),
    "reduce_and": _reduce(_logic("and"), np.all),
    "reduce_or": _reduce(_logic("or"), np.any),
    "argmin": _arg_extreme("lt"),
    "argmax": _arg_extreme("gt"),
    "top_k": _top_k,
    "cumsum": _cumulative(Graph.add),
    "cumprod": _cumulative(Graph.mul),
    "cummax": _cumulative(_extreme("max")),
    "cummin": _cumulative(_extreme("min")),
    "dot_general": _dot,
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
    "threefry2x32": _threefry,
}
"""Primitives that look at parameters or shapes: rule(graph, shape, params, *operands)."""


def apply(g: Graph, name: str, avals: list[Any], params: dict[str, Any], xs: list[Traced]) -> list[Traced]:
    """The results of a primitive. Unsupported if it has no rule."""
    shape, dtype = avals[0].shape, avals[0].dtype
    if all(not np.prod(aval.shape, dtype=int) for aval in avals):
        return [np.zeros(aval.shape, aval.dtype) for aval in avals]
    if name in _KNOWN and not any(isinstance(x, Symbolic) for x in xs):
        with np.errstate(all="ignore"):
            return [np.broadcast_to(np.asarray(_KNOWN[name](*xs), dtype), shape)]
    if name in ELEMENTWISE:
        return [lower(g, _elementwise(ELEMENTWISE[name], g, shape, *xs), dtype)]
    if name not in RULES:
        raise Unsupported(f"the primitive {name}")
    results = RULES[name](g, shape, params, *xs)
    results = results if isinstance(results, list) else [results]
    return [
        lower(g, x.ids, aval.dtype) if isinstance(x, Symbolic) else x for x, aval in zip(results, avals, strict=True)
    ]
