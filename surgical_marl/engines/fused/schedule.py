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
from surgical_marl.engines.fused.inplace import InPlace, Places

GIVEN = ("phi", "counter")
"""Values that are there at the start of a round of their loop."""
ALL_LOOPS = -1
"""Bits of all loops: what may depend on any of them."""


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
    """A graph with its values in regions, in order. Region 0 is the program; its results are the stores."""

    regions: list[Region]
    inside: dict[int, tuple[int, ...]]
    """Group -> the regions in it: of a loop its body, of a branch the chosen and the other side."""
    live: dict[int, list[int]]
    """Group -> which of its outs (or phis) are needed."""
    outside: dict[int, list[Value]]
    """Group -> the values from around it that it reads."""
    overwritten: set[Value]
    """Arrays that something else overwrites."""
    in_place: set[Value]
    """Updates, and outs of loops, that overwrite the array that they change: all else that reads it comes before."""
    merged: dict[Value, Value]
    """Out of a branch -> the array that it overwrites: both sides leave it in place, changed or not."""
    destination: dict[Value, Value]
    """Empty array in a side of a branch -> the out of the branch whose memory it gets, as it becomes that there."""


class Scheduler:
    """Makes a `Schedule` of the values `results`, step by step: see `pipeline.py`.

    To make one leaves out all that nothing needs (dead code).
    """

    def __init__(self, graph: Graph, results: list[Value]) -> None:
        self.graph, self.results = graph, results
        self.regions = [Region(-1, 0, -1)]
        self.inside: dict[int, tuple[int, ...]] = {}
        self._owner: dict[int, int] = {}  # region -> group
        self.region_of: dict[Value, int] = {}
        self.region_of_group: dict[int, int] = {}
        self.loops: dict[Value, int] = {}
        self.group_loops: dict[int, int] = {}
        self.pressure: dict[Value, int] = {}
        self.in_place: InPlace | None = None
        self.live = self._find_live()

    def schedule(self) -> Schedule:
        """Return what was found."""
        found = self.in_place
        return Schedule(
            self.regions,
            self.inside,
            self.live,
            {number: self._all_reads(number) for number in self.inside},
            found.overwritten if found else set(),
            found.in_place if found else set(),
            found.merged if found else {},
            found.destination if found else {},
        )

    # -- what is needed

    def _find_live(self) -> dict[int, list[int]]:
        g, seen = self.graph, set()
        live: dict[int, set[int]] = {}
        stack = [value for value in self.results if value >= 0]

        def group_result(number: int, k: int) -> None:
            group, wanted = g.groups[number], live.setdefault(number, set())
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
        return {number: sorted(wanted) for number, wanted in live.items()}

    def _group_reads(self, number: int) -> Iterable[Value]:
        """All that a group is given, from before it or within it."""
        group, wanted = self.graph.groups[number], self.live[number]
        sides = (group.chosen, group.others) if isinstance(group, Branch) else (group.starts, group.nexts)
        for values in sides:
            yield from (values[k] for k in wanted if values[k] >= 0)
        if group.condition is not None and group.condition >= 0:
            yield group.condition

    def find_invariants(self) -> None:
        """Find which loops each value depends on, as bits: `place` puts it outside of the others.

        before: for(int r3=0;r3<8;++r3){ F v5=SQRT(v4); v6=v6*v5; }
        after:  F v5=SQRT(v4); for(int r3=0;r3<8;++r3){ v6=v6*v5; }
        """
        g = self.graph
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
                starts.update(group.starts[k] for k in self.live.get(number, ()))
        return {value for value in starts if value >= 0 and len(g.kinds[value]) > 1}

    # -- where

    def place(self) -> None:
        """Place each value in the innermost region that holds all its uses.

        before: F v5=SQRT(v4); if(ANY(v3)){ v6=v5; }else{ v6=v4; }
        after:  if(ANY(v3)){ F v5=SQRT(v4); v6=v5; }else{ v6=v4; }
        """
        g, begins = self.graph, self._find_begins()
        for value in self.results:
            self._use(value, 0)
        for value in reversed(self.needed):
            op = g.ops[value]
            if op in GIVEN:
                continue
            if op == "out":
                number = g.args[value][0]
                if number not in self.region_of_group:
                    self._place_group(number, begins)
                continue
            region = self.region_of[value]
            # an array's elements would need registers outside of the loop; an empty array is best near what fills it
            if op not in ("read", "empty"):
                region = self._hoist(region, self.loops.get(value, ALL_LOOPS))
            self.region_of[value] = region
            for read in g.reads(value):
                self._use(read, region)

    def _place_group(self, number: int, begins: set[Value]) -> None:
        group = self.graph.groups[number]
        outs = [group.outs[k] for k in self.live[number] if group.outs[k] in self.region_of]
        region = self.region_of[outs[0]]
        for out in outs[1:]:
            region = self._common(region, self.region_of[out])
        # an array that a loop will change is made near that loop: one from outside would be copied again and again
        if not (isinstance(group, Branch) and begins.intersection(outs)):
            region = self._hoist(region, self.group_loops.get(number, ALL_LOOPS))
        self.region_of_group[number] = region
        for k in self.live[number]:
            self.region_of[group.outs[k]] = region
        inner = [len(self.regions) + k for k in range(2 if isinstance(group, Branch) else 1)]
        self.inside[number] = tuple(inner)
        depth = self.regions[region].depth + 1
        for _ in inner:
            loop = number if isinstance(group, Loop) else self.regions[region].loop
            self._owner[len(self.regions)] = number
            self.regions.append(Region(region, depth, loop))
        for k in self.live[number]:
            if isinstance(group, Branch):
                self._use(group.chosen[k], inner[0])
                self._use(group.others[k], inner[1])
            else:
                self._use(group.starts[k], region)
                self._use(group.nexts[k], inner[0])
                self.region_of[group.phis[k]] = inner[0]
        if group.condition is not None:
            self._use(group.condition, region if isinstance(group, Branch) else inner[0])

    def _use(self, value: Value, region: int) -> None:
        if value >= 0 and self.graph.ops[value] not in GIVEN:
            self.region_of[value] = self._common(self.region_of[value], region) if value in self.region_of else region

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
            region = self.region_of_group[loop]

    # -- in what order

    def find_pressure(self) -> None:
        """Estimate how many registers each value takes to compute (Sethi-Ullman number): `order` begins with the most.

        before: F v5=v1; F v6=v1*v2; F v7=v6*v3; F v8=v5+v7;
        after:  F v6=v1*v2; F v7=v6*v3; F v5=v1; F v8=v5+v7;
        """
        g = self.graph
        for value in self.needed:
            op = g.ops[value]
            if op == "out":
                reads = [read for read in self._group_reads(g.args[value][0]) if read < value]
            else:
                reads = g.reads(value)
            needs = sorted((self.pressure.get(read, 1) for read in reads[:8]), reverse=True)
            self.pressure[value] = max([need + k for k, need in enumerate(needs)], default=1)

    def order(self) -> None:
        """Put the values of each region into order: depth first from its results, each operand right before its use."""
        self._outside: dict[int, list[Value]] = {}
        self._members: dict[int, list[Value]] = {}
        for value in self.needed:
            if self.graph.ops[value] not in GIVEN:
                self._members.setdefault(self.region_of[value], []).append(value)
        for number in range(len(self.regions)):
            self._order(number)

    def find_in_place(self) -> None:
        """Find arrays that can be changed in place. See `inplace.py`."""
        places = Places(self.region_of, self.region_of_group, self.inside, self.live, self._owner)
        self.in_place = InPlace(self.graph, self.needed, places)

    def _order(self, number: int) -> None:
        region, results = self.regions[number], self._region_results(number)
        done: set[tuple[str, int]] = set()
        for k, result in enumerate(results):
            if result >= 0 and self.is_in(result, number):
                self._visit(number, result, done)
            region.items.append(("result", k))

    def _region_results(self, number: int) -> list[Value]:
        if number == 0:
            return self.results
        for group_number, inner in self.inside.items():
            if number in inner:
                group, wanted = self.graph.groups[group_number], self.live[group_number]
                if isinstance(group, Branch):
                    side = group.chosen if number == inner[0] else group.others
                    return [side[k] for k in wanted]
                condition = [] if group.condition is None else [group.condition]
                return condition + [group.nexts[k] for k in wanted]
        raise AssertionError(number)

    def _visit(self, region: int, value: Value, done: set[tuple[str, int]]) -> None:
        items, stack = self.regions[region].items, [(self.item(value), False)]
        while stack:
            item, ready = stack.pop()
            if item in done:
                continue
            if ready:
                done.add(item)
                items.append(item)
                continue
            stack.append((item, True))
            reads = [read for read in self._item_reads(item) if self.is_in(read, region)]
            # The highest pressure is popped, and so computed, first. A group that only has to come first may stand here
            # as a result that nobody needs, of which no pressure is known.
            reads.sort(key=lambda read: self.pressure.get(read, 1))
            stack.extend((self.item(read), False) for read in reads if self.item(read) not in done)

    def is_in(self, value: Value, region: int) -> bool:
        """Return whether a value is computed in a region."""
        return self.graph.ops[value] not in GIVEN and self.region_of[value] == region

    def item(self, value: Value) -> tuple[str, int]:
        """Return the item of a region that computes a value: the group if the value is one of its outs."""
        return ("group", self.graph.args[value][0]) if self.graph.ops[value] == "out" else ("node", value)

    def _item_reads(self, item: tuple[str, int]) -> list[Value]:
        kind, number = item
        if kind == "group":
            first = self.graph.groups[number].outs[self.live[number][0]]
            return [*self._all_reads(number), *self._before(first)]
        return self.graph.reads(number) + self._before(number)

    def _before(self, value: Value) -> list[Value]:
        """Return what must come before a value that overwrites an array, besides its operands."""
        return self.in_place.before.get(value, []) if self.in_place else []

    def _all_reads(self, number: int) -> list[Value]:
        """Return what a group and everything in it read from outside the group."""
        if number in self._outside:
            return self._outside[number]
        found: dict[Value, None] = dict.fromkeys(self._group_reads(number))
        depth = self.regions[self.region_of_group[number]].depth
        for inner in self.inside[number]:
            for value in self._members.get(inner, []):
                reads = self._all_reads(self.graph.args[value][0]) if self.graph.ops[value] == "out" else None
                found.update(dict.fromkeys(self.graph.reads(value) if reads is None else reads))
        outside = [
            value
            for value in found
            if self.graph.ops[value] not in GIVEN and self.regions[self.region_of[value]].depth <= depth
        ]
        self._outside[number] = outside
        return outside
