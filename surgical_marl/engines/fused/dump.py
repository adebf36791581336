"""The graph and its schedule as text, for people: `SURGICAL_MARL_DUMP` writes it after each pass.

v12 = mul f v3 v4                         a node: operation, kind, operands
if v7 -> v40 v41                          a branch, and the values that it results in
  v13 = sqrt f v12
  v40 := v13                              what the result is on this side
else
  v40 := 0.0
for 8 rounds r15 -> v50                   a loop; v20 is what it carries: v12 at first, v21 after a round
  v20 = phi f v12
  v21 = add f v20 v13
  v20 := v21
store state 3 := v50
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from surgical_marl.engines.fused.graph import Branch, Loop, Value
from surgical_marl.engines.fused.schedule import GIVEN, Scheduler

Stores = list[tuple[str, int, Value]]


def schedule_text(scheduler: Scheduler, stores: Stores) -> str:
    """Return the values of a scheduler, in the regions and in the order that are known by now."""
    lines = _Text(scheduler).region(0, [f"store {buffer} {field}" for buffer, field, _ in stores], scheduler.results)
    return "\n".join(lines)


class _Text:
    def __init__(self, scheduler: Scheduler) -> None:
        self.graph, self.scheduler = scheduler.graph, scheduler
        self.placed: dict[int, dict[tuple[str, int], None]] = {}
        """Region -> its items, in the order in which they were made: while no other order is known."""
        for value in scheduler.needed:
            if self.graph.ops[value] not in GIVEN:
                region = scheduler.region_of.get(value, 0)
                self.placed.setdefault(region, {})[scheduler.item(value)] = None

    def region(self, number: int, targets: list[str], results: list[Value]) -> Iterator[str]:
        ends = [("result", k) for k in range(len(results))]
        for kind, index in self.scheduler.regions[number].items or [*self.placed.get(number, ()), *ends]:
            if kind == "node":
                yield f"v{index} = {self._node(index)}"
            elif kind == "result":
                yield f"{targets[index]} := {self._name(results[index])}"
            else:
                group = self.graph.groups[index]
                yield from self._branch(index, group) if isinstance(group, Branch) else self._loop(index, group)

    def _branch(self, number: int, branch: Branch) -> Iterator[str]:
        live = self.scheduler.live[number]
        outs = [f"v{branch.outs[k]}" for k in live]
        yield f"if {self._name(branch.condition)} -> {' '.join(outs)}"
        for region, side in zip(self.scheduler.inside.get(number, ()), (branch.chosen, branch.others), strict=False):
            yield from (f"  {line}" for line in self.region(region, outs, [side[k] for k in live]))
            yield "else" if side is branch.chosen else "end"

    def _loop(self, number: int, loop: Loop) -> Iterator[str]:
        live = self.scheduler.live[number]
        rounds = f"for {loop.length} rounds" if loop.condition is None else "while"
        yield f"{rounds} r{number} -> {' '.join(f'v{loop.outs[k]}' for k in live)}"
        for k in live:
            yield f"  v{loop.phis[k]} = phi {self.graph.kinds[loop.phis[k]]} {self._name(loop.starts[k])}"
        condition = [] if loop.condition is None else [loop.condition]
        targets = ["continue"] * len(condition) + [f"v{loop.phis[k]}" for k in live]
        for region in self.scheduler.inside.get(number, ()):
            lines = self.region(region, targets, condition + [loop.nexts[k] for k in live])
            yield from (f"  {line}" for line in lines)
        yield "end"

    def _node(self, node: Value) -> str:
        g, op = self.graph, self.graph.ops[node]
        args = g.args[node]
        raw = len(args) if op in ("load", "fields") else 1 if op == "lookup" else 0  # fields and tables are no values
        return " ".join([op, g.kinds[node], *map(str, args[:raw]), *map(self._name, args[raw:])])

    def _name(self, value: Any) -> str:
        if value < 0:
            return str(self.graph.constants[~value])
        return f"r{self.graph.args[value][0]}" if self.graph.ops[value] == "counter" else f"v{value}"
