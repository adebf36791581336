"""The code of the fused engine's compiler: what is written for values, and what there is no code for."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from surgical_marl.engines.fused import instrumentation, kernel
from surgical_marl.engines.fused.hints import FENCE_DISTANCE
from surgical_marl.engines.fused.macros import CUDA, UNDEFINE
from surgical_marl.engines.fused.pipeline import Program, compile_program
from surgical_marl.engines.fused.symbolic_array import Unsupported
from tests.helpers.fused_blocks import all_blocks, random_arrays
from tests.helpers.fused_kernels import gpu_code, make_stores, run, worked
from tests.helpers.fused_programs import several

RNG = np.random.default_rng(2)


def body(function: Callable[..., Any], *columns: Any, vector: bool) -> str:
    graph, stores, *_ = make_stores(function, columns)
    return compile_program(Program(graph, stores, vector)).text


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


def test_nothing_is_loaded_behind_a_store() -> None:
    """A load behind a store can't begin before it; in branches, which few take, it may have to."""
    columns = tuple(RNG.uniform(1, 2, (3, 5)).astype(np.float32))

    def function(a: Any, b: Any, c: Any) -> Any:
        first = lax.fori_loop(0, 3, lambda k, x: x * x, a)
        return first, lax.fori_loop(0, 3, lambda k, x: x * x, b + first), b * c

    code = body(function, *columns, vector=False)
    memory = re.findall(r"\b(LD|ST)F\((?:state|outs),", code)
    assert memory == ["LD"] * 3 + ["ST"] * 3


def test_loops_in_loops_are_not_traced_in_all_combinations() -> None:
    """Each loop is traced until it is known what its rounds change, and an inner loop remembers what it changes."""

    def nested(depth: int) -> Callable[[Any], Any]:
        if not depth:
            return lambda x: x.at[0].set(1.5 * x[0] + x[1])
        inner = nested(depth - 1)
        return lambda x: lax.fori_loop(0, 3, lambda _, x: inner(x).at[depth].add(x[depth - 1]), x)

    tried = [len(make_stores(nested(depth), (np.ones((4, 9), np.float32),))[0].groups) for depth in (2, 4, 8)]
    assert tried[2] < 4 * tried[1] < 16 * tried[0], "twice the depth may take four times as many, and no more"
    column = np.ones((4, 9), np.float32)
    np.testing.assert_allclose(run(nested(4), column), jax.vmap(nested(4))(column), rtol=1e-5)


def test_long_code_for_a_cpu_has_fences() -> None:
    """Clang compares each store with all loads between two of them."""

    def function(x: Any) -> Any:
        for _ in range(500):
            x = jnp.sqrt(x * x + 1.0)
        return x

    cuda, cpu = (body(function, np.ones(3, np.float32), vector=vector) for vector in (False, True))
    stretches = [part.count(";") for part in cpu.split("FENCE")]
    assert len(stretches) > 10 and max(stretches) <= FENCE_DISTANCE + 5
    assert "FENCE" not in cuda


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
    return (
        chosen,
        loops,
        all_blocks("x: table", pool),
        all_blocks("r", pool),
        jnp.where(pool["b"][0], pool["e"][0], jnp.nan),
    )


def grouped(count: int, x: Any, which: Any) -> Any:
    """All that scans do with rows, of `count` rows: two in each other, written, read again, in a branch and a loop."""
    numbers = (np.arange(count * 24) % 7).astype(np.float32).reshape(count, 4, 6)

    def member(c: Any, row: Any) -> Any:
        return c / 2 + row[0] * x, (c + row[1], row[2] * c, c > 0)

    def group(c: Any, rows: Any) -> Any:
        return lax.scan(member, c, rows)

    def sweep(k: Any, forces: Any) -> Any:
        row = lambda c, r: (c / 2 + r[0][0], (r[0] + c * r[1]) / 2)  # noqa: E731
        return lax.scan(row, x, (forces, numbers[:, 0, 0]), reverse=True)[1]

    written = lax.scan(group, x, numbers)[1]
    chosen = lax.cond(which > 3, lambda: written[1], lambda: lax.scan(group, 2 * x, numbers)[1][1])
    swept = lax.fori_loop(0, 3, sweep, chosen)
    return written[0][which % count, 2], swept[which % count, 1], written[2][-1, which % 4]


