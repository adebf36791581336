"""Splits a step where it calls stages, into parts that an engine runs one after the other.

    step(x):                            run            run x                     a thread an environment
      y = a(x)                          call membrane  reads y, writes z         a block of threads an environment
      z = membrane(y)              ->   run            from x and z
      return b(x, z)

A loop (`lax.scan`) with a stage in it becomes a loop of parts. A part computes as little as the stage after it needs;
all else comes later. What one part computes and another reads is stored between them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.extend import core

from surgical_marl.engines.stages import Call, called

CALLS = {
    "jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr", "remat": "jaxpr",
    "remat2": "jaxpr", "checkpoint": "jaxpr", "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr",
    "custom_vjp_call_jaxpr": "fun_jaxpr", "custom_vmap_call": "call",
}  # fmt: skip
"""Primitives that call a function, and the parameter that holds it."""

Where = Callable[[Call], bool]
"""Function that says of a stage if a step is split there."""


@dataclass
class Run:
    """A part that runs a thread an environment."""

    equations: list[Any]
    assigns: list[tuple[Any, Any]]
    """Variables that loops carry, or numbers of the step's results, and the values that they get."""
    reads: tuple[Any, ...] = ()
    """Variables of other parts, and of the step's arguments."""
    writes: tuple[Any, ...] = ()
    """Variables, and numbers of the step's results."""
    jaxpr: Any = None
    """From what it reads to what it writes, a closed jaxpr."""


@dataclass
class Stage:
    """A part that calls a stage."""

    call: Call
    reads: tuple[Any, ...]
    """Variables, and numpy arrays where inputs are the same in all environments."""
    writes: tuple[Any, ...]


@dataclass
class Loop:
    """Parts that run `length` times."""

    length: int
    parts: list[Part]


Part = Run | Stage | Loop


class Unsplittable(ValueError):
    """A stage is called where a step can't be split."""


def split(step: core.ClosedJaxpr, where: Where) -> tuple[list[Any], list[Part]]:
    """Return the variables of a step's arguments, and its parts: one, if it calls no stage at which it is split.

    Raises:
        Unsplittable: a stage is called in a branch, in a `while` loop, or in a scan that reads or writes rows.
    """
    return _Splitter(step, where).split()


def scan_inputs(params: Any, inputs: Sequence[Any]) -> tuple[list[Any], list[Any], list[Any]]:
    """Return the inputs of a scan, from its parameters: constants, what it carries, and arrays of rows."""
    if "ft_in" in params:  # from JAX 0.11 on
        constants, carried, rows = map(list, params["ft_in"].update(inputs).unpack())
        return constants, carried, rows
    fixed, end = params["num_consts"], params["num_consts"] + params["num_carry"]
    return list(inputs[:fixed]), list(inputs[fixed:end]), list(inputs[end:])


def walk(parts: Sequence[Part]) -> Iterator[Run | Stage]:
    """Yield all parts but loops."""
    for part in parts:
        if isinstance(part, Loop):
            yield from walk(part.parts)
        else:
            yield part


