"""Lets arrays of a kernel share memory where they are never live at the same time.

A C compiler gives each array memory of its own for the whole function, most of which would hold dead numbers that
take the place of live ones in caches.
"""

from __future__ import annotations

from typing import NamedTuple

from surgical_marl.engines.fused import instructions as ir


class _Loop(NamedTuple):
    """A loop: its first and its last instruction."""

    start: int
    end: int


class _Array(NamedTuple):
    """An array, and the first and last instruction between which it is live."""

    name: str
    kind: str
    size: int
    first: int
    last: int


def share_memory(code: ir.Code) -> ir.Code:
    """Give arrays that are never live at the same time one memory, which is declared at the beginning.

    Arrays whose elements are all at known indices stay as they are: a compiler keeps those in registers.

    before: F v1[9]; ...uses of v1... F v2[5]; ...uses of v2...
    after:  ALIGNED F v1[9]; ...uses of v1... ...uses of v1...
    """
    names, memory = _assign(_arrays(code))

    def renamed(operand: ir.Operand) -> ir.Operand:
        if isinstance(operand, ir.Element | ir.Gather) and operand.array in names:
            return operand._replace(array=names[operand.array])
        return operand

    left = (one for one in code if not (isinstance(one, ir.Declare) and one.name in names))
    return [*memory, *(ir.rewritten(one, renamed) for one in left)]


def _arrays(code: ir.Code) -> list[_Array]:
    """Return all arrays of which some element is at an index that is not known, and where they are live."""
    declared, uses = dict[str, tuple[int, ir.Declare]](), dict[str, tuple[int, int]]()
    for at, one in enumerate(code):
        if isinstance(one, ir.Declare):
            declared[one.name] = at, one
        for operand in ir.operands(one):
            for part in ir.parts(operand):
                if isinstance(part, ir.Element | ir.Gather):
                    uses[part.array] = uses.get(part.array, (at, at))[0], at
    around, found = _loops_around(code), []
    for name in declared.keys() & uses.keys() & ir.arrays_at_unknown_places(code):
        (at, one), (first, last) = declared[name], uses[name]
        # what a round of a loop leaves in an array from outside of the loop may be read in the next one
        before, after = (next((loop for loop in around[use] if loop.start > at), None) for use in (first, last))
        first, last = before.start if before else first, after.end if after else last
        found.append(_Array(name, one.kind, one.size, first, last))
    return found


def _loops_around(code: ir.Code) -> list[tuple[_Loop, ...]]:
    """Return the loops around each instruction, outermost first."""
    ends, stack = dict[int, int](), list[int]()
    for at, one in enumerate(code):
        if isinstance(one, ir.OPENS):
            stack.append(at)
        elif isinstance(one, ir.End):
            ends[stack.pop()] = at
    around, inside = [], list[tuple[_Loop, ...]]([()])
    for at, one in enumerate(code):
        if isinstance(one, ir.End):
            inside.pop()
        around.append(inside[-1])
        if isinstance(one, ir.OPENS):
            inside.append(inside[-1] if isinstance(one, ir.If) else (*inside[-1], _Loop(at, ends[at])))
    return around


def _assign(arrays: list[_Array]) -> tuple[dict[str, str], list[ir.Declare]]:
    """Return the name of the memory that each array gets, and the declarations of all memory.

    The largest arrays come first, and each gets the smallest memory that is free: best fit, decreasing.
    """
    names, memories = dict[str, str](), list[list[_Array]]()
    for array in sorted(arrays, key=lambda array: (-array.size, array.first, array.name)):
        free = (memory for memory in memories if memory[0].kind == array.kind and not _meets(memory, array))
        memory = min(free, key=lambda memory: memory[0].size, default=None)
        if memory is None:
            memories.append(memory := [])
        memory.append(array)
        names[array.name] = memory[0].name
    return names, [ir.Declare(first.name, first.kind, first.size, aligned=True) for first, *_ in memories]


def _meets(memory: list[_Array], array: _Array) -> bool:
    """Return whether some array in a memory is live at the same time as another array."""
    return any(array.first <= other.last and other.first <= array.last for other in memory)
