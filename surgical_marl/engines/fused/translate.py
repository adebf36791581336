"""Translates an environment's functions to kernels in C: traces them, lays out their arrays and writes the code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from surgical_marl.engines.faults import checked
from surgical_marl.engines.fused.emit import Emitter, Watch, table_offsets
from surgical_marl.engines.fused.graph import Graph, Value
from surgical_marl.engines.fused.indexing import LEAST_TABLE, elements_of
from surgical_marl.engines.fused.operations import KINDS
from surgical_marl.engines.fused.program import Leaf, Source
from surgical_marl.engines.fused.trace import Tracer
from surgical_marl.engines.fused.traced import Table, Traced, lift, lower
from surgical_marl.engines.stages import Stage
from surgical_marl.engines.stepper import Stepper

BUFFERS = {"f": "outs", "i": "counts", "u": "counts", "b": "flags"}
"""Where results of each kind go unless they belong to the state."""


class Fields:
    """Gives out fields. `sizes` are how many each array has by now."""

    def __init__(self) -> None:
        self.sizes = {"state": 0, "counts": 0, "actions": 0, "outs": 0, "flags": 0}

    def place(self, tree: Any, reals: str) -> Any:
        """Return a tree of `Leaf`s for a tree of arrays or their shapes; float32 goes to the array `reals`."""
        return jax.tree.map(lambda x: self.leaf(x.shape, np.dtype(x.dtype).name, reals), tree)

    def leaf(self, shape: tuple[int, ...], dtype: str, reals: str) -> Leaf:
        buffer = reals if dtype == "float32" else BUFFERS[KINDS[dtype]]
        leaf = Leaf(buffer, self.sizes[buffer], tuple(shape), dtype)
        self.sizes[buffer] += leaf.size
        return leaf


def make_source(env: Stepper, vector: bool, stage: Stage) -> Source:
    """Traces an environment's functions."""
    stage("tracing the step")
    fields, graph = Fields(), Graph()
    key, number = jax.ShapeDtypeStruct((2,), np.uint32), jax.ShapeDtypeStruct((), np.int32)
    given, places = _parameters(graph, env.parameters)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), env.parameters)
    carry = fields.place(jax.eval_shape(env.reset, key, number, shapes).carry, "state")
    actions = {agent: fields.leaf((env.num_actions(agent),), "float32", "actions") for agent in env.agents}
    moved: Any = {}
    sensed = {name: fields.leaf((), "float32", "actions") for name in env.senses}
    kernels: dict[str, list[list[Value]]] = {}
    if env.pauses:
        kernels["move"], between = trace(graph, env.move, (carry, actions), given, shapes)
        moved = fields.place(between, "state")
        last, found = trace(graph, env.finish, (moved, sensed), given, shapes)
        kernels["finish"] = last
    else:
        last, found = trace(graph, env.step, (carry, actions), given, shapes)
        kernels["step"] = last
    stage("tracing the reset")
    first, _ = trace(graph, env.reset, (carry.key, carry.episode), given, shapes)
    known = len(jax.tree.leaves(carry))
    leaves = [
        *jax.tree.leaves(carry),
        *_share_fields(fields, jax.tree.leaves(found)[known:], last[known:], first[known:]),
    ]
    results = _nest([path for path, _ in jax.tree_util.tree_flatten_with_path(found)[0]], leaves)
    stored = {name: jax.tree.leaves(moved) if name == "move" else leaves for name in kernels}
    fault = fields.leaf((), "bool", "flags")
    watched = [*jax.tree.leaves(carry), *(leaf for _, leaf in checked(results))]
    reals = [leaf for leaf in watched if leaf.dtype == "float32"]
    watch = Watch(frozenset(place for leaf in reals for place in _places(leaf)), fault.first)
    bodies = {}
    for name, values in {**kernels, "reset": first}.items():
        stage(f"scheduling the {name}")
        bodies[name] = _body(graph, stored.get(name, leaves), values, vector, watch)
    return Source(
        bodies=bodies,
        tables=tables(graph),
        sizes=fields.sizes,
        carry=results.pop("carry"),
        actions=actions,
        results=results,
        parameters=places,
        moved=_tree(moved),
        sensed=sensed,
        fault=fault,
    )


def _parameters(graph: Graph, parameters: Any) -> tuple[list[Traced | Table], dict[str, Leaf]]:
    """Return what stands for the parameters while tracing, and where each is in the joined tables.

    A parameter of fewer than `LEAST_TABLE` numbers becomes values. A larger one stays a table, whose elements are
    looked up where they are needed.
    """
    given: list[Traced | Table] = []
    places: dict[str, Leaf] = {}
    for path, value in jax.tree_util.tree_flatten_with_path(parameters)[0]:
        value = np.asarray(value)
        buffer = "float32" if value.dtype.kind == "f" else "int32"
        number = graph.input_table(np.zeros(value.size, buffer))
        places[jax.tree_util.keystr(path)] = Leaf(buffer, table_offsets(graph)[number], value.shape, value.dtype.name)
        table = Table(number, value.shape, value.dtype)
        given.append(elements_of(graph, table) if value.size < LEAST_TABLE else table)
    return given, places


def _tree(tree: Any) -> dict[str, Any]:
    paths, leaves = zip(*jax.tree_util.tree_flatten_with_path(tree)[0], strict=True) if tree else ((), ())
    return _nest(list(paths), list(leaves))


def trace(
    graph: Graph,
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    given: Sequence[Traced | Table] = (),
    extra: Any = None,
) -> tuple[list[list[Value]], Any]:
    """Run a function on trees of `Leaf`s.

    Args:
        graph: where the values go.
        function: takes the arguments, and one more if there is `extra`.
        arguments: trees of leaves.
        given: what stands for the leaves of the last argument, the tree of shapes `extra`.

    Returns:
        The values of each leaf of the function's result, and the result's tree of shapes.

    Raises:
        Unsupported: for something that has no kernel code, with the line of the source that uses it.
    """
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), arguments)
    last = () if extra is None else (extra,)
    closed, results = jax.make_jaxpr(function, return_shape=True)(*shapes, *last)
    inputs: list[Traced] = []
    for leaf in jax.tree.leaves(arguments):
        kind = KINDS[leaf.dtype]
        ids = [graph.node("load", leaf.buffer, leaf.first + k, kind=kind) for k in range(leaf.size)]
        inputs.append(lower(graph, np.array(ids, np.int32).reshape(leaf.shape), np.dtype(leaf.dtype)))
    outputs = Tracer(graph).run(closed, [*inputs, *given])
    return [lift(graph, x).ravel().tolist() for x in outputs], results


def tables(graph: Graph) -> dict[str, np.ndarray]:
    """Return the constant tables of a graph, joined by dtype."""
    return {
        dtype: np.concatenate([t.ravel() for t in graph.tables if t.dtype == dtype] or [np.zeros(1, dtype)])
        for dtype in ("float32", "int32")
    }


def _body(graph: Graph, leaves: list[Leaf], values: list[list[Value]], vector: bool, watch: Watch) -> str:
    """C that stores the values of each leaf in its fields. What is stored where it was loaded from needs no store."""
    stores: dict[tuple[str, int], Value] = {}
    for leaf, elements in zip(leaves, values, strict=True):
        for place, value in zip(_places(leaf), elements, strict=True):
            if value < 0 or graph.ops[value] != "load" or graph.args[value] != place:
                stores[place] = value
    return Emitter(graph, [(*place, value) for place, value in stores.items()], vector, watch).body()


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
