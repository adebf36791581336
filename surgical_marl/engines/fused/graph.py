"""The first IR of the fused engine: a graph of values, simplified while it is built.

A value is an int. A negative one is a constant, `constants[~value]`; others are nodes: an operation, the values it
reads and a kind, one of "f" (float32), "i" (int32), "u" (uint32), "b" (bool). Equal nodes are made once. Branches and
loops are groups, whose results are nodes that name the group. `schedule.py` decides where a node is computed.

An array in memory is a value too, of the kind "f64" if it holds 64 floats. Nothing changes an array: `update` makes
another one. `inplace.py` gives both the same place in memory if nothing else reads the first.

Simplifications assume finite numbers: 0 * x is 0 even if x might be infinite, zero has no sign, and only `x != x` and
`isfinite` detect NaN.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from surgical_marl.engines.fused.operations import COMMUTATIVE, DTYPES, FOLD, KIND_OF, RESULT, combined_bounds

Value = int
LEAST_ROW = 32
"""Fields of a buffer, in a row, that a loop moves to or from an array; fewer are moved one by one."""


@dataclass
class Branch:
    """`outs[k]` is `chosen[k]` where `condition` holds, `others[k]` elsewhere."""

    condition: Value
    chosen: list[Value] = field(default_factory=list)
    others: list[Value] = field(default_factory=list)
    outs: list[Value] = field(default_factory=list)


@dataclass
class Loop:
    """`phis` start as `starts` and become `nexts` at the end of each round; `outs` are what they are after the last.

    The loop continues while `condition`, a value of the phis, holds, or for `length` rounds if there is no condition.
    """

    starts: list[Value]
    phis: list[Value] = field(default_factory=list)
    nexts: list[Value] = field(default_factory=list)
    outs: list[Value] = field(default_factory=list)
    condition: Value | None = None
    length: int = 0
    around: int = 0
    """The loops around it, as bits."""
    counter: Value | None = None
    """The number of the round, if something reads it: from 0 on, or back to 0 if it goes `backwards`."""
    backwards: bool = False


class Graph:
    """Nodes of one program. Methods named like operations make them, simplified."""

    def __init__(self, cse: bool = True) -> None:
        self.cse = cse
        """True if equal nodes are made once: common subexpression elimination, by hash consing."""
        self.ops: list[str] = []
        self.args: list[tuple[Any, ...]] = []
        self.kinds: list[str] = []
        self.constants: list[Any] = []
        self.groups: list[Branch | Loop] = []
        self.tables: list[np.ndarray] = []
        self.inputs: set[int] = set()
        """Tables whose values are not known while tracing: parameters."""
        self.views: dict[tuple[Any, ...], Any] = {}
        """The results of `array_view.view`."""
        self._constant_ids: dict[tuple[str, Any], Value] = {}
        self._constant_kinds: list[str] = []
        self._folded: dict[tuple[Any, ...], Value] = {}
        self._table_numbers: dict[tuple[str, bytes], int] = {}
        self._known: dict[tuple[Any, ...], Value] = {}
        self._loads: dict[tuple[Any, ...], Value] = {}  # in any scope
        self._scopes: list[dict[tuple[Any, ...], Value]] = []
        self._bounds: dict[Value, tuple[int, int] | None] = {}
        self.zero, self.one = self.constant(np.float32(0)), self.constant(np.float32(1))
        self.false, self.true = self.constant(np.bool_(False)), self.constant(np.bool_(True))

    # -- values

    def constant(self, value: Any) -> Value:
        """Return the constant of a numpy scalar."""
        kind = KIND_OF[value.dtype]
        number = value.item()
        key = (kind, "nan" if number != number else number or 0)  # -0 is 0
        found = self._constant_ids.get(key)
        if found is None:
            found = self._constant_ids[key] = ~len(self.constants)
            self.constants.append(value if number else DTYPES[kind](0))
            self._constant_kinds.append(kind)
        return found

    def constants_of(self, array: np.ndarray) -> list[Value]:
        """Return the constants of all elements of a numpy array, in a row."""
        kind, known = KIND_OF[array.dtype], self._constant_ids
        found = [known.get((kind, number or 0)) for number in array.ravel().tolist()]
        return [self.constant(array.flat[k]) if value is None else value for k, value in enumerate(found)]

    def kind(self, value: Value) -> str:
        return self.kinds[value] if value >= 0 else self._constant_kinds[~value]

    def node(self, op: str, *args: Any, kind: str) -> Value:
        """Return a node as it is, not simplified; equal nodes are shared."""
        key, known = (op, kind, *args), self._loads if op == "load" else self._known
        found = known.get(key) if self.cse or op == "load" else None
        if found is None:
            found = known[key] = self.fresh(op, *args, kind=kind)
        return found

    def fresh(self, op: str, *args: Any, kind: str) -> Value:
        """Return a new node that is never shared, even with one that looks the same."""
        self.ops.append(op)
        self.args.append(args)
        self.kinds.append(kind)
        return len(self.ops) - 1

    def open_scope(self) -> None:
        """Share the nodes made from here on only among themselves.

        What a branch computes is then computed in the branch, and need not be kept from before it. Inputs from before
        are still shared.
        """
        self._scopes.append(self._known)
        self._known = {}

    def close_scope(self) -> None:
        self._known = self._scopes.pop()

    def _fold(self, op: str, *args: Value) -> Value:
        found = self._folded.get((op, *args))
        if found is None:
            with np.errstate(all="ignore"):
                found = self.constant(np.asarray(FOLD[op](*(self.constants[~a] for a in args)))[()])
            self._folded[op, *args] = found
        return found

    def reads(self, value: Value) -> list[Value]:
        """Return the nodes that a node reads, without constants.

        What a group reads is not counted for the nodes that stand for its values, but for the group.
        """
        op, args = self.ops[value], self.args[value]
        if op in ("load", "fields", "phi", "out", "counter"):
            return []
        return [a for a in (args[1:] if op == "lookup" else args) if a >= 0]

    # -- operations

    def unary(self, op: str, a: Value) -> Value:
        if a < 0:
            return self._fold(op, a)
        return self.node(op, a, kind=RESULT.get(op) or self.kinds[a])

    def binary(self, op: str, a: Value, b: Value) -> Value:
        if a < 0 and b < 0:
            return self._fold(op, a, b)
        if op in COMMUTATIVE and a > b:
            a, b = b, a
        return self.node(op, a, b, kind=RESULT.get(op) or self.kind(a))

    def is_constant(self, a: Value, value: float) -> bool:
        return a < 0 and bool(self.constants[~a] == value)

    def neg(self, a: Value) -> Value:
        if a >= 0 and self.ops[a] == "neg":
            return int(self.args[a][0])
        if a >= 0 and self.ops[a] == "sub":
            return self.sub(self.args[a][1], self.args[a][0])
        return self.unary("neg", a)

    def add(self, a: Value, b: Value) -> Value:
        if self.is_constant(a, 0):
            return b
        if self.is_constant(b, 0):
            return a
        if b >= 0 and self.ops[b] == "neg":
            return self.sub(a, self.args[b][0])
        if a >= 0 and self.ops[a] == "neg":
            return self.sub(b, self.args[a][0])
        return self.binary("add", a, b)

    def sub(self, a: Value, b: Value) -> Value:
        if self.is_constant(b, 0):
            return a
        if a == b and a >= 0:
            return self.constant(DTYPES[self.kinds[a]](0))
        if self.is_constant(a, 0):
            return self.neg(b)
        if b >= 0 and self.ops[b] == "neg":
            return self.add(a, self.args[b][0])
        return self.binary("sub", a, b)

    def mul(self, a: Value, b: Value) -> Value:
        if b < 0:
            a, b = b, a  # a constant comes first
        if a < 0:
            if b < 0:
                return self._fold("mul", a, b)
            value = self.constants[~a]
            if value == 0:
                return a
            if value == 1:
                return b
            if value == -1:
                return self.neg(b)
            if self.ops[b] == "mul" and self.kinds[b] == "f" and self.args[b][0] < 0:
                return self.mul(self._fold("mul", a, self.args[b][0]), self.args[b][1])
            if self.ops[b] == "neg":
                return self.mul(self.unary("neg", a), self.args[b][0])
        negative = False
        if a >= 0 and self.ops[a] == "neg":
            a, negative = self.args[a][0], True
        if self.ops[b] == "neg":
            b, negative = self.args[b][0], not negative
        product = self.binary("mul", a, b)
        return self.neg(product) if negative else product

    def div(self, a: Value, b: Value) -> Value:
        if self.kind(a) == "f" and not (a < 0 and b < 0):
            if self.is_constant(a, 0):
                return a
            if b < 0 and self.constants[~b] != 0:
                with np.errstate(all="ignore"):
                    return self.mul(a, self.constant(np.float32(1) / self.constants[~b]))
        return self.binary("div", a, b)

    def compare(self, op: str, a: Value, b: Value) -> Value:
        if self.kind(a) == "b":
            return self._compare_truths(op, a, b)
        if a == b and a >= 0 and not (self.kinds[a] == "f" and op in ("eq", "ne")):  # these are tests for NaN
            return self.true if op in ("le", "ge", "eq") else self.false
        if (low := self.bounds(a)) and (high := self.bounds(b)) and max(a, b) >= 0:
            known = {bool(FOLD[op](x, y)) for x in low for y in high}
            if len(known) == 1 and (op not in ("eq", "ne") or low[1] < high[0] or high[1] < low[0]):
                return self.true if known.pop() else self.false
        for x, y, flipped in ((a, b, False), (b, a, True)):
            # a choice between constants, compared with a constant: the choice itself
            if y < 0 and x >= 0 and self.ops[x] == "select" and max(self.args[x][1:]) < 0:
                condition, other, chosen = self.args[x]
                pick = [self._fold(op, *((y, k) if flipped else (k, y))) for k in (other, chosen)]
                return self.select(condition, *pick)
        return self.binary(op, a, b)

    def _compare_truths(self, op: str, a: Value, b: Value) -> Value:
        if op in ("lt", "le"):
            a, b, op = b, a, "gt" if op == "lt" else "ge"
        if op == "ne":
            return self.logic("xor", a, b)
        return self.logic({"gt": "and", "ge": "or", "eq": "xor"}[op], a, self.invert(b))

    def logic(self, op: str, a: Value, b: Value) -> Value:
        if self.kind(a) == "b":
            for x, y in ((a, b), (b, a)):
                if x < 0:
                    value = bool(self.constants[~x])
                    if op == "and":
                        return y if value else self.false
                    if op == "or":
                        return self.true if value else y
                    return self.invert(y) if value else y
            if a == b:
                return self.false if op == "xor" else a
        elif self.is_constant(a, 0) or self.is_constant(b, 0):
            zero, other = (a, b) if self.is_constant(a, 0) else (b, a)
            return zero if op == "and" else other
        return self.binary(op, a, b)

    def invert(self, a: Value) -> Value:
        if a >= 0 and self.ops[a] == "not":
            return int(self.args[a][0])
        return self.unary("not", a)

    def extreme(self, op: str, a: Value, b: Value) -> Value:
        """Return the larger of two values if `op` is "max", the smaller if it is "min"."""
        if a == b:
            return a
        if self.kind(a) == "b":
            return self.logic("or" if op == "max" else "and", a, b)
        for x, y in ((a, b), (b, a)):
            if x < 0 and self.kind(x) == "f" and np.isinf(self.constants[~x]):
                return y if (self.constants[~x] < 0) == (op == "max") else x
            if x < 0 <= y and self._is_beyond(op, x, y):
                return x
        if max(a, b) >= 0 and (low := self.bounds(a)) and (high := self.bounds(b)):
            for x, y, least, most in ((a, b, low[0], high[1]), (b, a, high[0], low[1])):
                if least >= most:
                    return x if op == "max" else y
        return self.binary(op, a, b)

    def _is_beyond(self, op: str, constant: Value, value: Value) -> bool:
        """Return whether a value was clipped so that its "min" or "max" with a constant is the constant."""
        if self.ops[value] != {"min": "max", "max": "min"}[op]:
            return False
        limit, bounds = self.constants[~constant], [self.constants[~a] for a in self.args[value] if a < 0]
        return any(bound >= limit if op == "min" else bound <= limit for bound in bounds)

    def select(self, condition: Value, other: Value, chosen: Value) -> Value:
        """`chosen` where `condition` holds."""
        if condition < 0:
            return chosen if self.constants[~condition] else other
        if other == chosen:
            return other
        if self.ops[condition] == "not":
            return self.select(self.args[condition][0], chosen, other)
        if other >= 0 and self.ops[other] == "select" and self.args[other][0] == condition:
            other = self.args[other][1]
        if chosen >= 0 and self.ops[chosen] == "select" and self.args[chosen][0] == condition:
            chosen = self.args[chosen][2]
        kind = self.kind(other)
        if kind == "b":
            return self.logic(
                "or", self.logic("and", condition, chosen), self.logic("and", self.invert(condition), other)
            )
        return self.node("select", condition, other, chosen, kind=kind)

    def table(self, table: np.ndarray) -> int:
        """Return the number of a constant float32 or int32 table, [n]; equal tables are kept once."""
        number = self._table_numbers.setdefault((table.dtype.name, table.tobytes()), len(self.tables))
        if number == len(self.tables):
            self.tables.append(table)
        return number

    def input_table(self, example: np.ndarray) -> int:
        """Return the number of a new table whose values are given when the program runs.

        The table has the size and type of `example`.
        """
        self.tables.append(example)
        self.inputs.add(len(self.tables) - 1)
        return len(self.tables) - 1

    def lookup(self, number: int, index: Value) -> Value:
        """`tables[number][index]`; the index must be in range."""
        table = self.tables[number]
        if index < 0 and number not in self.inputs:
            return self.constant(table[int(self.constants[~index])])
        return self.node("lookup", number, index, kind=KIND_OF[table.dtype])

    def dtype(self, value: Value) -> type:
        """Return the numpy type of a value."""
        return DTYPES[self.kind(value)]

    # -- arrays in memory

    def array(self, values: list[Value]) -> Value:
        """Return an array that holds these values. Many that stand in a row in a buffer are loaded by a loop."""
        kind, row = f"{self.kind(values[0])}{len(values)}", self._row(values)
        return self.node("fields", *row, kind=kind) if row else self.node("array", *values, kind=kind)

    def _row(self, values: list[Value]) -> tuple[str, int, int] | None:
        """Return the buffer, the first field and the step from field to field of values that are loaded from a row."""
        if len(values) < LEAST_ROW or any(value < 0 or self.ops[value] != "load" for value in values):
            return None
        (buffer, first), (_, second) = self.args[values[0]], self.args[values[1]]
        step = second - first
        row = all(self.args[value] == (buffer, first + step * k) for k, value in enumerate(values))
        return (buffer, first, step) if row else None

    def update(self, array: Value, index: Value, values: list[Value]) -> Value:
        """Return an array that holds `values` from `index` on; the index must be in range."""
        return self.node("update", array, index, *values, kind=self.kinds[array])

    def read(self, array: Value, index: Value) -> Value:
        """`array[index]`; the index must be in range."""
        if index < 0 and self.ops[array] == "array":
            return int(self.args[array][int(self.constants[~index])])
        if index < 0 and self.ops[array] == "fields":
            buffer, first, step = self.args[array]
            return self.node("load", buffer, first + step * int(self.constants[~index]), kind=self.kinds[array][0])
        return self.node("read", array, index, kind=self.kinds[array][0])

    def bounds(self, value: Value) -> tuple[int, int] | None:
        """Return the least and the greatest that a whole number can be, if it is made of counters and constants."""
        if value not in self._bounds:
            self._bounds[value] = self._find_bounds(value)
        return self._bounds[value]

    def _find_bounds(self, value: Value) -> tuple[int, int] | None:
        if self.kind(value) != "i":
            return None
        if value < 0:
            return (int(self.constants[~value]),) * 2
        op, args = self.ops[value], self.args[value]
        if op == "counter":
            return 0, args[1] - 1
        known = [bounds for a in args if (bounds := self.bounds(a))] if op in ("add", "sub", "mul", "neg") else []
        return combined_bounds(op, known) if known and len(known) == len(args) else None
