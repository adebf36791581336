"""The schedule of the fused engine's compiler: where and when values are computed."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jax import lax

from surgical_marl.engines.fused.compiler import interpret, trace
from surgical_marl.engines.fused.graph import Branch, Graph, Loop
from surgical_marl.engines.fused.schedule import Schedule
from surgical_marl.engines.fused.symbolic_array import Table
from tests.helpers.fused_blocks import all_blocks, random_arrays
from tests.helpers.fused_kernels import make_stores
from tests.helpers.fused_programs import programs, several
from tests.helpers.fused_schedules import Scheduled, assert_schedule_is_right, schedule_of


def schedule(function: Callable[..., Any], *arguments: Any) -> tuple[Graph, Schedule]:
    """Of a function of float32 scalars, or of columns."""
    columns = arguments or (np.zeros(1, np.float32),) * function.__code__.co_argcount
    graph, stores, *_ = make_stores(function, columns)
    return graph, schedule_of(graph, [value for _, _, value in stores])


def where(graph: Graph, plan: Schedule, op: str) -> list[int]:
    """The regions that compute values of an operation."""
    return [
        number
        for number, region in enumerate(plan.regions)
        for kind, item in region.items
        if kind == "node" and graph.ops[item] == op
    ]


def test_a_value_of_one_side_is_computed_there() -> None:
    """Also if it was computed before the branch, as JAX's operands are."""

    def function(x: Any, y: Any) -> Any:
        angle = jnp.tan(y)
        return lax.cond(x > 0, lambda: angle * lax.acos(x), lambda: lax.asin(y))

    graph, plan = schedule(function)
    ((chosen, other),) = plan.inside.values()
    assert where(graph, plan, "tan") == where(graph, plan, "acos") == [chosen]
    assert where(graph, plan, "asin") == [other]


def test_a_value_of_both_sides_is_computed_in_each_or_before() -> None:
    def function(x: Any, y: Any) -> Any:
        before = jnp.tan(x)
        return lax.cond(x > 0, lambda: before + lax.acos(y), lambda: before - lax.acos(y))

    graph, plan = schedule(function)
    assert where(graph, plan, "tan") == [0]
    assert sorted(where(graph, plan, "acos")) == [1, 2]


def test_a_loop_invariant_leaves_the_loop() -> None:
    """Even from a branch and from two loops; what depends on a round does not."""

    def function(x: Any, y: Any) -> Any:
        def inner(k: Any, s: Any) -> Any:
            return lax.cond(s > 0, lambda: s + jnp.tan(x), lambda: s - 1) + lax.acos(s)

        def outer(k: Any, s: Any) -> Any:
            return lax.fori_loop(0, 5, inner, s) + lax.asin(s)

        return lax.fori_loop(0, 4, outer, y)

    graph, plan = schedule(function)
    assert where(graph, plan, "tan") == [0]
    (asin,), (acos,) = where(graph, plan, "asin"), where(graph, plan, "acos")
    assert plan.regions[asin].depth == 1 and plan.regions[acos].depth == 2


def test_a_search_stays_where_it_is_meant_to_be() -> None:
    """It might never end where it was not asked for."""

    def function(x: Any, y: Any) -> Any:
        def step(k: Any, s: Any) -> Any:
            found = lax.cond(y > 0, lambda: lax.while_loop(lambda v: v < 9, lambda v: v * y, x), lambda: x)
            return s + jnp.tan(found)

        return lax.fori_loop(0, 4, step, x)

    graph, plan = schedule(function)
    (search,) = (number for number, group in enumerate(graph.groups) if getattr(group, "condition", None) is not None
                 and isinstance(group, Loop) and number in plan.inside)  # fmt: skip
    region = plan.regions[plan.inside[search][0]]
    assert region.depth == 3 and where(graph, plan, "tan") != [0]


