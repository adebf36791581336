"""The instruction IR: a kernel as a list of instructions, one step above C.

`lower.py` makes instructions of a schedule, passes rewrite them, and `c_printer.py` prints them: nothing reads text.

An **operand** is one of

| operand | example in C |
|---|---|
| `str`: a register, or the counter of a loop | `v12`, `r3` |
| a numpy scalar or an `int`: a constant | `SPLAT(0.5f)`, `7` |
| `Element`: an element of a local array | `v4[2*(r3)+1]` |
| `Gather`: as `Element`, at an index that differs between lanes | `GATHER_ARRAY(F,v4,WITHIN(v12,8))` |
| `Call`: an operation on operands | `v12*v13` |

Kinds are those of the graph: "f", "i", "u", "b". A register of the kind "int" is a plain C int, the same for all lanes.
Control flow is structured: `If` ... `Else` ... `End`, `For` ... `End` and `While` ... `Break` ... `End`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Union

import numpy as np

from surgical_marl.engines.fused.graph import LEAST_ROW

Operand = Union[str, int, np.generic, "Element", "Gather", "Call"]


class Element(NamedTuple):
    """Element `base + offset + stride * k` of a local array. `k` is the round of the `Repeat` around it.

    If `width` arrays are interleaved in one, the element is that of number `lane` among them.
    """

    array: str
    base: Operand | None = None
    """None if the index is known."""
    offset: int = 0
    stride: int = 0
    width: int = 1
    lane: int = 0


class Gather(NamedTuple):
    """Element `place`, clipped to 0 ... `last`, of an array of vectors: each lane has its own place."""

    array: str
    kind: str
    place: Operand
    last: int


class Call(NamedTuple):
    """An operation of the graph, or "load", "fields", "table", "row", "splat", "all": see `c_printer.py`."""

    op: str
    kind: str
    args: tuple[Operand, ...]


class Declare(NamedTuple):
    """Declare a local array."""

    name: str
    kind: str
    size: int
    aligned: bool = False


class Define(NamedTuple):
    """Declare a register, with its value if it has one yet."""

    name: str
    kind: str
    value: Operand | None = None


class Assign(NamedTuple):
    """Change a register or an element of an array; lanes for which `keep` holds keep theirs."""

    target: str | Element
    value: Operand
    keep: Operand | None = None


class Scatter(NamedTuple):
    """Store a vector, each lane at its own index."""

    target: Gather
    value: Operand


class Store(NamedTuple):
    """Store to a field of a buffer of the environments: `field + stride * k` in a `Repeat`."""

    buffer: str
    field: int
    kind: str
    value: Operand
    stride: int = 0


class Size(NamedTuple):
    """Operations in a side of a branch or a body of a loop: outside of nested blocks, and in all."""

    own: int
    total: int


class If(NamedTuple):
    """Begin the side of a branch for `condition`. Lanes of a vector go through both sides if they differ."""

    condition: Operand
    number: int
    sizes: tuple[Size, Size]
    """Of this side and of the other one."""
    inputs: tuple[tuple[str, str], ...]
    """Names and kinds of the registers from outside that its sides read."""


class Else(NamedTuple):
    """End the first side of a branch and begin the other one."""

    condition: Operand
    """That of the `If`."""


class For(NamedTuple):
    """Begin a loop of `length` rounds; `counter` goes up from 0, or down to 0."""

    counter: str
    length: int
    backwards: bool


class While(NamedTuple):
    """Begin a loop that ends with a `Break`."""

    mask: str | None
    """The register that says which lanes of a vector are still in the loop."""
    size: Size


class Break(NamedTuple):
    """Leave the loop unless `condition` holds for some lane."""

    condition: Operand


class End(NamedTuple):
    """End a branch or a loop."""


class Hide(NamedTuple):
    """Copy a register into a new one, of which the C compiler can't know that it is equal."""

    name: str
    kind: str
    value: str


class Work(NamedTuple):
    """Add `size` to what there was to do, in the lanes that are `active`."""

    size: int
    active: Operand


class Path(NamedTuple):
    """Note that the lanes that are `active` took this path, one of `PATHS`."""

    number: int
    active: Operand


class CheckFinite(NamedTuple):
    """Note if a value is NaN or infinite."""

    value: Operand


