"""A traced function as C, and which fields of which arrays hold its arguments and results.

Arguments and results are trees of arrays of one environment; a leaf of n elements takes n consecutive fields (rows) of
an array whose columns are environments.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import jax
import numpy as np

from surgical_marl.cache import cached
from surgical_marl.engines.fused.emit import Emitter
from surgical_marl.engines.fused.graph import KINDS, Graph, Value
from surgical_marl.engines.fused.trace import Tracer
from surgical_marl.engines.fused.traced import Traced, lift, lower
from surgical_marl.engines.stepper import Stepper

BUFFERS = {"f": "outs", "i": "counts", "u": "counts", "b": "flags"}
"""Where results of each kind go unless they belong to the state."""


@dataclass(frozen=True)
class Leaf:
    """Fields `first`, `first + 1`, ... of an array hold the elements of one leaf, of this shape and dtype."""

    buffer: str
    first: int
    shape: tuple[int, ...]
    dtype: str

    @property
    def size(self) -> int:
        return math.prod(self.shape)


class Fields:
    """Gives out fields. `sizes` are how many each array has by now."""

    def __init__(self) -> None:
        self.sizes = {"state": 0, "counts": 0, "actions": 0, "outs": 0, "flags": 0}

    def place(self, tree: Any, reals: str) -> Any:
        """A tree of `Leaf`s for a tree of arrays or their shapes; float32 goes to the array `reals`."""
        return jax.tree.map(lambda x: self.leaf(x.shape, np.dtype(x.dtype).name, reals), tree)

    def leaf(self, shape: tuple[int, ...], dtype: str, reals: str) -> Leaf:
        buffer = reals if dtype == "float32" else BUFFERS[KINDS[dtype]]
        leaf = Leaf(buffer, self.sizes[buffer], tuple(shape), dtype)
        self.sizes[buffer] += leaf.size
        return leaf


@dataclass(frozen=True)
class Source:
    """The two kernels of an environment in C, and where everything is."""

    step: str
    reset: str
    tables: dict[str, np.ndarray]
    """All constant tables of a dtype, one after the other: "float32" and "int32"."""
    sizes: dict[str, int]
    """Fields of each array."""
    carry: dict[str, Any]
    """Leaves of the `Carry`, as dicts of dicts."""
    actions: dict[str, Any]
    results: dict[str, Any]
    """Leaves of the rest of the `State`."""


def load_source(env: Stepper, vector: bool, announce: Callable[[], None] = lambda: None) -> Source:
    """The source of an environment's kernels: for a CPU, with vectors, or for CUDA. Kept on disk; `announce` is called
    before it is made.

    Raises:
        Unsupported: the environment can't be traced.
    """

    def compute() -> np.ndarray:
        announce()
        return np.frombuffer(json.dumps(asdict(make_source(env, vector)), default=np.ndarray.tolist).encode(), np.uint8)

    found = json.loads(cached("fused", compute, f"vector={vector}", env.content, roots=env.roots).tobytes())
    tables = {dtype: np.array(table, dtype) for dtype, table in found.pop("tables").items()}
    trees = {name: _leaves(found.pop(name)) for name in ("carry", "actions", "results")}
    return Source(tables=tables, **trees, **found)


def make_source(env: Stepper, vector: bool) -> Source:
    """Traces `env.step` and `env.reset`."""
    layout, graph = Fields(), Graph()
    key, number = jax.ShapeDtypeStruct((2,), np.uint32), jax.ShapeDtypeStruct((), np.int32)
    carry = layout.place(jax.eval_shape(env.reset, key, number).carry, "state")
    actions = {agent: layout.leaf((env.num_actions(agent),), "float32", "actions") for agent in env.agents}
    values, shapes = trace(graph, env.step, (carry, actions))
    first, _ = trace(graph, env.reset, (carry.key, carry.episode))
    known = len(jax.tree.leaves(carry))
    leaves = [
        *jax.tree.leaves(carry),
        *_share_fields(layout, jax.tree.leaves(shapes)[known:], values[known:], first[known:]),
    ]
    paths = [path for path, _ in jax.tree_util.tree_flatten_with_path(shapes)[0]]
    results = _nest(paths, leaves)
    return Source(
        step=_body(graph, leaves, values, vector),
        reset=_body(graph, leaves, first, vector),
        tables=tables(graph),
        sizes=layout.sizes,
        carry=results.pop("carry"),
        actions=actions,
        results=results,
    )


def trace(graph: Graph, function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[list[list[Value]], Any]:
    """Runs a function on trees of `Leaf`s: the values of each leaf of its result, and the result's tree of shapes.

    Raises:
        Unsupported: for something that has no kernel code, with the line of the source that uses it.
    """
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), arguments)
    closed, results = jax.make_jaxpr(function, return_shape=True)(*shapes)
    inputs: list[Traced] = []
    for leaf in jax.tree.leaves(arguments):
        kind = KINDS[leaf.dtype]
        ids = [graph.node("load", leaf.buffer, leaf.first + k, kind=kind) for k in range(leaf.size)]
        inputs.append(lower(graph, np.array(ids, np.int32).reshape(leaf.shape), np.dtype(leaf.dtype)))
    outputs = Tracer(graph).run(closed, inputs)
    return [lift(graph, x).ravel().tolist() for x in outputs], results


def tables(graph: Graph) -> dict[str, np.ndarray]:
    """The constant tables of a graph, joined by dtype."""
    return {
        dtype: np.concatenate([t.ravel() for t in graph.tables if t.dtype == dtype] or [np.zeros(1, dtype)])
        for dtype in ("float32", "int32")
    }


def _body(graph: Graph, leaves: list[Leaf], values: list[list[Value]], vector: bool) -> str:
    """C that stores the values of each leaf in its fields. What is stored where it was loaded from needs no store."""
    stores: dict[tuple[str, int], Value] = {}
    for leaf, elements in zip(leaves, values, strict=True):
        for field, value in enumerate(elements, leaf.first):
            if value < 0 or graph.ops[value] != "load" or graph.args[value] != (leaf.buffer, field):
                stores[leaf.buffer, field] = value
    return Emitter(graph, [(*place, value) for place, value in stores.items()], vector).body()


def _share_fields(layout: Fields, shapes: list[Any], values: list[list[Value]], first: list[list[Value]]) -> list[Leaf]:
    """A leaf for each result. One whose values stand in a row in another, in both kernels, shares its fields: a state
    holds the observations of all agents."""
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
    """A dict of dicts of leaves by their paths in a tree."""
    tree: dict[str, Any] = {}
    for path, leaf in zip(paths, leaves, strict=True):
        *outer, last = [str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", "")))) for key in path]
        node = tree
        for name in outer:
            node = node.setdefault(name, {})
        node[last] = leaf
    return tree


def _leaves(tree: Any) -> Any:
    if "buffer" in tree and not isinstance(tree["buffer"], dict):
        return Leaf(tree["buffer"], tree["first"], tuple(tree["shape"]), tree["dtype"])
    return {name: _leaves(child) for name, child in tree.items()}
