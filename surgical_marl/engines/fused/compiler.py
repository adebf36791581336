"""Compiles an environment's functions to kernels in C: traces them, lays out their arrays and runs all passes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend import core

from surgical_marl.engines.compilation import Phase
from surgical_marl.engines.faults import checked
from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.indexing import LEAST_TABLE, elements_of
from surgical_marl.engines.fused.instrumentation import Watch
from surgical_marl.engines.fused.jaxpr_interpreter import JaxprInterpreter
from surgical_marl.engines.fused.kernel_layout import BUFFERS, Leaf, Source, Stage
from surgical_marl.engines.fused.lower import table_offsets
from surgical_marl.engines.fused.operations import KINDS
from surgical_marl.engines.fused.pipeline import CSE, Compiled, Program, compile_program, switched_off, without_report
from surgical_marl.engines.fused.stage_code import StageCode, load
from surgical_marl.engines.fused.symbolic_array import AnyArray, Table, Unsupported, values_of
from surgical_marl.engines.split import Unsplittable, split
from surgical_marl.engines.stepper import Stepper

RESULTS = {"f": "outs", "i": "counts", "u": "counts", "b": "flags"}
"""Buffers of results by their kind, of results that are not part of the state."""


class Fields:
    """Allocates fields of the buffers. `sizes` are how many each array has by now."""

    def __init__(self) -> None:
        self.sizes = dict.fromkeys(BUFFERS, 0)

    def place(self, tree: Any, reals: str) -> Any:
        """Return a tree of `Leaf`s for a tree of arrays or their shapes; float32 goes to the array `reals`."""
        return jax.tree.map(lambda x: self.leaf(x.shape, np.dtype(x.dtype).name, reals), tree)

    def actions(self, shapes: dict[str, Any]) -> dict[str, Leaf]:
        """Return a `Leaf` for each shape, in their order, in the array "actions"."""
        return {name: self.leaf(x.shape, "float32", "actions") for name, x in shapes.items()}

    def leaf(self, shape: tuple[int, ...], dtype: str, reals: str) -> Leaf:
        buffer = reals if dtype == "float32" else RESULTS[KINDS[dtype]]
        leaf = Leaf(buffer, self.sizes[buffer], tuple(shape), dtype)
        self.sizes[buffer] += leaf.size
        return leaf


class Function(NamedTuple):
    """A function as JAX traced it."""

    jaxpr: core.ClosedJaxpr
    arguments: tuple[Any, ...]
    """Trees of shapes."""
    result: Any
    """A tree of shapes."""


def trace(function: Callable[..., Any], *arguments: Any) -> Function:
    """Trace a function of trees of arrays or their shapes."""
    jaxpr, result = jax.make_jaxpr(function, return_shape=True)(*arguments)
    return Function(jaxpr, arguments, result)


def trace_environment(env: Stepper, phase: Phase) -> dict[str, Function]:
    """Trace an environment's functions: "reset" and "step"."""
    parameters = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), env.parameters)
    key, number = jax.ShapeDtypeStruct((2,), np.uint32), jax.ShapeDtypeStruct((), np.int32)
    phase("tracing the reset")
    reset = trace(env.reset, key, number, parameters)
    actions = {agent: jax.ShapeDtypeStruct((env.num_actions(agent),), np.float32) for agent in env.agents}
    phase("tracing the step")
    return {"reset": reset, "step": trace(env.step, reset.result.carry, actions, parameters)}


def make_source(functions: dict[str, Function], parameters: Any, vector: bool, phase: Phase, title: str = "") -> Source:
    """Return the source of an environment's kernels.

    Args:
        functions: what `trace_environment` returned.
        parameters: the environment's, a tree of numpy arrays.
        vector: whether the kernels are for a CPU, with vectors.
        phase: is told the phases in which the source is made.
        title: of the environment, for the names of dumps.

    Raises:
        Unsupported: for something that has no kernel code, with the line of the source that uses it.
    """
    fields, graph = Fields(), Graph(cse=CSE not in switched_off())
    given, places = _parameters(graph, parameters)
    carry = fields.place(functions["reset"].result.carry, "state")
    actions = fields.actions(functions["step"].arguments[1])
    phase("interpreting the step")
    kernels, stages, last = _step(graph, fields, functions["step"], (carry, actions), (given, places), vector)
    found = functions["step"].result
    phase("interpreting the reset")
    first = interpret(graph, functions["reset"], (carry.key, carry.episode), given)
    known = len(jax.tree.leaves(carry))
    leaves = [
        *jax.tree.leaves(carry),
        *_share_fields(fields, jax.tree.leaves(found)[known:], last[known:], first[known:]),
    ]
    results = _nest([path for path, _ in jax.tree_util.tree_flatten_with_path(found)[0]], leaves)
    fault = fields.leaf((), "bool", "flags")
    watched = [*jax.tree.leaves(carry), *(leaf for _, leaf in checked(results))]
    reals = [leaf for leaf in watched if leaf.dtype == "float32"]
    watch = Watch(frozenset(place for leaf in reals for place in _places(leaf)), fault.first)
    kernels[stages[-1].name] += list(zip(leaves, last, strict=True))
    kernels["reset"] = list(zip(leaves, first, strict=True))
    programs, compiled = dict[str, Program](), dict[str, Compiled]()
    for name, stored in kernels.items():
        phase(f"scheduling the {name}")
        programs[name] = Program(graph, _stores(graph, stored), vector, watch)
        compiled[name] = compile_program(programs[name], f"{title}.{name}" if title else name)
    bodies = {name: one.text for name, one in compiled.items()}
    parts = [name for name in kernels if name != "reset"]
    parts.remove(max(parts, key=lambda name: compiled[name].large_branches))
    bodies |= {name: without_report(programs[name]) for name in parts}
    return Source(
        bodies=bodies,
        stages=stages,
        large_branches=sum(one.large_branches for one in compiled.values()),
        tables=tables(graph),
        sizes=fields.sizes,
        carry=results.pop("carry"),
        actions=actions,
        results=results,
        parameters=places,
        fault=fault,
    )


