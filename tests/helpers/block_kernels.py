"""The CUDA code of a block stage by itself: on a GPU, or on a CPU with one thread a block.

Barriers and sums over threads are nothing then.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from surgical_marl.engines.fused import kernel
from surgical_marl.engines.fused.arrays import make_arrays
from surgical_marl.engines.fused.compiler import Fields, tables
from surgical_marl.engines.fused.graph import Graph
from surgical_marl.engines.fused.kernel_layout import Leaf
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


def has_clang() -> bool:
    """Return whether Warp can compile for a CPU: some builds of it have no Clang."""
    return bool(kernel.wp._src.context.runtime.llvm)


STRIDE = 8
"""Columns of the arrays, of which the first is the environment's: a kernel that takes numbers for neighbours fails."""
DEVICES = [
    pytest.param("cpu", marks=pytest.mark.skipif(not has_clang(), reason="needs Warp's compiler for a CPU")),
    pytest.param("cuda", marks=pytest.mark.skipif(not kernel.has_cuda(), reason="needs a CUDA device")),
]


class Laid(NamedTuple):
    """A stage, and where its inputs and results are."""

    call: Call
    inputs: list[np.ndarray]
    layout: Fields
    reads: dict[str, Leaf]
    writes: dict[str, Leaf]

    def body(self, threads: int) -> str:
        """The kernel's body for a block of so many threads."""
        return block_code(self.call.cuda or "", threads, self.reads, self.writes)


def cuda_of(function: Callable[..., Any], *arguments: Any) -> tuple[str, int]:
    """Return the body of the kernel of a stage, and how many threads a block has."""
    laid = _laid(function, arguments)
    return laid.body(laid.call.threads), laid.call.threads


def run_block(device: str, function: Callable[..., Any], *arguments: Any) -> dict[str, np.ndarray]:
    """Return the results of a stage by name, of its CUDA code, for one environment."""
    laid = _laid(function, arguments)
    source: Any = SimpleNamespace(sizes=laid.layout.sizes)
    arrays: Any = make_arrays(device, source, tables(Graph()), STRIDE, 1)
    for leaf, values in zip(laid.reads.values(), laid.inputs, strict=True):
        arrays.write(leaf, values[None])
    if device == "cpu":
        with gpu_code():
            body = _ON_A_CPU + laid.body(1)
            kernel.compile_kernels({"block": body}, "cpu")["block"].launch(arrays.all, STRIDE, 0, 1)
    else:
        threads = laid.call.threads
        kernel.compile_block("block", laid.body(threads), threads).launch(arrays.all, STRIDE, 1)
    return {name: arrays.read(leaf, "numpy")[0] for name, leaf in laid.writes.items()}


def _laid(function: Callable[..., Any], arguments: Any) -> Laid:
    """Return the stage that a function calls: it does nothing else."""
    traced = jax.make_jaxpr(function)(*arguments)
    (equation,) = traced.eqns
    call, layout = called(equation), Fields()
    assert call is not None
    given = dict(zip(traced.jaxpr.constvars, traced.consts, strict=True))
    given |= dict(zip(traced.jaxpr.invars, jax.tree.leaves(arguments), strict=True))
    inputs = [np.asarray(one.val if hasattr(one, "val") else given[one]) for one in equation.invars]
    places = [
        {
            name: layout.leaf(one.shape, np.dtype(one.dtype).name, "state")
            for name, one in zip(names, arrays, strict=True)
        }
        for names, arrays in ((call.reads, inputs), (call.writes, call.reference.out_avals))
    ]
    return Laid(call, inputs, layout, *places)
