"""The graph of the fused engine's compiler: what is simplified, folded and shared."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest

from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.operations import DTYPES, FOLD, KINDS


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
    "clip to a point": (
        lambda g, x, y: g.extreme("min", g.extreme("max", x, real(g, 2)), real(g, 2)),
        lambda g, x, y: real(g, 2),
    ),
    "clip beyond a bound": (
        lambda g, x, y: g.extreme("max", real(g, 3), g.extreme("min", x, real(g, 1))),
        lambda g, x, y: real(g, 3),
    ),
    "clip within a bound": (
        lambda g, x, y: g.extreme("min", g.extreme("max", x, real(g, 1)), real(g, 2)),
        lambda g, x, y: g.binary("min", g.binary("max", x, real(g, 1)), real(g, 2)),
    ),
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


@pytest.mark.parametrize("op", ["lt", "le", "gt", "ge", "eq", "ne"])
def test_comparisons_of_counters_are_decided_where_all_rounds_agree(op: str) -> None:
    """And only there; for equality, where they are apart. Of a counter and a number, and of two counters."""
    for rounds, shift, other, away in product((1, 2, 4), (-3, 0, 2), (1, 3), (-5, -1, 0, 1, 4)):
        g = Graph()
        first, second = (g.fresh("counter", k, n, kind="i") for k, n in enumerate((rounds, other)))
        moved = g.add(first, g.constant(np.int32(shift)))
        number = g.constant(np.int32(away))
        mine = {k + shift for k in range(rounds)}
        for value, theirs in ((number, {away}), (g.add(second, number), {k + away for k in range(other)})):
            truths = {bool(FOLD[op](np.int32(a), np.int32(b))) for a in mine for b in theirs}
            for a, b, way in ((moved, value, op), (value, moved, {"lt": "gt", "le": "ge"}.get(op, op))):
                if (a, b) == (value, moved) and op in ("gt", "ge"):
                    continue
                found = g.compare(way, a, b)
                apart = max(mine) < min(theirs) or max(theirs) < min(mine)
                if len(truths) == 1 and (apart or op not in ("eq", "ne")):
                    assert found == (g.true if truths == {True} else g.false)
                else:
                    assert found >= 0
            for kind, best in (("max", max), ("min", min)):
                found = g.extreme(kind, moved, value)
                results = {best(a, b) for a in mine for b in theirs}
                if found == moved:
                    assert results <= mine
                if found == value:
                    assert results <= theirs
                certain = max(mine) <= min(theirs) or max(theirs) <= min(mine)
                assert (found in (moved, value)) == certain or moved < 0


def test_an_element_is_read_from_where_it_was_put() -> None:
    """At a number that is known without a node; at the first node of the graph, whose number is 0, by one."""
    g = Graph()
    index = load(g, "i")
    assert index == 0
    values = [load(g, "f", k) for k in range(3)]
    array = g.array(values)
    assert [g.read(array, g.constant(np.int32(k))) for k in range(3)] == values
    found = g.read(array, index)
    assert g.ops[found] == "read" and g.args[found] == (array, index) and g.kinds[found] == "f"


def test_a_table_that_is_given_later_is_looked_up_then() -> None:
    g = Graph()
    one = g.table(np.arange(3, dtype=np.float32))
    example = np.ones(4, np.int32)
    given = g.input_table(example)
    assert (one, given, g.inputs) == (0, 1, {1}) and g.tables[given] is example
    found = g.lookup(given, g.constant(np.int32(2)))
    assert found >= 0 and g.kinds[found] == "i" and g.args[found][0] == given
    assert g.input_table(example) == 2  # never the same one
