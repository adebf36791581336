"""Finds arrays in memory that can be changed in place, so that nothing is copied."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from surgical_marl.engines.fused.graph import Branch, Graph, Loop, Value


@dataclass
class Places:
    """Where everything is computed: see `Scheduler`."""

    of: dict[Value, int]
    """Value -> its region."""
    of_group: dict[int, int]
    inside: dict[int, tuple[int, ...]]
    alive: dict[int, list[int]]
    owner: dict[int, int]
    """Region -> the group that it belongs to."""


class Takeovers:
    """Which arrays are changed in place.

    `replaced`, `takers` and `kept` are as in `Schedule`; `before` says what has to come before a value, or before the
    group whose first result it is.
    """

    def __init__(self, graph: Graph, needed: list[Value], places: Places) -> None:
        self.graph, self.place, self.group_place = graph, places.of, places.of_group
        self.inside, self.alive, self._owner = places.inside, places.alive, places.owner
        self.replaced: set[Value] = set()
        self.takers: set[Value] = set()
        self.kept: dict[Value, Value] = {}
        self.before: dict[Value, list[Value]] = {}
        self._readers: dict[Value, list[Value]] = {}
        self._find(needed)

    def _find(self, needed: list[Value]) -> None:
        """Find the arrays that a `put`, or a branch, may change in place, and what has to come before it (`_before`).

        A node that was made earlier can't depend on one that was made later. So the other readers of the array can come
        first if all of them were made earlier.
        """
        g = self.graph
        for value in needed:
            if g.ops[value] in ("read", "put"):
                self._readers.setdefault(g.args[value][0], []).append(value)
        for number in self.inside:
            group = g.groups[number]
            if isinstance(group, Loop):
                for k in self.alive[number]:
                    self._readers.setdefault(group.starts[k], []).append(group.outs[k])
        held = Counter(value for number in self.inside for value in self._results_of(number))
        for array, known in self._readers.items():
            last = max(known)
            if g.ops[last] == "put" and array not in held and self.place[last] == self.place[array]:
                before = self._come_first(self.place[last], last, [value for value in known if value != last])
                if before is not None:
                    self._take(array, [last], {last: before})
        for number in self.inside:
            branch = g.groups[number]
            if isinstance(branch, Branch):
                for k in self.alive[number]:
                    if len(g.kinds[branch.outs[k]]) > 1:
                        self._keep(number, branch, k, held)

    def _keep(self, number: int, branch: Branch, k: int, held: Counter[Value]) -> None:
        """Let a branch leave an array where it is, if one side changes it by `put`s and the other one too, or not."""
        inner, region = self.inside[number], self.group_place[number]
        ends = branch.chosen[k], branch.others[k]
        chains = [self._chain(end, side) for end, side in zip(ends, inner, strict=True)]
        array = chains[0][-1]
        if chains[1][-1] != array or array < 0 or self.place.get(array) != region:
            return
        if held[array] != ends.count(array) or array in self.replaced or any(held[end] > 1 for end in ends):
            return
        puts = [chain[-2] for chain in chains if len(chain) > 1]
        within = {put: self.place[put] for put in puts}
        order: dict[Value, list[Value]] = {put: [] for put in puts}
        outside = []
        for value in self._readers.get(array, []):
            if value in puts:
                continue
            home = next((put for put, side in within.items() if self._around_in(side, value) is not None), None)
            if home is not None:
                order[home].append(value)
            elif all(self._around_in(side, value) is None for side in inner):
                outside.append(value)
        first = min(branch.outs[j] for j in self.alive[number])
        before = self._come_first(region, first, outside)
        inside = {put: self._come_first(within[put], put, values) for put, values in order.items()}
        if before is None or any(values is None for values in inside.values()):
            return
        self._take(array, puts, {**inside, branch.outs[self.alive[number][0]]: before})  # type: ignore[dict-item]
        self.kept[branch.outs[k]] = array

    def _take(self, array: Value, puts: list[Value], before: dict[Value, list[Value]]) -> None:
        self.replaced.add(array)
        self.takers.update(puts)
        for value, readers in before.items():
            self.before.setdefault(value, []).extend(readers)

    def _chain(self, value: Value, region: int) -> list[Value]:
        """Return an array, the one that it is a changed copy of, and so on, until one was made outside of a region."""
        chain = [value]
        while value >= 0 and self.graph.ops[value] == "put" and self.place[value] == region:
            value = self.graph.args[value][0]
            chain.append(value)
        return chain

    def _come_first(self, region: int, last: Value, values: list[Value]) -> list[Value] | None:
        """Return what must come first in a region, so that values come before the value `last`; None if some can't."""
        items = [self._around_in(region, value) for value in values]
        return None if any(item is None or item >= last for item in items) else items  # type: ignore[return-value]

    def _results_of(self, number: int) -> Iterable[Value]:
        group = self.graph.groups[number]
        for k in self.alive[number]:
            yield from (group.chosen[k], group.others[k]) if isinstance(group, Branch) else (group.nexts[k],)

    def _around_in(self, region: int, value: Value) -> Value | None:
        """Return the value, or the last result of the group in a region that it is computed in."""
        here = self.place[value]
        while here != region:
            if here <= 0:
                return None
            group = self._owner[here]
            value, here = max(self.graph.groups[group].outs[k] for k in self.alive[group]), self.group_place[group]
        return value