def test_what_no_result_needs_is_left_out() -> None:
    def function(x: Any, y: Any) -> Any:
        step = lambda k, s: (s[0] + 1, s[1] + jnp.tan(s[0]), s[2] + lax.acos(y))  # noqa: E731
        return lax.fori_loop(0, 4, step, (x, x, x))[0], lax.cond(x > 0, lambda: (x, lax.asin(y)), lambda: (y, y))[0]

    graph, plan = schedule(function)
    assert not any(where(graph, plan, op) for op in ("tan", "acos", "asin"))
    assert {len(wanted) for wanted in plan.live.values()} == {1}


@pytest.mark.parametrize("side", ["same", "put", "loop", "other"])
@pytest.mark.parametrize("condition", [-1.0, 1.0])
def test_a_branch_changes_an_array_where_it_is(side: str, condition: float) -> None:
    """One side puts two values into it, and the other leaves it alone or changes it, too; but not if it is another."""

    def function(x: Any, i: Any, y: Any, values: Any, more: Any) -> Any:
        array, other = values.at[i].set(y), more.at[i].set(x)
        sides = {
            "same": lambda a: a,
            "put": lambda a: a.at[i + 1].set(2 * y),
            "loop": lambda a: lax.fori_loop(0, 3, lambda k, b: b.at[k].set(b[k] + y), a),
            "other": lambda a: other,
        }
        return lax.cond(x > 0, lambda a: a.at[i].set(x).at[i + 2].add(y), sides[side], array)

    rng = np.random.default_rng(0)
    columns = (
        np.array([condition], np.float32), np.array([1], np.int32), np.array([3.0], np.float32),
        *rng.normal(size=(2, 1, 5)).astype(np.float32),
    )  # fmt: skip
    _, plan = schedule(function, *columns)
    assert len(plan.merged) == (side != "other")
    assert_schedule_is_right(function, *columns)


COLUMNS = (
    np.ones(1, np.float32), np.ones(1, np.int32), np.full(1, 3.0, np.float32),
    np.random.default_rng(0).normal(size=(1, 5)).astype(np.float32),
)  # fmt: skip


def test_what_was_read_of_an_array_is_read_before_it_changes() -> None:
    """Before a branch and within one of its sides, also in a loop there. What is read later finds it unchanged."""

    def function(x: Any, i: Any, y: Any, values: Any, late: bool = False) -> Any:
        array = values.at[i].set(y)
        early = array[i + 1]

        def changed(a: Any) -> Any:
            old = a[i] + lax.fori_loop(0, 3, lambda k, s: s + a[k] * a[i + 2], x)
            return a.at[i].set(x).at[i + 1].set(y), old

        after, old = lax.cond(x > 0, changed, lambda a: (a, a[i + 2]), array)
        return after, early + old, array[i] if late else y

    for sign, late in product((1.0, -1.0), (False, True)):
        columns = np.full(1, sign, np.float32), *COLUMNS[1:]
        _, plan = schedule(partial(function, late=late), *columns)
        assert len(plan.merged) != late
        assert_schedule_is_right(partial(function, late=late), *columns)


def test_a_loop_begins_with_an_array_that_nobody_reads_any_more() -> None:
    def function(x: Any, i: Any, y: Any, values: Any, late: bool = False) -> Any:
        array = values.at[i].set(y)
        early = array[i]
        out = lax.fori_loop(0, 4, lambda k, a: a.at[k].set(a[k + 1] + x), array)
        return out, early, array[i + 1] if late else y

    for late in (False, True):
        graph, plan = schedule(partial(function, late=late), *COLUMNS)
        assert any(graph.ops[value] == "out" for value in plan.in_place) != late
        assert_schedule_is_right(partial(function, late=late), *COLUMNS)


def test_a_loop_reads_an_array_before_it_changes() -> None:
    """Also a loop whose last result nobody needs: what it counts with ends it."""

    def function(x: Any, i: Any, y: Any, values: Any) -> Any:
        array = values.at[i].set(y)
        step = lambda s: (s[0] + array[i + 1], s[1] + 1)  # noqa: E731
        total, _ = lax.while_loop(lambda s: s[1] < y, step, (x, x))
        return array.at[i].set(x), total

    _, plan = schedule(function, *COLUMNS)
    assert plan.overwritten
    assert_schedule_is_right(function, *COLUMNS)


