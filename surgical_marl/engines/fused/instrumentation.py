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

    before: STF(state,3,v9);
    after:  F watch_=SPLAT(0.0f); STF(state,3,v9); watch_+=v9*SPLAT(0.0f);
            B bad_=watch_!=SPLAT(0.0f);if(ANY(bad_)){STB(flags,0,LDB(flags,0)|bad_)}
    """
    found: ir.Code = [ir.Define("watch_", "f", np.float32(0))]
    for one in code:
        found.append(one)
        if isinstance(one, ir.Store) and (one.buffer, one.field) in watch.fields:
            found.append(ir.CheckFinite(one.value))
        elif isinstance(one, ir.Repeat) and isinstance(one.one, ir.Store):
            found += _checked_row(one.one, one.rounds, watch)
    return [*found, ir.ReportFinite(watch.flag)]


def _checked_row(store: ir.Store, rounds: int, watch: Watch) -> ir.Code:
    """Return the checks of what a loop stores: of an array's elements, in one loop if all are watched."""
    watched = [(store.buffer, store.field + store.stride * k) in watch.fields for k in range(rounds)]
    if all(watched):
        return [ir.Repeat(rounds, ir.CheckFinite(store.value))]
    value = store.value
    assert isinstance(value, ir.Element)
    offsets = (value.offset + value.stride * k for k in range(rounds) if watched[k])
    return [ir.CheckFinite(value._replace(offset=offset, stride=0)) for offset in offsets]


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
