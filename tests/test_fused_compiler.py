"""The parts of the fused engine's compiler: its graph, where and when values are computed, and the code for them."""

from __future__ import annotations

import re
from collections import ChainMap, Counter
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jax import lax

from fused_blocks import all_blocks, programs, random_arrays, several
from fused_kernels import make_stores, run
from surgical_marl.engines.fused import kernel
from surgical_marl.engines.fused.emit import Emitter
from surgical_marl.engines.fused.graph import DTYPES, FOLD, KINDS, Branch, Graph, Loop, Value
from surgical_marl.engines.fused.preludes import CUDA, UNDEFINE
from surgical_marl.engines.fused.schedule import Schedule, Scheduler
from surgical_marl.engines.fused.traced import Unsupported

RNG = np.random.default_rng(2)

# -- graph


def load(g: Graph, kind: str, field: int = 0) -> Value:
    return g.node("load", "state", field, kind=kind)


def real(g: Graph, number: float) -> Value:
    return g.constant(np.float32(number))


SIMPLER: dict[str, tuple[Callable[..., Value], Callable[..., Value]]] = {
    "x + 0": (lambda g, x, y: g.add(g.zero, x), lambda g, x, y: x),
    "x - 0": (lambda g, x, y: g.sub(x, real(g, -0.0)), lambda g, x, y: x),
    "0 - x": (lambda g, x, y: g.sub(g.zero, x), lambda g, x, y: g.neg(x)),
    "x - x": (lambda g, x, y: g.sub(x, x), lambda g, x, y: g.zero),
    "x + -y": (lambda g, x, y: g.add(x, g.neg(y)), lambda g, x, y: g.sub(x, y)),
    "x - -y": (lambda g, x, y: g.sub(x, g.neg(y)), lambda g, x, y: g.add(y, x)),
    "-(x - y)": (lambda g, x, y: g.neg(g.sub(x, y)), lambda g, x, y: g.sub(y, x)),
    "--x": (lambda g, x, y: g.neg(g.neg(x)), lambda g, x, y: x),
    "x 0": (lambda g, x, y: g.mul(x, g.zero), lambda g, x, y: g.zero),
    "x 1": (lambda g, x, y: g.mul(x, g.one), lambda g, x, y: x),
    "x -1": (lambda g, x, y: g.mul(real(g, -1), x), lambda g, x, y: g.neg(x)),
    "2 (3 x)": (lambda g, x, y: g.mul(real(g, 2), g.mul(x, real(g, 3))), lambda g, x, y: g.mul(real(g, 6), x)),
    "2 -x": (lambda g, x, y: g.mul(g.neg(x), real(g, 2)), lambda g, x, y: g.mul(real(g, -2), x)),
    "-x -y": (lambda g, x, y: g.mul(g.neg(x), g.neg(y)), lambda g, x, y: g.mul(y, x)),
    "x / 4": (lambda g, x, y: g.div(x, real(g, 4)), lambda g, x, y: g.mul(x, real(g, 0.25))),
    "0 / x": (lambda g, x, y: g.div(g.zero, x), lambda g, x, y: g.zero),
    "1 / 3": (lambda g, x, y: g.div(g.one, real(g, 3)), lambda g, x, y: real(g, np.float32(1) / np.float32(3))),
    "x < x": (lambda g, x, y: g.compare("lt", x, x), lambda g, x, y: g.false),
    "x <= x": (lambda g, x, y: g.compare("le", x, x), lambda g, x, y: g.true),
    "max(x, x)": (lambda g, x, y: g.extreme("max", x, x), lambda g, x, y: x),
    "max(x, -inf)": (lambda g, x, y: g.extreme("max", real(g, -np.inf), x), lambda g, x, y: x),
    "min(x, -inf)": (lambda g, x, y: g.extreme("min", x, real(g, -np.inf)), lambda g, x, y: real(g, -np.inf)),
    "not not a": (lambda g, x, y: g.invert(g.invert(less(g, x, y))), lambda g, x, y: less(g, x, y)),
    "a and true": (lambda g, x, y: g.logic("and", g.true, less(g, x, y)), lambda g, x, y: less(g, x, y)),
    "a and false": (lambda g, x, y: g.logic("and", less(g, x, y), g.false), lambda g, x, y: g.false),
    "a or true": (lambda g, x, y: g.logic("or", less(g, x, y), g.true), lambda g, x, y: g.true),
    "a xor true": (lambda g, x, y: g.logic("xor", less(g, x, y), g.true), lambda g, x, y: g.invert(less(g, x, y))),
    "a xor a": (lambda g, x, y: g.logic("xor", less(g, x, y), less(g, x, y)), lambda g, x, y: g.false),
    "x if true else y": (lambda g, x, y: g.select(g.true, y, x), lambda g, x, y: x),
    "x if a else x": (lambda g, x, y: g.select(less(g, x, y), x, x), lambda g, x, y: x),
    "x if not a else y": (
        lambda g, x, y: g.select(g.invert(less(g, x, y)), y, x), lambda g, x, y: g.select(less(g, x, y), x, y)),
    "a choice within its own": (
        lambda g, x, y: g.select(less(g, x, y), g.zero, g.select(less(g, x, y), y, x)),
        lambda g, x, y: g.select(less(g, x, y), g.zero, x)),
    "(1 if a else 0) > 0": (
        lambda g, x, y: g.compare("lt", g.zero, g.select(less(g, x, y), g.zero, g.one)),
        lambda g, x, y: less(g, x, y)),
    "a if a else false": (
        lambda g, x, y: g.select(less(g, x, y), g.false, less(g, x, y)), lambda g, x, y: less(g, x, y)),
}  # fmt: skip


