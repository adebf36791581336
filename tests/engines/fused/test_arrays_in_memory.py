"""Arrays that share memory, and arrays that are interleaved: all reads see what they saw before."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl.engines.fused import instructions as ir
from surgical_marl.engines.fused.stack_allocation import share_memory
from surgical_marl.engines.fused.vector_layout import interleave
from surgical_marl.engines.fused.verify import check_code

ROUNDS = 2
BEGIN: ir.Code = [ir.Define(name, "int" if name in "ij" else "f", 0) for name in ("x", "y", "i", "j")]
IF, LOOP = ir.If("x", 1, (ir.Size(1, 1),) * 2, ()), ir.For("r1", 3, False)

Place = int | str
"""A known index of an array, or a register that holds one."""


def at(name: str, place: Place) -> ir.Element:
    return ir.Element(name, offset=place) if isinstance(place, int) else ir.Element(name, place)


def floats(name: str, size: int) -> ir.Declare:
    return ir.Declare(name, "f", size)


def stored(name: str, place: Place = "i") -> ir.Instruction:
    return ir.Assign(at(name, place), "x")


def read(name: str, place: Place = "i") -> ir.Instruction:
    return ir.Assign("y", at(name, place))


def use(name: str, place: Place = "i") -> ir.Code:
    return [stored(name, place), read(name, place)]


def memory(code: ir.Code) -> int:
    """Return how many numbers all arrays of some code have room for."""
    return sum(one.size for one in code if isinstance(one, ir.Declare))


def shared(code: ir.Code) -> ir.Code:
    after = share_memory(code)
    check_code([*BEGIN, *after])
    return after


def interleaved(code: ir.Code) -> ir.Code:
    after = interleave(code)
    check_code([*BEGIN, *after])
    return after


def test_one_array_after_another_takes_its_memory() -> None:
    code = [floats("v1", 9), *use("v1"), floats("v2", 5), *use("v2"), floats("v3", 9), *use("v3")]
    assert shared(code) == [ir.Declare("v1", "f", 9, aligned=True), *use("v1") * 3]


def test_arrays_that_are_needed_together_do_not_share() -> None:
    uses = [*use("v1"), *use("v2"), *use("v1")]
    kept = shared([floats("v1", 9), floats("v2", 9), *uses])
    assert kept == [ir.Declare("v1", "f", 9, True), ir.Declare("v2", "f", 9, True), *uses]


def test_an_array_that_is_copied_from_another_one_has_memory_of_its_own() -> None:
    copy = ir.Repeat(4, ir.Assign(ir.Element("v2", stride=1), ir.Element("v1", stride=1)))
    assert memory(shared([floats("v1", 4), floats("v2", 4), stored("v1"), copy, read("v2")])) == 8


def test_what_a_loop_reads_again_keeps_its_memory_to_the_end_of_it() -> None:
    code = [floats("v1", 4), stored("v1"), LOOP, read("v1"), floats("v2", 4), *use("v2"), ir.End()]
    assert memory(shared(code)) == 8


def test_arrays_of_two_sides_of_a_branch_share() -> None:
    sides = [floats("v1", 4), *use("v1"), ir.Else("x"), floats("v2", 4), *use("v2")]
    assert memory(shared([IF, *sides, ir.End()])) == 4


def test_what_a_loop_carries_keeps_its_memory_to_the_end_of_it() -> None:
    arrays = [floats("v1", 4), floats("v2", 4)]
    assert memory(shared([*arrays, LOOP, *use("v1"), *use("v2"), ir.End()])) == 8
    assert memory(shared([LOOP, arrays[0], *use("v1"), arrays[1], *use("v2"), ir.End()])) == 4


def test_arrays_whose_places_are_all_known_stay_as_they_are() -> None:
    fill = ir.Repeat(4, ir.Assign(ir.Element("v1", stride=1), "x"))
    known = [floats("v1", 4), stored("v1", 2), fill, floats("v2", 4), ir.Assign(at("v2", 3), at("v1", 2))]
    assert shared(known) == interleaved(known) == known


def test_what_a_loop_reads_at_one_place_is_interleaved() -> None:
    sizes = {"v1": 9, "v2": 9, "v3": 9, "v4": 9, "v5": 8}
    arrays = [floats(name, size) for name, size in sizes.items()]
    code = [*arrays, LOOP, *(read(name, "r1") for name in sizes), ir.End(), read("v3", 7)]
    reads = [ir.Assign("y", ir.Element("w0", "r1", width=4, lane=k)) for k in range(4)]
    last = ir.Assign("y", ir.Element("w0", offset=7, width=4, lane=2))
    assert interleaved(code) == [floats("w0", 36), arrays[4], LOOP, *reads, read("v5", "r1"), ir.End(), last]


def test_two_arrays_that_find_no_others_are_interleaved() -> None:
    arrays = [floats(f"v{k}", 9) for k in (1, 2, 3)]
    pair = [ir.Assign(ir.Element("w0", "i", width=2, lane=k), "x") for k in (0, 1)]
    found = interleaved([*arrays, stored("v1"), stored("v2"), stored("v3", "j")])
    assert found == [floats("w0", 18), arrays[2], *pair, stored("v3", "j")]


def test_what_is_stored_or_read_elsewhere_lies_alone() -> None:
    code = [*(floats(f"v{k}", 9) for k in (1, 2, 3)), stored("v1"), read("v2"), stored("v3", "j")]
    assert interleaved(code) == code


def test_arrays_of_other_types_or_blocks_or_at_known_places_lie_alone() -> None:
    def added(a: str, b: str, place: Place = "i") -> ir.Instruction:
        return ir.Assign("y", ir.Call("add", "f", (at(a, place), at(b, place))))

    whole = [ir.Declare("v1", "i", 9), ir.Declare("v2", "i", 9), added("v1", "v2")]
    inner = [floats("v3", 9), IF, floats("v4", 9), added("v3", "v4"), ir.End()]
    code = [*whole, *inner, floats("v5", 2), floats("v6", 2), added("v5", "v6", 1)]
    assert interleaved(code) == code


def test_arrays_that_code_does_not_simply_run_through_lie_alone() -> None:
    code = [floats("v1", 9), floats("v2", 9), read("v1"), IF, read("v2"), ir.End()]
    assert interleaved(code) == code


def test_an_element_of_an_array_may_be_the_place_in_another_one() -> None:
    place = ir.Element("v1", ir.Element("v1", offset=2))
    product = ir.Call("mul", "f", (ir.Element("v2", place), ir.Element("v3", place)))
    code = [ir.Declare("v1", "i", 9), floats("v2", 9), floats("v3", 9), ir.Assign("y", product)]
    moved = tuple(ir.Element("w0", place, width=2, lane=k) for k in (0, 1))
    assert interleaved(code)[2:] == [ir.Assign("y", ir.Call("mul", "f", moved))]


@st.composite
def blocks(draw: st.DrawFn, depth: int, numbers: Iterator[int], places: tuple[Place, ...]) -> ir.Code:
    """Code of loops and branches that writes and reads arrays, each within the block that declares it."""
    names = [f"v{next(numbers)}" for _ in range(draw(st.integers(0, 5)))]
    code: ir.Code = [floats(name, draw(st.integers(ROUNDS, ROUNDS + 1))) for name in names]

    def uses() -> ir.Code:
        return [use(name, place)[kind] for name, place, kind in draw(drawn)] if names else []

    drawn = st.lists(st.tuples(st.sampled_from(names or [""]), st.sampled_from(places), st.integers(0, 1)), max_size=6)
    for _ in range(draw(st.integers(0, 4))):
        code += uses()
        if depth < 3 and (kind := draw(st.sampled_from(["loop", "branch", ""]))):
            head: ir.Instruction = ir.For(f"r{depth}", ROUNDS, False) if kind == "loop" else IF
            inner = (*places, f"r{depth}") if kind == "loop" else places
            code += [head, *uses(), *draw(blocks(depth + 1, numbers, inner)), *uses(), ir.End()]
    return code


@st.composite
def codes(draw: st.DrawFn) -> ir.Code:
    return draw(blocks(0, count(), (0, 1, "i")))


def run(code: ir.Code) -> Iterator[tuple[int, int | None]]:
    """Yield for each read, by its number, which write it sees, by that one's number; None if there was none.

    All branches are taken. Memory is lost where it is declared.
    """
    written: dict[tuple[str, int], int] = {}
    registers = {"i": 1}

    def place(one: ir.Element) -> tuple[str, int]:
        base = 0 if one.base is None else registers[str(one.base)]
        return one.array, one.width * (base + one.offset) + one.lane

    step, clock, opened = 0, 0, list[int]()
    while step < len(code):
        one = code[step]
        if isinstance(one, ir.Declare):
            written = {key: write for key, write in written.items() if key[0] != one.name}
        elif isinstance(one, ir.Assign) and isinstance(one.target, ir.Element):
            written[place(one.target)], clock = clock, clock + 1
        elif isinstance(one, ir.Assign):
            assert isinstance(one.value, ir.Element)
            yield clock, written.get(place(one.value))
        elif isinstance(one, ir.OPENS):
            opened.append(step)
            if isinstance(one, ir.For):
                registers[one.counter] = 0
        elif isinstance(one, ir.End):
            start = opened.pop()
            head = code[start]
            if isinstance(head, ir.For) and registers[head.counter] + 1 < head.length:
                registers[head.counter] += 1
                step = start
                opened.append(start)
        step += 1


@settings(max_examples=100)
@given(codes())
def test_every_read_sees_the_write_that_it_saw_before(code: ir.Code) -> None:
    for changed in (shared(code), interleaved(code), shared(interleave(code))):
        assert memory(changed) <= memory(code)
        seen = zip(run(code), run(changed), strict=True)
        assert all(before == after for before, after in seen if before[1] is not None)
