"""What a schedule amounts to: the values of a graph as it says, beside those that the graph says."""

from __future__ import annotations

from collections import ChainMap, Counter
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from surgical_marl.engines.fused.graph import Branch, Graph, Loop, Value
from surgical_marl.engines.fused.operations import DTYPES, FOLD
from surgical_marl.engines.fused.pipeline import PASSES, Program
from surgical_marl.engines.fused.schedule import Schedule
from surgical_marl.engines.fused.verify import check_schedule
from tests.helpers.fused_kernels import make_stores


class Direct:
    """Values of a graph for one environment, each computed when it is asked for: what the schedule has to amount to."""

    def __init__(self, graph: Graph, loads: Mapping[tuple[str, int], Any]) -> None:
        self.graph, self.loads, self.known = graph, loads, {}  # type: ignore[var-annotated]

    def __call__(self, value: Value) -> Any:
        if value < 0:
            return self.graph.constants[~value]
        stack = [value]  # rather than calls within calls, which go too deep
        while stack:
            missing = [] if stack[-1] in self.known else [a for a in self._reads(stack[-1]) if a not in self.known]
            stack.extend(missing)
            if not missing:
                node = stack.pop()
                if node not in self.known:
                    self.known[node] = self._compute(node)
        return self.known[value]

    def _reads(self, node: Value) -> list[Value]:
        op, args = self.graph.ops[node], self.graph.args[node]
        if op == "out" and isinstance(group := self.graph.groups[args[0]], Branch):
            condition = group.condition
            if condition not in self.known:
                return [condition]
            read = (group.chosen if self.known[condition] else group.others)[args[1]]
            return [read] if read >= 0 else []
        return self.graph.reads(node)

    def _compute(self, node: Value) -> Any:
        op, args = self.graph.ops[node], self.graph.args[node]
        if op != "out":
            return compute(self.graph, node, self, self.loads)
        group = self.graph.groups[args[0]]
        if isinstance(group, Branch):
            return self((group.chosen if self(group.condition) else group.others)[args[1]])
        self.known.update(zip(group.outs, self._loop(group), strict=True))  # all of them at once
        return self.known[node]

    def _loop(self, loop: Loop) -> list[Any]:
        outside, values, count = self.known, [self(start) for start in loop.starts], 0
        while True:
            row = loop.length - 1 - count if loop.backwards else count
            self.known = {**outside, **dict(zip(loop.phis, values, strict=True)), loop.counter: np.int32(row)}
            if not (count < loop.length if loop.condition is None else self(loop.condition)):
                break
            values, count = [self(value) for value in loop.nexts], count + 1
        self.known = outside
        return values


def compute(g: Graph, node: Value, read: Callable[[Value], Any], loads: Mapping[tuple[str, int], Any]) -> Any:
    op, args = g.ops[node], g.args[node]
    if op == "load":
        return loads[args]
    if op == "lookup":
        return g.tables[args[0]][int(read(args[1]))]
    if op == "select":
        return read(args[2]) if read(args[0]) else read(args[1])
    if op == "empty":
        return np.zeros(int(g.kinds[node][1:]), DTYPES[g.kinds[node][0]])
    if op == "array":
        return np.array([read(value) for value in args])
    if op == "read":
        return read(args[0])[int(read(args[1]))]
    if op == "update":
        start, values = int(read(args[1])), [read(value) for value in args[2:]]
        return np.concatenate([read(args[0])[:start], values, read(args[0])[start + len(values) :]])
    with np.errstate(all="ignore"):
        return np.asarray(FOLD[op](*map(read, args)))[()]