def test_the_sides_of_a_branch_fill_its_result() -> None:
    def function(x: Any, i: Any, y: Any, values: Any) -> Any:
        return lax.cond(x > 0, lambda: lax.map(lambda v: v * x, values), lambda: lax.map(lambda v: v - y, values))[i]

    graph, plan = schedule(function, *COLUMNS)
    (branch,) = (group for group in graph.groups if isinstance(group, Branch))
    assert list(plan.destination.values()) == 2 * [branch.outs[0]]
    assert_schedule_is_right(function, *COLUMNS)


def test_an_array_that_an_inner_loop_changes_is_made_near_it() -> None:
    """Made before the outer loop it would be copied in each round, though no round makes another."""

    def function(x: Any, i: Any, y: Any, values: Any, changes: bool) -> Any:
        def outer(_: Any, total: Any) -> Any:
            made = lax.cond(x > 0, lambda: lax.map(lambda v: v * x, values), lambda: lax.map(lambda v: v - y, values))
            inner = lambda k, a: a.at[k].add(total)  # noqa: E731
            return total + (lax.fori_loop(0, 3, inner, made) if changes else made)[i]

        return lax.fori_loop(0, 2, outer, y)

    for changes in (False, True):
        graph, plan = schedule(partial(function, changes=changes), *COLUMNS)
        (branch,) = (number for number in plan.inside if isinstance(graph.groups[number], Branch))
        (region,) = (k for k, each in enumerate(plan.regions) if ("group", branch) in each.items)
        assert (plan.regions[region].loop >= 0) == changes
        assert_schedule_is_right(partial(function, changes=changes), *COLUMNS)


def test_the_schedule_of_every_block() -> None:
    for group in ("a", "f", "m", "r", "x"):
        assert_schedule_is_right(partial(all_blocks, group), random_arrays(0))


@settings(max_examples=30, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(st.lists(programs(2), min_size=1, max_size=1))
def test_the_schedule_of_programs(written: list[list[Any]]) -> None:
    assert_schedule_is_right(partial(several, written), random_arrays(0))


def test_rows_of_parameters() -> None:
    """What a loop reads of a parameter is looked up at its counter, also row by row in a loop within the loop."""
    values = np.random.default_rng(0).uniform(-1, 1, (6, 4, 3)).astype(np.float32)
    truths = np.arange(24).reshape(6, 4) % 3 == 0

    def function(parameters: Any) -> Any:
        def inner(c: Any, row: Any) -> Any:
            return c / 2 + row[0][0] * row[0][1], jnp.where(row[1], c, row[0][2])

        outer = lax.scan(lambda c, rows: lax.scan(inner, c, rows), 0.5, parameters, reverse=True)
        return outer, lax.scan(inner, 1.5, (parameters[0][2], parameters[1][0]), unroll=True)

    g, shapes = Graph(), (jax.ShapeDtypeStruct((6, 4, 3), np.float32), jax.ShapeDtypeStruct((6, 4), bool))
    tables = [
        Table(g.input_table(values.ravel()), (6, 4, 3), values.dtype),
        Table(g.input_table(truths.ravel().astype(np.int32)), (6, 4), truths.dtype),
    ]
    leaves = interpret(g, trace(function, shapes), (), tables)
    results = [value for leaf in leaves for value in leaf]
    plan = schedule_of(g, results)
    assert sum(len(region.items) for region in plan.regions) < 250
    found = Scheduled(g, plan, {}).results(results)
    expected = [np.ravel(leaf) for leaf in jax.tree.leaves(function((jnp.asarray(values), jnp.asarray(truths))))]
    np.testing.assert_allclose(found, np.concatenate(expected), rtol=1e-6)
