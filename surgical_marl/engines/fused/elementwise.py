"""The rules of JAX's element-wise primitives, for the values of one element."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from surgical_marl.engines.fused import elementary
from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.operations import DTYPES


def _op(name: str) -> Callable[..., Value]:
    return lambda g, *args: g.unary(name, *args) if len(args) == 1 else g.binary(name, *args)


def compare(name: str) -> Callable[..., Value]:
    return lambda g, a, b: g.compare(name, a, b)


def logic(name: str) -> Callable[..., Value]:
    return lambda g, a, b: g.logic(name, a, b)


def extreme(name: str) -> Callable[..., Value]:
    return lambda g, a, b: g.extreme(name, a, b)


def _divide(g: Graph, a: Value, b: Value) -> Value:
    return g.div(a, b) if g.kind(a) == "f" else _divide_whole(g, "div", a, b)


def _remainder(g: Graph, a: Value, b: Value) -> Value:
    return g.binary("rem", a, b) if g.kind(a) == "f" else _divide_whole(g, "rem", a, b)


def _divide_whole(g: Graph, op: str, a: Value, b: Value) -> Value:
    """Divide whole numbers as XLA does, also where a CPU would stop with an error.

    Dividing x by 0 gives -1, and the remainder is x. Dividing the least number by -1 gives that number.
    """
    zero, one = (g.constant(g.dtype(a)(k)) for k in (0, 1))
    by_zero = odd = g.compare("eq", b, zero)
    if g.kind(a) == "i":
        least = g.compare("eq", a, g.constant(np.int32(-(2**31))))
        odd = g.logic("or", odd, g.logic("and", least, g.compare("eq", b, g.neg(one))))
    found = g.binary(op, a, g.select(odd, b, one))
    return g.select(by_zero, found, g.neg(one) if op == "div" else a)


def _sign(g: Graph, a: Value) -> Value:
    zero, one = (g.constant(g.dtype(a)(k)) for k in (0, 1))
    below = zero if g.kind(a) == "u" else g.select(g.compare("lt", a, zero), zero, g.neg(one))
    return g.select(g.compare("gt", a, zero), below, one)


def _clamp(g: Graph, low: Value, a: Value, high: Value) -> Value:
    return g.extreme("min", g.extreme("max", a, low), high)


def round_(g: Graph, a: Value, *, rounding_method: int) -> Value:
    if int(rounding_method) == 1:
        return g.unary("rint", a)
    size = g.unary("abs", a)
    whole = g.unary("floor", size)
    half = g.compare("ge", g.sub(size, whole), g.constant(np.float32(0.5)))
    rounded = g.select(half, whole, g.add(whole, g.one))  # halves away from zero
    return g.select(g.compare("lt", a, g.zero), rounded, g.neg(rounded))


def _logistic(g: Graph, a: Value) -> Value:
    return g.div(g.one, g.add(g.one, elementary.exponential(g, g.neg(a))))


def _shift(name: str) -> Callable[..., Value]:
    """By 32 and more, which C leaves undefined, all bits are shifted out."""

    def shift(g: Graph, a: Value, b: Value) -> Value:
        count = convert(g, b, "u")
        inside = g.compare("lt", count, g.constant(np.uint32(32)))
        most = g.select(inside, g.constant(np.uint32(31)), count)
        moved = a if g.is_constant(most, 0) else g.binary(name, a, convert(g, most, g.kind(a)))
        return moved if name == "sar" else g.select(inside, g.constant(g.dtype(a)(0)), moved)

    return shift


def _shift_as(name: str, kind: str) -> Callable[..., Value]:
    """Return a function that shifts the bits of a value as if it were of this kind.

    The kind determines which bits come in from the left.
    """

    def shift(g: Graph, a: Value, b: Value) -> Value:
        return convert(g, _shift(name)(g, convert(g, a, kind), b), g.kind(a))

    return shift


def _power(g: Graph, a: Value, b: Value) -> Value:
    exponent = float(g.constants[~b]) if b < 0 else np.nan
    if exponent.is_integer() and abs(exponent) <= 8:
        return elementary.power(g, a, int(exponent))
    if exponent == 0.5:
        return g.unary("sqrt", a)
    return g.binary("pow", a, convert(g, b, "f"))


def _select_n(g: Graph, which: Value, *cases: Value) -> Value:
    if g.kind(which) == "b":
        return g.select(which, *cases)
    value = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        value = g.select(g.compare("le", which, g.constant(np.int32(k))), value, cases[k])
    return value


def convert(g: Graph, a: Value, to: str) -> Value:
    """Return a value as another kind.

    A number that the kind can't hold becomes the nearest number that it can hold, as in XLA.
    """
    kind = g.kind(a)
    if kind == to:
        return a
    if to == "b":
        return g.compare("ne", a, g.constant(g.dtype(a)(0)))
    if kind == "b":
        return g.select(a, *(g.constant(DTYPES[to](k)) for k in (0, 1)))
    if kind != "f":
        return g.unary(f"{kind}2{to}", a)
    limits = np.iinfo(DTYPES[to])
    found = g.unary(f"f2{to}", g.extreme("max", a, g.constant(np.float32(limits.min))))
    inside = g.compare("lt", a, g.constant(np.float32(limits.max)))  # float32 rounds the limit up, to a power of two
    return g.select(inside, g.constant(DTYPES[to](limits.max)), found)


def bitcast(g: Graph, a: Value, to: str) -> Value:
    """Return the bits of a value as another kind."""
    kind = g.kind(a)
    if kind == to:
        return a
    bits = g.unary("bits", a) if kind == "f" else convert(g, a, "u")
    return g.unary("float", bits) if to == "f" else convert(g, bits, to)


ELEMENTWISE: dict[str, Callable[..., Value]] = {
    "add": Graph.add, "add_any": Graph.add, "sub": Graph.sub, "mul": Graph.mul, "div": _divide, "neg": Graph.neg,
    "rem": _remainder, "abs": _op("abs"), "sqrt": _op("sqrt"), "floor": _op("floor"), "ceil": _op("ceil"),
    "log": _op("log"), "tan": _op("tan"), "acos": _op("acos"), "asin": _op("asin"), "atan2": _op("atan2"),
    "tanh": _op("tanh"), "is_finite": _op("isfinite"), "sin": elementary.sine, "cos": elementary.cosine,
    "exp": elementary.exponential, "log1p": elementary.logarithm_of_more, "erf_inv": elementary.inverse_error,
    "logistic": _logistic, "pow": _power, "sign": _sign, "rsqrt": lambda g, a: g.div(g.one, g.unary("sqrt", a)),
    "square": lambda g, a: g.mul(a, a), "max": extreme("max"), "min": extreme("min"), "clamp": _clamp,
    "lt": compare("lt"), "le": compare("le"), "gt": compare("gt"), "ge": compare("ge"), "eq": compare("eq"),
    "ne": compare("ne"), "and": logic("and"), "or": logic("or"), "xor": logic("xor"), "not": Graph.invert,
    "shift_left": _shift("shl"), "shift_right_logical": _shift_as("shr", "u"),
    "shift_right_arithmetic": _shift_as("sar", "i"), "select_n": _select_n,
}  # fmt: skip
"""Primitives without parameters that matter: their values from those of the operands."""
