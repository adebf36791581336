"""The passes of the fused engine's compiler: each can be left out, each leaves IR that is right, each can be seen."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from surgical_marl.engines.fused import graph, hints, instructions, instrumentation, source_cache, stores
from surgical_marl.engines.fused import instructions as ir
from surgical_marl.engines.fused.c_printer import CPrinter
from surgical_marl.engines.fused.graph import Graph
from surgical_marl.engines.fused.options import DUMP, PASSES, VERIFY
from surgical_marl.engines.fused.pipeline import CSE, Program, compile_program, switched_off
from surgical_marl.engines.fused.pipeline import PASSES as ALL
from surgical_marl.engines.fused.verify import Malformed, check_code, check_graph, check_schedule
from surgical_marl.envs.env import Env
from tests.helpers.fused_kernels import gpu_code, make_stores, run
from tests.helpers.fused_schedules import schedule_of

RNG = np.random.default_rng(3)
COLUMNS = RNG.uniform(-1, 1, 9).astype(np.float32), RNG.integers(0, 2**30, 9).astype(np.int32)
SWITCHES = [CSE, *(one.name for one in ALL if not one.required)]


def function(x: Any, which: Any) -> Any:
    """Has something to do for each pass: loops that change arrays, branches, values that no round changes."""

    def change(rows: Any, r: Any) -> tuple[Any, Any]:
        row = rows[(r + which) % 6] * jnp.sqrt(1 + x * x)
        rows = lax.cond(row > x, lambda rows: rows.at[(r + which) % 6].add(x), lambda rows: rows.at[r].set(row), rows)
        return rows, (row, 2 * row)

    rows, (first, second) = lax.scan(change, x * jnp.arange(6.0), jnp.arange(6))
    summed = lax.fori_loop(0, 6, lambda k, s: s + first[k] * second[k], x)
    side = lax.cond(which % 2 > 0, lambda: 3 * x, lambda: x)
    return lax.while_loop(lambda s: s < 9, lambda s: 2 * abs(s) + 1, summed), rows, x, which + 1, side


@pytest.fixture(autouse=True)
def verified(monkeypatch: pytest.MonkeyPatch) -> None:
    """All branches count as large, all code as long, few fields as many, and the IR is checked after each pass."""
    monkeypatch.setenv(VERIFY, "1")
    monkeypatch.setattr("surgical_marl.engines.fused.macros.LONG_CODE", 0)
    monkeypatch.setattr(hints, "LARGE", 0)
    for module in (graph, instructions, stores):
        monkeypatch.setattr(module, "LEAST_ROW", 4)
    for size in ("LARGE", "LARGE_PATH"):
        monkeypatch.setattr(instrumentation, size, 0)


def text(vector: bool, function: Any = function, columns: Any = COLUMNS) -> str:
    graph, stores, *_ = make_stores(function, columns)
    return compile_program(Program(graph, stores, vector)).text


def check_results(function: Any, columns: Any, rtol: float) -> None:
    """Compare what kernels for a CPU and for a GPU compute with what JAX does."""
    expected = jax.jit(jax.vmap(function))(*columns)
    found = [run(function, *columns)]
    with gpu_code():
        found.append(run(function, *columns))
    for one in found:
        for a, b in zip(one, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=rtol)


@pytest.mark.parametrize("name", SWITCHES)
def test_code_without_a_pass_is_other_code(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    graph, *_ = make_stores(function, COLUMNS)
    with_it = [text(vector) for vector in (False, True)]
    monkeypatch.setenv(PASSES, f"-{name}")
    if name == CSE:
        monkeypatch.setattr("tests.helpers.fused_kernels.Graph", partial(Graph, cse=False))
        assert len(make_stores(function, COLUMNS)[0].ops) > len(graph.ops)
    targets = {one.target for one in ALL if one.name == name}
    changed = [before != text(vector) for before, vector in zip(with_it, (False, True), strict=True)]
    assert any(changed) or name == "fences", "short code has no fences"
    assert not (changed[0] and targets == {"cpu"}) and not (changed[1] and targets == {"cuda"})


def test_paths_are_noted_only_where_work_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise C would use a register that nothing declares: a side of many small blocks is large, none of them is."""
    assert "PATH(" in text(vector=False)
    monkeypatch.setattr(instrumentation, "LARGE", 1000)
    assert not any(word in text(vector=False) for word in ("PATH(", "WORK(", "paths_", "WORK_KEY"))


def test_code_without_any_pass_computes_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PASSES, ",".join(f"-{name}" for name in SWITCHES))
    check_results(function, COLUMNS, 1e-5)


