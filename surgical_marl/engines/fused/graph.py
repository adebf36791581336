"""The scalar program of the fused engine: a graph of values, simplified while it is built.

A value is an int. A negative one is a constant, `constants[~value]`; others are nodes: an operation, the values it
reads and a kind, one of "f" (float32), "i" (int32), "u" (uint32), "b" (bool). Equal nodes are made once. Branches and
loops are groups, whose results are nodes that name the group. `schedule.py` decides where a node is computed.

Simplifications assume finite numbers: 0 * x is 0 even if x might be infinite, zero has no sign, and only `x != x` and
`isfinite` detect NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

KINDS = {"float32": "f", "int32": "i", "uint32": "u", "bool": "b"}
DTYPES = {kind: np.dtype(name).type for name, kind in KINDS.items()}

Value = int


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


COMMUTATIVE = {"add", "mul", "min", "max", "and", "or", "xor", "eq", "ne"}


def _divide(a: Any, b: Any) -> Any:
    return np.divide(a, b) if a.dtype.kind == "f" else np.trunc(np.divide(a, b, dtype=np.float64)).astype(a.dtype)


FOLD: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": _divide, "neg": np.negative, "abs": np.abs,
    "sqrt": np.sqrt, "floor": np.floor, "ceil": np.ceil, "rint": np.rint, "rem": np.fmod, "pow": np.power,
    "log": np.log, "tan": np.tan, "acos": np.arccos, "asin": np.arcsin, "atan2": np.arctan2, "tanh": np.tanh,
    "max": np.maximum, "min": np.minimum, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal, "and": np.bitwise_and, "or": np.bitwise_or,
    "xor": np.bitwise_xor, "not": np.bitwise_not, "shl": np.left_shift, "shr": np.right_shift,
    "sar": np.right_shift, "isfinite": np.isfinite, "f2i": lambda a: a.astype(np.int32),
    "i2f": lambda a: a.astype(np.float32), "u2f": lambda a: a.astype(np.float32),
    "f2u": lambda a: a.astype(np.uint32), "i2u": lambda a: a.astype(np.uint32), "u2i": lambda a: a.astype(np.int32),
    "bits": lambda a: a.view(np.uint32), "float": lambda a: a.view(np.float32),
}  # fmt: skip
"""What each operation does to constants: numpy, in the operands' own type."""

RESULT = {name: "b" for name in ("lt", "le", "gt", "ge", "eq", "ne", "isfinite")} | {
    "f2i": "i", "u2i": "i", "i2f": "f", "u2f": "f", "float": "f", "f2u": "u", "i2u": "u", "bits": "u",
}  # fmt: skip


class Graph:
    """Nodes of one program. Methods named like operations make them, simplified."""

    def __init__(self) -> None:
        self.ops: list[str] = []
        self.args: list[tuple[Any, ...]] = []
        self.kinds: list[str] = []
        self.constants: list[Any] = []
        self.groups: list[Branch | Loop] = []
        self.tables: list[np.ndarray] = []
        self.inputs: set[int] = set()
        """Tables whose values are not known while tracing: parameters."""
        self._constant_ids: dict[tuple[str, Any], Value] = {}
        self._table_numbers: dict[tuple[str, bytes], int] = {}
        self._known: dict[tuple[Any, ...], Value] = {}
        self._scopes: list[dict[tuple[Any, ...], Value]] = []
        self.zero, self.one = self.constant(np.float32(0)), self.constant(np.float32(1))
        self.false, self.true = self.constant(np.bool_(False)), self.constant(np.bool_(True))

    # -- values

    def constant(self, value: Any) -> Value:
        """Return the constant of a numpy scalar."""
        kind = KINDS[value.dtype.name]
        key = (kind, "nan" if value != value else value.item() if value != 0 else 0)  # -0 is 0
        found = self._constant_ids.get(key)
        if found is None:
            found = self._constant_ids[key] = ~len(self.constants)
            self.constants.append(value if value != 0 else DTYPES[kind](0))
        return found

    def kind(self, value: Value) -> str:
        return self.kinds[value] if value >= 0 else KINDS[self.constants[~value].dtype.name]

    def node(self, op: str, *args: Any, kind: str) -> Value:
        """Return a node as it is, not simplified; equal nodes are shared."""
        key = (op, kind, *args)
        found = self._known.get(key)
        if found is None:
            found = self._known[key] = self.fresh(op, *args, kind=kind)
        return found

    def fresh(self, op: str, *args: Any, kind: str) -> Value:
        """Return a new node that is never shared, even with one that looks the same."""
        self.ops.append(op)
        self.args.append(args)
        self.kinds.append(kind)
        return len(self.ops) - 1

    def open_scope(self) -> None:
        """Share the nodes made from here on only among themselves.

        What a branch computes is then computed in the branch, and need not be kept from before it. Nodes of the kinds
        "load", "phi" and "out" from before are still shared.
        """
        self._scopes.append(self._known)
        self._known = {key: value for key, value in self._known.items() if key[0] in ("load", "phi", "out")}

    def close_scope(self) -> None:
        self._known = self._scopes.pop()

    def _fold(self, op: str, *args: Value) -> Value:
        with np.errstate(all="ignore"):
            return self.constant(np.asarray(FOLD[op](*(self.constants[~a] for a in args)))[()])

    def reads(self, value: Value) -> list[Value]:
        """Return the nodes that a node reads, without constants.

        What a group reads is not counted for the nodes that stand for its values, but for the group.
        """
        op, args = self.ops[value], self.args[value]
        if op in ("load", "phi", "out"):
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
        return self.binary(op, a, b)

    def _is_beyond(self, op: str, constant: Value, value: Value) -> bool:
        """Whether a value is never less (of "min"; of "max", more) than a constant, as it was clipped there."""
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
        return self.node("lookup", number, index, kind=KINDS[table.dtype.name])

    def dtype(self, value: Value) -> type:
        """Return the numpy type of a value."""
        return DTYPES[self.kind(value)]
