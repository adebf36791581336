"""What the fused engine's compiler makes of a JAX function, before any code is written, means what JAX says."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.helpers.fused_blocks import all_blocks, random_arrays
from tests.helpers.fused_kernels import make_stores
from tests.helpers.fused_schedules import Direct


@cache
def meant(group: str) -> tuple[Any, Any, Any]:
    """The graph of all blocks of a group, the values of its results, and what it is given."""
    columns = random_arrays(0)
    graph, stores, _, inputs, _ = make_stores(partial(all_blocks, group), (columns,))
    return graph, [value for _, _, value in stores], inputs


def given(inputs: Any, columns: Any, which: int) -> dict[tuple[str, int], Any]:
    """The numbers of one environment by their places."""
    return {
        (leaf.buffer, leaf.first + k): element
        for leaf, column in zip(jax.tree.leaves(inputs), jax.tree.leaves(columns), strict=True)
        for k, element in enumerate(column[which].ravel())
    }


def compare(function: Callable[..., Any], *columns: Any, rtol: float = 1e-6) -> list[str]:
    """Compare a function's graph with JAX in all environments; return the operations of its nodes."""
    graph, stores, _, inputs, _ = make_stores(function, columns)
    values, expected = [value for _, _, value in stores], jax.jit(jax.vmap(function))(*columns)
    for which in range(len(jax.tree.leaves(columns)[0])):
        direct = Direct(graph, given(inputs, columns, which))
        flat = np.concatenate([np.ravel(leaf[which]) for leaf in jax.tree.leaves(expected)])
        np.testing.assert_allclose([float(direct(value)) for value in values], flat, rtol=rtol, atol=0)
    return graph.ops


@pytest.mark.parametrize("group", ["a", "f", "m", "r", "x"])
def test_the_values_of_every_block_are_those_of_jax(group: str) -> None:
    """In three environments, by numpy on one value after the other."""
    graph, values, inputs = meant(group)
    columns = random_arrays(0)
    expected = jax.jit(jax.vmap(partial(all_blocks, group)))(columns)
    for which in range(3):
        direct = Direct(graph, given(inputs, (columns,), which))
        found = iter(values)
        for name, column in sorted(expected.items()):
            mine = np.array([direct(next(found)) for _ in column[which].ravel()], column.dtype)
            np.testing.assert_allclose(mine, np.ravel(column[which]), rtol=1e-5, atol=1e-6, err_msg=name)


X = np.float32([-3.0, -0.5, 0.25, 1.5, 20.0])


def test_whole_powers_are_products_up_to_the_eighth() -> None:
    """Without a call of `pow`, which costs more than squaring."""
    compare(
        lambda x: [x**k for k in range(-9, 10)] + [lax.pow(abs(x), np.float32(y)) for y in (0.5, 2.5)], X, rtol=1e-5
    )
    for k, few in ((2, 2), (3, 3), (4, 3), (5, 4), (8, 4), (-8, 5)):
        operations = compare(lambda x, k=k: lax.pow(x, np.float32(k)), X, rtol=1e-5)
        assert len(operations) <= few and set(operations) <= {"load", "mul", "div"}, k


def test_an_exponential_reaches_to_the_ends_of_single_precision() -> None:
    ends = np.float32([-87.4, -86.99, -86.4, -80.0, 0.0, 80.0, 87.5, 88.0, 88.5, 88.71])
    compare(lambda x: jnp.where(x < -87, 0, jnp.exp(x)), ends, rtol=3e-6)
    compare(jnp.exp, np.float32([-200.0, 88.8, 200.0]))


def test_infinite_limits_are_none() -> None:
    """A clip at infinity is no operation."""
    inf = np.float32(np.inf)
    found = compare(lambda x: [lax.max(x, -inf), lax.min(x, inf), lax.max(x, inf), lax.min(-inf, x)], X)
    assert found == ["load"]


