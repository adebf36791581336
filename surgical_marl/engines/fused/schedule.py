"""Decides where and in what order a graph's values are computed.

A value belongs to the innermost region (the body of a loop, a side of a branch, or the whole program) that holds all
its uses, moved out of each loop that it does not depend on: Click, "Global code motion, global value numbering", 1995.
Within a region values are computed depth first from the results, the operand with the higher register pressure first
(Sethi and Ullman, 1970), so that few values have overlapping live ranges.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from surgical_marl.engines.fused.graph import Branch, Graph, Loop, Value
from surgical_marl.engines.fused.inplace import Places, Takeovers

GIVEN = ("phi", "counter")
"""Values that are there at the start of a round of their loop."""


@dataclass
class Region:
    """A region of the program without branches and loops of its own.

    `items` are what it computes, in order. Each is ("node", value), ("group", number), or ("result", k). The last says
    that the k-th result of the region is known from there on.
    """

    parent: int
    depth: int
    loop: int
    """The innermost loop around it, -1 if there is none."""
    items: list[tuple[str, int]] = field(default_factory=list)


@dataclass
class Schedule:
    """Region 0 is the program; its results are the stores."""

    regions: list[Region]
    inside: dict[int, tuple[int, ...]]
    """Group -> the regions in it: of a loop its body, of a branch the chosen and the other side."""
    alive: dict[int, list[int]]
    """Group -> which of its outs (or phis) are needed."""
    outside: dict[int, list[Value]]
    """Group -> the values from around it that it reads."""
    replaced: set[Value]
    """Arrays whose memory something else takes over."""
    takers: set[Value]
    """The `put`s that take over the memory of the array they change, as all else that reads it comes before."""
    kept: dict[Value, Value]
    """Out of a branch -> the array whose memory it takes over: both sides leave it there, changed or not."""
    given: dict[Value, Value]
    """Empty array in a side of a branch -> the out of the branch that it becomes there, and whose memory it gets."""


class Scheduler:
    """Makes a `Schedule` of the values `results`."""

    def __init__(self, graph: Graph, results: list[Value]) -> None:
        self.graph, self.results = graph, results
        self.regions = [Region(-1, 0, -1)]
        self.inside: dict[int, tuple[int, ...]] = {}
        self._owner: dict[int, int] = {}  # region -> group
        self.place: dict[Value, int] = {}
        self.group_place: dict[int, int] = {}
        self.alive = self._find_alive()
        self._depend()
        self._begins = self._find_begins()

    def run(self) -> Schedule:
        self._place_all()
        places = Places(self.place, self.group_place, self.inside, self.alive, self._owner)
        taken = Takeovers(self.graph, self.needed, places)
        self._before = taken.before
        self._measure()
        self._outside: dict[int, list[Value]] = {}
        self._members: dict[int, list[Value]] = {}
        for value in self.needed:
            if self.graph.ops[value] not in GIVEN:
                self._members.setdefault(self.place[value], []).append(value)
        for number in range(len(self.regions)):
            self._order(number)
        return Schedule(
            self.regions,
            self.inside,
            self.alive,
            {n: self._all_reads(n) for n in self.inside},
            taken.replaced,
            taken.takers,
            taken.kept,
            taken.given,
        )

    # -- what is needed

    def _find_alive(self) -> dict[int, list[int]]:
        g, seen = self.graph, set()
        alive: dict[int, set[int]] = {}
        stack = [value for value in self.results if value >= 0]

        def group_result(number: int, k: int) -> None:
            group, wanted = g.groups[number], alive.setdefault(number, set())
            if k in wanted:
                return
            wanted.add(k)
            if isinstance(group, Branch):
                needs = [group.condition, group.chosen[k], group.others[k]]
            else:
                needs = [group.starts[k], group.nexts[k]] + ([] if group.condition is None else [group.condition])
            stack.extend(value for value in needs if value >= 0)

        while stack:
            value = stack.pop()
            if value in seen:
                continue
            seen.add(value)
            if g.ops[value] in ("out", "phi"):
                group_result(*g.args[value])
            else:
                stack.extend(g.reads(value))
        self.needed = sorted(seen)
        return {number: sorted(wanted) for number, wanted in alive.items()}

    def _group_reads(self, number: int) -> Iterable[Value]:
        """All that a group is given, from before it or within it."""
        group, wanted = self.graph.groups[number], self.alive[number]
        sides = (group.chosen, group.others) if isinstance(group, Branch) else (group.starts, group.nexts)
        for values in sides:
            yield from (values[k] for k in wanted if values[k] >= 0)
        if group.condition is not None and group.condition >= 0:
            yield group.condition

    def _depend(self) -> None:
        """Which loops each value depends on, as bits."""
        g = self.graph
        self.loops: dict[Value, int] = {}
        self.group_loops: dict[int, int] = {}
        for value in self.needed:
            op = g.ops[value]
            if op in GIVEN:
                self.loops[value] = 1 << g.args[value][0]
                continue
            if op == "out":
                number = g.args[value][0]
                if number not in self.group_loops:
                    group = g.groups[number]
                    # a loop that is moved out of its branch might never end for inputs that don't take the branch
                    bits = group.around if isinstance(group, Loop) and group.condition is not None else 0
                    for read in self._group_reads(number):
                        bits |= self.loops[read]
                    self.group_loops[number] = bits & ~(1 << number)
                self.loops[value] = self.group_loops[number]
                continue
            bits = 0
            for read in g.reads(value):
                bits |= self.loops[read]
            self.loops[value] = bits

    def _find_begins(self) -> set[Value]:
        """Return the arrays in memory that a loop begins with."""
        g = self.graph
        starts: set[Value] = set()
        for number, group in enumerate(g.groups):
            if isinstance(group, Loop):
                starts.update(group.starts[k] for k in self.alive.get(number, ()))
        return {value for value in starts if value >= 0 and len(g.kinds[value]) > 1}

    # -- where

    def _place_all(self) -> None:
        g = self.graph
        for value in self.results:
            self._use(value, 0)
        for value in reversed(self.needed):
            op = g.ops[value]
            if op in GIVEN:
                continue
            if op == "out":
                number = g.args[value][0]
                if number not in self.group_place:
                    self._place_group(number)
                continue
            region = self.place[value]
            # to keep what is in memory in registers too would need many of them, and a room is best near what fills it
            if op not in ("read", "room"):
                region = self._hoist(region, self.loops[value])
            self.place[value] = region
            for read in g.reads(value):
                self._use(read, region)

    def _place_group(self, number: int) -> None:
        group = self.graph.groups[number]
        outs = [group.outs[k] for k in self.alive[number] if group.outs[k] in self.place]
        region = self.place[outs[0]]
        for out in outs[1:]:
            region = self._common(region, self.place[out])
        # an array that a loop will change is made near that loop: one from outside would be copied again and again
        if not (isinstance(group, Branch) and self._begins.intersection(outs)):
            region = self._hoist(region, self.group_loops[number])
        self.group_place[number] = region
        for k in self.alive[number]:
            self.place[group.outs[k]] = region
        inner = [len(self.regions) + k for k in range(2 if isinstance(group, Branch) else 1)]
        self.inside[number] = tuple(inner)
        depth = self.regions[region].depth + 1
        for _ in inner:
            loop = number if isinstance(group, Loop) else self.regions[region].loop
            self._owner[len(self.regions)] = number
            self.regions.append(Region(region, depth, loop))
        for k in self.alive[number]:
            if isinstance(group, Branch):
                self._use(group.chosen[k], inner[0])
                self._use(group.others[k], inner[1])
            else:
                self._use(group.starts[k], region)
                self._use(group.nexts[k], inner[0])
                self.place[group.phis[k]] = inner[0]
        if group.condition is not None:
            self._use(group.condition, region if isinstance(group, Branch) else inner[0])

    def _use(self, value: Value, region: int) -> None:
        if value >= 0 and self.graph.ops[value] not in GIVEN:
            self.place[value] = self._common(self.place[value], region) if value in self.place else region

    def _common(self, a: int, b: int) -> int:
        regions = self.regions
        while a != b:
            if regions[a].depth >= regions[b].depth:
                a = regions[a].parent
            else:
                b = regions[b].parent
        return a

    def _hoist(self, region: int, loops: int) -> int:
        """Return the region outside of the loops that a value does not depend on."""
        while True:
            loop = self.regions[region].loop
            if loop < 0 or loops >> loop & 1:
                return region
            region = self.group_place[loop]

    # -- in what order

    def _measure(self) -> None:
        """Estimate how many values are alive at once while each is computed (Sethi-Ullman number)."""
        g = self.graph
        self.room: dict[Value, int] = {}
        for value in self.needed:
            op = g.ops[value]
            if op == "out":
                reads = [read for read in self._group_reads(g.args[value][0]) if read < value]
            else:
                reads = g.reads(value)
            needs = sorted((self.room.get(read, 1) for read in reads[:8]), reverse=True)
            self.room[value] = max([need + k for k, need in enumerate(needs)], default=1)

    def _order(self, number: int) -> None:
        region, results = self.regions[number], self._region_results(number)
        done: set[tuple[str, int]] = set()
        for k, result in enumerate(results):
            if result >= 0 and self._here(result, number):
                self._visit(number, result, done)
            region.items.append(("result", k))
        if number == 0:
            self._store_early(region, results)

    def _store_early(self, region: Region, results: list[Value]) -> None:
        """Put each store right behind what computes its value, which then needs no register any more."""
        waiting: dict[tuple[str, int], list[tuple[str, int]]] = {}
        for k, result in enumerate(results):
            if result >= 0 and self._here(result, 0):
                waiting.setdefault(self._item(result), []).append(("result", k))
        early = {item for group in waiting.values() for item in group}
        items = [item for item in region.items if item not in early]
        region.items = [item for one in items for item in (one, *waiting.get(one, ()))]

    def _region_results(self, number: int) -> list[Value]:
        if number == 0:
            return self.results
        for group_number, inner in self.inside.items():
            if number in inner:
                group, wanted = self.graph.groups[group_number], self.alive[group_number]
                if isinstance(group, Branch):
                    side = group.chosen if number == inner[0] else group.others
                    return [side[k] for k in wanted]
                condition = [] if group.condition is None else [group.condition]
                return condition + [group.nexts[k] for k in wanted]
        raise AssertionError(number)

    def _visit(self, region: int, value: Value, done: set[tuple[str, int]]) -> None:
        items, stack = self.regions[region].items, [(self._item(value), False)]
        while stack:
            item, ready = stack.pop()
            if item in done:
                continue
            if ready:
                done.add(item)
                items.append(item)
                continue
            stack.append((item, True))
            reads = [read for read in self._item_reads(item) if self._here(read, region)]
            # The highest pressure is popped, and so computed, first. A group that only has to come first may stand here
            # as a result that nobody needs, of which no pressure is known.
            reads.sort(key=lambda read: self.room.get(read, 1))
            stack.extend((self._item(read), False) for read in reads if self._item(read) not in done)

    def _here(self, value: Value, region: int) -> bool:
        return self.graph.ops[value] not in GIVEN and self.place[value] == region

    def _item(self, value: Value) -> tuple[str, int]:
        return ("group", self.graph.args[value][0]) if self.graph.ops[value] == "out" else ("node", value)

    def _item_reads(self, item: tuple[str, int]) -> list[Value]:
        kind, number = item
        if kind == "group":
            first = self.graph.groups[number].outs[self.alive[number][0]]
            return [*self._all_reads(number), *self._before.get(first, [])]
        return self.graph.reads(number) + self._before.get(number, [])

    def _all_reads(self, number: int) -> list[Value]:
        """Return what a group and everything in it read from outside the group."""
        if number in self._outside:
            return self._outside[number]
        found: dict[Value, None] = dict.fromkeys(self._group_reads(number))
        depth = self.regions[self.group_place[number]].depth
        for inner in self.inside[number]:
            for value in self._members.get(inner, []):
                reads = self._all_reads(self.graph.args[value][0]) if self.graph.ops[value] == "out" else None
                found.update(dict.fromkeys(self.graph.reads(value) if reads is None else reads))
        outside = [
            value
            for value in found
            if self.graph.ops[value] not in GIVEN and self.regions[self.place[value]].depth <= depth
        ]
        self._outside[number] = outside
        return outside
