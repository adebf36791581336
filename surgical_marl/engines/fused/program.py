"""The kernels of an environment in C, and which fields of which arrays hold their arguments and results.

Arguments and results are trees of arrays of one environment; a leaf of n elements takes n consecutive fields (rows) of
an array whose columns are environments.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.engines.stepper import Stepper

TREES = ("carry", "actions", "results", "parameters", "moved", "sensed")


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


@dataclass(frozen=True)
class Source:
    """The kernels of an environment in C, and where everything is."""

    bodies: dict[str, str]
    """C by the name of the kernel: "reset" and "step", or "move" and "finish" instead of that."""
    tables: dict[str, np.ndarray]
    """All constant tables of a dtype, one after the other: "float32" and "int32"."""
    sizes: dict[str, int]
    """Fields of each array."""
    carry: dict[str, Any]
    """Leaves of the `Carry`, as dicts of dicts."""
    actions: dict[str, Any]
    results: dict[str, Any]
    """Leaves of the rest of the `State`."""
    parameters: dict[str, Any]
    """Where each parameter stands in the tables, by its path: leaves whose buffer is "float32" or "int32"."""
    moved: dict[str, Any]
    """Leaves of what is between both halves of a step, and of what is `sensed` there; none if a step is one kernel."""
    sensed: dict[str, Any]


def load_source(env: Stepper, vector: bool, announce: Callable[[], None] = lambda: None) -> Source:
    """The source of an environment's kernels: for a CPU, with vectors, or for CUDA. Kept on disk; `announce` is called
    before it is made.

    Raises:
        Unsupported: the environment can't be traced.
    """

    def compute() -> np.ndarray:
        from surgical_marl.engines.fused.translate import make_source  # imports JAX

        announce()
        return np.frombuffer(json.dumps(asdict(make_source(env, vector)), default=np.ndarray.tolist).encode(), np.uint8)

    settings = f"vector={vector} {_describe(env.parameters)}"
    found = json.loads(cached("fused", compute, settings, env.content, roots=env.roots).tobytes())
    tables = {dtype: np.array(table, dtype) for dtype, table in found.pop("tables").items()}
    trees = {name: _leaves(found.pop(name)) for name in TREES}
    return Source(tables=tables, **trees, **found)


def _describe(parameters: Any) -> str:
    """Names, shapes and types of parameters, without JAX: their values are inputs of the kernels."""
    if isinstance(parameters, dict):
        return repr({name: _describe(value) for name, value in sorted(parameters.items())})
    return f"{np.shape(parameters)} {parameters.dtype.name}"


def _leaves(tree: Any) -> Any:
    if "buffer" in tree and not isinstance(tree["buffer"], dict):
        return Leaf(tree["buffer"], tree["first"], tuple(tree["shape"]), tree["dtype"])
    return {name: _leaves(child) for name, child in tree.items()}