def test_fields_in_a_row_are_moved_by_loops() -> None:
    """To an array that a branch changes, of which one element is read at a known place, and from it to other fields."""

    def changed(rows: Any, which: Any) -> Any:
        late = lax.cond(which % 3 > 0, lambda: rows.at[which % 6, 1].set(rows[(which + 1) % 6, 0]), lambda: rows)
        return late, late[2, 1] - rows[3, 0]

    columns = RNG.uniform(-1, 1, (9, 6, 2)).astype(np.float32), COLUMNS[1]
    for vector in (False, True):
        code = text(vector, changed, columns)
        assert "LDF(state,0+(1)*k)" in code and "=LDF(state,6);" in code
        assert len([line for line in code.splitlines() if "STF(" in line and "+(1)*k,v" in line]) == 1
    check_results(changed, columns, 1e-6)


def test_a_reset_is_stored_in_its_branch() -> None:
    """A side stores constants, or what other fields hold, by loops; one value is also read behind the branch."""

    def reset(rows: Any, done: Any) -> Any:
        first = lax.cond(done % 2 > 0, lambda: (jnp.full(12, 2.0), jnp.float32(1)), lambda: (rows[:12], rows[12]))
        return *first, first[1] * 2

    columns = RNG.uniform(-1, 1, (9, 13)).astype(np.float32), COLUMNS[1]
    side, other, behind = (
        text(False, reset, columns).split("\n}else{\n")[0],
        *text(False, reset, columns).split("}")[1:3],
    )
    loop = "for(int k=0;k<12;++k)STF(outs,0+(1)*k,"
    assert f"{loop}SPLAT(2.0f));" in side and f"{loop}LDF(state,0+(1)*k));" in other and "STF(outs,12," in behind
    check_results(reset, columns, 1e-6)


@pytest.mark.parametrize(("rounds", "vector", "few"), [(32, False, True), (31, False, False), (32, True, False)])
def test_nvrtc_is_told_to_write_out_few_rounds_of_a_long_loop(rounds: int, vector: bool, few: bool) -> None:
    """A short one stays whole: elements at known places are kept in registers."""
    loop = ir.Repeat(rounds, ir.Assign(ir.Element("v1", stride=1), ir.Element("v2", stride=1)))
    assert CPrinter(vector).line(loop).startswith("#pragma unroll 4\nfor(") == few


FIELDS = [ir.Define(f"v{k}", "f", ir.Call("load", "f", ("state", k))) for k in range(8)]


def test_fields_that_change_places_are_loaded_before_they_are_stored() -> None:
    """Rows of fields are copied by a loop, but not if a store before the loop, or in it, changes what it reads."""
    kept = [ir.Store("state", 4 + k, "f", f"v{k}") for k in range(4)]
    changed = [ir.Store("state", (k + 4) % 8, "f", f"v{k}") for k in range(8)]
    assert stores.roll_stores([*FIELDS, *changed]) == [*FIELDS, *changed]
    assert len(stores.roll_stores([*FIELDS, *kept])) < len([*FIELDS, *kept])
    own = [ir.Store("state", k, "f", f"v{k}") for k in range(8)]
    (loop,) = stores.roll_stores([*FIELDS, *own])
    watch = instrumentation.Watch(frozenset(("state", k) for k in range(8)), 0)
    (check,) = [one for one in instrumentation.check_finite([loop], watch) if isinstance(one, ir.Repeat)]
    assert isinstance(check.one, ir.CheckFinite)


@pytest.mark.parametrize("late", [None, "chosen", "behind"])
def test_a_store_stays_behind_loads_of_its_field(late: str | None) -> None:
    """It is not moved into a branch if the field is still loaded there, or between the branch and the store."""
    load = ir.Define("late", "f", ir.Call("load", "f", ("state", 3)))
    sizes = ir.Size(1, 1), ir.Size(1, 1)
    code = [
        ir.Define("c", "b", np.bool_(True)), ir.Define("v9", "f"), ir.If("c", 0, sizes, ()),
        ir.Assign("v9", np.float32(1)), *[load] * (late == "chosen"), ir.Else("c"), *FIELDS[3:4],
        ir.Assign("v9", "v3"), ir.End(), *[load] * (late == "behind"), ir.Store("state", 3, "f", "v9"),
    ]  # fmt: skip
    found = stores.store_in_branches(code)
    assert (found == code) == (late is not None)
    assert sum(isinstance(one, ir.Store) for one in found) == (1 if late else 2)


@pytest.mark.parametrize("word", ["interleave", "-place", "-interleaving", "-"])
def test_a_switch_that_is_not_there_is_refused(word: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PASSES, f"-fences,{word}")
    with pytest.raises(ValueError, match=rf"^{PASSES} has '{word}'; what it can have is -cse, .*-fences$"):
        switched_off()


