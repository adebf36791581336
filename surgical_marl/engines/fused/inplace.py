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
    """Which arrays are changed in place: by a `put`, by a loop that begins with one, or by a branch.

    `replaced`, `takers`, `kept` and `given` are as in `Schedule`; `before` says what has to come before a value, or
    before the group whose first result it is.
    """

    def __init__(self, graph: Graph, needed: list[Value], places: Places) -> None:
        self.graph, self.place, self.group_place = graph, places.of, places.of_group
        self.inside, self.alive, self._owner = places.inside, places.alive, places.owner
        self.replaced: set[Value] = set()
        self.takers: set[Value] = set()
        self.kept: dict[Value, Value] = {}
        self.given: dict[Value, Value] = {}
        self.before: dict[Value, list[Value]] = {}
        self._readers: dict[Value, list[Value]] = {}
        self._find(needed)

    def _find(self, needed: list[Value]) -> None:
        """Find the arrays that may be changed in place, and what has to come before that.

        A node that was made earlier can't depend on one that was made later. So the other readers of the array can come
        first if all of them were made earlier. A loop that begins with an array stands among them as its out.
        """
        g = self.graph
        for value in needed:
            if g.ops[value] in ("read", "put"):
                self._readers.setdefault(g.args[value][0], []).append(value)
        for number in self.inside:
            group = g.groups[number]
            if isinstance(group, Loop):
                for k in self.alive[number]:
                    if len(g.kinds[group.outs[k]]) > 1:
                        self._readers.setdefault(group.starts[k], []).append(group.outs[k])
        held = Counter(value for number in self.inside for value in self._results_of(number))
        for array, known in self._readers.items():
            last = max(known)
            if g.ops[last] in ("put", "out") and array not in held and self.place[last] == self.place[array]:
                before = self._come_first(self.place[last], last, [value for value in known if value != last])
                if before is not None:
                    self._take(array, [last], {last: before})
        for number in self.inside:
            branch = g.groups[number]
            if isinstance(branch, Branch):
                for k in self.alive[number]:
                    if len(g.kinds[branch.outs[k]]) > 1:
                        self._keep(number, branch, k, held)
                        self._give(number, branch, k, held)

    def _keep(self, number: int, branch: Branch, k: int, held: Counter[Value]) -> None:
        """Let a branch leave an array where it is, if each side changes it by `put`s and loops, or not at all."""
        inner, region = self.inside[number], self.group_place[number]
        ends = branch.chosen[k], branch.others[k]
        chains = [self._chain(end, side) for end, side in zip(ends, inner, strict=True)]
        array = chains[0][-1]
        if chains[1][-1] != array or array < 0 or self.place.get(array) != region:
            return
        if held[array] != ends.count(array) or array in self.replaced or any(held[end] > 1 for end in ends):
            return
        takers = [chain[-2] for chain in chains if len(chain) > 1]
        within = {taker: self.place[taker] for taker in takers}
        order: dict[Value, list[Value]] = {taker: [] for taker in takers}
        outside = []
        for value in self._readers.get(array, []):
            if value in takers:
                continue
            home = next((taker for taker, side in within.items() if self._around_in(side, value) is not None), None)
            if home is not None:
                order[home].append(value)
            elif all(self._around_in(side, value) is None for side in inner):
                outside.append(value)
        first = min(branch.outs[j] for j in self.alive[number])
        before = self._come_first(region, first, outside)
        inside = {taker: self._come_first(within[taker], taker, values) for taker, values in order.items()}
        if before is None or any(values is None for values in inside.values()):
            return
        self._take(array, takers, {**inside, first: before})  # type: ignore[dict-item]
        self.kept[branch.outs[k]] = array

    def _give(self, number: int, branch: Branch, k: int, held: Counter[Value]) -> None:
        """Let the sides of a branch fill its result, where they would fill an empty array of their own."""
        for end, side in zip((branch.chosen[k], branch.others[k]), self.inside[number], strict=True):
            room = self._chain(end, side)[-1]
            if held[end] == 1 and self.place.get(room) == side and self.graph.ops[room] == "room":
                self.given[room] = branch.outs[k]

    def _take(self, array: Value, takers: list[Value], before: dict[Value, list[Value]]) -> None:
        self.replaced.add(array)
        self.takers.update(takers)
        for value, readers in before.items():
            self.before.setdefault(self._item(value), []).extend(readers)

    def _item(self, value: Value) -> Value:
        """Return what stands for a value in the order of its region: the first result of the group that it is of."""
        if self.graph.ops[value] != "out":
            return value
        number = self.graph.args[value][0]
        return self.graph.groups[number].outs[self.alive[number][0]]

    def _chain(self, value: Value, region: int) -> list[Value]:
        """Return an array, the one that it is a changed copy of, and so on, until one was made outside of a region."""
        chain = [value]
        while value >= 0 and self.place[value] == region:
            made = self._made_of(value)
            if made is None:
                break
            value = made
            chain.append(value)
        return chain

    def _made_of(self, value: Value) -> Value | None:
        """Return the array that a `put` changes, or that a loop begins with."""
        if self.graph.ops[value] == "put":
            return int(self.graph.args[value][0])
        if self.graph.ops[value] != "out":
            return None
        number, k = self.graph.args[value]
        group = self.graph.groups[number]
        return group.starts[k] if isinstance(group, Loop) else None

    def _come_first(self, region: int, last: Value, values: list[Value]) -> list[Value] | None:
        """Return what must come first in a region, so that values come before the value `last`; None if some can't."""
        items = [self._around_in(region, value) for value in values]
        if any(item is None or item >= last or self._item(item) == self._item(last) for item in items):
            return None
        return items  # type: ignore[return-value]

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
