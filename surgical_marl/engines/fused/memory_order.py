"""The order of a kernel's loads from the environments' arrays and its stores to them."""

from __future__ import annotations

from collections.abc import Iterator

from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.schedule import Schedule, Scheduler


def store_early(scheduler: Scheduler) -> None:
    """Put each store right behind its value, which then needs no register any more.

    before: F v5=v1*v2; F v6=v3*v4; STF(state,0,v5); STF(state,1,v6);
    after:  F v5=v1*v2; STF(state,0,v5); F v6=v3*v4; STF(state,1,v6);
    """
    region = scheduler.regions[0]
    waiting: dict[tuple[str, int], list[tuple[str, int]]] = {}
    for k, result in enumerate(scheduler.results):
        if result >= 0 and scheduler.is_in(result, 0):
            waiting.setdefault(scheduler.item(result), []).append(("result", k))
    early = {item for group in waiting.values() for item in group}
    items = [item for item in region.items if item not in early]
    region.items[:] = [item for one in items for item in (one, *waiting.get(one, ()))]


def load_early(graph: Graph, schedule: Schedule) -> None:
    """Put loads before the first store, except those in branches and loops.

    For all that a compiler knows, a store may change what any load behind it reads. So such a load can't begin early,
    and a thread would wait for memory again and again.

    before: F v1=LDF(state,0); STF(state,0,v5); F v2=LDF(state,1); STF(state,1,v6);
    after:  F v1=LDF(state,0); F v2=LDF(state,1); STF(state,0,v5); STF(state,1,v6);
    """
    items = schedule.regions[0].items
    first = next((at for at, (kind, _) in enumerate(items) if kind == "result"), len(items))
    late = [at for at, (kind, k) in enumerate(items) if at > first and kind == "node" and graph.ops[k] == "load"]
    _move(items, dict.fromkeys(late, first - 0.5))


def store_late(graph: Graph, schedule: Schedule, stores: list[tuple[str, int, Value]]) -> None:
    """Put each store behind all loads of its field: the same fields hold arguments and results.

    before: STF(state,0,v5); F v2=LDF(state,0);
    after:  F v2=LDF(state,0); STF(state,0,v5);

    Args:
        graph: of the function.
        schedule: whose first region is put into order.
        stores: (buffer, field, value); a "result" in the first region is the number of one of them.
    """
    items = schedule.regions[0].items
    after = {field: at + 0.5 for at, item in enumerate(items) for field in _loads(graph, schedule, *item)}
    _move(items, {at: max(at, after.get(stores[k][:2], 0)) for at, (kind, k) in enumerate(items) if kind == "result"})


def _move(items: list[tuple[str, int]], places: dict[int, float]) -> None:
    """Move some items to new places, between the others."""
    items[:] = [items[at] for at in sorted(range(len(items)), key=lambda at: places.get(at, at))]


def _loads(graph: Graph, schedule: Schedule, kind: str, index: int) -> Iterator[tuple[str, int]]:
    """Return (buffer, field) of each load in an item of a region."""
    if kind == "node" and graph.ops[index] == "load":
        yield graph.args[index]
    elif kind == "node" and graph.ops[index] == "fields":
        buffer, first, step = graph.args[index]
        yield from ((buffer, first + step * k) for k in range(int(graph.kinds[index][1:])))
    elif kind == "group":
        for region in schedule.inside[index]:
            for item in schedule.regions[region].items:
                yield from _loads(graph, schedule, *item)
