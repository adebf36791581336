"""Finds arrays that can be updated in place, so that nothing is copied.

In the graph nothing changes an array: an update makes another one. Both can have one place in memory if all other
readers of the old array come before the update. Three things can overwrite an array: an update, a loop that starts with
it, and a branch whose sides update it or leave it as it is.

before: F v9[64]; for(int k=0;k<64;++k)v9[k]=v4[k]; v9[r3]=v7;
after:  v4[r3]=v7;

This is the analysis that compilers of functional arrays call destructive update, and XLA buffer assignment.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from surgical_marl.engines.fused.graph import Branch, Graph, Loop, Value


@dataclass
class Places:
    """The regions in which values and groups are computed: see `Scheduler`."""

    of: dict[Value, int]
    """Value -> its region."""
    of_group: dict[int, int]
    inside: dict[int, tuple[int, ...]]
    live: dict[int, list[int]]
    owner: dict[int, int]
    """Region -> the group that it belongs to."""


class InPlace:
    """The arrays that are overwritten in place, and what that demands of the order.

    Attributes:
        overwritten, in_place, merged, destination: as in `Schedule`.
        before: what has to come before a value; of a group it is what has to come before its first result.
    """

    def __init__(self, graph: Graph, needed: list[Value], places: Places) -> None:
        self.graph, self.place, self.group_place = graph, places.of, places.of_group
        self.inside, self.live, self._owner = places.inside, places.live, places.owner
        self.overwritten: set[Value] = set()
        self.in_place: set[Value] = set()
        self.merged: dict[Value, Value] = {}
        self.destination: dict[Value, Value] = {}
        self.before: dict[Value, list[Value]] = {}
        self._readers: dict[Value, list[Value]] = {}
        self._find(needed)

    def _find(self, needed: list[Value]) -> None:
        """Find the arrays that can be overwritten, and what has to come before that.

        Nodes are numbered in the order in which they were made, and a node depends on earlier ones alone. So the last
        reader of an array can overwrite it if all others were made before it. A loop that starts with an array counts
        as a reader, by its out.
        """
        g = self.graph
        for value in needed:
            if g.ops[value] in ("read", "update"):
                self._readers.setdefault(g.args[value][0], []).append(value)
        for number in self.inside:
            group = g.groups[number]
            if isinstance(group, Loop):
                for k in self.live[number]:
                    if len(g.kinds[group.outs[k]]) > 1:
                        self._readers.setdefault(group.starts[k], []).append(group.outs[k])
        held = Counter(value for number in self.inside for value in self._results_of(number))
        for array, known in self._readers.items():
            last = max(known)
            if g.ops[last] in ("update", "out") and array not in held and self.place[last] == self.place[array]:
                before = self._come_first(self.place[last], last, [value for value in known if value != last])
                if before is not None:
                    self._overwrite(array, [last], {last: before})
        for number in self.inside:
            branch = g.groups[number]
            if isinstance(branch, Branch):
                for k in self.live[number]:
                    if len(g.kinds[branch.outs[k]]) > 1:
                        self._merge(number, branch, k, held)
                        self._redirect(number, branch, k, held)

    def _merge(self, number: int, branch: Branch, k: int, held: Counter[Value]) -> None:
        """Merge an array in place if each side of a branch updates it, by updates and loops, or leaves it as it is."""
        inner, region = self.inside[number], self.group_place[number]
        ends = branch.chosen[k], branch.others[k]
        chains = [self._chain(end, side) for end, side in zip(ends, inner, strict=True)]
        array = chains[0][-1]
        if chains[1][-1] != array or array < 0 or self.place.get(array) != region:
            return
        if held[array] != ends.count(array) or array in self.overwritten or any(held[end] > 1 for end in ends):
            return
        updates = [chain[-2] for chain in chains if len(chain) > 1]
        within = {update: self.place[update] for update in updates}
        order: dict[Value, list[Value]] = {update: [] for update in updates}
        outside = []
        for value in self._readers.get(array, []):
            if value in updates:
                continue
            home = next((update for update, side in within.items() if self._around_in(side, value) is not None), None)
            if home is not None:
                order[home].append(value)
            elif all(self._around_in(side, value) is None for side in inner):
                outside.append(value)
        first = min(branch.outs[j] for j in self.live[number])
        before = self._come_first(region, first, outside)
        inside = {update: self._come_first(within[update], update, values) for update, values in order.items()}
        if before is None or any(values is None for values in inside.values()):
            return
        self._overwrite(array, updates, {**inside, first: before})  # type: ignore[dict-item]
        self.merged[branch.outs[k]] = array

    def _redirect(self, number: int, branch: Branch, k: int, held: Counter[Value]) -> None:
        """Let a side of a branch fill the result itself, instead of an empty array that is then copied there."""
        for end, side in zip((branch.chosen[k], branch.others[k]), self.inside[number], strict=True):
            empty = self._chain(end, side)[-1]
            if held[end] == 1 and self.place.get(empty) == side and self.graph.ops[empty] == "empty":
                self.destination[empty] = branch.outs[k]

    def _overwrite(self, array: Value, updates: list[Value], before: dict[Value, list[Value]]) -> None:
        self.overwritten.add(array)
        self.in_place.update(updates)
        for value, readers in before.items():
            self.before.setdefault(self._item(value), []).extend(readers)

    def _item(self, value: Value) -> Value:
        """Return the value whose place in the order this one has: all outs of a group have that of the first."""
        if self.graph.ops[value] != "out":
            return value
        number = self.graph.args[value][0]
        return self.graph.groups[number].outs[self.live[number][0]]

    def _chain(self, value: Value, region: int) -> list[Value]:
        """Return an array, the array that it updates, and so on, up to the first that is from outside the region."""
        chain = [value]
        while value >= 0 and self.place[value] == region:
            made = self._updated_array(value)
            if made is None:
                break
            value = made
            chain.append(value)
        return chain

    def _updated_array(self, value: Value) -> Value | None:
        """Return the array that an update changes, or that a loop starts with; None if an array is made anew."""
        if self.graph.ops[value] == "update":
            return int(self.graph.args[value][0])
        if self.graph.ops[value] != "out":
            return None
        number, k = self.graph.args[value]
        group = self.graph.groups[number]
        return group.starts[k] if isinstance(group, Loop) else None

    def _come_first(self, region: int, last: Value, values: list[Value]) -> list[Value] | None:
        """Return the items of a region that hold these values, if all can come before the value `last`, else None."""
        items = [self._around_in(region, value) for value in values]
        if any(item is None or item >= last or self._item(item) == self._item(last) for item in items):
            return None
        return items  # type: ignore[return-value]

    def _results_of(self, number: int) -> Iterable[Value]:
        group = self.graph.groups[number]
        for k in self.live[number]:
            yield from (group.chosen[k], group.others[k]) if isinstance(group, Branch) else (group.nexts[k],)

    def _around_in(self, region: int, value: Value) -> Value | None:
        """Return the value itself if it is in this region, or the last out of the group there that computes it.

        None if it is computed elsewhere.
        """
        here = self.place[value]
        while here != region:
            if here <= 0:
                return None
            group = self._owner[here]
            value, here = max(self.graph.groups[group].outs[k] for k in self.live[group]), self.group_place[group]
        return value