def _parameters(graph: Graph, parameters: Any) -> tuple[list[AnyArray | Table], dict[str, Leaf]]:
    """Return what stands for the parameters while tracing, and where each is in the joined tables.

    A parameter of fewer than `LEAST_TABLE` numbers becomes values. A larger one stays a table, whose elements are
    looked up where they are needed.
    """
    given: list[AnyArray | Table] = []
    places: dict[str, Leaf] = {}
    for path, value in jax.tree_util.tree_flatten_with_path(parameters)[0]:
        value = np.asarray(value)
        buffer = "float32" if value.dtype.kind == "f" else "int32"
        number = graph.input_table(np.zeros(value.size, buffer))
        places[jax.tree_util.keystr(path)] = Leaf(buffer, table_offsets(graph)[number], value.shape, value.dtype.name)
        table = Table(number, value.shape, value.dtype)
        given.append(elements_of(graph, table) if value.size < LEAST_TABLE else table)
    return given, places


Stored = list[tuple[Leaf, list[Value]]]
"""The leaves that a kernel stores, and their values."""


def _step(
    graph: Graph, fields: Fields, step: Function, leaves: tuple[Any, Any],
    parameters: tuple[list[AnyArray | Table], dict[str, Leaf]], vector: bool,
) -> tuple[dict[str, Stored], list[Stage], list[list[Value]]]:  # fmt: skip
    """Return what the kernels of a step store between its stages, the stages, and the values of its results.

    A CPU runs no blocks: their reference is a part of its kernel.
    """
    given, places = parameters
    try:
        variables, parts = split(step.jaxpr, lambda call: call.cuda is None or not vector)
    except Unsplittable as error:
        raise Unsupported(str(error)) from None
    if len(parts) == 1:
        return {"step": []}, [Stage("thread", "step")], interpret(graph, step, leaves, given)
    known = [*jax.tree.leaves(leaves), *places.values()]
    tables = dict(zip(variables[len(known) - len(given) :], given, strict=True))
    code = StageCode(graph, fields.leaf, dict(zip(variables, known, strict=True)), tables)
    stages = code.stages(parts)
    return code.kernels, stages, [code.results[number] for number in range(len(code.results))]


def interpret(
    graph: Graph, function: Function, arguments: tuple[Any, ...], given: Sequence[AnyArray | Table] = ()
) -> list[list[Value]]:
    """Run a traced function on trees of `Leaf`s.

    Args:
        graph: where the values go.
        function: takes them.
        arguments: trees of leaves.
        given: what stands for the leaves of the function's last argument.

    Returns:
        The values of each leaf of the function's result.

    Raises:
        Unsupported: for something that has no kernel code, with the line of the source that uses it.
    """
    inputs = [load(graph, leaf) for leaf in jax.tree.leaves(arguments)]
    outputs = JaxprInterpreter(graph).run(function.jaxpr, [*inputs, *given])
    return [values_of(graph, x).ravel().tolist() for x in outputs]


def tables(graph: Graph) -> dict[str, np.ndarray]:
    """Return the constant tables of a graph, joined by dtype."""
    return {
        dtype: np.concatenate([t.ravel() for t in graph.tables if t.dtype == dtype] or [np.zeros(1, dtype)])
        for dtype in ("float32", "int32")
    }


def _stores(graph: Graph, stored: Stored) -> list[tuple[str, int, Value]]:
    """Return the stores of each leaf's values in its fields. A value that was loaded from there needs none."""
    stores: dict[tuple[str, int], Value] = {}
    for leaf, elements in stored:
        for place, value in zip(_places(leaf), elements, strict=True):
            if value < 0 or graph.ops[value] != "load" or graph.args[value] != place:
                stores[place] = value
    return [(*place, value) for place, value in stores.items()]


def _places(leaf: Leaf) -> list[tuple[str, int]]:
    """Return buffer and field of each element of a leaf."""
    return [(leaf.buffer, leaf.first + k) for k in range(leaf.size)]


def _share_fields(layout: Fields, shapes: list[Any], values: list[list[Value]], first: list[list[Value]]) -> list[Leaf]:
    """Return a leaf for each result.

    If the values of a result stand in a row in another result, in both kernels, the two share fields. For example, a
    state holds the observations of all agents.
    """
    leaves: dict[int, Leaf] = {}
    for k in sorted(range(len(shapes)), key=lambda k: -len(values[k])):
        size, dtype = len(values[k]), shapes[k].dtype.name
        for other, leaf in leaves.items():
            starts = [a for a, value in enumerate(values[other]) if size and value == values[k][0]]
            same = [
                a for a in starts if values[other][a : a + size] == values[k] and first[other][a : a + size] == first[k]
            ]
            if same:
                leaves[k] = Leaf(leaf.buffer, leaf.first + same[0], tuple(shapes[k].shape), dtype)
                break
        else:
            leaves[k] = layout.leaf(tuple(shapes[k].shape), dtype, "outs")
    return [leaves[k] for k in range(len(shapes))]


def _nest(paths: list[Any], leaves: list[Leaf]) -> dict[str, Any]:
    """Return a dict of dicts of leaves, arranged by their paths in a tree."""
    tree: dict[str, Any] = {}
    for path, leaf in zip(paths, leaves, strict=True):
        *outer, last = [str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", "")))) for key in path]
        node = tree
        for name in outer:
            node = node.setdefault(name, {})
        node[last] = leaf
    return tree
