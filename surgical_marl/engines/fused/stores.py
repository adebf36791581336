"""Passes over the stores of a kernel: into the sides of branches, and many at a time by loops."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import groupby
from typing import Any

import numpy as np

from surgical_marl.engines.fused import instructions as ir
from surgical_marl.engines.fused.graph import LEAST_ROW

Field = tuple[str, int]
"""A buffer and the number of a field in it."""


# -- stores in branches


def store_in_branches(code: ir.Code) -> ir.Code:
    """Store results of a branch in its sides if nothing else reads them: no register holds them behind the branch.

    before: F v9; if(ANY(v7)){v9=v1;}else{F v3=LDF(state,5);v9=v3;} STF(state,5,v9);
    after:  if(ANY(v7)){STF(state,5,v1);}else{F v3=LDF(state,5);STF(state,5,v3);}
    """
    moved, found = _movable(code), ir.Code()
    gone = {id(store) for store in moved.values()}
    for one in code:
        if isinstance(one, ir.Assign) and one.target in moved:
            found.append(moved[one.target]._replace(value=one.value))
        elif id(one) not in gone and not (isinstance(one, ir.Define) and one.name in moved):
            found.append(one)
    return found


def _movable(code: ir.Code) -> dict[str, ir.Store]:
    """Return the stores of registers that both sides of an outermost branch set, and nothing else reads."""
    reads, loads, found = _reads(code), _loads(code), dict[str, ir.Store]()
    changes: dict[str, list[tuple[int, int]]] = {}  # where a register changes, and where that side of a branch begins
    depth, side = 0, -1
    for at, one in enumerate(code):
        if isinstance(one, ir.OPENS) and not depth:
            side = at if isinstance(one, ir.If) else -1
        elif isinstance(one, ir.Else) and depth == 1:
            side = at
        depth += isinstance(one, ir.OPENS) - isinstance(one, ir.End)
        if isinstance(one, ir.Assign) and isinstance(one.target, str):
            changes.setdefault(one.target, []).append((at, side if depth == 1 else -1))
        elif isinstance(one, ir.Store) and not depth and isinstance(one.value, str) and reads[one.value] == 1:
            ends = changes.get(one.value, [])
            if len(ends) == 2 and min(start for _, start in ends) >= 0:
                (first, _), (last, other) = ends
                if all(q < first or other < q < last for q in loads.get((one.buffer, one.field), ())):
                    found[one.value] = one
    return found


def _reads(code: ir.Code) -> Counter[str]:
    """Return how often each register is read."""
    found = Counter[str]()
    for one in code:
        found.update(part for operand in ir.operands(one) for part in ir.parts(operand) if isinstance(part, str))
        if isinstance(one, ir.Assign) and isinstance(one.target, str):
            found[one.target] -= 1
    return found


def _loads(code: ir.Code) -> dict[Field, list[int]]:
    """Return where each field is loaded."""
    found: dict[Field, list[int]] = {}
    for at, one in enumerate(code):
        rounds = one.rounds if isinstance(one, ir.Repeat) else 1
        for part in (part for operand in ir.operands(one) for part in ir.parts(operand)):
            for field in _fields(part, rounds):
                found.setdefault(field, []).append(at)
    return found


def _fields(operand: ir.Operand, rounds: int) -> Iterator[Field]:
    """Yield the fields that an operand loads in the rounds of a `Repeat`."""
    if isinstance(operand, ir.Call) and operand.op == "load":
        yield operand.args  # type: ignore[misc]
    elif isinstance(operand, ir.Call) and operand.op == "fields":
        buffer, first, step = operand.args
        yield from ((buffer, first + step * k) for k in range(rounds))  # type: ignore[misc, operator]


# -- many stores in one loop


def roll_stores(code: ir.Code) -> ir.Code:
    """Store by loops what goes to fields in a row: a C compiler takes long for so many lines.

    It is a constant, what other fields hold, or the elements of an array. Arrays whose elements are all at known
    indices stay as they are: a compiler keeps those in registers.

    before: STF(state,3,v9[0]); STF(state,4,v9[1]); ... STF(state,34,v9[31]);
    after:  for(int k=0;k<32;++k)STF(state,3+(1)*k,v9[0+(1)*k]);
    """
    arrays, copied, found = ir.arrays_in_memory(code), _copied(code), ir.Code()
    for rolls, group in groupby(code, lambda one: isinstance(one, ir.Store) or _name(one) in copied):
        block = [*group]
        loops = _rolled([one for one in block if isinstance(one, ir.Store)], arrays, copied) if rolls else []
        found += [one for one in block if not isinstance(one, ir.Store)] + loops if loops else block
    reads = _reads(found)
    return [one for one in found if _name(one) not in copied or reads[_name(one)]]


def _copied(code: ir.Code) -> dict[str, ir.Call]:
    """Return the loads that are only stored, by their registers; their fields are not changed by another store."""
    reads, stores = _reads(code), [one for one in code if isinstance(one, ir.Store)]
    stored = {(one.buffer, one.field): one.value for one in stores}
    only = {one.value for one in stores if isinstance(one.value, str) and reads[one.value] == 1}
    loads = {one.name: one.value for one in code if isinstance(one, ir.Define) and one.name in only}
    return {
        name: load
        for name, load in loads.items()
        if isinstance(load, ir.Call) and load.op == "load" and stored.get(load.args, name) == name  # type: ignore[arg-type]
    }


def _rolled(stores: list[ir.Store], arrays: set[str], copied: dict[str, ir.Call]) -> ir.Code:
    """Return stores, by loops where fields, and what is stored there, are evenly spaced; nothing if that is nowhere."""
    rows: dict[Any, list[ir.Store]] = {}
    for one in sorted(stores, key=lambda one: one.field):
        rows.setdefault(_row(one, arrays, copied), []).append(one)
    found = ir.Code()
    for kind, row in rows.items():
        for run in _runs(row, copied):
            found += [_loop(run, copied)] if kind is not None and len(run) >= LEAST_ROW else run
    return found if any(isinstance(one, ir.Repeat) for one in found) else []


def _name(one: ir.Instruction) -> str:
    return one.name if isinstance(one, ir.Define) else ""


def _row(store: ir.Store, arrays: set[str], copied: dict[str, ir.Call]) -> tuple[Any, ...] | None:
    """Return equal keys for stores that a loop may do, None for one that stays as it is."""
    value = store.value
    if isinstance(value, ir.Element) and value.base is None and value.array in arrays:
        return store.buffer, value.array
    if isinstance(value, str) and value in copied:
        return store.buffer, "load", copied[value].args[0]
    return (store.buffer, value.item()) if isinstance(value, np.generic) else None


def _runs(stores: list[ir.Store], copied: dict[str, ir.Call]) -> list[list[ir.Store]]:
    """Return stores in runs, in each of which fields and what is stored there are evenly spaced."""
    runs = [stores[:1]]
    for one in stores[1:]:
        run = runs[-1]
        if len(run) == 1 or _step(run[-1], one, copied) == _step(run[0], run[1], copied):
            run.append(one)
        else:
            runs.append([one])
    return runs


def _step(one: ir.Store, other: ir.Store, copied: dict[str, ir.Call]) -> tuple[int, int]:
    """Return from one store to another how many fields it is, and how many elements or fields that are read."""
    return other.field - one.field, _source(other.value, copied) - _source(one.value, copied)


def _source(value: ir.Operand, copied: dict[str, ir.Call]) -> int:
    """Return the element or the field that a value is read from."""
    if isinstance(value, ir.Element):
        return value.offset
    return copied[value].args[1] if isinstance(value, str) and value in copied else 0  # type: ignore[return-value]


def _loop(run: list[ir.Store], copied: dict[str, ir.Call]) -> ir.Repeat:
    """Return a loop that does stores whose steps are equal."""
    first, (fields, sources) = run[0], _step(run[0], run[1], copied)
    value = first.value
    if isinstance(value, ir.Element):
        value = value._replace(stride=sources)
    elif isinstance(value, str):
        load = copied[value]
        value = load._replace(op="fields", args=(*load.args, sources))
    return ir.Repeat(len(run), first._replace(value=value, stride=fields))
