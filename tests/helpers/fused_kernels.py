"""JAX functions as kernels on the CPU, for the tests of the fused engine's compiler."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import jax
import numpy as np

from surgical_marl.engines.fused import engine, kernel
from surgical_marl.engines.fused.arrays import make_arrays
from surgical_marl.engines.fused.compiler import Fields, interpret, tables, trace
from surgical_marl.engines.fused.graph import Graph
from surgical_marl.engines.fused.macros import CUDA
from surgical_marl.engines.fused.pipeline import Program, compile_program
from surgical_marl.engines.fused.source_cache import load_source

Stores = list[tuple[str, int, int]]

_ON_A_CPU = {
    "SM_INF": "__builtin_inff()",
    "SM_NAN": '__builtin_nanf("")',
    "DIVF(a,b)": "((a)/(b))",
    "SQRT(x)": "sqrtf(x)",
    **{f"{name}{kind}(a,b)": f"({{auto a_=(a);auto b_=(b);a_{sign}b_?a_:b_;}})"
       for name, sign in (("MAX", ">"), ("MIN", "<")) for kind in "IU"},
    "MAXF(a,b)": "__builtin_fmaxf(a,b)",
    "MINF(a,b)": "__builtin_fminf(a,b)",
    "BLOCK_BARRIER": "",
    "GRID_BARRIER": "",
    "FINITE(x)": "(fabsf(x)<SM_INF)",
    "HIDEF(x)": 'asm volatile("":"+x"(x));',
    "BITS(x)": "({float a_=(x);U r_;__builtin_memcpy(&r_,&a_,4);r_;})",
    "FLOAT(x)": "({U a_=(x);float r_;__builtin_memcpy(&r_,&a_,4);r_;})",
}  # fmt: skip
"""What the macros for CUDA mean that a CPU does not know."""


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
    traced = trace(function, *shapes_of(columns))
    values = interpret(graph, traced, inputs)
    outputs = inputs if in_place else layout.place(traced.result, "outs")
    pairs = zip(jax.tree.leaves(outputs), values, strict=True)
    stores = [(leaf.buffer, leaf.first + k, value) for leaf, row in pairs for k, value in enumerate(row)]
    return graph, stores, layout, inputs, outputs


@contextmanager
def gpu_code() -> Iterator[None]:
    """Write code as for a GPU, one environment a thread, and run it on the CPU: its faults show without a GPU."""
    prelude = CUDA
    for macro, meaning in _ON_A_CPU.items():
        prelude, found = re.subn(rf"#define {re.escape(macro)} .*", lambda _: f"#define {macro} {meaning}", prelude)  # noqa: B023
        assert found == 1, macro
    load = lambda *args, **options: load_source(*args, **{**options, "vector": False})  # noqa: E731
    with (
        patch.multiple(kernel, CPU=prelude, LANES=1),
        patch.multiple(engine, load_source=load, LANES=1),
    ):
        yield


def run(function: Callable[..., Any], *columns: Any, in_place: bool = False) -> Any:
    """What a kernel of `function`, which is of one environment's arrays, makes of columns [N, ...]."""
    arrays, outputs = _launched(function, columns, in_place)
    return jax.tree.map(lambda leaf: arrays.read(leaf, "numpy"), outputs)


def worked(function: Callable[..., Any], *columns: Any) -> np.ndarray:
    """What a kernel notes of how much it had to do for each of columns [N, ...], [N]: the order of environments."""
    noted: np.ndarray = _launched(function, columns, False)[0].work[: len(jax.tree.leaves(columns)[0])]
    return noted


def _launched(function: Callable[..., Any], columns: Any, in_place: bool) -> tuple[Any, Any]:
    graph, stores, layout, inputs, outputs = make_stores(function, columns, in_place)
    body = compile_program(Program(graph, stores, vector=kernel.LANES > 1)).text
    compiled = kernel.compile_kernels({"run": body}, "cpu")["run"]
    count = len(jax.tree.leaves(columns)[0])
    stride = -(-count // kernel.LANES) * kernel.LANES
    arrays: Any = make_arrays("cpu", SimpleNamespace(sizes=layout.sizes), tables(graph), stride, count)
    for leaf, column in zip(jax.tree.leaves(inputs), jax.tree.leaves(columns), strict=True):
        arrays.write(leaf, column)
    compiled.launch(arrays.all, stride, 0, stride)
    return arrays, outputs
