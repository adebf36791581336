"""JAX functions as kernels on the CPU, for the tests of the fused engine's compiler."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax

from surgical_marl.engines.fused.arrays import make_arrays
from surgical_marl.engines.fused.emit import Emitter
from surgical_marl.engines.fused.graph import Graph
from surgical_marl.engines.fused.kernel import compile_kernels
from surgical_marl.engines.fused.preludes import LANES
from surgical_marl.engines.fused.translate import Fields, tables, trace

Stores = list[tuple[str, int, int]]


def shapes_of(columns: Any) -> Any:
    """The shapes of one environment's arrays, of columns [N, ...]."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), columns)


def make_stores(
    function: Callable[..., Any], columns: Any, in_place: bool = False
) -> tuple[Graph, Stores, Fields, Any, Any]:
    """A function's graph, what is to be stored where, and the leaves of its arguments and results: if `in_place`, the
    same ones."""
    layout, graph = Fields(), Graph()
    inputs = layout.place(shapes_of(columns), "state")
    values, shapes = trace(graph, function, inputs)
    outputs = inputs if in_place else layout.place(shapes, "outs")
    pairs = zip(jax.tree.leaves(outputs), values, strict=True)
    stores = [(leaf.buffer, leaf.first + k, value) for leaf, row in pairs for k, value in enumerate(row)]
    return graph, stores, layout, inputs, outputs


def run(function: Callable[..., Any], *columns: Any, in_place: bool = False) -> Any:
    """What a kernel of `function`, which is of one environment's arrays, makes of columns [N, ...]."""
    graph, stores, layout, inputs, outputs = make_stores(function, columns, in_place)
    kernel = compile_kernels({"run": Emitter(graph, stores, vector=True).body()}, "cpu")["run"]
    count = len(jax.tree.leaves(columns)[0])
    stride = -(-count // LANES) * LANES
    arrays: Any = make_arrays("cpu", SimpleNamespace(sizes=layout.sizes), tables(graph), stride, count)
    for leaf, column in zip(jax.tree.leaves(inputs), jax.tree.leaves(columns), strict=True):
        arrays.write(leaf, column)
    kernel.launch(arrays.all, stride, 0, stride)
    return jax.tree.map(lambda leaf: arrays.read(leaf, "numpy"), outputs)
