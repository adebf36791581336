"""Lowers arrays of the graph to local arrays: of scalars on CUDA and of vectors of environments on a CPU.

An array that is an updated copy of another one has its memory where `inplace.py` found that nothing else reads that
one. So a loop that writes rows writes them in place.
"""

from __future__ import annotations

from collections.abc import Iterator, Set
from itertools import groupby
from typing import Any

import numpy as np

from surgical_marl.engines.fused import instructions as ir
from surgical_marl.engines.fused.array_view import split, view
from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.schedule import Schedule

SHORTEST_REPEAT = 4
"""Least number of elements that are copied by a loop."""


class ArrayLowering:
    """Appends the instructions of arrays to `code`; `names` has the operand that stands for each value."""

    def __init__(self, graph: Graph, schedule: Schedule, vector: bool) -> None:
        self.graph, self.schedule, self.vector = graph, schedule, vector
        self.code: ir.Code = []
        self.names: dict[Value, Any] = {}
        self.uniform: dict[Value, str] = {}
        """The plain ints of values that are equal for all environments."""
        self.keep: dict[str, ir.Operand] = {}
        """Array -> the lanes of a vector in which it must not change."""
        self._region_of: dict[Value, int] = {}
        self._waiting: dict[Value, list[tuple[Value, int]]] = {}
        """Value -> elements of arrays that it is stored in as soon as it is known, so that it needs no register."""
        self._stored: dict[Value, set[int]] = {}
        for number, region in enumerate(schedule.regions):
            for kind, item in region.items:
                if kind == "node":
                    self._note(number, item)

    def _note(self, region: int, node: Value) -> None:
        """Note where a value is computed, and which elements of arrays it is stored in there."""
        g = self.graph
        self._region_of[node] = region
        for k, value in enumerate(g.args[node] if g.ops[node] == "array" else ()):
            if self._region_of.get(value) == region and g.ops[value] != "read":
                self._waiting.setdefault(value, []).append((node, k))

    def is_operand(self, read: Value) -> bool:
        """Return whether a read needs no instruction: it is at a known index of an array that does not change."""
        array, index = self.graph.args[read]
        return bool(index < 0) and array not in self.schedule.overwritten

    def is_array(self, value: Value) -> bool:
        return len(self.graph.kinds[value]) > 1

    def name(self, value: Value) -> ir.Operand:
        """Return the operand that stands for a value."""
        found: ir.Operand = self.names[value] if value >= 0 else self.graph.constants[~value]
        return found

    def place(self, index: Value) -> tuple[ir.Operand | None, int] | None:
        """Return base and offset of an index that is the same for all environments, None for others."""
        if index < 0:
            return None, int(self.graph.constants[~index])
        return (self.uniform[index], 0) if index in self.uniform else None

    # -- making arrays

    def declare(self, name: str, kind: str) -> None:
        """Declare an array of a kind such as "f64"."""
        self.code.append(ir.Declare(name, kind[0], int(kind[1:])))

    def become(self, target: str, value: Value) -> None:
        """Fill an array with the elements of a value, in all lanes that do not keep theirs."""
        g, op = self.graph, self.graph.ops[value]
        if op == "array" and max(g.args[value], default=0) < 0:  # to copy constants would be to read them too
            self._fill(target, (None, 0), list(g.args[value]))
        elif op != "empty" or value in self.schedule.destination:
            self.copy(target, self.names[value], g.kinds[value], self.keep.get(target))

    def copy(self, target: str, source: str, kind: str, keep: ir.Operand | None = None) -> None:
        """Copy an array, in all lanes but those of `keep`."""
        if target != source:
            assign = ir.Assign(ir.Element(target, stride=1), ir.Element(source, stride=1), keep)
            self.code.append(ir.Repeat(int(kind[1:]), assign))

    def store_element(self, value: Value) -> None:
        """Store a value that was just computed in the arrays that wait for it."""
        for array, k in self._waiting.get(value, []):
            if array not in self.names:
                self.names[array] = f"v{array}"
                self.declare(f"v{array}", self.graph.kinds[array])
            self._stored.setdefault(array, set()).add(k)
            self.code.append(ir.Assign(ir.Element(f"v{array}", offset=k), self.name(value)))

    def array(self, value: Value) -> None:
        """Make an array of values: store those that are not stored yet."""
        if value not in self.names:
            self.names[value] = f"v{value}"
            self.declare(f"v{value}", self.graph.kinds[value])
        self._fill(f"v{value}", (None, 0), list(self.graph.args[value]), self._stored.get(value, set()))

    def fields(self, value: Value) -> None:
        """Make an array of fields of a buffer."""
        kind, name = self.graph.kinds[value], f"v{value}"
        self.names[value] = name
        self.declare(name, kind)
        load = ir.Call("fields", kind[0], self.graph.args[value])
        self.code.append(ir.Repeat(int(kind[1:]), ir.Assign(ir.Element(name, stride=1), load)))

    def update(self, value: Value) -> None:
        """Store the new elements of an updated array, in place or in a copy."""
        array, index, *values = self.graph.args[value]
        name = self.names[array]
        if value not in self.schedule.in_place:
            self.declare(f"v{value}", self.graph.kinds[value])
            self.copy(f"v{value}", name, self.graph.kinds[value])
            name = f"v{value}"
        self.names[value] = name
        place = self.place(index)
        if place is not None:
            self._fill(name, place, values)
            return
        (element,) = values
        stored, keep = self.name(element), self.keep.get(name)
        if not self.vector:
            self.code.append(ir.Assign(ir.Element(name, self.name(index)), stored))
            return
        target = self._gather(name, value, index)
        if keep is not None:
            stored = ir.Call("select", target.kind, (keep, target, stored))
        self.code.append(ir.Scatter(target, stored))

    def _fill(
        self, name: str, start: tuple[ir.Operand | None, int], values: list[Value], stored: Set[int] = frozenset()
    ) -> None:
        """Store values from `start` on; elements of one other array, and equal constants, by a loop."""
        keep, (base, first) = self.keep.get(name), start
        for at, run in self._runs(values, stored):
            many = self._run(run) if len(run) >= SHORTEST_REPEAT else None
            if many is not None:
                store = ir.Assign(ir.Element(name, base, first + at, stride=1), many, keep)
                self.code.append(ir.Repeat(len(run), store))
                continue
            for k, value in enumerate(run, first + at):
                self.code.append(ir.Assign(ir.Element(name, base, k), self.name(value), keep))

    def _runs(self, values: list[Value], stored: Set[int]) -> Iterator[tuple[int, list[Value]]]:
        """Yield runs of values that may be copied by one loop, and where they begin."""

        def sort(item: tuple[int, int]) -> tuple[int, ...]:
            count, k = item
            value = values[k]
            if value >= 0 and self.graph.ops[value] == "read":
                source, index = self.graph.args[value]
                return source, _moving(self.graph, index), k - count
            return (value, k - count) if value < 0 else (-1, k, 0, 0)

        for _, run in groupby(enumerate(k for k in range(len(values)) if k not in stored), sort):
            places = [k for _, k in run]
            yield places[0], [values[k] for k in places]

    def _run(self, run: list[Value]) -> ir.Operand | None:
        """Return element k of a run as an operand, None if there is no rule for it."""
        if run[0] < 0:
            return self.name(run[0])
        found = view(self.graph, np.array(run))
        if (
            found is None
            or found.source in self.schedule.overwritten
            or (found.base is not None and found.base not in self.uniform)
        ):
            return None
        base = None if found.base is None else self.uniform[found.base]
        return ir.Element(self.names[found.source], base, found.first, found.strides[0])

    # -- reading them

    def read(self, value: Value) -> ir.Operand:
        """Return an element of an array. One at a known index gets no name of its own, and so no register."""
        array, index = self.graph.args[value]
        place = self.place(index)
        if place is not None:
            return ir.Element(self.names[array], *place)
        if self.vector:
            return self._gather(self.names[array], array, index)
        return ir.Element(self.names[array], self.name(index))

    def _gather(self, name: str, array: Value, index: Value) -> ir.Gather:
        """Return the elements of an array at an index that differs between lanes.

        Lanes that are not active in this branch or round may have any index: it is clipped.
        """
        kind = self.graph.kinds[array]
        return ir.Gather(name, kind[0], self.name(index), int(kind[1:]) - 1)


def _moving(graph: Graph, index: Value) -> Value:
    """Return what an index is without the constant in it, -1 for a constant."""
    moving, _ = split(graph, index)
    return -1 if moving is None else moving
