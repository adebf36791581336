"""Every primitive of the fused engine's compiler, alone and in random programs, against JAX."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jax import lax
from jax.extend.core import Primitive, primitives

from surgical_marl.engines.fused import hints, instrumentation
from surgical_marl.engines.fused.jaxpr_interpreter import JaxprInterpreter
from surgical_marl.engines.fused.primitives import ELEMENTWISE, RULES
from surgical_marl.engines.fused.symbolic_array import SymbolicArray
from tests.helpers.fused_blocks import all_blocks, random_arrays
from tests.helpers.fused_kernels import gpu_code, make_stores, run
from tests.helpers.fused_programs import STRUCTURES, programs, several

Arrays = Any


def compare(function: Callable[..., Any], *columns: Any, rtol: float = 1e-5, atol: float = 1e-6) -> None:
    """A kernel and JAX make the same of columns [N, ...].

    Whole numbers and truths must be equal. Floats may differ as sums in another order and other polynomials do, a few
    units of 1.2e-7 each.
    """
    found = run(function, *columns)
    expected = jax.jit(jax.vmap(function))(*columns)
    for (path, a), b in zip(jax.tree_util.tree_flatten_with_path(expected)[0], jax.tree.leaves(found), strict=True):
        name, a = jax.tree_util.keystr(path), np.asarray(a)
        assert (a.dtype, a.shape) == (b.dtype, b.shape), name
        if a.dtype.kind == "f":
            np.testing.assert_allclose(b, a, rtol=rtol, atol=atol, err_msg=name)
        else:
            np.testing.assert_array_equal(b, a, err_msg=name)


@pytest.mark.parametrize("group", ["a", "f", "m", "r", "x"])
def test_blocks(group: str) -> None:
    compare(partial(all_blocks, group), random_arrays(0))


def nested(pool: Any) -> Any:
    """Each sort of branch or loop in each."""
    names = ("a: add", "m: cumsum back", "a: lt", "f: mean", "a: mul words")  # one of each sort
    blocks = [("block", name, (2, 1, 0, 0)) for name in names]
    return several([[(a, 4, [[(b, 5, [blocks] * 3)]] * 3)] for a in STRUCTURES for b in STRUCTURES], pool)


@pytest.mark.parametrize("written_for", [nullcontext, gpu_code], ids=["cpu", "gpu"])
def test_branches_and_loops_within_each_other(written_for: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for passes in (hints, instrumentation):  # all branches hide their inputs from the C compiler, and count as work
        monkeypatch.setattr(passes, "LARGE", 0)
    with written_for():
        compare(nested, random_arrays(0), rtol=1e-5, atol=2e-5)


@settings(max_examples=5, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(st.lists(programs(2), min_size=3, max_size=3))
def test_programs(written: list[list[Any]]) -> None:
    compare(partial(several, written), random_arrays(0), rtol=1e-5, atol=2e-5)


# -- what must be tested


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Names of the primitives that are traced for something that is not known."""
    names: set[str] = set()
    original = JaxprInterpreter._equation

    def recorded(self: JaxprInterpreter, equation: Any, xs: list[Any]) -> list[Any]:
        if not xs or any(isinstance(x, SymbolicArray) for x in xs):
            names.add(equation.primitive.name)
        return original(self, equation, xs)

    monkeypatch.setattr(JaxprInterpreter, "_equation", recorded)
    return names


def test_every_primitive_has_a_block(seen: set[str]) -> None:
    make_stores(lambda pool: (all_blocks("", pool), nested(pool)), (random_arrays(0),))
    known = [value for module in (lax, lax.linalg, primitives) for value in vars(module).values()]
    there = {primitive.name for primitive in known if isinstance(primitive, Primitive)}  # in this version of JAX
    control = {"cond", "while", "scan", "custom_jvp_call", "custom_vjp_call", "custom_vmap_call", "random_bits",
               "random_fold_in", "random_split", "random_wrap", "random_unwrap"}  # fmt: skip
    assert not ((ELEMENTWISE.keys() | RULES.keys()) & there | control) - seen


# -- special values

INTS = np.array([0, 1, -1, 2, -2, 7, -7, 2**31 - 1, -(2**31), 31, 32, 33, -33], np.int32)
FLOATS = np.float32([0, -0.0, 1, -1, 0.5, -0.5, 1.5, 2.5, -2.5, 0.49999997, 8388609, 1e3, -1e3, 3e9, -3e9, 1e10, 1e-20])


def pairs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.repeat(values, len(values)), np.tile(values, len(values))


