"""Loads programs from the cache on disk, or makes them."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.engines.fused.program import TREES, Leaf, Source
from surgical_marl.engines.stages import Stage, unsaid
from surgical_marl.engines.stepper import Stepper, describe
from surgical_marl.runtime import no_collection


def load_source(env: Stepper, vector: bool, stage: Stage = unsaid) -> Source:
    """Return the source of an environment's kernels: for a CPU, with vectors, or for CUDA.

    The source is kept on disk. `stage` is told the stages in which it is made.

    Raises:
        Unsupported: the environment can't be traced.
    """

    def compute() -> np.ndarray:
        from surgical_marl.engines.fused.translate import make_source  # imports JAX

        # what tracing makes stays: to look for garbage among it takes a fifth of the time
        with no_collection():
            source = make_source(env, vector, stage)
        return np.frombuffer(json.dumps(asdict(source), default=np.ndarray.tolist).encode(), np.uint8)

    settings = f"vector={vector} {describe(env.parameters)}"
    found = json.loads(cached("fused", compute, settings, env.content, roots=env.roots).tobytes())
    tables = {dtype: np.array(table, dtype) for dtype, table in found.pop("tables").items()}
    trees = {name: _leaves(found.pop(name)) for name in TREES}
    return Source(tables=tables, **trees, **found)


def _leaves(tree: Any) -> Any:
    if "buffer" in tree and not isinstance(tree["buffer"], dict):
        return Leaf(tree["buffer"], tree["first"], tuple(tree["shape"]), tree["dtype"])
    return {name: _leaves(child) for name, child in tree.items()}