class Repeat(NamedTuple):
    """Do an instruction for k = 0 ... rounds - 1."""

    rounds: int
    one: Assign | Store | CheckFinite


class ReportFinite(NamedTuple):
    """Set a field of `flags` if some value was not finite."""

    field: int


class ReportWork(NamedTuple):
    """Store what `Work` and `Path` have noted."""


class Barrier(NamedTuple):
    """Wait for the other threads of a block, or of all blocks of the grid."""

    grid: bool = False


class Fence(NamedTuple):
    """Keep the C compiler from moving loads and stores past this place."""


Instruction = (
    Declare | Define | Assign | Repeat | Scatter | Store | If | Else | For | While | Break | End | Hide | Work | Path
    | CheckFinite | ReportFinite | ReportWork | Barrier | Fence
)  # fmt: skip
Code = list[Instruction]
Rename = Callable[[Any], Any]

OPENS = (If, For, While)
"""Instructions that begin a block which an `End` ends."""
CONTROL = (*OPENS, Else, Break, End, Repeat)
"""Instructions between which code is not a straight line."""
_OPERANDS = {
    Define: ("value",), Assign: ("target", "value", "keep"), Scatter: ("target", "value"), Store: ("value",),
    If: ("condition",), Else: ("condition",), Break: ("condition",), Hide: ("value",), Work: ("active",),
    Path: ("active",), CheckFinite: ("value",),
}  # fmt: skip
"""Fields that are operands, in the order in which C names them."""


def operands(one: Instruction) -> Iterator[Operand]:
    """Yield the operands of an instruction, the target of an assignment first, and not those within others."""
    if isinstance(one, Repeat):
        one = one.one
    for field in _OPERANDS.get(type(one), ()):
        value = getattr(one, field)
        if value is not None:
            yield value


def parts(operand: Operand) -> Iterator[Operand]:
    """Yield an operand and all operands within it, as C names them from left to right."""
    yield operand
    if isinstance(operand, Call):
        for arg in operand.args:
            yield from parts(arg)
    elif isinstance(operand, Element) and operand.base is not None:
        yield from parts(operand.base)
    elif isinstance(operand, Gather):
        yield from parts(operand.place)


def rewritten(one: Any, change: Rename) -> Any:
    """Return an instruction with `change` applied to all operands in it, inner ones first."""
    if isinstance(one, Repeat):
        return Repeat(one.rounds, rewritten(one.one, change))
    new = {}
    for field in _OPERANDS.get(type(one), ()):
        value = getattr(one, field)
        if value is not None and (changed := _rewritten(value, change)) is not value:
            new[field] = changed
    return one._replace(**new) if new else one


def _rewritten(operand: Operand, change: Rename) -> Operand:
    if isinstance(operand, Call):
        args = tuple(_rewritten(arg, change) for arg in operand.args)
        if any(a is not b for a, b in zip(args, operand.args, strict=True)):
            operand = operand._replace(args=args)
    elif isinstance(operand, Element) and operand.base is not None:
        base = _rewritten(operand.base, change)
        operand = operand if base is operand.base else operand._replace(base=base)
    elif isinstance(operand, Gather):
        place = _rewritten(operand.place, change)
        operand = operand if place is operand.place else operand._replace(place=place)
    found: Operand = change(operand)
    return found


def arrays_at_unknown_places(code: Code) -> set[str]:
    """Return the names of arrays of which some element is at an index that is not known.

    A C compiler keeps the elements of all other arrays in registers.
    """
    return {
        part.array
        for one in code
        for operand in operands(one)
        for part in parts(operand)
        if isinstance(part, Gather) or (isinstance(part, Element) and part.base is not None)
    }


def arrays_in_memory(code: Code) -> set[str]:
    """Return the names of arrays at unknown places, and of those that a loop of `LEAST_ROW` rounds copies."""
    repeated = (one for one in code if isinstance(one, Repeat) and one.rounds >= LEAST_ROW)
    elements = (part for one in repeated for operand in operands(one) for part in parts(operand))
    rows = {part.array for part in elements if isinstance(part, Element) and part.stride}
    return arrays_at_unknown_places(code) | rows


def large_branches(code: Code) -> int:
    """Return in how many places environments differ in how much they have to do."""
    return sum(isinstance(one, Work) for one in code)
