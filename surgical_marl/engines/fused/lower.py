"""Lowers a scheduled graph to the instruction IR: one environment a thread, or a vector of them.

On a CPU a branch is taken if any environment of the vector takes it, and its results are blended.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from surgical_marl.engines.fused import instructions as ir
from surgical_marl.engines.fused.graph import Branch, Graph, Loop, Value
from surgical_marl.engines.fused.lower_arrays import ArrayLowering
from surgical_marl.engines.fused.schedule import Schedule

Stores = list[tuple[str, int, Value]]
"""Buffer, field and value of each store of a kernel."""


def lower(graph: Graph, schedule: Schedule, stores: Stores, vector: bool) -> ir.Code:
    """Return the instructions of a scheduled function.

    Args:
        graph: of the function. A node "load" names a buffer and a field.
        schedule: of the values that are stored.
        stores: in the order of the schedule's results.
        vector: whether the code is for a CPU, with vectors.
    """
    lowering = Lowering(graph, schedule, stores, vector)
    lowering.region(0, lowering.store)
    return lowering.code


class Lowering(ArrayLowering):
    """Appends the instructions of regions, branches and loops to `code`."""

    def __init__(self, graph: Graph, schedule: Schedule, stores: Stores, vector: bool) -> None:
        super().__init__(graph, schedule, vector)
        self.stores, self.offsets = stores, table_offsets(graph)
        self.active: tuple[ir.Operand, ...] = ()
        """Conditions of the blocks around: code applies to the lanes for which all of them hold."""

    def region(self, number: int, result: Callable[[int], None]) -> None:
        """Append a region; `result` is called where one of its results is known."""
        for kind, index in self.schedule.regions[number].items:
            if kind == "node":
                self._node(index)
                self.store_element(index)
            elif kind == "result":
                result(index)
            else:
                group = self.graph.groups[index]
                self._branch(index, group) if isinstance(group, Branch) else self._loop(index, group)

    def store(self, k: int) -> None:
        """Append a store of the kernel."""
        buffer, field, value = self.stores[k]
        self.code.append(ir.Store(buffer, field, self.graph.kind(value), self.name(value)))

    def _size(self, region: int) -> ir.Size:
        items = self.schedule.regions[region].items
        groups = [index for kind, index in items if kind == "group"]
        inner = sum(self._size(one).total for group in groups for one in self.schedule.inside[group])
        return ir.Size(len(items), len(items) + inner)

    # -- branches

    def _branch(self, number: int, branch: Branch) -> None:
        live, condition = self.schedule.live[number], self.name(branch.condition)
        outs = [branch.outs[k] for k in live]
        merged = {self.names[self.schedule.merged[out]]: out for out in outs if out in self.schedule.merged}
        for name, out in merged.items():
            self.names[out] = name
        for out in outs:
            if out not in self.schedule.merged:
                self._declare_out(out)
        chosen, other = self.schedule.inside[number]
        inputs = tuple(self._inputs(number))
        self.code.append(ir.If(condition, number, (self._size(chosen), self._size(other)), inputs))
        with self._side(condition, merged, _not(condition)):
            self.region(chosen, self._become_outs(outs, [branch.chosen[k] for k in live], None))
        self.code.append(ir.Else(condition))
        arrays = [self.names[out] for out in outs if self.is_array(out)]
        with self._side(_not(condition), arrays, condition):
            self.region(other, self._become_outs(outs, [branch.others[k] for k in live], condition))
        self.code.append(ir.End())

    def _declare_out(self, out: Value) -> None:
        self.names[out] = f"v{out}"
        if self.is_array(out):
            self.declare(f"v{out}", self.graph.kinds[out])
        else:
            self.code.append(ir.Define(f"v{out}", self.graph.kind(out)))

    def _become_outs(self, outs: list[Value], values: list[Value], keep: ir.Operand | None) -> Callable[[int], None]:
        """Return how results of a branch get the values of one side, in all lanes but those of `keep`."""

        def result(k: int) -> None:
            name = self.names[outs[k]]
            if self.is_array(outs[k]):
                self.become(name, values[k])
            else:
                self.code.append(ir.Assign(name, self.name(values[k]), keep if self.vector else None))

        return result

    def _inputs(self, number: int) -> Iterator[tuple[str, str]]:
        """Yield names and kinds of the registers from outside that a branch reads."""
        for value in self.schedule.outside[number]:
            if not self.is_array(value) and isinstance(name := self.names[value], str):
                yield name, self.graph.kind(value)

    @contextmanager
    def _side(self, condition: ir.Operand, arrays: Iterable[str], others: ir.Operand) -> Iterator[None]:
        """Lower a side of a branch, which changes these arrays except for the lanes of `others`."""
        names, active, keep = dict(self.names), self.active, dict(self.keep)
        self.active = (*active, condition)
        if self.vector:
            for name in arrays:
                self.keep[name] = ir.Call("or", "b", (others, keep[name])) if name in keep else others
        yield
        self.names, self.active, self.keep = names, active, keep

    # -- loops

    def _loop(self, number: int, loop: Loop) -> None:
        tested, keep, active = loop.condition is not None, dict(self.keep), self.active
        mask, body = f"m{number}", self.schedule.inside[number][0]
        for k in self.schedule.live[number]:
            self._start(loop, k, mask)
        if tested and self.vector:
            self.code.append(ir.Define(mask, "b", ir.Call("all", "b", active)))
        if tested:
            self.code.append(ir.While(mask if self.vector else None, self._size(body)))
            self.active = (mask,)
        else:
            counter = f"r{number}"
            if loop.counter is not None:
                self.names[loop.counter], self.uniform[loop.counter] = ir.Call("splat", "i", (counter,)), counter
            self.code.append(ir.For(counter, loop.length, loop.backwards))

        def result(k: int) -> None:
            if loop.condition is not None and k == 0:
                condition = self.name(loop.condition)
                if self.vector:
                    self.code.append(ir.Assign(mask, ir.Call("and", "b", (mask, condition))))
                    condition = mask
                self.code.append(ir.Break(condition))

        self.region(body, result)
        self._next(number, loop, mask)
        self.code.append(ir.End())
        self.keep, self.active = keep, active

    def _start(self, loop: Loop, k: int, mask: str) -> None:
        """Declare what a loop carries, and set it to what it starts with."""
        phi, start = loop.phis[k], loop.starts[k]
        kind, name = self.graph.kinds[phi], f"v{phi}"
        if not self.is_array(phi):
            self.code.append(ir.Define(name, kind, self.name(start)))
        elif loop.outs[k] in self.schedule.in_place:
            name = self.names[start]
        else:
            self.declare(name, kind)
            self.become(name, start)
        self.names[phi] = self.names[loop.outs[k]] = name
        if self.is_array(phi) and loop.condition is not None and self.vector:
            self.keep[name] = _not(mask)

    def _next(self, number: int, loop: Loop, mask: str) -> None:
        """Append the end of a round: all new values get registers first, and then replace the old ones."""
        live = self.schedule.live[number]
        carried = {self.names[loop.phis[k]] for k in live}
        arrays = [k for k in live if self.is_array(loop.phis[k])]
        new = {k: self.name(loop.nexts[k]) for k in live}
        for k in live:
            phi, kind = loop.phis[k], self.graph.kinds[loop.phis[k]]
            if k not in arrays:
                self.code.append(ir.Define(f"n{phi}", kind, new[k]))
                new[k] = f"n{phi}"
            elif new[k] in carried - {self.names[phi]}:  # it may be replaced before it is read
                self.declare(f"n{phi}", kind)
                self.copy(f"n{phi}", str(new[k]), kind)
                new[k] = f"n{phi}"
        tested = loop.condition is not None and self.vector
        for k in live:
            phi, name = loop.phis[k], self.names[loop.phis[k]]
            if k in arrays:
                self.copy(name, str(new[k]), self.graph.kinds[phi], self.keep.get(name))
            else:
                value = ir.Call("select", self.graph.kinds[phi], (mask, new[k], name)) if tested else new[k]
                self.code.append(ir.Assign(name, value))

    # -- values

    def _node(self, value: Value) -> None:
        g, op = self.graph, self.graph.ops[value]
        if op == "array":
            self.array(value)
        elif op == "fields":
            self.fields(value)
        elif op == "update":
            self.update(value)
        elif op == "read" and self.is_operand(value):
            self.names[value] = self.read(value)
        elif g.kinds[value] == "i" and g.bounds(value):  # made of counters: the same for all environments
            args = tuple(self.uniform[a] if a >= 0 else int(g.constants[~a]) for a in g.args[value])
            self.code.append(ir.Define(f"v{value}", "int", ir.Call(op, "int", args)))
            self.names[value], self.uniform[value] = ir.Call("splat", "i", (f"v{value}",)), f"v{value}"
        elif op == "empty":
            target = self.schedule.destination.get(value)
            if target is None:
                self.declare(f"v{value}", g.kinds[value])
            self.names[value] = f"v{value}" if target is None else self.names[target]
        else:
            self.code.append(ir.Define(f"v{value}", g.kinds[value], self._operation(value)))
            self.names[value] = f"v{value}"

    def _operation(self, value: Value) -> ir.Operand:
        """Return the operation that computes a value."""
        g, op, args = self.graph, self.graph.ops[value], self.graph.args[value]
        kind = g.kinds[value]
        if op == "load":
            return ir.Call("load", kind, args)
        if op == "read":
            return self.read(value)
        if op == "lookup":
            number, index = args
            if index in self.uniform:
                return ir.Call("row", kind, (self.offsets[number], self.uniform[index]))
            return ir.Call("table", kind, (self.offsets[number], self.name(index)))
        operands = tuple(map(self.name, args))
        if op == "select":  # the graph has what is chosen last, C has it first
            operands = operands[0], operands[2], operands[1]
        return ir.Call(op, kind, operands)


def _not(condition: ir.Operand) -> ir.Operand:
    return ir.Call("not", "b", (condition,))


def table_offsets(graph: Graph) -> list[int]:
    """Return where each table starts in the array of all tables of its dtype."""
    ends: dict[str, int] = {}
    offsets = []
    for table in graph.tables:
        offsets.append(ends.get(table.dtype.name, 0))
        ends[table.dtype.name] = offsets[-1] + table.size
    return offsets