class _Splitter:
    def __init__(self, step: core.ClosedJaxpr, where: Where) -> None:
        self._step, self._where = step, where
        self._constants: dict[Any, Any] = {}
        self._fixed: dict[Any, tuple[int, Any]] = {}
        """Equations of constants alone by the variables that they define. Each part computes them itself."""

    def split(self) -> tuple[list[Any], list[Part]]:
        arguments = [core.Var(one.aval) for one in self._step.jaxpr.invars]
        equations, results = self._inline(self._step.jaxpr, self._step.consts, arguments)
        parts = self._parts(equations, list(enumerate(results)))
        self._connect(list(walk(parts)))
        return arguments, parts

    # -- which equations are in which part

    def _holds(self, equation: Any) -> bool:
        """Return whether a stage is called in an equation at which the step is split."""
        return any(map(self._where, _calls(equation)))

    def _inline(self, jaxpr: Any, constants: Sequence[Any], arguments: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        """Return the equations of a jaxpr in terms of other variables, without calls that hold stages, and its results.

        Equations of constants alone go to `_fixed`.
        """
        known = dict(zip(jaxpr.invars, arguments, strict=True))
        for variable, value in zip(jaxpr.constvars, constants, strict=True):
            known[variable] = core.Var(variable.aval)
            self._constants[known[variable]] = value
        equations: list[Any] = []

        def read(one: Any) -> Any:
            return one if isinstance(one, core.Literal) else known[one]

        for equation in jaxpr.eqns:
            given, name = [read(one) for one in equation.invars], equation.primitive.name
            if name in CALLS and self._holds(equation):
                inner = equation.params[CALLS[name]]
                found, results = self._inline(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), given)
                equations += found
                known.update(zip(equation.outvars, results, strict=True))
                continue
            own = [core.Var(one.aval) for one in equation.outvars]
            known.update(zip(equation.outvars, own, strict=True))
            renamed = equation.replace(invars=given, outvars=own)
            if all(self._is_constant(one) for one in given) and not self._holds(equation):
                self._fixed |= dict.fromkeys(own, (len(self._fixed), renamed))
            else:
                equations.append(renamed)
        return equations, [read(one) for one in jaxpr.outvars]

    def _is_constant(self, atom: Any) -> bool:
        return isinstance(atom, core.Literal) or atom in self._constants or atom in self._fixed

    def _parts(self, equations: list[Any], assigns: list[tuple[Any, Any]]) -> list[Part]:
        """Return the parts of equations, the last of which makes the assignments."""
        parts: list[Part] = []
        while (number := next((k for k, one in enumerate(equations) if self._holds(one)), None)) is not None:
            equation, before = equations[number], equations[:number]
            needed = _slice(before, equation.invars)
            first = [one for k, one in enumerate(before) if k in needed]
            # a random key is no number that could be stored: each part makes its own
            rest = [one for k, one in enumerate(before) if k not in needed or _makes_key(one)]
            equations = rest + equations[number + 1 :]
            call = called(equation)
            if call is not None:
                reads, fixed = self._readable(call, equation.invars)
                parts += [Run(first, fixed)] * bool(first or fixed)
                parts.append(Stage(call, reads, tuple(equation.outvars)))
            else:
                starts, loop = self._loop(equation)
                parts += [Run(first, starts), loop]
        last = _slice(equations, [value for _, value in assigns])
        return [*parts, Run([one for k, one in enumerate(equations) if k in last], assigns)]

    def _readable(self, call: Call, inputs: Sequence[Any]) -> tuple[tuple[Any, ...], list[tuple[Any, Any]]]:
        """Return what a stage reads, and variables that are made of constants: the host reads nothing else."""
        if call.cuda is not None:
            return tuple(self._value(one) if self._is_constant(one) else one for one in inputs), []
        made = {k: core.Var(one.aval) for k, one in enumerate(inputs) if self._is_constant(one)}
        reads = tuple(made.get(k, one) for k, one in enumerate(inputs))
        return reads, [(variable, inputs[k]) for k, variable in made.items()]

    def _loop(self, scan: Any) -> tuple[list[tuple[Any, Any]], Loop]:
        """Return how what a scan carries starts, and the scan as a loop. Its results are what it carries."""
        params, carried, name = scan.params, scan.outvars, scan.primitive.name
        constants, starts, rows = scan_inputs(params, scan.invars) if name == "scan" else ([], [], [scan])
        if rows or len(starts) != len(carried):
            stage = next(call.name for call in _calls(scan) if self._where(call))
            place = "a scan over rows" if name == "scan" else f"`{name}`"
            raise Unsplittable(f"stage {stage!r} inside of {place}; it can be in a step, or in a scan without rows")
        inner = params["jaxpr"]
        equations, nexts = self._inline(inner.jaxpr, inner.consts, [*constants, *carried])
        changed = [(own, value) for own, value in zip(carried, nexts, strict=True) if value is not own]
        return list(zip(carried, starts, strict=True)), Loop(params["length"], self._parts(equations, changed))

    # -- what parts read of each other

    def _connect(self, parts: list[Run | Stage]) -> None:
        """Find out what each part reads and writes."""
        needs: list[list[Any]] = []
        for part in parts:
            if isinstance(part, Stage):
                needs.append([one for one in part.reads if isinstance(one, core.Var)])
                continue
            used = _variables(part.equations, [value for _, value in part.assigns])
            part.equations = [*self._own(used), *part.equations]
            defined = {one for equation in part.equations for one in equation.outvars}
            part.reads = tuple(
                one for one in _variables(part.equations, [value for _, value in part.assigns])
                if one not in defined and one not in self._constants
            )  # fmt: skip
            needs.append(list(part.reads))
        wanted = {one for own in needs for one in own}
        for part in parts:
            if isinstance(part, Run):
                made = [one for equation in part.equations for one in equation.outvars]
                kept = [one for one in made if one in wanted and one not in self._fixed]
                wanted.difference_update(kept)
                part.writes = (*kept, *(target for target, _ in part.assigns))
                part.jaxpr = self._closed(part.equations, part.reads, [*kept, *(value for _, value in part.assigns)])

    def _own(self, used: list[Any]) -> list[Any]:
        """Return the equations of constants that a part needs, in their order."""
        found: dict[int, Any] = {}
        open_ = [one for one in used if one in self._fixed]
        while open_:
            number, equation = self._fixed[open_.pop()]
            if number not in found:
                found[number] = equation
                open_ += [one for one in _variables([equation], []) if one in self._fixed]
        return [found[number] for number in sorted(found)]

    def _closed(self, equations: list[Any], reads: Sequence[Any], results: list[Any]) -> core.ClosedJaxpr:
        step = self._step.jaxpr
        constants = [one for one in _variables(equations, results) if one in self._constants]
        jaxpr = step.replace(
            constvars=constants, invars=list(reads), outvars=results, eqns=equations,
            debug_info=step.debug_info.with_unknown_names(),
        )  # fmt: skip
        return core.ClosedJaxpr(jaxpr, [self._constants[one] for one in constants])

    def _value(self, atom: Any) -> np.ndarray:
        """Return the value of a constant."""
        if isinstance(atom, core.Literal):
            aval: Any = atom.aval
            return np.asarray(atom.val, aval.dtype)
        if atom in self._constants:
            return np.asarray(self._constants[atom])
        return np.asarray(core.jaxpr_as_fun(self._closed(self._own([atom]), (), [atom]))()[0])


def _slice(equations: list[Any], results: Sequence[Any]) -> set[int]:
    """Return the numbers of the equations that results need."""
    needed, found = {one for one in results if isinstance(one, core.Var)}, set[int]()
    for number in reversed(range(len(equations))):
        if not needed.isdisjoint(equations[number].outvars):
            found.add(number)
            needed.update(_variables([equations[number]], []))
    return found


def _variables(equations: list[Any], results: Sequence[Any]) -> list[Any]:
    """Return the variables that equations and results use, each once."""
    atoms = [*(one for equation in equations for one in equation.invars), *results]
    return list(dict.fromkeys(one for one in atoms if isinstance(one, core.Var)))


def _makes_key(equation: Any) -> bool:
    return any(jax.numpy.issubdtype(one.aval.dtype, jax.dtypes.prng_key) for one in equation.outvars)


def _calls(equation: Any) -> Iterator[Call]:
    """Yield the calls of stages in an equation."""
    call = called(equation)
    if call is not None:
        yield call
    else:
        for inner in core.jaxprs_in_params(equation.params):
            for one in inner.eqns:
                yield from _calls(one)
