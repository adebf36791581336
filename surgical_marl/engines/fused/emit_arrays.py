"""Writes C for arrays in memory: local arrays, of scalars on CUDA and of vectors of environments on a CPU.

An array that is made of another one takes over its memory if nothing else reads that one. So a loop that writes rows
writes them in place.
"""

from __future__ import annotations

from collections.abc import Iterator, Set
from itertools import groupby

import numpy as np

from surgical_marl.engines.fused.array_view import split, view
from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.schedule import Schedule

LEAST_RUN = 4
"""Least number of elements that are copied by a loop."""

TYPES = {"f": "F", "i": "I", "u": "U", "b": "B"}


class ArrayEmitter:
    """Writes the code of arrays among `lines`; `names` are what values are called there."""

    def __init__(self, graph: Graph, schedule: Schedule, vector: bool) -> None:
        self.graph, self.schedule, self.vector = graph, schedule, vector
        self.lines: list[str] = []
        self.names: dict[Value, str] = {}
        self.wholes: dict[Value, str] = {}
        """What values are called as plain ints, if they are equal for all environments."""
        self.kept: dict[str, str] = {}
        """For which environments of a vector an array must not change."""
        self._place: dict[Value, int] = {}
        self._awaited: dict[Value, list[tuple[Value, int]]] = {}
        """The elements of arrays that a value is stored in as soon as it is known, so that it needs no register."""
        self._stored: dict[Value, set[int]] = {}
        for number, region in enumerate(schedule.regions):
            for kind, item in region.items:
                if kind == "node":
                    self._note(number, item)

    def _note(self, region: int, node: Value) -> None:
        """Note where a value is computed, and which elements of arrays wait for it there."""
        g = self.graph
        self._place[node] = region
        for k, value in enumerate(g.args[node] if g.ops[node] == "array" else ()):
            if self._place.get(value) == region and g.ops[value] != "read":
                self._awaited.setdefault(value, []).append((node, k))

    def _is_in_place(self, value: Value) -> bool:
        """Whether an element of an array is read wherever it is used: at a known place of what does not change."""
        array, index = self.graph.args[value]
        return bool(index < 0) and array not in self.schedule.replaced

    def _whole(self, value: Value) -> str | None:
        if value >= 0:
            return self.wholes.get(value)
        number = int(self.graph.constants[~value])
        return f"({number})" if number < 0 else str(number)

    def _name(self, value: Value) -> str:
        raise NotImplementedError

    # -- making arrays

    def _declare(self, name: str, kind: str) -> None:
        self.lines.append(f"{TYPES[kind[0]]} {name}[{kind[1:]}];")

    def _become(self, target: str, value: Value) -> None:
        """Let an array in memory be like a value, except for environments that must keep theirs."""
        g, op = self.graph, self.graph.ops[value]
        if op == "array" and max(g.args[value], default=0) < 0:  # to copy constants would be to read them too
            self._fill(target, "0", list(g.args[value]))
        elif op != "room" or value in self.schedule.given:
            self._copy(target, self.names[value], g.kinds[value], self.kept.get(target, ""))

    def _copy(self, target: str, source: str, kind: str, kept: str = "") -> None:
        """Copy an array, except for environments that `kept` holds for."""
        if target != source:
            self.lines.append(f"for(int k=0;k<{kind[1:]};++k){self._assign(f'{target}[k]', f'{source}[k]', kept)}")

    def _assign(self, target: str, value: str, kept: str) -> str:
        return f"{target}={f'SELECT({kept},{target},{value})' if kept else value};"

    def _store_element(self, value: Value) -> None:
        """Store a value that was just computed in the arrays that wait for it."""
        for array, k in self._awaited.get(value, []):
            if array not in self.names:
                self.names[array] = f"v{array}"
                self._declare(f"v{array}", self.graph.kinds[array])
            self._stored.setdefault(array, set()).add(k)
            self.lines.append(f"v{array}[{k}]={self._name(value)};")

    def _array(self, value: Value) -> None:
        if value not in self.names:
            self.names[value] = f"v{value}"
            self._declare(f"v{value}", self.graph.kinds[value])
        self._fill(f"v{value}", "0", list(self.graph.args[value]), self._stored.get(value, set()))

    def _put(self, value: Value) -> None:
        array, index, *values = self.graph.args[value]
        name = self.names[array]
        if value not in self.schedule.takers:
            self._declare(f"v{value}", self.graph.kinds[value])
            self._copy(f"v{value}", name, self.graph.kinds[value])
            name = f"v{value}"
        self.names[value] = name
        at = self._whole(index)
        if at is not None:
            self._fill(name, at, values)
            return
        kind = TYPES[self.graph.kinds[value][0]]
        (element,) = values
        stored, kept, place = self._name(element), self.kept.get(name, ""), self._within(value, index)
        if kept:
            stored = f"SELECT({kept},AT({kind},{name},{place}),{stored})"
        self.lines.append(f"PUT({kind},{name},{place},{stored})" if self.vector else f"{name}[{place}]={stored};")

    def _fill(self, name: str, start: str, values: list[Value], stored: Set[int] = frozenset()) -> None:
        """Store values from `start` on; elements of one other array, and equal constants, by a loop."""
        kept = self.kept.get(name, "")
        for first, run in self._runs(values, stored):
            many = self._run(run) if len(run) >= LEAST_RUN else None
            if many is not None:
                store = self._assign(f"{name}[{_plus(start, first)}+k]", many, kept)
                self.lines.append(f"for(int k=0;k<{len(run)};++k){store}")
                continue
            for k, value in enumerate(run, first):
                self.lines.append(self._assign(f"{name}[{_plus(start, k)}]", self._name(value), kept))

    def _runs(self, values: list[Value], stored: Set[int]) -> Iterator[tuple[int, list[Value]]]:
        """Return runs of values that may be copied by one loop, and where they begin."""

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

    def _run(self, run: list[Value]) -> str | None:
        """Return element k of a run, if there is a rule for it."""
        if run[0] < 0:
            return self._name(run[0])
        found = view(self.graph, np.array(run))
        if (
            found is None
            or found.source in self.schedule.replaced
            or (found.base is not None and found.base not in self.wholes)
        ):
            return None
        start = _plus("0" if found.base is None else self.wholes[found.base], found.first)
        return f"{self.names[found.source]}[{start}+({found.strides[0]})*k]"

    # -- reading them

    def _read(self, value: Value) -> str:
        """Return the element of an array. An element at a known place gets no name of its own, and so no register."""
        array, index = self.graph.args[value]
        at = self._whole(index)
        if at is None and self.vector:
            return f"AT({TYPES[self.graph.kinds[value]]},{self.names[array]},{self._within(array, index)})"
        return f"{self.names[array]}[{self._name(index) if at is None else at}]"

    def _within(self, array: Value, index: Value) -> str:
        """Return a place in an array. In a vector, environments that sit out this branch or round may be anywhere."""
        last = int(self.graph.kinds[array][1:]) - 1
        return f"WITHIN({self._name(index)},{last})" if self.vector else self._name(index)


def _plus(start: str, more: int) -> str:
    return str(more) if start == "0" else f"{start}+{more}" if more else start


def _moving(graph: Graph, index: Value) -> Value:
    """Return what an index is without the constant in it, -1 for a constant."""
    moving, _ = split(graph, index)
    return -1 if moving is None else moving
