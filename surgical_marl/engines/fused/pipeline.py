"""The passes of the compiler, in their order. `options.py` says how to leave some out, check and dump the IR."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from surgical_marl.engines.fused import hints, options, schedule
from surgical_marl.engines.fused.c_printer import CPrinter
from surgical_marl.engines.fused.dump import schedule_text
from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.instructions import Code, ReportWork, large_branches
from surgical_marl.engines.fused.instrumentation import Watch, check_finite, count_work
from surgical_marl.engines.fused.lower import Stores, lower
from surgical_marl.engines.fused.macros import is_long
from surgical_marl.engines.fused.memory_order import load_early, store_early, store_late
from surgical_marl.engines.fused.options import read_options
from surgical_marl.engines.fused.stack_allocation import share_memory
from surgical_marl.engines.fused.stores import roll_stores, store_in_branches
from surgical_marl.engines.fused.vector_layout import interleave
from surgical_marl.engines.fused.verify import check_code, check_graph, check_schedule
from surgical_marl.files import write_text


@dataclass
class Program:
    """A function on its way through the compiler: a graph, then a schedule of it, then code."""

    graph: Graph
    stores: Stores
    """Buffer, field and value of each result. Buffers are names of parameters."""
    vector: bool
    """True for a CPU, with vectors of environments, False for CUDA."""
    watch: Watch | None = None
    """The results that must be finite; None for no check."""
    scheduler: schedule.Scheduler = field(init=False)
    schedule: schedule.Schedule = field(init=False)
    code: Code = field(default_factory=list)

    @property
    def results(self) -> list[Value]:
        return [value for _, _, value in self.stores]


class Pass(NamedTuple):
    """A step of the compiler. What it does is said, with an example, by the function that it calls."""

    name: str
    run: Callable[[Program], None]
    on: str
    """The IR that it leaves: "scheduler" (values without order), "schedule" or "code"."""
    target: str = ""
    """ "cpu" or "cuda" if it is for one of them only."""
    required: bool = False
    """True if programs would be wrong without it: it has no switch then."""


def _dead_code(program: Program) -> None:
    program.scheduler = schedule.Scheduler(program.graph, program.results)


def _order(program: Program) -> None:
    program.scheduler.order()
    program.schedule = program.scheduler.schedule()


def _store_late(program: Program) -> None:
    store_late(program.graph, program.schedule, program.stores)


def _lower(program: Program) -> None:
    program.code = lower(program.graph, program.schedule, program.stores, program.vector)


def _check_finite(program: Program) -> None:
    program.code = check_finite(program.code, program.watch) if program.watch else program.code


def _interleave(program: Program) -> None:
    # short code keeps few numbers in arrays, and fewer others in registers if it moves several at a time
    if is_long(large_branches(program.code)):
        program.code = interleave(program.code)


def _store_in_branches(program: Program) -> None:
    # short code keeps its results in registers, and is faster if it stores all of them at its end
    if is_long(large_branches(program.code)):
        program.code = store_in_branches(program.code)


def _code(function: Callable[[Code], Code]) -> Callable[[Program], None]:
    def run(program: Program) -> None:
        program.code = function(program.code)

    return run


PASSES = (
    Pass("dead_code", _dead_code, "scheduler", required=True),
    Pass("invariants", lambda program: program.scheduler.find_invariants(), "scheduler"),
    Pass("place", lambda program: program.scheduler.place(), "scheduler", required=True),
    Pass("in_place", lambda program: program.scheduler.find_in_place(), "scheduler"),
    Pass("pressure", lambda program: program.scheduler.find_pressure(), "scheduler"),
    Pass("order", _order, "schedule", required=True),
    Pass("store_early", lambda program: store_early(program.scheduler), "schedule"),
    Pass("load_early", lambda program: load_early(program.graph, program.schedule), "schedule"),
    Pass("store_late", _store_late, "schedule", required=True),
    Pass("lower", _lower, "code", required=True),
    Pass("store_in_branches", _store_in_branches, "code", "cuda"),
    Pass("roll_stores", _code(roll_stores), "code"),
    Pass("check_finite", _check_finite, "code", required=True),
    Pass("count_work", _code(count_work), "code"),
    Pass("hide_inputs", _code(hints.hide_inputs), "code", "cuda"),
    Pass("barriers", _code(hints.add_barriers), "code", "cuda"),
    Pass("interleave", _interleave, "code", "cuda"),
    Pass("share_memory", _code(share_memory), "code"),
    Pass("fences", _code(hints.add_fences), "code", "cpu"),
)
CSE = "cse"
"""Common subexpressions are found while the graph is built (`Graph.node`), so this switch is the graph's."""


def switched_off() -> frozenset[str]:
    """Return the passes that are left out.

    Raises:
        ValueError: there is no such pass, or it can't be left out.
    """
    names = [CSE, *(one.name for one in PASSES if not one.required)]
    found = set[str]()
    for word in read_options().switches:
        if word[0] != "-" or word[1:] not in names:
            good = ", ".join(f"-{name}" for name in names)
            raise ValueError(f"{options.PASSES} has {word!r}; what it can have is {good}")
        found.add(word[1:])
    return frozenset(found)


class Compiled(NamedTuple):
    """The C of a kernel."""

    text: str
    large_branches: int
    """In how many places environments differ in how much they have to do."""


def compile_program(program: Program, name: str = "kernel") -> Compiled:
    """Run all passes that are on, and print the code. `name` is that of the dump's folder."""
    off, target = switched_off(), "cpu" if program.vector else "cuda"
    _, verify, folder = read_options()
    if verify:
        check_graph(program.graph)
    run = [one for one in PASSES if one.name not in off and one.target in ("", target)]
    for number, one in enumerate(run):
        one.run(program)
        if verify:
            _check(program, one)
        if folder:
            own = folder / re.sub(r"[^\w.-]+", "_", f"{name}.{target}")
            own.mkdir(parents=True, exist_ok=True)
            write_text(own / f"{number:02}-{one.name}.txt", _dumped(program, one))
    return Compiled(CPrinter(program.vector).text(program.code), large_branches(program.code))


def without_report(program: Program) -> str:
    """Return the C of a compiled program that does not note how much an environment had to do.

    A step of several kernels has one that notes it for all.
    """
    return CPrinter(program.vector).text([one for one in program.code if not isinstance(one, ReportWork)])


def _check(program: Program, one: Pass) -> None:
    if one.on == "schedule":
        check_schedule(program.graph, program.schedule, program.results)
    elif one.on == "code":
        check_code(program.code)


def _dumped(program: Program, one: Pass) -> str:
    """Return the IR as text."""
    if one.on == "code":
        return CPrinter(program.vector).text(program.code) + "\n"
    return schedule_text(program.scheduler, program.stores) + "\n"
