"""Arrays that share memory, and arrays that lie side by side: all reads see what they saw before."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import count

from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl.engines.fused.stack_allocation import share_memory
from surgical_marl.engines.fused.vector_layout import interleave

Code = list[str]
ROUNDS = 2


def memory(lines: Code) -> int:
    """Return how many numbers all arrays of some code have room for."""
    return sum(int(size) for line in lines for size in re.findall(r"^(?:ALIGNED )?F \w+\[(\d+)\];$", line))


def use(name: str, place: str = "i") -> Code:
    return [f"{name}[{place}]=x;", f"y+={name}[{place}];"]


def test_one_array_after_another_takes_its_memory() -> None:
    lines = ["F v1[9];", *use("v1"), "F v2[5];", *use("v2"), "F v3[9];", *use("v3")]
    assert share_memory(lines) == ["ALIGNED F v1[9];", *use("v1"), *use("v1"), *use("v1")]


def test_arrays_that_are_needed_together_do_not_share() -> None:
    uses = [*use("v1"), *use("v2"), *use("v1")]
    assert share_memory(["F v1[9];", "F v2[9];", *uses]) == ["ALIGNED F v1[9];", "ALIGNED F v2[9];", *uses]


def test_an_array_that_is_copied_from_another_one_has_memory_of_its_own() -> None:
    copied = ["v1[i]=x;", "for(int k=0;k<4;++k)v2[k]=v1[k];", "y+=v2[i];"]
    assert memory(share_memory(["F v1[4];", "F v2[4];", *copied])) == 8


def test_what_a_loop_reads_again_keeps_its_memory_to_the_end_of_it() -> None:
    lines = ["F v1[4];", "v1[i]=x;", "for(int r1=0;r1<3;++r1){", "y+=v1[i];", "F v2[4];", *use("v2"), "}"]
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


def test_what_a_loop_reads_at_one_place_lies_side_by_side() -> None:
    lines = ["F v1[9];", "F v2[9];", "F v3[9];", "F v4[9];", "F v5[8];", "for(int r1=0;r1<9;++r1){",
             *(f"y+=v{k}[r1];" for k in range(1, 6)), "}", "y+=v3[7];"]  # fmt: skip
    read = [f"y+=w0[4*(r1)+{k}];" for k in range(4)]
    assert interleave(lines) == ["F w0[36];", "F v5[8];", lines[5], *read, "y+=v5[r1];", "}", "y+=w0[4*(7)+2];"]


def test_two_arrays_that_find_no_others_lie_side_by_side() -> None:
    lines = ["F v1[9];", "F v2[9];", "F v3[9];", "v1[i]=x;", "v2[i]=y;", "v3[j]=z;"]
    assert interleave(lines) == ["F w0[18];", "F v3[9];", "w0[2*(i)+0]=x;", "w0[2*(i)+1]=y;", "v3[j]=z;"]


def test_what_is_stored_or_read_elsewhere_lies_alone() -> None:
    lines = ["F v1[9];", "F v2[9];", "F v3[9];", "v1[i]=x;", "y+=v2[i];", "v3[j]=z;"]
    assert interleave(lines) == lines


def test_arrays_of_other_types_or_blocks_or_at_known_places_lie_alone() -> None:
    lines = ["I v1[9];", "I v2[9];", "y+=v1[i]+v2[i];", "F v3[9];", "if(c){", "F v4[9];", "y+=v3[i]+v4[i];", "}",
             "F v5[2];", "F v6[2];", "y+=v5[1]+v6[1];"]  # fmt: skip
    assert interleave(lines) == lines


def test_arrays_that_code_does_not_simply_run_through_lie_alone() -> None:
    lines = ["F v1[9];", "F v2[9];", "y+=v1[i];", "if(c){", "y+=v2[i];", "}"]
    assert interleave(lines) == lines


def test_an_element_of_an_array_may_be_the_place_in_another_one() -> None:
    lines = ["I v1[9];", "F v2[9];", "F v3[9];", "y+=v2[v1[2]]*v3[v1[2]];"]
    assert interleave(lines)[2:] == ["y+=w0[2*(v1[2])+0]*w0[2*(v1[2])+1];"]


@st.composite
def blocks(draw: st.DrawFn, depth: int, numbers: Iterator[int], places: tuple[str, ...]) -> Code:
    """Code of loops and branches that writes and reads arrays, each within the block that declares it."""
    names = [f"v{next(numbers)}" for _ in range(draw(st.integers(0, 5)))]
    lines = [f"F {name}[{draw(st.integers(ROUNDS, ROUNDS + 1))}];" for name in names]

    def uses() -> Code:
        return [use(name, place)[kind] for name, place, kind in draw(drawn)] if names else []

    drawn = st.lists(st.tuples(st.sampled_from(names or [""]), st.sampled_from(places), st.integers(0, 1)), max_size=6)
    for _ in range(draw(st.integers(0, 4))):
        lines += uses()
        if depth < 3 and (kind := draw(st.sampled_from(["loop", "branch", ""]))):
            head = f"for(int r{depth}=0;r{depth}<{ROUNDS};++r{depth}){{" if kind == "loop" else "if(c){"
            inner = (*places, f"r{depth}") if kind == "loop" else places
            lines += [head, *uses(), *draw(blocks(depth + 1, numbers, inner)), *uses(), "}"]
    return lines


@st.composite
def codes(draw: st.DrawFn) -> Code:
    return draw(blocks(0, count(), ("0", "1", "i")))


def run(lines: Code) -> Iterator[tuple[int, int | None]]:
    """Yield for each read, by its number, which write it sees, by that one's number; None if there was none.

    All branches are taken. Memory is lost where it is declared.
    """
    memory: dict[tuple[str, int], int] = {}
    counters = {"i": 1}
    at, clock, blocks = 0, 0, list[tuple[int, str]]()
    while at < len(lines):
        line = lines[at]
        if found := re.fullmatch(r"(?:ALIGNED )?F (\w+)\[\d+\];", line):
            memory = {place: write for place, write in memory.items() if place[0] != found[1]}
        elif found := re.fullmatch(r"(\w+)\[(.*)\]=x;", line):
            memory[found[1], eval(found[2], counters)], clock = clock, clock + 1
        elif found := re.fullmatch(r"y\+=(\w+)\[(.*)\];", line):
            yield clock, memory.get((found[1], eval(found[2], counters)))
        elif found := re.match(r"for\(int (\w+)=|if\(c\)\{", line):
            blocks.append((at, found[1] or ""))
            counters[found[1] or ""] = 0
        elif line == "}":
            start, counter = blocks.pop()
            counters[counter] += 1
            if counter and counters[counter] < ROUNDS:
                blocks.append((start, counter))
                at = start
        at += 1


@settings(max_examples=150)
@given(codes())
def test_every_read_sees_the_write_that_it_saw_before(lines: Code) -> None:
    for changed in (share_memory(lines), interleave(lines), share_memory(interleave(lines))):
        assert memory(changed) <= memory(lines)
        seen = zip(run(lines), run(changed), strict=True)
        assert all(before == after for before, after in seen if before[1] is not None)
