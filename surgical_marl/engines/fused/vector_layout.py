"""Interleaves arrays that are used side by side, so that a GPU moves several of their elements by one instruction."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from surgical_marl.engines.fused import instructions as ir

WIDTHS = 4, 2
"""Numbers of arrays that are interleaved: an instruction moves up to four neighbours in memory. Arrays that find no
three others may find one."""


def interleave(code: ir.Code) -> ir.Code:
    """Interleave arrays of floats, by fours or twos, that straight code reads, or stores, at the same index.

    Arrays whose elements are all at known indices stay as they are: a compiler keeps those in registers.

    before: F v1[9]; F v2[9]; ... v1[r3]=v7; v2[r3]=v8;
    after:  F w0[18]; ... w0[2*(r3)+0]=v7; w0[2*(r3)+1]=v8;
    """
    arrays = _arrays(code)
    memory = {name: (f"w{k}", row) for k, row in enumerate(_rows(code, arrays)) for name in row}

    def moved(operand: ir.Operand) -> ir.Operand:
        if not isinstance(operand, ir.Element) or operand.array not in memory:
            return operand
        name, row = memory[operand.array]
        return operand._replace(array=name, width=len(row), lane=row.index(operand.array))

    found: ir.Code = []
    declared = set[str]()
    for one in code:
        if not isinstance(one, ir.Declare) or one.name not in memory:
            found.append(ir.rewritten(one, moved))
            continue
        name, row = memory[one.name]
        if name not in declared:
            found.append(ir.Declare(name, one.kind, len(row) * one.size))
            declared.add(name)
    return found


def _arrays(code: ir.Code) -> dict[str, tuple[int, int]]:
    """Return the arrays that may be interleaved: name -> the block that declares it, and its size.

    Only arrays that agree in both can be interleaved.
    """
    unknown = ir.arrays_at_unknown_places(code)
    arrays, blocks = dict[str, tuple[int, int]](), [0]
    for at, one in enumerate(code, 1):
        if isinstance(one, ir.Declare) and one.kind == "f" and one.name in unknown:
            arrays[one.name] = blocks[-1], one.size
        if isinstance(one, ir.End | ir.Else):
            blocks.pop()
        if isinstance(one, (*ir.OPENS, ir.Else)):
            blocks.append(at)
    return arrays


def _rows(code: ir.Code, arrays: Mapping[str, tuple[int, int]]) -> Iterator[tuple[str, ...]]:
    """Yield arrays to interleave: straight code uses elements of them one after the other."""
    taken = set[str]()
    for width in WIDTHS:
        waiting = dict[tuple[object, ...], list[str]]()
        for one in code:
            if isinstance(one, ir.CONTROL):
                waiting.clear()
                continue
            for element, stored in _elements(one):
                name = element.array
                if name not in arrays or name in taken:
                    continue
                row = waiting.setdefault((element._replace(array=""), stored, arrays[name]), [])
                row[:] = [other for other in row if other not in taken and other != name] + [name]
                if len(row) == width:
                    yield tuple(row)
                    taken.update(row)


def _elements(one: ir.Instruction) -> Iterator[tuple[ir.Element, bool]]:
    """Yield the elements of arrays in an instruction, and whether they are stored."""
    target = one.target if isinstance(one, ir.Assign) else None
    for operand in ir.operands(one):
        for part in ir.parts(operand):
            if isinstance(part, ir.Element):
                yield part, part is target
