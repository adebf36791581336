"""The CUDA code of a block stage on a CPU, with one thread a block: barriers and sums over threads are nothing then."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np

from surgical_marl.engines.fused import kernel
from surgical_marl.engines.fused.arrays import make_arrays
from surgical_marl.engines.fused.compiler import Fields, tables
from surgical_marl.engines.fused.graph import Graph
from surgical_marl.engines.fused.stage_code import block_code
from surgical_marl.engines.stages import Call, called
from tests.helpers.fused_kernels import gpu_code

_ON_A_CPU = """
#define __shared__
#define __device__
#define fmaxf __builtin_fmaxf
#define fminf __builtin_fminf
#define __syncthreads()
#define __syncthreads_or(x) (x)
struct { int x; } threadIdx = {0};
"""


def call_of(function: Callable[..., Any], *arguments: Any) -> tuple[Call, list[np.ndarray]]:
    """Return how a function calls a stage, and its inputs: the function does nothing else."""
    traced = jax.make_jaxpr(function)(*arguments)
    (equation,) = traced.eqns
    call = called(equation)
    assert call is not None and call.cuda is not None
    given = dict(zip(traced.jaxpr.constvars, traced.consts, strict=True))
    given |= dict(zip(traced.jaxpr.invars, jax.tree.leaves(arguments), strict=True))
    return call, [np.asarray(one.val if hasattr(one, "val") else given[one]) for one in equation.invars]


def run_block(function: Callable[..., Any], *arguments: Any) -> dict[str, np.ndarray]:
    """Return the results of a stage by name, of its CUDA code, for one environment."""
    call, inputs = call_of(function, *arguments)
    layout = Fields()
    reads = {
        name: layout.place(jax.ShapeDtypeStruct(one.shape, one.dtype), "state")
        for name, one in zip(call.reads, inputs, strict=True)
    }
    results = zip(call.writes, call.reference.out_avals, strict=True)
    writes = {name: layout.place(jax.ShapeDtypeStruct(one.shape, one.dtype), "state") for name, one in results}
    body = _ON_A_CPU + block_code(call.cuda or "", 1, reads, writes)
    with gpu_code():
        compiled = kernel.compile_kernels({"block": body}, "cpu")["block"]
        source: Any = SimpleNamespace(sizes=layout.sizes)
        arrays: Any = make_arrays("cpu", source, tables(Graph()), 1, 1)
        for leaf, values in zip(reads.values(), inputs, strict=True):
            arrays.write(leaf, values[None])
        compiled.launch(arrays.all, 1, 0, 1)
        return {name: arrays.read(leaf, "numpy")[0] for name, leaf in writes.items()}
