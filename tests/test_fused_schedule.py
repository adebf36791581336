"""The schedule of the fused engine's compiler: where and when values are computed."""

from __future__ import annotations

from collections import ChainMap, Counter
from collections.abc import Callable, Mapping
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

from surgical_marl.engines.fused.graph import Branch, Graph, Loop, Value
from surgical_marl.engines.fused.operations import DTYPES, FOLD
from surgical_marl.engines.fused.schedule import Schedule, Scheduler
from surgical_marl.engines.fused.traced import Table
from surgical_marl.engines.fused.translate import trace
from tests.helpers.fused_blocks import all_blocks, random_arrays
from tests.helpers.fused_kernels import make_stores
from tests.helpers.fused_programs import programs, several


def schedule(function: Callable[..., Any], *arguments: Any) -> tuple[Graph, Schedule]:
    """Of a function of float32 scalars, or of columns."""
    columns = arguments or (np.zeros(1, np.float32),) * function.__code__.co_argcount
    graph, stores, *_ = make_stores(function, columns)
    return graph, Scheduler(graph, [value for _, _, value in stores]).run()


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
    assert {len(wanted) for wanted in plan.alive.values()} == {1}


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
    assert len(plan.kept) == (side != "other")
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
        assert len(plan.kept) != late
        assert_schedule_is_right(partial(function, late=late), *columns)


def test_a_loop_begins_with_an_array_that_nobody_reads_any_more() -> None:
    def function(x: Any, i: Any, y: Any, values: Any, late: bool = False) -> Any:
        array = values.at[i].set(y)
        early = array[i]
        out = lax.fori_loop(0, 4, lambda k, a: a.at[k].set(a[k + 1] + x), array)
        return out, early, array[i + 1] if late else y

    for late in (False, True):
        graph, plan = schedule(partial(function, late=late), *COLUMNS)
        assert any(graph.ops[value] == "out" for value in plan.takers) != late
        assert_schedule_is_right(partial(function, late=late), *COLUMNS)


def test_the_sides_of_a_branch_fill_its_result() -> None:
    def function(x: Any, i: Any, y: Any, values: Any) -> Any:
        return lax.cond(x > 0, lambda: lax.map(lambda v: v * x, values), lambda: lax.map(lambda v: v - y, values))[i]

    graph, plan = schedule(function, *COLUMNS)
    (branch,) = (group for group in graph.groups if isinstance(group, Branch))
    assert list(plan.given.values()) == 2 * [branch.outs[0]]
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


class Direct:
    """Values of a graph for one environment, each computed when it is asked for: what the schedule has to amount to."""

    def __init__(self, graph: Graph, loads: Mapping[tuple[str, int], Any]) -> None:
        self.graph, self.loads, self.known = graph, loads, {}  # type: ignore[var-annotated]

    def __call__(self, value: Value) -> Any:
        if value < 0:
            return self.graph.constants[~value]
        stack = [value]  # rather than calls within calls, which go too deep
        while stack:
            missing = [] if stack[-1] in self.known else [a for a in self._reads(stack[-1]) if a not in self.known]
            stack.extend(missing)
            if not missing:
                node = stack.pop()
                if node not in self.known:
                    self.known[node] = self._compute(node)
        return self.known[value]

    def _reads(self, node: Value) -> list[Value]:
        op, args = self.graph.ops[node], self.graph.args[node]
        if op == "out" and isinstance(group := self.graph.groups[args[0]], Branch):
            condition = group.condition
            if condition not in self.known:
                return [condition]
            read = (group.chosen if self.known[condition] else group.others)[args[1]]
            return [read] if read >= 0 else []
        return self.graph.reads(node)

    def _compute(self, node: Value) -> Any:
        op, args = self.graph.ops[node], self.graph.args[node]
        if op != "out":
            return compute(self.graph, node, self, self.loads)
        group = self.graph.groups[args[0]]
        if isinstance(group, Branch):
            return self((group.chosen if self(group.condition) else group.others)[args[1]])
        self.known.update(zip(group.outs, self._loop(group), strict=True))  # all of them at once
        return self.known[node]

    def _loop(self, loop: Loop) -> list[Any]:
        outside, values, count = self.known, [self(start) for start in loop.starts], 0
        while True:
            row = loop.length - 1 - count if loop.backwards else count
            self.known = {**outside, **dict(zip(loop.phis, values, strict=True)), loop.counter: np.int32(row)}
            if not (count < loop.length if loop.condition is None else self(loop.condition)):
                break
            values, count = [self(value) for value in loop.nexts], count + 1
        self.known = outside
        return values


def compute(g: Graph, node: Value, read: Callable[[Value], Any], loads: Mapping[tuple[str, int], Any]) -> Any:
    op, args = g.ops[node], g.args[node]
    if op == "load":
        return loads[args]
    if op == "lookup":
        return g.tables[args[0]][int(read(args[1]))]
    if op == "select":
        return read(args[2]) if read(args[0]) else read(args[1])
    if op == "room":
        return np.zeros(int(g.kinds[node][1:]), DTYPES[g.kinds[node][0]])
    if op == "array":
        return np.array([read(value) for value in args])
    if op == "read":
        return read(args[0])[int(read(args[1]))]
    if op == "put":
        start, values = int(read(args[1])), [read(value) for value in args[2:]]
        return np.concatenate([read(args[0])[:start], values, read(args[0])[start + len(values) :]])
    with np.errstate(all="ignore"):
        return np.asarray(FOLD[op](*map(read, args)))[()]