def less(g: Graph, x: Value, y: Value) -> Value:
    return g.compare("lt", x, y)


@pytest.mark.parametrize("name", SIMPLER)
def test_a_graph_is_simplified(name: str) -> None:
    g = Graph()
    x, y = load(g, "f", 0), load(g, "f", 1)
    written, simpler = SIMPLER[name]
    assert written(g, x, y) == simpler(g, x, y)


def test_what_is_not_a_number_is_kept() -> None:
    g = Graph()
    x, count = load(g, "f"), load(g, "i")
    assert g.compare("ne", x, x) != g.false and g.compare("eq", x, x) != g.true
    assert g.compare("ne", count, count) == g.false


@pytest.mark.parametrize("op", FOLD)
def test_constants_are_folded(op: str) -> None:
    """To what numpy makes of them, without a node."""
    g = Graph()
    kinds = {"f2i": "f", "f2u": "f", "i2f": "i", "i2u": "i", "u2f": "u", "u2i": "u", "bits": "f", "float": "u",
             "and": "iub", "or": "iub", "xor": "iub", "not": "iub", "shl": "iu", "shr": "u", "sar": "i"}  # fmt: skip
    whole = {"add", "sub", "mul", "div", "rem", "neg", "abs", "max", "min", "lt", "le", "gt", "ge", "eq", "ne"}
    for kind in kinds.get(op, "fiu" if op in whole else "f"):
        pair = [g.constant(DTYPES[kind](value)) for value in (1, 1)]
        for arguments in (pair[:1], pair):
            try:
                expected = FOLD[op](*(g.constants[~a] for a in arguments))
            except TypeError:  # the other number of arguments
                continue
            found = (g.unary if len(arguments) == 1 else g.binary)(op, *arguments)
            assert found < 0 and g.constants[~found] == expected, (op, kind)
    assert not g.ops


def test_equal_values_are_one() -> None:
    g = Graph()
    x, y = load(g, "f", 0), load(g, "f", 1)
    assert load(g, "f", 0) == x
    assert g.add(x, y) == g.add(y, x) and g.sub(x, y) != g.sub(y, x)
    assert real(g, 0.0) == real(g, -0.0) and real(g, np.nan) == real(g, np.nan)
    assert len({g.constant(DTYPES[kind](0)) for kind in KINDS.values()}) == 4
    assert len({g.constant(DTYPES[kind](1)) for kind in KINDS.values()}) == 4
    assert g.fresh("phi", 0, 0, kind="f") != g.fresh("phi", 0, 0, kind="f")
    table = np.arange(20, dtype=np.float32)
    numbers = [g.table(table), g.table(table.copy()), g.table(table.astype(np.int32)), g.table(table[:19])]
    assert numbers == [0, 0, 1, 2] and len(g.tables) == 3
    assert g.lookup(0, g.constant(np.int32(7))) == real(g, 7)


def test_a_scope_shares_only_what_costs_nothing() -> None:
    g = Graph()
    x, y = load(g, "f", 0), load(g, "f", 1)
    total = g.add(x, y)
    g.open_scope()
    inner = g.add(x, y)
    assert inner != total and g.add(y, x) == inner and load(g, "f", 0) == x
    g.close_scope()
    assert g.add(x, y) == total