def test_whole_numbers_at_their_limits() -> None:
    """No division stops the process, and shifts by 32 and more are JAX's, not C's."""

    def function(a: Arrays, b: Arrays) -> Arrays:
        u, v = (lax.bitcast_convert_type(x, jnp.uint32) for x in (a, b))
        both = [lax.add, lax.sub, lax.mul, lax.div, lax.rem, lax.max, lax.min, lax.lt, lax.le, lax.shift_left,
                lax.shift_right_logical, lax.shift_right_arithmetic]  # fmt: skip
        constants = [(f(x, x.dtype.type(k)), f(x.dtype.type(k), x)) for x in (a, u) for k in (0, 7, 35) for f in both]
        return (
            [(f(a, b), f(u, v)) for f in both],
            constants,
            lax.div(a, np.int32(-1)),
            [f(x) for x in (a, u) for f in (lax.neg, lax.sign, lambda x: x.astype(jnp.float32), lambda x: x // 3)],
            lax.abs(a),
            lax.integer_pow(a, 3),
        )

    compare(function, *pairs(INTS))


def test_floats_at_their_limits() -> None:
    def function(x: Arrays, y: Arrays) -> Arrays:
        return {
            "round": [lax.round(x, method) for method in lax.RoundingMethod],
            "convert": (x.astype(jnp.int32), x.astype(jnp.uint32), x.astype(bool)),
            "arithmetic": (x / y, lax.rem(x, y), x % y, lax.sign(x), lax.floor(x), lax.ceil(x)),
            "pow": (lax.pow(abs(x), y / 1e4), lax.pow(x, jnp.round(y / 1e9)), x ** np.float32(np.inf), x ** (-3)),
            "nan": (jnp.isnan(x / y), jnp.isfinite(x / y), jnp.where(y == 0, 0, jnp.arctan2(y, x))),
        }

    x, y = pairs(FLOATS)
    compare(function, x, np.where(y == 0, 0, y), rtol=1e-5, atol=0)


def test_functions_over_their_ranges() -> None:
    """Each to a millionth of its value: also the logarithm of 1 + 1e-7, and the sine of 1e4 (to 1e-6 of its range)."""
    unit = np.linspace(-1, 1, 2001, dtype=np.float32)
    small = np.float32(10) ** np.linspace(-20, 0, 2001, dtype=np.float32)
    inner = np.nextafter(np.float32(1), np.float32(0)) * unit

    def function(unit: Arrays, small: Arrays, inner: Arrays) -> Arrays:
        return {
            "log1p": (jnp.log1p(small), jnp.log1p(-small / 2), jnp.log1p(small * 1e30)),
            "exp": jnp.exp(unit * 87),
            "exp at the end": jnp.exp(88 + small / 2),
            "erf_inv": (lax.erf_inv(inner), lax.erf_inv(small / 2)),
            "logistic": lax.logistic(unit * 80),
            "tanh": jnp.tanh(unit * 10),
        }

    compare(function, unit, small, inner, rtol=2e-6, atol=0)
    for scale in (1, 1e3, 1e4):
        compare(lambda x: (jnp.sin(x), jnp.cos(x)), np.float32(scale) * unit, rtol=0, atol=1e-6)
    compare(lambda x: (jnp.exp(100 * x + 200), jnp.exp(100 * x - 200)), unit, rtol=0, atol=0)


def test_algebra_is_of_finite_numbers() -> None:
    """What the compiler's algebra takes for granted, and what it doesn't."""
    x = np.float32([np.inf, -np.inf, np.nan, 3])
    found = run(lambda x: (0 * x, x - x, x + 0, jnp.isnan(x), jnp.isfinite(x), x == x, jnp.isinf(x)), x)
    np.testing.assert_array_equal(found[:2], np.zeros((2, 4)))
    np.testing.assert_array_equal(found[2], x)
    for truth, expected in zip(found[3:], (np.isnan(x), np.isfinite(x), ~np.isnan(x), np.isinf(x)), strict=True):
        np.testing.assert_array_equal(truth, expected)


# -- other versions of JAX


class Nearest:
    """As a primitive of jax 0.12 that has rules of its own for derivatives: it says what it computes, in trees."""

    def __init__(self, *arguments: Any) -> None:
        self.in_avals_flat, self.in_tree = jax.tree.flatten(jax.tree.map(jax.typeof, arguments))

    def expand(self, point: Arrays, others: dict[str, Arrays]) -> dict[str, Arrays]:
        away = jnp.abs(others["ways"] - point)
        return {"least": away.min(), "which": away.argmin().astype(jnp.int32)}


def test_a_primitive_that_says_what_it_computes() -> None:
    """Where this version of JAX has none, one that is named as they are."""
    called = Primitive("call_hi_primitive")
    called.multiple_results = True
    called.def_abstract_eval(lambda *_, _prim: [jax.typeof(jnp.float32(0)), jax.typeof(jnp.int32(0))])

    def function(point: Arrays, ways: Arrays) -> Arrays:
        arguments = (point, {"ways": ways})
        least, which = called.bind(*jax.tree.leaves(arguments), _prim=Nearest(*arguments))
        return 2 * least, which

    point, ways = np.float32([0, 3, -2]), np.float32([[1, 2, 0.5], [9, 2.5, 4], [-1, 0, 1]])
    found = run(function, point, ways)
    np.testing.assert_array_equal(found[0], [1, 1, 2])
    np.testing.assert_array_equal(found[1], [2, 1, 0])


# -- lanes


def test_loops_end_for_those_that_are_not_in_them() -> None:
    """In a branch that others take, a loop would go on for ever from 0: as it would in a lane without environment."""

    def double(x: Arrays) -> Arrays:
        return lax.while_loop(lambda x: x < 100, lambda x: 2 * x, x)

    def guarded(x: Arrays) -> Arrays:
        return lax.cond(x > 0, double, lambda x: x, x)

    def within_a_loop(x: Arrays) -> Arrays:
        """The inner loop depends on nothing in the outer one, and could be moved out of it and of the branch."""
        return lax.fori_loop(0, 3, lambda k, y: y + lax.cond(x > 0, double, lambda x: x, x), x)

    def within_a_search(x: Arrays) -> Arrays:
        """Environments leave the outer loop with an x that the inner one never ends for."""
        halved = lambda c: (c[0] - 3, c[1] + double(c[0]))  # noqa: E731
        return lax.while_loop(lambda c: c[0] > 0, halved, (x, jnp.float32(0)))

    def function(x: Arrays) -> Arrays:
        return guarded(x), guarded(x - 3), within_a_loop(x), *within_a_search(x)

    x = np.arange(-10, 11, dtype=np.float32)
    expected = [jax.jit(function)(value) for value in x]  # one by one: jax.vmap takes both sides of branches
    for found, values in zip(run(function, x), zip(*expected, strict=True), strict=True):
        np.testing.assert_array_equal(found, values)
