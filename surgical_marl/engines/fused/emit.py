"""Writes C for CUDA and for Clang from a scheduled graph: one environment per thread, or a vector of them.

`F I U B` are float, int, unsigned and bool: scalars in CUDA, vectors of environments on a CPU, where a branch is taken
if any of them takes it, and its results are blended. The differences are in two short preludes of macros.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from surgical_marl.engines.fused.emit_arrays import TYPES, ArrayEmitter
from surgical_marl.engines.fused.graph import Branch, Graph, Loop, Value
from surgical_marl.engines.fused.macros import WAYS, fenced, is_long, large_branches
from surgical_marl.engines.fused.memory_order import order_memory
from surgical_marl.engines.fused.schedule import Scheduler
from surgical_marl.engines.fused.stack_allocation import share_memory
from surgical_marl.engines.fused.vector_layout import interleave

LARGE = 500
"""Least number of operations in a branch whose inputs are hidden from the compiler (`HIDEF`), or in a branch or a round
of a loop that counts as work."""
APART = 1500
"""Least number of operations in a side of a branch, all that is in it included, for environments that take it to be
kept apart from those that don't."""
ROLLED = "#pragma unroll 1\n"
"""Keeps a compiler from writing the body of a loop once for each round: code that runs once has to be fetched from far,
as instruction caches don't hold it."""

_CODE = {
    "add": "{}+{}", "sub": "{}-{}", "mul": "{}*{}", "neg": "-{}", "lt": "{}<{}", "le": "{}<={}", "gt": "{}>{}",
    "ge": "{}>={}", "eq": "{}=={}", "ne": "{}!={}", "and": "{}&{}", "or": "{}|{}", "xor": "{}^{}", "shl": "{}<<{}",
    "shr": "{}>>{}", "sar": "{}>>{}", "div": "DIV{1}({0},{2})", "abs": "ABS{1}({0})", "rem": "REM{1}({0},{2})",
    "sqrt": "SQRT({})", "floor": "FLOOR({})", "ceil": "CEIL({})", "rint": "RINT({})", "pow": "POW({},{})",
    "log": "LOG({})", "tan": "TAN({})", "acos": "ACOS({})", "asin": "ASIN({})", "atan2": "ATAN2({},{})",
    "tanh": "TANH({})", "max": "MAX{1}({0},{2})", "min": "MIN{1}({0},{2})", "isfinite": "FINITE({})", "f2i": "F2I({})",
    "i2f": "I2F({})", "u2f": "U2F({})", "f2u": "F2U({})", "i2u": "I2U({})", "u2i": "U2I({})", "bits": "BITS({})",
    "float": "FLOAT({})", "select": "SELECT({0},{2},{1})",
}  # fmt: skip


class Watch(NamedTuple):
    """Which stored numbers must be finite, and what says that one was not."""

    fields: frozenset[tuple[str, int]]
    """(buffer, field) of each number."""
    flag: int
    """Field of `flags` that becomes 1. No kernel makes it 0."""