# -- schedule


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
        return self._loop(group)[args[1]]

    def _loop(self, loop: Loop) -> list[Any]:
        outside, values, count = self.known, [self(start) for start in loop.starts], 0
        while True:
            self.known = {**outside, **dict(zip(loop.phis, values, strict=True))}
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
    with np.errstate(all="ignore"):
        return np.asarray(FOLD[op](*map(read, args)))[()]


class Scheduled:
    """Values of a graph for one environment, computed as a schedule has them. KeyError for one that comes too late."""

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
            if kind == "node":
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
        known.update({branch.outs[j]: found[k] for k, j in enumerate(wanted)})

    def _loop(self, number: int, loop: Loop, known: Any, read: Callable[[Value], Any]) -> None:
        wanted, tested, count = self.plan.alive[number], loop.condition is not None, 0
        values = [read(loop.starts[j]) for j in wanted]
        while tested or count < loop.length:
            found: list[Any] = []

            def result(k: int, read: Callable[[Value], Any], found: list[Any] = found) -> bool:
                if tested and k == 0:
                    return bool(read(loop.condition))  # type: ignore[arg-type]
                found.append(read(loop.nexts[wanted[k - tested]]))
                return True

            inside = known.new_child(dict(zip((loop.phis[j] for j in wanted), values, strict=True)))
            if not self._region(self.plan.inside[number][0], inside, result):
                break
            values, count = found, count + 1
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
    for group in ("a", "f", "m", "x"):
        assert_schedule_is_right(partial(all_blocks, group), random_arrays(0))


