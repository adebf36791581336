"""The order of a kernel's loads from the environments' arrays and its stores to them."""

from __future__ import annotations

from collections.abc import Iterator

from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.schedule import Schedule


def order_memory(graph: Graph, schedule: Schedule, stores: list[tuple[str, int, Value]]) -> None:
    """Put loads before the first store, except those in branches and loops, and a store behind all loads of its field.

    For all that a compiler knows, a store may change what any load behind it reads. So such a load can't begin early,
    and a thread would wait for memory again and again.

    Args:
        graph: of the function.
        schedule: whose first region is put into order.
        stores: (buffer, field, value); a "result" in the first region is the number of one of them.
    """
    items = schedule.regions[0].items

    def move(places: dict[int, float]) -> None:
        """Move some items to new places, between the others."""
        items[:] = [items[at] for at in sorted(range(len(items)), key=lambda at: places.get(at, at))]

    first = next((at for at, (kind, _) in enumerate(items) if kind == "result"), len(items))
    late = [at for at, (kind, k) in enumerate(items) if at > first and kind == "node" and graph.ops[k] == "load"]
    move(dict.fromkeys(late, first - 0.5))
    after = {field: at + 0.5 for at, item in enumerate(items) for field in _loads(graph, schedule, *item)}
    move({at: max(at, after.get(stores[k][:2], 0)) for at, (kind, k) in enumerate(items) if kind == "result"})


def _loads(graph: Graph, schedule: Schedule, kind: str, index: int) -> Iterator[tuple[str, int]]:
    """Return (buffer, field) of each load in an item of a region."""
    if kind == "node" and graph.ops[index] == "load":
        yield graph.args[index]
    elif kind == "group":
        for region in schedule.inside[index]:
            for item in schedule.regions[region].items:
                yield from _loads(graph, schedule, *item)