def test_code_does_not_grow_with_the_number_of_rows() -> None:
    columns = RNG.uniform(-1, 1, 9).astype(np.float32), RNG.integers(0, 2**30, 9).astype(np.int32)
    for vector in (False, True):
        few, many = (body(partial(grouped, count), *columns, vector=vector).splitlines() for count in (40, 100))
        assert len(few) == len(many) < 150
    expected = jax.jit(jax.vmap(partial(grouped, 30)))(*columns)
    for found, values in zip(run(partial(grouped, 30), *columns), expected, strict=True):
        np.testing.assert_allclose(found, values, rtol=1e-5)


def changed(count: int, x: Any, which: Any) -> Any:
    """An array that loops change in branches, in a loop, next to what only reads it."""

    def add(rows: Any, r: Any) -> tuple[Any, None]:
        return rows.at[(r + which) % count].add(x), None

    def halve(rows: Any, r: Any) -> tuple[Any, None]:
        row = rows[(r + which) % count]
        return lax.cond(row > x, lambda rows: lax.scan(add, rows, jnp.arange(2))[0], lambda rows: rows, rows), None

    def sweep(rows: Any, r: Any) -> tuple[Any, None]:
        total = rows[which % count] + rows[(which + 1) % count]
        rows = lax.cond(
            which % 3 > 0, lambda rows: lax.scan(halve, rows, jnp.arange(count))[0], lambda rows: rows, rows
        )
        return rows.at[r].add(total / 9), None

    rows = lax.scan(lambda rows, r: (rows.at[r].set(x * r), None), jnp.zeros(count), jnp.arange(count))[0]
    return lax.scan(sweep, rows, jnp.arange(3))[0]


