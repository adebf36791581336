"""Checks of the IR, which are run after each pass in tests, and with `SURGICAL_MARL_VERIFY=1`."""

from __future__ import annotations

from collections.abc import Iterator

from surgical_marl.engines.fused import instructions as ir
from surgical_marl.engines.fused.graph import Branch, Graph, Loop, Value
from surgical_marl.engines.fused.kernel_layout import BUFFERS
from surgical_marl.engines.fused.schedule import Schedule


class Malformed(AssertionError):
    """The IR breaks one of its rules: a fault of the compiler."""


def check_graph(graph: Graph) -> None:
    """Check that nodes read earlier nodes, and that what branches and loops join is of one kind.

    Raises:
        Malformed: it is not so.
    """
    for node in range(len(graph.ops)):
        if any(read >= node for read in graph.reads(node)):
            raise Malformed(f"node {node} ({graph.ops[node]}) reads one that was made later")
    for number, group in enumerate(graph.groups):
        sides = (group.chosen, group.others) if isinstance(group, Branch) else (group.starts, group.nexts)
        for values in zip(group.outs, *sides, strict=False):
            if len({graph.kind(value) for value in values}) > 1:
                raise Malformed(f"group {number} joins {[graph.kind(value) for value in values]}")


def check_schedule(graph: Graph, schedule: Schedule, results: list[Value]) -> None:
    """Check that every value is computed once, before its uses, and that no array is read after it is overwritten.

    Raises:
        Malformed: it is not so.
    """
    _ScheduleCheck(graph, schedule).region(0, results, set(), set())


class _ScheduleCheck:
    """Walks through the regions of a schedule; values that are known, and arrays that are overwritten, are sets."""

    def __init__(self, graph: Graph, schedule: Schedule) -> None:
        self.graph, self.plan = graph, schedule
        self.computed: set[tuple[str, int]] = set()

    def region(self, number: int, results: list[Value], known: set[Value], lost: set[Value]) -> None:
        waiting = set(range(len(results)))
        for kind, index in self.plan.regions[number].items:
            if kind == "result":
                self._read(results[index], known, lost)
                waiting.remove(index)
                continue
            if (kind, index) in self.computed:
                raise Malformed(f"{kind} {index} is computed twice")
            self.computed.add((kind, index))
            if kind == "node":
                for value in self.graph.reads(index):
                    self._read(value, known, lost)
                if index in self.plan.in_place:
                    lost.add(self.graph.args[index][0])
                known.add(index)
            else:
                group = self.graph.groups[index]
                if isinstance(group, Branch):
                    self._branch(index, group, known, lost)
                else:
                    self._loop(index, group, known, lost)
                known.update(group.outs[k] for k in self.plan.live[index])
        if waiting:
            raise Malformed(f"region {number} has no result {min(waiting)}")

    def _read(self, value: Value, known: set[Value], lost: set[Value]) -> None:
        if value >= 0 and value not in known:
            raise Malformed(f"value {value} ({self.graph.ops[value]}) is read before it is computed")
        if value in lost:
            raise Malformed(f"array {value} is read after it was overwritten")

    def _branch(self, number: int, branch: Branch, known: set[Value], lost: set[Value]) -> None:
        self._read(branch.condition, known, lost)
        live = self.plan.live[number]
        for region, side in zip(self.plan.inside[number], (branch.chosen, branch.others), strict=True):
            self.region(region, [side[k] for k in live], set(known), set(lost))
        lost.update(self.plan.merged[branch.outs[k]] for k in live if branch.outs[k] in self.plan.merged)

    def _loop(self, number: int, loop: Loop, known: set[Value], lost: set[Value]) -> None:
        live = self.plan.live[number]
        for k in live:
            self._read(loop.starts[k], known, lost)
        lost.update(loop.starts[k] for k in live if loop.outs[k] in self.plan.in_place)
        given = {loop.phis[k] for k in live} | ({loop.counter} if loop.counter is not None else set())
        condition = [] if loop.condition is None else [loop.condition]
        results = condition + [loop.nexts[k] for k in live]
        self.region(self.plan.inside[number][0], results, known | given, set(lost))


def check_code(code: ir.Code) -> None:
    """Check that names are declared once and before their uses, that known indices are in range, and that blocks end.

    Raises:
        Malformed: it is not so.
    """
    scopes: list[dict[str, int]] = [dict.fromkeys(BUFFERS, 0)]
    opened: list[object] = []
    for one in code:
        if isinstance(one, ir.End | ir.Else):
            if not opened or (isinstance(one, ir.Else) and not isinstance(opened[-1], ir.If)):
                raise Malformed(f"{one} ends nothing")
            scopes.pop()
            if isinstance(one, ir.End):
                opened.pop()
        for operand in ir.operands(one):
            _check_operand(operand, scopes, one.rounds if isinstance(one, ir.Repeat) else 1)
        for name, size in _declared(one):
            if any(name in scope for scope in scopes):
                raise Malformed(f"{name} is declared twice")
            scopes[-1][name] = size
        if isinstance(one, (*ir.OPENS, ir.Else)):
            scopes.append({one.counter: 0} if isinstance(one, ir.For) else {})
        if isinstance(one, ir.OPENS):
            opened.append(one)
        if isinstance(one, ir.Break) and not any(isinstance(block, ir.While) for block in opened):
            raise Malformed("a break is outside of a loop")
    if opened:
        raise Malformed(f"{opened[-1]} does not end")


def _declared(one: object) -> Iterator[tuple[str, int]]:
    """Yield the name that an instruction declares, and the size of an array or 0."""
    if isinstance(one, ir.Declare):
        yield one.name, one.size
    elif isinstance(one, ir.Define | ir.Hide):
        yield one.name, 0


def _check_operand(operand: ir.Operand, scopes: list[dict[str, int]], rounds: int) -> None:
    for part in ir.parts(operand):
        name = part if isinstance(part, str) else part.array if isinstance(part, ir.Element | ir.Gather) else None
        if name is None:
            continue
        size = next((scope[name] for scope in reversed(scopes) if name in scope), None)
        if size is None:
            raise Malformed(f"{name} is used before it is declared")
        if (size > 0) == isinstance(part, str):
            raise Malformed(f"{name} is {'an array' if size else 'no array'}")
        if isinstance(part, ir.Gather) and part.last >= size:
            raise Malformed(f"{name}[{part.last}] is out of range")
        if isinstance(part, ir.Element) and part.base is None:
            for k in (0, rounds - 1):
                index = part.width * (part.offset + part.stride * k) + part.lane
                if not 0 <= index < size:
                    raise Malformed(f"{name}[{index}] is out of range")