class Scheduled:
    """Values of a graph for one environment, computed as a schedule has them. KeyError for one that comes too late.

    What takes over the memory of an array changes it there: whatever reads the array afterwards reads something else,
    and what a branch leaves where it is has whatever its sides have put there.
    """

    def __init__(self, graph: Graph, plan: Schedule, loads: Mapping[tuple[str, int], Any]) -> None:
        self.graph, self.plan, self.loads = graph, plan, loads

    def results(self, values: list[Value]) -> list[Any]:
        found: dict[int, Any] = {}
        self._region(0, ChainMap(), lambda k, read: found.__setitem__(k, read(values[k])))
        return [found[k] for k in range(len(values))]

    def _region(self, number: int, known: Any, result: Callable[[int, Callable[[Value], Any]], Any]) -> bool:
        """Whether `result` let it come to its end."""

        def read(value: Value) -> Any:
            return known[value] if value >= 0 else self.graph.constants[~value]

        for kind, item in self.plan.regions[number].items:
            if kind == "node" and item in self.plan.in_place:
                array, index, *values = map(read, self.graph.args[item])
                array[int(index) : int(index) + len(values)] = values
                known[item] = array
            elif kind == "node":
                known[item] = compute(self.graph, item, read, self.loads)
            elif kind == "group":
                group = self.graph.groups[item]
                (self._branch if isinstance(group, Branch) else self._loop)(item, group, known, read)  # type: ignore
            elif result(item, read) is False:
                return False
        return True

    def _branch(self, number: int, branch: Branch, known: Any, read: Callable[[Value], Any]) -> None:
        wanted, taken = self.plan.live[number], bool(read(branch.condition))
        values, found = (branch.chosen if taken else branch.others), {}
        region = self.plan.inside[number][0 if taken else 1]
        self._region(region, known.new_child(), lambda k, read: found.__setitem__(k, read(values[wanted[k]])))
        found = {branch.outs[j]: found[k] for k, j in enumerate(wanted)}
        # what is left where it is, is what the array's memory now holds; all else is in memory of the branch
        known.update(
            {
                out: read(self.plan.merged[out]) if out in self.plan.merged else np.array(new)
                for out, new in found.items()
            }
        )

    def _loop(self, number: int, loop: Loop, known: Any, read: Callable[[Value], Any]) -> None:
        wanted, tested, count = self.plan.live[number], loop.condition is not None, 0
        taken = [loop.outs[j] in self.plan.in_place for j in wanted]
        starts = [read(loop.starts[j]) for j in wanted]
        values = [start if takes else np.array(start) for start, takes in zip(starts, taken, strict=True)]
        while tested or count < loop.length:
            found: list[Any] = []

            def result(k: int, read: Callable[[Value], Any], found: list[Any] = found) -> bool:
                if tested and k == 0:
                    return bool(read(loop.condition))  # type: ignore[arg-type]
                found.append(np.array(read(loop.nexts[wanted[k - tested]])))
                return True

            inside = known.new_child(dict(zip((loop.phis[j] for j in wanted), values, strict=True)))
            inside[loop.counter] = np.int32(loop.length - 1 - count if loop.backwards else count)
            if not self._region(self.plan.inside[number][0], inside, result):
                break
            for value, new, takes in zip(values, found, taken, strict=True):
                if takes:
                    value[:] = new
            values = [value if takes else new for value, new, takes in zip(values, found, taken, strict=True)]
            count += 1
        known.update({loop.outs[j]: value for j, value in zip(wanted, values, strict=True)})


def schedule_of(graph: Graph, results: list[Value]) -> Schedule:
    """The schedule of values that are stored in fields of a buffer, after all passes before code is made."""
    program = Program(graph, [("outs", k, value) for k, value in enumerate(results)], vector=False)
    for one in PASSES[: [one.on for one in PASSES].index("code")]:
        one.run(program)
    check_schedule(graph, program.schedule, results)
    return program.schedule


def assert_schedule_is_right(function: Callable[..., Any], *columns: Any) -> None:
    """For the first environment of columns [N, ...] it gives what the graph says, and computes everything once."""
    graph, stores, _, inputs, _ = make_stores(function, columns)
    loads = {
        (leaf.buffer, leaf.first + k): element
        for leaf, column in zip(jax.tree.leaves(inputs), jax.tree.leaves(columns), strict=True)
        for k, element in enumerate(column[0].ravel())
    }
    values = [value for _, _, value in stores]
    plan = schedule_of(graph, values)
    computed = Counter(item for region in plan.regions for item in region.items if item[0] != "result")
    assert set(computed.values()) <= {1}
    direct = Direct(graph, loads)
    np.testing.assert_array_equal(Scheduled(graph, plan, loads).results(values), [direct(value) for value in values])
