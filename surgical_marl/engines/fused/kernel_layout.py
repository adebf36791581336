"""The kernels of an environment in C, and which fields of which arrays hold their arguments and results.

Arguments and results are trees of arrays of one environment; a leaf of n elements takes n consecutive fields (rows) of
an array whose columns are environments.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

BUFFERS = ("state", "counts", "actions", "outs", "flags")
"""Arrays of environments that kernels work on: see `kernel.py`."""
TREES = ("carry", "actions", "results", "parameters", "fault")


@dataclass(frozen=True)
class Leaf:
    """Fields `first`, `first + 1`, ... of an array hold the elements of one leaf, of this shape and dtype."""

    buffer: str
    first: int
    shape: tuple[int, ...]
    dtype: str

    @cached_property
    def size(self) -> int:
        return math.prod(self.shape)

    @cached_property
    def fields(self) -> int | slice:
        """The index of the fields in their array; of a single number without an axis."""
        return slice(self.first, self.first + self.size) if self.shape else self.first


@dataclass(frozen=True)
class Stage:
    """A stage of a step: what an engine does next.

    Its kind is "thread" or "block" for a kernel of this name with one or with many threads an environment, "host" for
    numbers that are computed outside, "copy" from the fields that it reads to those that it writes, or "loop".
    """

    kind: str
    name: str
    reads: dict[str, Leaf] = field(default_factory=dict)
    """Of a block or the host, by name. A block reads constants and parameters in the tables "float32" and "int32"."""
    writes: dict[str, Leaf] = field(default_factory=dict)
    code: str = ""
    """CUDA of a block."""
    threads: int = 1
    length: int = 1
    """Rounds of a loop."""
    stages: list[Stage] = field(default_factory=list)
    """Of a loop."""


def all_stages(stages: Iterable[Stage]) -> Iterator[Stage]:
    """Yield stages, and those of loops, in their order."""
    for stage in stages:
        yield stage
        yield from all_stages(stage.stages)


@dataclass(frozen=True)
class Source:
    """The kernels of an environment in C, and the layout of their data."""

    bodies: dict[str, str]
    """C by the name of the kernel: "reset" and "step", or "step_0", "step_1", ... where a step has several stages."""
    stages: list[Stage]
    """Of a step, in their order."""
    large_branches: int
    """In how many places of the kernels environments differ in how much they have to do."""
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
    """Places of parameters in the tables, by their paths: leaves whose buffer is "float32" or "int32"."""
    fault: Leaf
    """A flag that kernels set, and never clear, when they store a NaN or infinity that `faults.checked` forbids."""
