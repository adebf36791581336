"""Lets arrays that are used side by side lie side by side, number by number, in code for a GPU.

One instruction moves up to four numbers that are neighbours in memory. A loop that reads number i of twelve arrays
needs three of them if these arrays lie side by side by fours, and twelve if they lie one behind the other.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

from surgical_marl.engines.fused.stack_allocation import DECLARED, names_at_unknown_places

WIDTHS = 4, 2
"""How many arrays lie side by side. Those that find no three others may find one."""
_USED = re.compile(r"\b([vn]\d+)\[((?:[^][]|\[[^][]*\])+)\](=)?")
"""An element of an array, and what follows where it is stored."""
_ENDS = "for(", "if(", "}"
"""How lines begin that code does not simply run through."""


def interleave(lines: Sequence[str]) -> list[str]:
    """Return code in which arrays of real numbers lie side by side.

    Arrays whose elements are all at known places stay as they are: a compiler keeps those in registers.
    """
    lines = "\n".join(lines).split("\n")
    arrays = _arrays(lines)
    rows = {name: (f"w{k}", row) for k, row in enumerate(_rows(lines, arrays)) for name in row}

    def moved(use: re.Match[str]) -> str:
        name, index, stored = use.groups("")
        if name not in rows:
            return use[0]
        memory, row = rows[name]
        return f"{memory}[{len(row)}*({index})+{row.index(name)}]{stored}"

    found, declared = [], set[str]()
    for line in lines:
        declaration = DECLARED.fullmatch(line)
        if declaration is None or declaration[2] not in rows:
            found.append(line if declaration else _USED.sub(moved, line))
            continue
        memory, row = rows[declaration[2]]
        if memory not in declared:
            _, size = arrays[row[0]]
            found.append(f"F {memory}[{len(row) * size}];")
            declared.add(memory)
    return found


def _arrays(lines: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Return the arrays that may be moved: name -> the block that declares it, and its size.

    Arrays that differ in either can't lie side by side.
    """
    moving = {name for line in lines for name in names_at_unknown_places(line)}
    arrays, blocks = dict[str, tuple[int, int]](), [0]
    for at, line in enumerate(lines, 1):
        if (found := DECLARED.fullmatch(line)) and found[1] == "F" and found[2] in moving:
            arrays[found[2]] = blocks[-1], int(found[3])
        for brace in re.findall("[{}]", line):
            blocks = [*blocks, at] if brace == "{" else blocks[:-1]
    return arrays


def _rows(lines: Sequence[str], arrays: Mapping[str, tuple[int, int]]) -> Iterator[tuple[str, ...]]:
    """Yield arrays that are to lie side by side: code reads, or stores, elements of them one after the other."""
    taken, used = set[str](), [line for line in lines if not DECLARED.fullmatch(line)]
    for width in WIDTHS:
        waiting = dict[tuple[str, str, tuple[int, int]], list[str]]()
        for line in used:
            if line.startswith(_ENDS):
                waiting.clear()
                continue
            for name, index, stored in _USED.findall(line):
                if name not in arrays or name in taken:
                    continue
                row = waiting.setdefault((index, stored, arrays[name]), [])
                row[:] = [other for other in row if other not in taken and other != name] + [name]
                if len(row) == width:
                    yield tuple(row)
                    taken.update(row)
