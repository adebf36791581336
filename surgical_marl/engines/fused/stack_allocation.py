"""Lets arrays of a function share memory if they are never needed at the same time.

A compiler gives each array of a function memory of its own, for the whole function. Most of it would hold what nobody
reads any more, in the way of what is needed in caches.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

DECLARED = re.compile(r"([FIUB]) ([vnw]\d+)\[(\d+)\];")
"""The declaration of an array: its type, name and size."""
_NAME = re.compile(r"\b[vnw]\d+\b")
_FIXED = re.compile(r"\b[vnw]\d+\[[\d+*()k-]*\]")
"""An element at a known place; `k` counts in short loops, which compilers unroll."""


class _Loop(NamedTuple):
    """A loop: its first line, and the loops around it, outermost first."""

    start: int
    around: tuple[_Loop, ...]


class _Array(NamedTuple):
    """An array, and the lines from and up to which its memory must be its own."""

    name: str
    kind: str
    size: int
    first: int
    last: int


def share_memory(lines: Sequence[str]) -> list[str]:
    """Return code in which arrays share memory; those that do are declared at its beginning.

    Arrays whose elements are all at known places stay as they are: a compiler keeps those in registers.
    """
    lines = "\n".join(lines).split("\n")
    arrays = _arrays(lines)
    names, declared = _assign(arrays)
    kept = (line for line in lines if not ((found := DECLARED.fullmatch(line)) and found[2] in names))
    return declared + [_NAME.sub(lambda name: names.get(name[0], name[0]), line) for line in kept]


def names_at_unknown_places(line: str) -> set[str]:
    """Return the names in a line of code, but for arrays whose elements there are at known places."""
    return set(_NAME.findall(_FIXED.sub("", line)))


def _arrays(lines: list[str]) -> list[_Array]:
    """Return all arrays of which some element is at a place that is not known."""
    declared, uses, moving = {}, dict[str, tuple[int, int]](), set[str]()
    for at, line in enumerate(lines):
        if match := DECLARED.fullmatch(line):
            declared[match[2]] = at, match[1], int(match[3])
            continue
        names = [name for name in _NAME.findall(line) if name in declared]
        for name in names:
            uses[name] = uses.get(name, (at, at))[0], at
        if names:
            moving |= names_at_unknown_places(line)
    loops, ends = _loops(lines)
    found = []
    for name in declared.keys() & uses.keys() & moving:
        (at, kind, size), (first, last) = declared[name], uses[name]
        # what a round of a loop leaves in an array from outside of the loop may be read in the next one
        before, after = (next((loop for loop in loops[use] if loop.start > at), None) for use in (first, last))
        first, last = before.start if before else first, ends[after.start] if after else last
        found.append(_Array(name, kind, size, first, last))
    return found


def _loops(lines: list[str]) -> tuple[list[tuple[_Loop, ...]], dict[int, int]]:
    """Return the loops around each line, outermost first, and the last line of each loop by its first one."""
    around, ends, stack = [], {}, list[_Loop | None]()
    inside: tuple[_Loop, ...] = ()
    for at, line in enumerate(lines):
        around.append(inside)
        for brace in re.findall("[{}]", line):
            if brace == "{":
                loop = _Loop(at, inside) if line.startswith("for(") else None
                stack.append(loop)
                inside += (loop,) if loop else ()
            elif (loop := stack.pop()) is not None:
                ends[loop.start], inside = at, loop.around
    return around, ends


def _assign(arrays: list[_Array]) -> tuple[dict[str, str], list[str]]:
    """Return the name of the memory that each array gets, and the declarations of all memory.

    The largest arrays come first, and each gets the smallest memory that is free.
    """
    names, rooms = {}, list[list[_Array]]()
    for array in sorted(arrays, key=lambda array: (-array.size, array.first, array.name)):
        free = (room for room in rooms if room[0].kind == array.kind and not _meets(room, array))
        room = min(free, key=lambda room: room[0].size, default=None)
        if room is None:
            rooms.append(room := [])
        room.append(array)
        names[array.name] = room[0].name
    return names, [f"ALIGNED {room[0].kind} {room[0].name}[{room[0].size}];" for room in rooms]


def _meets(room: list[_Array], array: _Array) -> bool:
    """Whether any of the arrays in some memory is needed at the same time as another one."""
    return any(array.first <= other.last and other.first <= array.last for other in room)
