"""Arrays that share memory: only if none of them is needed while another one is."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import count

from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl.engines.fused.sharing import share_memory

Code = list[str]
ROUNDS = 2


def memory(lines: Code) -> int:
    """Return how many numbers all arrays of some code have room for."""
    return sum(int(size) for line in lines for size in re.findall(r"^F \w+\[(\d+)\];$", line))


def use(name: str) -> Code:
    return [f"PUT(F,{name},i,x)", f"y+=AT(F,{name},i);"]


def test_one_array_after_another_takes_its_memory() -> None:
    lines = ["F v1[9];", *use("v1"), "F v2[5];", *use("v2"), "F v3[9];", *use("v3")]
    assert share_memory(lines) == ["F v1[9];", *use("v1"), *use("v1"), *use("v1")]


def test_arrays_that_are_needed_together_do_not_share() -> None:
    lines = ["F v1[9];", "F v2[9];", *use("v1"), *use("v2"), *use("v1")]
    assert share_memory(lines) == lines


def test_an_array_that_is_copied_from_another_one_has_memory_of_its_own() -> None:
    copied = ["PUT(F,v1,i,x)", "for(int k=0;k<4;++k)v2[k]=v1[k];", "y+=AT(F,v2,i);"]
    assert memory(share_memory(["F v1[4];", "F v2[4];", *copied])) == 8


def test_what_a_loop_reads_again_keeps_its_memory_to_the_end_of_it() -> None:
    lines = ["F v1[4];", "PUT(F,v1,i,x)", "for(int r1=0;r1<3;++r1){", "y+=AT(F,v1,i);", "F v2[4];", *use("v2"), "}"]
    assert memory(share_memory(lines)) == 8


def test_arrays_of_two_sides_of_a_branch_share() -> None:
    lines = ["if(c){", "F v1[4];", *use("v1"), "}else{", "F v2[4];", *use("v2"), "}"]
    assert memory(share_memory(lines)) == 4


def test_what_a_loop_carries_keeps_its_memory_to_the_end_of_it() -> None:
    carried = ["F v1[4];", "F v2[4];", "for(int r1=0;r1<3;++r1){", *use("v1"), *use("v2"), "}"]
    assert memory(share_memory(carried)) == 8
    of_a_round = ["for(int r1=0;r1<3;++r1){", "F v1[4];", *use("v1"), "F v2[4];", *use("v2"), "}"]
    assert memory(share_memory(of_a_round)) == 4


def test_arrays_whose_places_are_all_known_stay_as_they_are() -> None:
    known = ["F v1[4];", "v1[2]=x;", "for(int k=0;k<4;++k)v1[0+(1)*k]=y;", "F v2[4];", "v2[3]=v1[2];"]
    assert share_memory(known) == known


@st.composite
def blocks(draw: st.DrawFn, depth: int, numbers: Iterator[int]) -> Code:
    """Code of loops and branches that writes and reads arrays, each within the block that declares it."""
    names = [f"v{next(numbers)}" for _ in range(draw(st.integers(0, 3)))]
    lines = [f"F {name}[{draw(st.integers(1, 2))}];" for name in names]
    for _ in range(draw(st.integers(0, 4))):
        kind = draw(st.sampled_from(["put", "read", "loop", "branch"]))
        if kind in ("put", "read") and names:
            name = draw(st.sampled_from(names))
            lines.append(use(name)[kind == "read"])
        elif depth < 3:
            head = f"for(int r{depth}=0;r{depth}<{ROUNDS};++r{depth}){{" if kind == "loop" else "if(c){"
            uses = st.lists(st.sampled_from([line for name in names for line in use(name)]), max_size=3)
            before, after = (draw(uses) if names else [] for _ in range(2))
            lines += [head, *before, *draw(blocks(depth + 1, numbers)), *after, "}"]
    return lines


@st.composite
def codes(draw: st.DrawFn) -> Code:
    return draw(blocks(0, count()))


def run(lines: Code) -> Iterator[tuple[int, int | None]]:
    """Yield for each read, by its number, which write it sees, by that one's number; None if there was none.

    All branches are taken. Memory is lost where it is declared.
    """
    memory: dict[str, int | None] = {}
    at, clock, loops = 0, 0, list[tuple[int, int] | None]()
    while at < len(lines):
        line = lines[at]
        if found := re.match(r"F (\w+)\[", line):
            memory[found[1]] = None
        elif found := re.match(r"PUT\(F,(\w+),", line):
            memory[found[1]], clock = clock, clock + 1
        elif found := re.match(r"y\+=AT\(F,(\w+),", line):
            yield clock, memory[found[1]]
        elif line.startswith("for("):
            loops.append((at, 1))
        elif line == "if(c){":
            loops.append(None)
        elif line == "}" and (loop := loops.pop()) is not None and loop[1] < ROUNDS:
            at = loop[0]
            loops.append((at, loop[1] + 1))
        at += 1


@settings(max_examples=500)
@given(codes())
def test_every_read_sees_the_write_that_it_saw_before(lines: Code) -> None:
    shared = share_memory(lines)
    assert memory(shared) <= memory(lines)
    seen = zip(run(lines), run(shared), strict=True)
    assert all(before == after for before, after in seen if before[1] is not None)