def test_a_switch_is_part_of_the_key_of_a_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """And a dump compiles anew: nothing is looked for in the cache."""
    keys: list[Any] = []

    def cached(kind: str, make: Any, *content: Any, classes: Any) -> Any:
        keys.append(content)
        raise LookupError

    monkeypatch.setattr(source_cache, "cached", cached)
    monkeypatch.setattr(source_cache, "_trace", lambda *_: pytest.fail("compiles"))
    env = Env("reach", "psm")
    for switches in ("", "-share_memory", "-fences -share_memory", "-share_memory,-fences"):
        monkeypatch.setenv(PASSES, switches)
        with pytest.raises(LookupError):
            source_cache.load_source(env, vector=False)
    assert len({*keys}) == 3 and keys[2] == keys[3]
    monkeypatch.setenv(DUMP, "folder")
    with pytest.raises(pytest.fail.Exception, match="compiles"):
        source_cache.load_source(env, vector=False)


def test_the_ir_can_be_seen_after_each_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DUMP, str(tmp_path))
    monkeypatch.setenv(PASSES, "-barriers")
    graph, stores, *_ = make_stores(function, COLUMNS)
    found = compile_program(Program(graph, stores, vector=False), "step").text
    files = sorted((tmp_path / "step.cuda").iterdir())
    passes = [one.name for one in ALL if one.target != "cpu" and one.name != "barriers"]
    assert [file.name for file in files] == [f"{k:02}-{name}.txt" for k, name in enumerate(passes)]
    texts = {name: file.read_text() for name, file in zip(passes, files, strict=True)}
    assert texts["share_memory"] == found + "\n"
    assert texts["order"] != texts["place"], "an order is known"
    for name in ("place", "order"):
        assert {"sqrt", "if", "end", "while", "store", "phi"} <= set(texts[name].split())
        assert "for 6 rounds r" in texts[name]


X = ir.Define("x", "f", 0)
ARRAY, LOOP = ir.Declare("v1", "f", 4), ir.For("r1", 3, False)


@pytest.mark.parametrize(
    ("code", "what"),
    [
        ([ir.Assign("y", "x")], "y is used before it is declared"),
        ([X, ir.Assign("x", ir.Call("add", "f", ("x", "z")))], "z is used before"),
        ([X, X], "x is declared twice"),
        ([LOOP, X, ir.End(), ir.Assign("x", 0)], "x is used before"),
        ([ARRAY, ir.Assign(ir.Element("v1", offset=4), 0)], r"v1\[4\] is out of range"),
        ([ARRAY, ir.Repeat(3, ir.Assign(ir.Element("v1", offset=2, stride=1), 0))], r"v1\[4\] is out of range"),
        ([ARRAY, X, ir.Assign("x", ir.Gather("v1", "f", "x", 4))], r"v1\[4\] is out of range"),
        ([ARRAY, ir.Assign("v1", 0)], "v1 is an array"),
        ([X, ir.Assign(ir.Element("x"), 0)], "x is no array"),
        ([LOOP], "does not end"),
        ([ir.End()], "ends nothing"),
        ([LOOP, ir.Else(1), ir.End()], "ends nothing"),
        ([LOOP, ir.Break(1), ir.End()], "a break is outside"),
    ],
)
def test_malformed_code_is_found(code: ir.Code, what: str) -> None:
    with pytest.raises(Malformed, match=what):
        check_code(code)


def test_a_malformed_schedule_is_found() -> None:
    columns = np.ones((1, 20), np.float32), np.ones(1, np.int32)
    graph, stores, *_ = make_stores(lambda x, i: (x.at[i].set(3.0), x[0] + 1), columns)
    results = [value for _, _, value in stores]
    for what in ("before it is computed", "computed twice", "no result", "after it was overwritten"):
        plan = schedule_of(graph, results)
        items = plan.regions[0].items
        if what == "before it is computed":
            items.reverse()
        elif what == "computed twice":
            items.insert(0, next(item for item in items if item[0] == "node"))
        elif what == "no result":
            items.remove(("result", 0))
        else:
            (update,) = plan.in_place
            seventh = graph.constant(np.int32(7))
            items.append(("node", graph.fresh("read", graph.args[update][0], seventh, kind="f")))
        with pytest.raises(Malformed, match=what):
            check_schedule(graph, plan, results)


def test_a_malformed_graph_is_found() -> None:
    graph = Graph()
    check_graph(graph)
    graph.fresh("neg", 5, kind="f")
    with pytest.raises(Malformed, match="made later"):
        check_graph(graph)