class Emitter(ArrayEmitter):
    """Writes the body of a function.

    `stores` are (buffer, field, value) in the order in which they should happen. A load is a node "load" of (buffer,
    field). Buffers are names of parameters. If there is a `watch`, the function also notices numbers that are not
    finite.
    """

    def __init__(
        self, graph: Graph, stores: list[tuple[str, int, Value]], vector: bool, watch: Watch | None = None
    ) -> None:
        super().__init__(graph, Scheduler(graph, [value for _, _, value in stores]).run(), vector)
        self.stores, self.offsets, self.watch = stores, table_offsets(graph), watch
        self.active: list[str] = []
        """Conditions of the code's branch: it applies to the environments of a vector for which all of them hold."""
        self.ways = 0
        """Branches so far whose sides keep environments apart."""

    def body(self) -> str:
        order_memory(self.graph, self.schedule, self.stores)
        self._wait(0, self._region(0, self._store))
        if self.watch:
            # Adding 0 times each number leaves 0, or NaN if one of them was NaN or infinite.
            field = self.watch.flag
            self.lines = ["F watch_=SPLAT(0.0f);", *self.lines]
            self.lines.append(f"B bad_=watch_!=SPLAT(0.0f);if(ANY(bad_)){{STB(flags,{field},LDB(flags,{field})|bad_)}}")
        if large_branches(self.lines):
            self.lines = ["I work_=SPLATI(0),ways_=SPLATI(0);", *self.lines, "STI(work,0,WORKED)"]
        # short code keeps few numbers in arrays, and fewer others in registers if it moves several at a time
        lines = interleave(self.lines) if is_long(self.lines) and not self.vector else self.lines
        lines = share_memory(lines)
        return "\n".join(fenced(lines) if self.vector else lines)

    def _region(self, number: int, result: Any) -> list[int]:
        """Write a region. Return where its long branches and loops end, as numbers of lines."""
        ends = []
        for kind, index in self.schedule.regions[number].items:
            if kind == "node":
                self._node(index)
                self._store_element(index)
            elif kind == "result":
                result(index)
            else:
                group, start = self.graph.groups[index], len(self.lines)
                (self._branch if isinstance(group, Branch) else self._loop)(index, group)  # type: ignore[arg-type]
                if len(self.lines) - start >= LARGE:
                    ends.append(len(self.lines))
        return ends

    def _store(self, k: int) -> None:
        buffer, field, value = self.stores[k]
        self.lines.append(f"ST{self.graph.kind(value).upper()}({buffer},{field},{self._name(value)});")
        if self.watch and (buffer, field) in self.watch.fields:
            self.lines.append(f"watch_+={self._name(value)}*SPLAT(0.0f);")

    def _branch(self, number: int, branch: Branch) -> None:
        wanted, condition = self.schedule.alive[number], self._name(branch.condition)
        outs = [branch.outs[k] for k in wanted]
        kept = {self.names[self.schedule.kept[out]]: out for out in outs if out in self.schedule.kept}
        for name, out in kept.items():
            self.names[out] = name
        for out in outs:
            if out in self.schedule.kept:
                continue
            self.names[out] = f"v{out}"
            if self._is_array(out):
                self._declare(f"v{out}", self.graph.kinds[out])
                continue
            kind = TYPES[self.graph.kind(out)]
            self.lines.append(f"{kind} v{out}={kind}{{}};" if self.vector else f"{kind} v{out};")
        chosen, other = self.schedule.inside[number]
        apart = next((side for side in (chosen, other) if self._size(side) >= APART and self.ways < WAYS), None)
        way = WAYS - self.ways - 1
        self.ways += apart is not None

        def take(values: list[Value], first: bool) -> Any:
            def result(k: int) -> None:
                name, value = self.names[outs[k]], values[wanted[k]]
                if self._is_array(outs[k]):
                    self._become(name, value)
                else:
                    kept = condition if self.vector and not first else ""
                    self.lines.append(self._assign(name, self._name(value), kept))

            return result

        self.lines.append(f"if(ANY({condition})){{")
        with self._side(number, condition), self._kept(kept, f"NOT({condition})"):
            self._count(chosen, way if apart == chosen else None)
            self._region(chosen, take(branch.chosen, True))
        self.lines.append(f"}}\nif(ANY(NOT({condition}))){{" if self.vector else "}else{")
        arrays = [self.names[out] for out in outs if self._is_array(out)]
        with self._side(number, f"NOT({condition})"), self._kept(arrays, condition):
            self._count(other, way if apart == other else None)
            self._region(other, take(branch.others, False))
        self.lines.append("}")

    def _count(self, region: int, way: int | None = None) -> None:
        """Note that an environment goes through a part that not all do: how long it is, and which of the `WAYS`."""
        size, all_ = len(self.schedule.regions[region].items), "&".join(self.active) or "SPLATB(1)"
        if size >= LARGE:
            self.lines.append(f"WORK({size},{all_})")
        if way is not None:
            self.lines.append(f"WAY({way},{all_})")

    def _size(self, region: int) -> int:
        """Return how many operations a region has, all that is in it included."""
        items = self.schedule.regions[region].items
        groups = [index for kind, index in items if kind == "group"]
        return len(items) + sum(self._size(inner) for group in groups for inner in self.schedule.inside[group])

    def _wait(self, top: int, places: list[int]) -> None:
        """Let threads wait for each other before some lines, if there is much to do from `top` on.

        Those of all blocks do so at the top of a loop, those of one block behind long parts.
        """
        if is_long(self.lines[top:]):
            for place in reversed(places):
                self.lines.insert(place, "PACE" if place == top else "TOGETHER")

    @contextmanager
    def _kept(self, arrays: Iterable[str], condition: str) -> Iterator[None]:
        """Let a side of a branch change arrays for those environments of a vector alone that take it."""
        before = dict(self.kept)
        if self.vector:
            self.kept.update(
                {name: f"({condition}|{before[name]})" if name in before else condition for name in arrays}
            )
        yield
        self.kept = before

    @contextmanager
    def _side(self, number: int, condition: str) -> Iterator[None]:
        """Give values from outside a large branch new names while one of its sides is written.

        The compiler takes these names for new values. Without new names it would compute before the branch what both
        sides need, which causes register spills.
        """
        self.active.append(condition)
        names, size = dict(self.names), sum(len(self.schedule.regions[r].items) for r in self.schedule.inside[number])
        if size >= LARGE and not self.vector:
            for value in self.schedule.outside[number]:
                if self._is_array(value) or self.graph.kind(value) == "b":
                    continue
                if self.names[value].isalnum():
                    kind = TYPES[self.graph.kind(value)]
                    hidden = f"h{number}v{value}"  # a branch within this one has another: `F h=h;` takes the new h
                    self.lines.append(f"{kind} {hidden}={self._name(value)};HIDE{kind}({hidden})")
                    self.names[value] = hidden
        yield
        self.names = names
        self.active.pop()

    def _loop(self, number: int, loop: Loop) -> None:
        tested, kept = loop.condition is not None, dict(self.kept)
        for k in self.schedule.alive[number]:
            self._start(number, loop, k)
        if tested and self.vector:
            self.lines.append(f"B m{number}={'&'.join(self.active) or 'SPLATB(1)'};")
        self.lines.append(self._head(number, loop))
        body, top = self.schedule.inside[number][0], len(self.lines)

        def result(k: int) -> None:
            if tested and k == 0:
                condition = self._name(loop.condition)  # type: ignore[arg-type]
                if self.vector:
                    self.lines.append(f"m{number}=m{number}&{condition};")
                    condition = f"m{number}"
                self.lines.append(f"if(!ANY({condition}))break;")

        active = self.active
        self.active = [f"m{number}"] if tested else active
        if tested:
            self._count(body)
        ends = self._region(body, result)
        self.active = active
        if self.schedule.regions[body].parent == 0 and not tested:
            self._wait(top, [top, *ends])
        self._next(number, loop)
        self.lines.append("}")
        self.kept = kept

    def _start(self, number: int, loop: Loop, k: int) -> None:
        """Declare what a loop carries, and set it to what it starts with."""
        phi, start = loop.phis[k], loop.starts[k]
        kind, name = self.graph.kinds[phi], f"v{phi}"
        if not self._is_array(phi):
            self.lines.append(f"{TYPES[kind]} {name}={self._name(start)};")
        elif loop.outs[k] in self.schedule.takers:
            name = self.names[start]
        else:
            self._declare(name, kind)
            self._become(name, start)
        self.names[phi] = self.names[loop.outs[k]] = name
        if self._is_array(phi) and loop.condition is not None and self.vector:
            self.kept[name] = f"NOT(m{number})"

    def _head(self, number: int, loop: Loop) -> str:
        r, length = f"r{number}", loop.length
        if loop.condition is not None:
            return f"{ROLLED}for(;;){{"
        if loop.counter is not None:
            self.names[loop.counter], self.wholes[loop.counter] = f"SPLATI({r})", r
        head = f"for(int {r}={length - 1};{r}>=0;--{r}){{" if loop.backwards else f"for(int {r}=0;{r}<{length};++{r}){{"
        return head if self.vector else ROLLED + head

    def _next(self, number: int, loop: Loop) -> None:
        """Write the end of a round: first all new values get names, and then they replace the old ones."""
        wanted = self.schedule.alive[number]
        carried = {self.names[loop.phis[k]] for k in wanted}
        arrays = [k for k in wanted if self._is_array(loop.phis[k])]
        sources = {k: self._name(loop.nexts[k]) for k in wanted}
        for k in wanted:
            phi, kind = loop.phis[k], self.graph.kinds[loop.phis[k]]
            if k not in arrays:
                self.lines.append(f"{TYPES[kind]} n{phi}={sources[k]};")
                sources[k] = f"n{phi}"
            elif sources[k] in carried - {self.names[phi]}:  # it may be replaced before it is read
                self._declare(f"n{phi}", kind)
                self._copy(f"n{phi}", sources[k], kind)
                sources[k] = f"n{phi}"
        for k in wanted:
            phi, tested = loop.phis[k], loop.condition is not None and self.vector
            if k in arrays:
                name = self.names[phi]
                self._copy(name, sources[k], self.graph.kinds[phi], self.kept.get(name, ""))
            else:
                self.lines.append(f"v{phi}={f'SELECT(m{number},{sources[k]},v{phi})' if tested else sources[k]};")

    def _is_array(self, value: Value) -> bool:
        return len(self.graph.kinds[value]) > 1

    def _node(self, value: Value) -> None:
        g, op = self.graph, self.graph.ops[value]
        if op == "array":
            self._array(value)
        elif op == "put":
            self._put(value)
        elif op == "read" and self._is_in_place(value):
            self.names[value] = self._read(value)
        elif g.kinds[value] == "i" and g.bounds(value):  # made of counters: the same for all environments
            code = _CODE[op].format(*map(self._whole, g.args[value]))
            self.lines.append(f"int v{value}={code};")
            self.names[value], self.wholes[value] = f"SPLATI(v{value})", f"v{value}"
        elif op == "room":
            given = self.schedule.given.get(value)
            if given is None:
                self._declare(f"v{value}", g.kinds[value])
            self.names[value] = f"v{value}" if given is None else self.names[given]
        else:
            code = self._operation(value)
            self.names[value] = f"v{value}"
            self.lines.append(f"{TYPES[g.kinds[value]]} v{value}={code};")

    def _operation(self, value: Value) -> str:
        """Return what computes a value."""
        g, op, args = self.graph, self.graph.ops[value], self.graph.args[value]
        kind = g.kinds[value]
        if op == "load":
            return f"LD{kind.upper()}({args[0]},{args[1]})"
        if op == "read":
            return self._read(value)
        if op == "lookup":
            if args[1] in self.wholes:
                return f"ROW{kind.upper()}({self.offsets[args[0]]},{self.wholes[args[1]]})"
            return f"TABLE{kind.upper()}({self.offsets[args[0]]},{self._name(args[1])})"
        if op == "not":
            return f"NOT({self._name(args[0])})" if kind == "b" else f"~{self._name(args[0])}"
        if op in ("div", "rem", "max", "min"):
            return _CODE[op].format(self._name(args[0]), kind.upper(), self._name(args[1]))
        if op == "abs":
            return _CODE[op].format(self._name(args[0]), kind.upper())
        if kind == "i" and op in ("add", "sub", "mul", "neg", "shl"):  # overflow of I is undefined in C
            return f"(I)({_CODE[op].format(*(f'(U){self._name(a)}' for a in args))})"
        return _CODE[op].format(*(self._name(a) for a in args))

    def _name(self, value: Value) -> str:
        return self.names[value] if value >= 0 else literal(self.graph.constants[~value])


def literal(value: Any) -> str:
    """Return a numpy scalar as a C literal of its type."""
    kind = value.dtype.kind
    if kind == "b":
        return "SPLATB(1)" if value else "SPLATB(0)"
    if kind == "f":
        if np.isnan(value):
            return "SPLAT(SM_NAN)"
        if np.isinf(value):
            return "SPLAT(SM_INF)" if value > 0 else "SPLAT(-SM_INF)"
        text = repr(float(value))
        return f"SPLAT({text if '.' in text or 'e' in text else text + '.0'}f)"
    if kind == "u":
        return f"SPLATU({int(value)}u)"
    return f"SPLATI({int(value)})" if value > -(2**31) else "SPLATI(-2147483647-1)"


def table_offsets(graph: Graph) -> list[int]:
    """Where each table starts in the array of all tables of its dtype."""
    ends: dict[str, int] = {}
    offsets = []
    for table in graph.tables:
        offsets.append(ends.get(table.dtype.name, 0))
        ends[table.dtype.name] = offsets[-1] + table.size
    return offsets