def test_threads_wait_for_each_other_only_where_all_come_by(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that waits in a branch, or in a round that others don't make, would wait for ever."""
    monkeypatch.setattr("surgical_marl.engines.fused.macros.LONG_CODE", 2)

    def long(x: Any) -> Any:
        return lax.cond(x > 0, lambda: sum(jnp.sin(k * x) for k in range(1, 40)), lambda: x)

    def loop(x: Any, branches: int) -> Any:
        return lax.fori_loop(0, 3, lambda _, y: sum(long(y + k) for k in range(branches)), x)

    def waits(function: Callable[[Any], Any]) -> list[int]:
        """How many loops are around each place where threads wait."""
        around, found, last = [], [], ""
        for line in body(function, np.ones(3, np.float32), vector=False).splitlines():
            if line in ("BLOCK_BARRIER", "GRID_BARRIER"):
                assert all(re.match(r"for\(int r\d+=0;r\d+<3;", head) for head in around)
                assert (line == "GRID_BARRIER") == (bool(around) and last == around[-1]), (
                    "only at its top do all blocks wait"
                )
                found.append(len(around))
            last = line
            if line.startswith("}"):
                around.pop()
            if line.endswith("{"):
                around.append(line)
        return found

    assert waits(lambda x: long(x) + long(x + 1)) == [0, 0]
    assert waits(lambda x: loop(x, 2)) == [1, 1, 1, 0], "at its top, behind two branches, and behind it"
    assert waits(lambda x: loop(loop(x, 2), 2)) == [1, 1, 1, 0] * 2
    assert waits(lambda x: loop(x, 1)) == []
    assert waits(lambda x: lax.cond(x > 1, lambda: loop(x, 2), lambda: x)) == [0]
    assert waits(lambda x: lax.while_loop(lambda y: y < 9, lambda y: loop(y, 2) + 1, x)) == [0]


def test_loops_and_branches_change_arrays_in_place() -> None:
    columns = RNG.uniform(-1, 1, 19).astype(np.float32), RNG.integers(0, 2**30, 19).astype(np.int32)
    for vector in (False, True):
        assert not re.search(r"\bv\d+\[k\]=.*v\d+\[k\]", body(partial(changed, 24), *columns, vector=vector))
    expected = jax.jit(jax.vmap(partial(changed, 24)))(*columns)
    np.testing.assert_allclose(run(partial(changed, 24), *columns), expected, rtol=1e-5)
    with gpu_code():
        np.testing.assert_allclose(run(partial(changed, 24), *columns), expected, rtol=1e-5)


def test_environments_that_take_one_way_come_before_those_that_take_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """And then by how much they had to do. Only sides of branches that are long, with all in them, are ways."""
    monkeypatch.setattr(instrumentation, "LARGE", 8)
    monkeypatch.setattr(instrumentation, "LARGE_PATH", 60)

    def long(x: Any) -> Any:
        inner = lambda y: lax.cond(y > 0.5, lambda y: rounds(y, 3, 30), lambda y: rounds(y, 3, 31), y)  # noqa: E731
        return inner(x) + 1

    def rounds(x: Any, count: Any, length: int = 12) -> Any:
        def body(_: Any, y: Any) -> Any:
            for k in range(length):
                y = jnp.sin(y) * (k + 2)
            return y

        return lax.fori_loop(0, count, body, x)

    def function(way: Any, count: Any, x: Any) -> Any:
        return rounds(lax.cond(way, lambda: long(x), lambda: x * 2), count)

    way, count = np.array([True, False] * 12), RNG.permutation(np.arange(24, dtype=np.int32))
    columns = way, count, RNG.uniform(0, 1, 24).astype(np.float32)
    noted = worked(function, *columns)
    with gpu_code():
        assert np.array_equal(worked(function, *columns), noted)
    assert noted[way].min() > noted[~way].max()
    for each in (way & (columns[2] > 0.5), way & (columns[2] <= 0.5), ~way):
        assert np.array_equal(np.argsort(noted[each]), np.argsort(count[each]))


def test_a_scan_that_is_to_be_unrolled_is() -> None:
    """Then it needs no memory."""

    def function(unroll: bool | int, x: Any) -> Any:
        return lax.scan(lambda c, row: (c / 2 + row * x, c), x, np.arange(6, dtype=np.float32), unroll=unroll)

    x = RNG.uniform(-1, 1, 9).astype(np.float32)
    assert "for(" in body(partial(function, 1), x, vector=False)
    for unroll in (True, 6, 8):
        code = body(partial(function, unroll), x, vector=False)
        assert "for(" not in code and "[" not in code
        np.testing.assert_allclose(run(partial(function, unroll), x)[1], run(partial(function, 1), x)[1], rtol=1e-6)


def test_code_for_cuda_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every macro of the prelude, by NVRTC, which needs no GPU."""
    monkeypatch.setattr("surgical_marl.engines.fused.macros.LONG_CODE", 0)
    monkeypatch.setattr(instrumentation, "LARGE_PATH", 0)
    code = body(everything, random_arrays(0), vector=False)
    used = set(re.findall(r"\w+", code))
    assert not [name for name in re.findall("^#define (\\w+)", CUDA, re.M) if name not in used]
    if 90 not in kernel.wp.get_cuda_supported_archs():
        pytest.skip("Warp has no NVRTC that knows sm_90 here")
    module = kernel.wp.get_module("surgical_marl_test_cuda")
    module.options["enable_backward"] = False
    kernel._make("test_cuda", f"{CUDA}\n{code}\n{UNDEFINE}\n", module)
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
    "many keys": ("random_bits of many keys at once", lambda x: jax.vmap(jax.random.bits)(
        jax.random.split(jax.random.wrap_key_data(x.astype(jnp.uint32)[:2]), 3))),
    "a loop": ("a loop that never ends", endless),
}  # fmt: skip


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_an_error_names_what_and_where(name: str) -> None:
    """The line in this file, not one in JAX or of what called it."""
    what, function = UNSUPPORTED[name]
    with pytest.raises(Unsupported, match=rf"{what}.* at .*test_compiler\.py:\d+") as caught:
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