@settings(max_examples=50, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(st.lists(programs(2), min_size=1, max_size=1))
def test_the_schedule_of_programs(written: list[list[Any]]) -> None:
    assert_schedule_is_right(partial(several, written), random_arrays(0))


# -- code


def body(function: Callable[..., Any], *columns: Any, vector: bool) -> str:
    graph, stores, *_ = make_stores(function, columns)
    return Emitter(graph, stores, vector).body()


def test_code_for_cuda_knows_no_vectors() -> None:
    """No blending, no masks of environments; both kinds of code give every value a name of its own."""
    written = [("search", 4, [[("block", "f: sin", (0,) * 4)]] * 2), ("cond", 0, [[("block", "a: add", (0,) * 4)]] * 2)]
    function = lambda pool: (all_blocks("", pool), several([written], pool))  # noqa: E731
    cuda, cpu = (body(function, random_arrays(0), vector=vector) for vector in (False, True))
    assert not re.search(r"vector|__builtin|LANEWISE|NOT\(v\d+\)\)\)|\bm\d+\b", cuda)
    assert re.search(r"if\(ANY\(NOT\(v\d+\)\)\)", cpu) and re.search(r"B m\d+=", cpu)
    assert not re.search(r"vector|__builtin", CUDA)
    for code in (cuda, cpu):
        declared = Counter(re.findall(r"^[FIUB] (\w+)=", code, re.M))
        assert set(declared.values()) == {1}


def test_a_field_is_not_stored_before_it_is_loaded() -> None:
    """Results may go where the arguments came from: also ones that change places."""
    columns = tuple(RNG.uniform(1, 2, (4, 5)).astype(np.float32))

    def function(a: Any, b: Any, c: Any, d: Any) -> Any:
        late = lax.cond(a > b, lambda: lax.fori_loop(0, 3, lambda k, x: x * c, d), lambda: a)
        return b, a, a + b, late

    _, stores, *_ = make_stores(function, columns, in_place=True)
    assert [field for _, field, _ in stores] == [0, 1, 2, 3]
    expected = jax.vmap(function)(*columns)
    np.testing.assert_allclose(run(function, *columns, in_place=True), expected, rtol=1e-6)


def test_many_tables() -> None:
    """They share an array of each dtype; equal ones are there once."""
    reals = RNG.normal(size=(30, 40)).astype(np.float32)
    wholes = RNG.integers(-(2**31), 2**31, (30, 40)).astype(np.int32)

    def function(k: Any) -> Any:
        once = [jnp.asarray(table)[k] for tables in (reals, wholes) for table in tables]
        return once, jnp.asarray(reals[7].copy())[k], jnp.asarray(wholes[3:5])[1, k]

    k = RNG.integers(0, 40, 5).astype(np.int32)
    graph, *_ = make_stores(function, (k,))
    assert len(graph.tables) == 61  # two rows are looked up as a table of their own
    (*once,), again, row = run(function, k)
    np.testing.assert_array_equal(once[:30], reals[:, k])
    np.testing.assert_array_equal(once[30:], wholes[:, k])
    np.testing.assert_array_equal(again, reals[7, k])
    np.testing.assert_array_equal(row, wholes[4, k])


def everything(pool: Any) -> Any:
    """Uses every operation: in a branch that is large, in loops of both sorts, and of tables."""
    arithmetic = lambda: all_blocks("a", pool) | all_blocks("f", pool)  # noqa: E731
    chosen = lax.cond(pool["b"][0][0], arithmetic, lambda: jax.tree.map(jnp.zeros_like, arithmetic()))
    step = ("block", "a: add", (0, 0, 0, 0))
    loops = several([[("search", 5, [[step]]), ("repeat", 0, [[step]])]], pool)
    return chosen, loops, all_blocks("x: table", pool), jnp.where(pool["b"][0], pool["e"][0], jnp.nan)


def test_code_for_cuda_compiles(tmp_path: Path) -> None:
    """Every macro of the prelude, by NVRTC, which needs no GPU."""
    code = body(everything, random_arrays(0), vector=False)
    used = set(re.findall(r"\w+", code))
    assert not [name for name in re.findall("^#define (\\w+)", CUDA, re.M) if name not in used]
    if 90 not in kernel.wp.get_cuda_supported_archs():
        pytest.skip("Warp has no NVRTC that knows sm_90 here")
    module = kernel.wp.get_module("surgical_marl_test_cuda")
    module.options["enable_backward"] = False
    kernel._make("test_cuda", f"{CUDA}\n{code}\n{UNDEFINE}\n", module, None)
    kernel.wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    assert list(tmp_path.glob("*.ptx"))


# -- what there is no code for


def endless(x: Any) -> Any:
    return lax.while_loop(lambda s: s[0] < 3, lambda s: (s[0] * 1, s[1] + x), (0, x))[1]


UNSUPPORTED: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "a primitive": ("the primitive sort", lambda x: lax.sort(x)),
    "complex numbers": ("arrays of complex64", lambda x: jnp.abs(jnp.fft.fft(x))),
    "within a function": ("the primitive erfc", lambda x: jax.jit(lambda x: lax.erfc(x))(x)),
    "within a branch": ("the primitive sort", lambda x: lax.cond(x[0] > 0, lambda: jnp.sort(x), lambda: x)),
    "within loops": ("the primitive cbrt", lambda x: lax.fori_loop(0, 3, lambda k, s: lax.cbrt(s), x)),
    "a dtype": ("arrays of int8", lambda x: x.astype(jnp.int8)),
    "bits of a dtype": ("arrays of uint8", lambda x: lax.bitcast_convert_type(x, jnp.uint8)),
    "a scatter": ("a scatter to places", lambda x: x.at[x.astype(int)].set(1)),
    "many keys": ("random_bits of many keys at once", lambda x: jax.vmap(jax.random.bits)(
        jax.random.split(jax.random.wrap_key_data(x.astype(jnp.uint32)[:2]), 3))),
    "a loop": ("a loop that never ends", endless),
}  # fmt: skip


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_an_error_names_what_and_where(name: str) -> None:
    """The line in this file, not one in JAX or of what called it."""
    what, function = UNSUPPORTED[name]
    with pytest.raises(Unsupported, match=rf"{what}.* at .*test_fused_compiler\.py:\d+") as caught:
        make_stores(function, (np.zeros((1, 3), np.float32),))
    line = int(re.search(r"\.py:(\d+)", caught.value.place)[1])  # type: ignore[index]
    start = function.__code__.co_firstlineno
    assert start <= line <= start + 1


def test_a_loop_of_no_rounds_is_one() -> None:
    def function(x: Any) -> Any:
        never = lax.while_loop(lambda s: s[1] < -1, lambda s: (s[0] + 1, 2), (x, 1))[0]
        return never, lax.fori_loop(0, 0, lambda k, s: s + 1, x), lax.fori_loop(3, 4, lambda k, s: s + k, x)

    x = np.arange(5, dtype=np.float32)
    np.testing.assert_array_equal(run(function, x), [x, x, x + 3])
