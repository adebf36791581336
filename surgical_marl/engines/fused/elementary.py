"""Functions made of a graph's operations: sine, cosine, exponential and others, exact to a few units in the last place.

They cost the same on all devices and need no library. Common parts are shared: a sine and a cosine of one angle share
its reduction. Polynomials are those of Cephes (S. L. Moshier, single precision) and of M. Giles, "Approximating the
erfinv function", 2010.
"""

from __future__ import annotations

import numpy as np

from surgical_marl.engines.fused.graph import Graph, Value

_SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
_COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)
_EXPONENTIAL = (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1)
_HALF_PI = (1.5703125, 4.837512969970703e-4, 7.549789948768648e-8)
_LOG_2 = (0.693359375, -2.12194440e-4)
_ERFINV_SMALL = (
    2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087, -0.00125372503, -0.00417768164,
    0.246640727, 1.50140941,
)  # fmt: skip
_ERFINV_LARGE = (
    -0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773, -0.0076224613, 0.00943887047,
    1.00167406, 2.83297682,
)  # fmt: skip


def sine(g: Graph, x: Value) -> Value:
    return _wave(g, x, 0)


def cosine(g: Graph, x: Value) -> Value:
    return _wave(g, x, 1)


def _wave(g: Graph, x: Value, quarter: int) -> Value:
    """sin(x + quarter * pi / 2), for |x| up to some thousands."""
    if x < 0:
        return g.constant((np.cos if quarter else np.sin)(g.constants[~x]))
    turns = g.unary("rint", g.mul(_real(g, 2 / np.pi), x))
    rest = x
    for part in _HALF_PI:
        rest = g.sub(rest, g.mul(_real(g, part), turns))
    square = g.mul(rest, rest)
    sine = g.add(rest, g.mul(g.mul(rest, square), polynomial(g, square, _SINE)))
    cosine = g.add(
        g.sub(g.one, g.mul(_real(g, 0.5), square)),
        g.mul(g.mul(square, square), polynomial(g, square, _COSINE)),
    )
    count = g.add(g.unary("f2i", turns), g.constant(np.int32(quarter)))
    odd = g.compare("ne", g.logic("and", count, g.constant(np.int32(1))), g.constant(np.int32(0)))
    low = g.compare("ne", g.logic("and", count, g.constant(np.int32(2))), g.constant(np.int32(0)))
    value = g.select(odd, sine, cosine)
    return g.select(low, value, g.neg(value))


def exponential(g: Graph, x: Value) -> Value:
    """E to the x; 0 and infinity beyond what float32 holds."""
    if x < 0:
        return g.constant(np.exp(g.constants[~x]))
    bounded = g.extreme("max", g.extreme("min", x, _real(g, 88.72)), _real(g, -87.0))
    power = g.unary("rint", g.mul(_real(g, 1 / np.log(2)), bounded))
    power = g.extreme("min", power, _real(g, 127.0))  # the largest that a float32's exponent holds
    rest = bounded
    for part in _LOG_2:
        rest = g.sub(rest, g.mul(_real(g, part), power))
    value = g.add(g.add(g.one, rest), g.mul(g.mul(rest, rest), polynomial(g, rest, _EXPONENTIAL)))
    exponent = g.add(g.unary("f2i", power), g.constant(np.int32(127)))
    scale = g.unary("float", g.binary("shl", g.unary("i2u", exponent), g.constant(np.uint32(23))))
    value = g.mul(value, scale)
    value = g.select(g.compare("lt", x, _real(g, -87.0)), value, g.zero)
    return g.select(g.compare("gt", x, _real(g, 88.72)), value, _real(g, np.inf))


def logarithm_of_more(g: Graph, x: Value) -> Value:
    """Return log(1 + x), also accurate for small x.

    Rounding 1 + x loses digits of a small x. The result is corrected for that loss with W. Kahan's method, given in
    Goldberg, "What every computer scientist should know about floating-point arithmetic", 1991.
    """
    more = g.add(g.one, x)
    kept = g.sub(more, g.one)
    scaled = g.mul(g.unary("log", more), g.div(x, kept))
    return g.select(g.compare("eq", kept, g.zero), scaled, x)


def inverse_error(g: Graph, x: Value) -> Value:
    """Return the inverse of the error function, as XLA computes it."""
    w = g.neg(g.unary("log", g.mul(g.sub(g.one, x), g.add(g.one, x))))
    small = polynomial(g, g.sub(w, _real(g, 2.5)), _ERFINV_SMALL)
    large = polynomial(g, g.sub(g.unary("sqrt", w), _real(g, 3.0)), _ERFINV_LARGE)
    return g.mul(g.select(g.compare("lt", w, _real(g, 5.0)), large, small), x)


def polynomial(g: Graph, x: Value, coefficients: tuple[float, ...]) -> Value:
    """By Horner's rule, highest power first."""
    value = _real(g, coefficients[0])
    for coefficient in coefficients[1:]:
        value = g.add(g.mul(value, x), _real(g, coefficient))
    return value


def power(g: Graph, x: Value, y: int) -> Value:
    """X to a whole number, by squaring."""
    if y < 0:
        return g.div(g.constant(np.ones((), g.dtype(x))[()]), power(g, x, -y))
    if y == 0:
        return g.constant(np.ones((), g.dtype(x))[()])
    half = power(g, x, y // 2) if y > 1 else x
    if y == 1:
        return x
    square = g.mul(half, half)
    return g.mul(square, x) if y % 2 else square


def _real(g: Graph, value: float) -> Value:
    return g.constant(np.float32(value))