def test_scans_that_are_unrolled_take_rows_of_constants_and_of_values() -> None:
    rows, flags = np.arange(6, dtype=np.float32).reshape(3, 2), np.array([True, False, True])

    def function(x: Any) -> Any:
        def step(c: Any, row: Any) -> Any:
            fixed, moving, flag = row
            return c * 0.5 + fixed[0] - fixed[1] * moving, (c, fixed * 2, jnp.where(flag, c, moving))

        start, own = x, jnp.stack([x, x + 1, x * 2])
        forth = lax.scan(step, start, (rows, own, flags), unroll=True)
        back = lax.scan(step, start, (rows, own, flags), unroll=3, reverse=True)
        none = lax.scan(step, start, (rows[:0], own[:0], flags[:0]), unroll=True)
        constant = lax.scan(lambda c, row: (c, row.sum()), x, rows, unroll=True)
        return forth, back, none[0], constant

    compare(function, X)


def test_loops_count_and_carry_as_jax_has_them() -> None:
    rows = np.linspace(-1, 1, 10, dtype=np.float32).reshape(5, 2)

    def function(x: Any, n: Any) -> Any:
        forth = lax.scan(lambda c, row: (c + row[0] * x, (c, row[1] * c)), x, rows)
        back = lax.scan(lambda c, row: (c * 0.9 + row[1], c), x, rows, reverse=True)
        rounds = lax.while_loop(lambda s: s[0] < n, lambda s: (s[0] + 1, s[1] * 0.5 + x), (jnp.int32(0), x))
        nested = lax.fori_loop(0, 3, lambda k, c: lax.fori_loop(0, 2, lambda j, d: d * 0.5 + k - j, c), x)
        chosen = lax.switch(n, [lambda x: x, lambda x: x * 2, lambda x: -x], x)
        return forth, back, rounds, nested, chosen, lax.cond(x > 0, lambda: (x, n), lambda: (-x, n + 1))

    compare(function, X, np.int32([0, 1, 2, 5, -1]), rtol=1e-5)


def test_functions_of_known_numbers_are_numbers() -> None:
    def function(x: Any) -> Any:
        known = x - x + np.float32(0.3)
        return [f(known) for f in (jnp.sin, jnp.cos, jnp.exp, jnp.tan, jnp.log1p)]

    assert compare(function, X) == ["load"]


def test_a_switch_takes_the_branch_of_its_number_or_the_nearest() -> None:
    branches = [lambda x: x + 1, lambda x: x * 3, lambda x: -x, lambda x: x / 4, lambda x: x * x]
    compare(lambda n, x: lax.switch(n, branches, x), np.int32([-2, 0, 1, 2, 3, 4, 9]), np.float32(range(7)))


def test_whole_numbers_divide_as_in_jax() -> None:
    ends = np.array([0, 1, 2, 7, 2**31 - 1, 2**31, 2**32 - 1], np.uint32)
    a, b = (pair.ravel() for pair in np.meshgrid(ends, ends))
    compare(lambda a, b: (lax.div(a, b), lax.rem(a, b)), a, b)
    compare(lambda a, b: (lax.div(a, b), lax.rem(a, b)), a.view(np.int32), b.view(np.int32))


def test_truths_are_compared_as_zero_and_one() -> None:
    a, b = np.array([False, False, True, True]), np.array([False, True, False, True])
    operations = (lax.lt, lax.le, lax.gt, lax.ge, lax.eq, lax.ne, lax.max, lax.min, lax.bitwise_and, lax.bitwise_xor)
    compare(lambda a, b: [operation(a, b) for operation in operations], a, b)


def test_windows_that_reach_out_are_filled_or_moved() -> None:
    """Gathers at places that are not known, of constants and of values, within and without their range."""
    table = np.arange(40, dtype=np.float32).reshape(20, 2)

    def function(k: Any, x: Any) -> Any:
        own = jnp.stack([x, x + 1, x * 2, -x])
        return [
            jnp.asarray(part).at[k].get(mode=mode, fill_value=-7.0)
            for part in (table[:, 0], table[:5, 1], own)
            for mode in ("fill", "clip")
        ] + [lax.dynamic_slice(own, (k,), (2,)), lax.dynamic_slice(jnp.asarray(table), (k, k), (2, 1))]

    compare(function, np.int32([-30, -4, -1, 0, 1, 3, 4, 5, 18, 19, 20, 50]), np.float32(range(12)))
