"""Passes that add code which watches a kernel: numbers that are not finite, and how much each environment had to do."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from surgical_marl.engines.fused import instructions as ir
from surgical_marl.engines.fused.macros import PATHS

LARGE = 500
"""Least number of operations in a block, without nested blocks, that counts as work."""
LARGE_PATH = 1500
"""Least number of operations in a side of a branch, with nested blocks, that counts as a path of its own."""


class Watch(NamedTuple):
    """The stored numbers that must be finite, and the flag that is set when one is not."""

    fields: frozenset[tuple[str, int]]
    """(buffer, field) of each number."""
    flag: int
    """Field of `flags` that becomes 1. No kernel makes it 0."""


def check_finite(code: ir.Code, watch: Watch) -> ir.Code:
    """Add up 0 times each number that must be finite: 0, or NaN if one of them was NaN or infinite.

    A field that would be stored as it is, is only looked at.

    before: STF(state,3,v9); STF(state,4,LDF(state,4));
    after:  F watch_=SPLAT(0.0f); STF(state,3,v9); watch_+=v9*SPLAT(0.0f); watch_+=LDF(state,4)*SPLAT(0.0f);
            B bad_=watch_!=SPLAT(0.0f);if(ANY(bad_)){STB(flags,0,LDB(flags,0)|bad_)}
    """
    found: ir.Code = [ir.Define("watch_", "f", np.float32(0))]
    for one in code:
        store, rounds = (one.one, one.rounds) if isinstance(one, ir.Repeat) else (one, 1)
        if not isinstance(store, ir.Store):
            found.append(one)
            continue
        if not _stays(store):
            found.append(one)
        found += _checks(store, rounds, watch)
    return [*found, ir.ReportFinite(watch.flag)]


def _stays(store: ir.Store) -> bool:
    """Return whether a store leaves its fields as they are."""
    places = {(store.buffer, store.field), (store.buffer, store.field, store.stride)}
    return isinstance(store.value, ir.Call) and store.value.op in ("load", "fields") and store.value.args in places


def _checks(store: ir.Store, rounds: int, watch: Watch) -> ir.Code:
    """Return the checks of what is stored, in one loop if all of it is watched."""
    value = store.value
    if isinstance(value, np.generic) and np.isfinite(value):
        return []
    watched = [k for k in range(rounds) if (store.buffer, store.field + store.stride * k) in watch.fields]
    if rounds > 1 and len(watched) == rounds:
        return [ir.Repeat(rounds, ir.CheckFinite(value))]
    return [ir.CheckFinite(_of_round(value, k)) for k in watched]


def _of_round(value: ir.Operand, k: int) -> ir.Operand:
    """Return the value in round `k` of a loop."""
    if isinstance(value, ir.Element):
        return value._replace(offset=value.offset + value.stride * k, stride=0)
    if isinstance(value, ir.Call) and value.op == "fields":
        buffer, first, step = value.args
        return ir.Call("load", value.kind, (buffer, first + step * k))  # type: ignore[operator, arg-type]
    return value


def count_work(code: ir.Code) -> ir.Code:
    """Count the operations of the large blocks that each environment goes through. Environments are sorted by it.

    before: if(ANY(v7)){ ...612 operations... }
    after:  if(ANY(v7)){ WORK(612,v7) ... } STI(work,0,WORK_KEY)

    One side of a branch that is very large is a path, which has a bit of its own: PATH(13,v7).
    """
    found: ir.Code = [ir.Define(name, "i", np.int32(0)) for name in ("work_", "paths_")]
    blocks: list[tuple[tuple[ir.Operand, ...], ir.If | None, tuple[int, int] | None]] = []
    active: tuple[ir.Operand, ...] = ()
    paths = 0
    for one in code:
        found.append(one)
        if isinstance(one, ir.If):
            side = next((k for k, size in enumerate(one.sizes) if size.total >= LARGE_PATH), None)
            path = None if side is None or paths == PATHS else (side, PATHS - paths - 1)
            paths += path is not None
            blocks.append((active, one, path))
            active = (*active, one.condition)
            found += _counters(0, one.sizes[0], path, active)
        elif isinstance(one, ir.Else):
            outer, branch, path = blocks[-1]
            assert branch is not None
            active = (*outer, ir.Call("not", "b", (branch.condition,)))
            found += _counters(1, branch.sizes[1], path, active)
        elif isinstance(one, ir.For | ir.While):
            blocks.append((active, None, None))
            if isinstance(one, ir.While):
                active = (one.mask,) if one.mask else ()
                found += _counters(0, one.size, None, active)
        elif isinstance(one, ir.End):
            active, *_ = blocks.pop()
    return [*found, ir.ReportWork()] if ir.large_branches(found) else code


def _counters(side: int, size: ir.Size, path: tuple[int, int] | None, active: tuple[ir.Operand, ...]) -> ir.Code:
    """Return what a block begins with; `path` are the side of its branch that is a path, and the path's number."""
    lanes, found = ir.Call("all", "b", active), ir.Code()
    if size.own >= LARGE:
        found.append(ir.Work(size.own, lanes))
    if path is not None and path[0] == side:
        found.append(ir.Path(path[1], lanes))
    return found