class Scheduled:
    """Values of a graph for one environment, computed as a schedule has them. KeyError for one that comes too late.

    What takes over the memory of an array changes it there: whatever reads the array afterwards reads something else,
    and what a branch leaves where it is has whatever its sides have put there.
    """

    def __init__(self, graph: Graph, plan: Schedule, loads: Mapping[tuple[str, int], Any]) -> None:
        self.graph, self.plan, self.loads = graph, plan, loads

    def results(self, values: list[Value]) -> list[Any]:
        found: dict[int, Any] = {}
        self._region(0, ChainMap(), lambda k, read: found.__setitem__(k, read(values[k])))
        return [found[k] for k in range(len(values))]

    def _region(self, number: int, known: Any, result: Callable[[int, Callable[[Value], Any]], Any]) -> bool:
        """Whether `result` let it come to its end."""

        def read(value: Value) -> Any:
            return known[value] if value >= 0 else self.graph.constants[~value]

        for kind, item in self.plan.regions[number].items:
            if kind == "node" and item in self.plan.takers:
                array, index, *values = map(read, self.graph.args[item])
                array[int(index) : int(index) + len(values)] = values
                known[item] = array
            elif kind == "node":
                known[item] = compute(self.graph, item, read, self.loads)
            elif kind == "group":
                group = self.graph.groups[item]
                (self._branch if isinstance(group, Branch) else self._loop)(item, group, known, read)  # type: ignore
            elif result(item, read) is False:
                return False
        return True

    def _branch(self, number: int, branch: Branch, known: Any, read: Callable[[Value], Any]) -> None:
        wanted, taken = self.plan.alive[number], bool(read(branch.condition))
        values, found = (branch.chosen if taken else branch.others), {}
        region = self.plan.inside[number][0 if taken else 1]
        self._region(region, known.new_child(), lambda k, read: found.__setitem__(k, read(values[wanted[k]])))
        found = {branch.outs[j]: found[k] for k, j in enumerate(wanted)}
        # what is left where it is, is what the array's memory now holds; all else is in memory of the branch
        known.update(
            {out: read(self.plan.kept[out]) if out in self.plan.kept else np.array(new) for out, new in found.items()}
        )

    def _loop(self, number: int, loop: Loop, known: Any, read: Callable[[Value], Any]) -> None:
        wanted, tested, count = self.plan.alive[number], loop.condition is not None, 0
        taken = [loop.outs[j] in self.plan.takers for j in wanted]
        starts = [read(loop.starts[j]) for j in wanted]
        values = [start if takes else np.array(start) for start, takes in zip(starts, taken, strict=True)]
        while tested or count < loop.length:
            found: list[Any] = []

            def result(k: int, read: Callable[[Value], Any], found: list[Any] = found) -> bool:
                if tested and k == 0:
                    return bool(read(loop.condition))  # type: ignore[arg-type]
                found.append(np.array(read(loop.nexts[wanted[k - tested]])))
                return True

            inside = known.new_child(dict(zip((loop.phis[j] for j in wanted), values, strict=True)))
            inside[loop.counter] = np.int32(loop.length - 1 - count if loop.backwards else count)
            if not self._region(self.plan.inside[number][0], inside, result):
                break
            for value, new, takes in zip(values, found, taken, strict=True):
                if takes:
                    value[:] = new
            values = [value if takes else new for value, new, takes in zip(values, found, taken, strict=True)]
            count += 1
        known.update({loop.outs[j]: value for j, value in zip(wanted, values, strict=True)})


def assert_schedule_is_right(function: Callable[..., Any], *columns: Any) -> None:
    """For the first environment of columns [N, ...] it gives what the graph says, and computes everything once."""
    graph, stores, _, inputs, _ = make_stores(function, columns)
    loads = {
        (leaf.buffer, leaf.first + k): element
        for leaf, column in zip(jax.tree.leaves(inputs), jax.tree.leaves(columns), strict=True)
        for k, element in enumerate(column[0].ravel())
    }
    values = [value for _, _, value in stores]
    plan = Scheduler(graph, values).run()
    computed = Counter(item for region in plan.regions for item in region.items if item[0] != "result")
    assert set(computed.values()) <= {1}
    direct = Direct(graph, loads)
    np.testing.assert_array_equal(Scheduled(graph, plan, loads).results(values), [direct(value) for value in values])


def test_the_schedule_of_every_block() -> None:
    for group in ("a", "f", "m", "r", "x"):
        assert_schedule_is_right(partial(all_blocks, group), random_arrays(0))


@settings(max_examples=50, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
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
    leaves, _ = trace(g, function, (), tables, shapes)
    results = [value for leaf in leaves for value in leaf]
    plan = Scheduler(g, results).run()
    assert sum(len(region.items) for region in plan.regions) < 250
    found = Scheduled(g, plan, {}).results(results)
    expected = [np.ravel(leaf) for leaf in jax.tree.leaves(function((jnp.asarray(values), jnp.asarray(truths))))]
    np.testing.assert_allclose(found, np.concatenate(expected), rtol=1e-6)
