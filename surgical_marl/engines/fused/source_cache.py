"""Loads the source of kernels from the cache on disk, or compiles it."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from surgical_marl.cache import cached, is_shipped
from surgical_marl.engines.compilation import Phase, unsaid
from surgical_marl.engines.fused.kernel_layout import TREES, Leaf, Source, Stage
from surgical_marl.engines.fused.options import read_options
from surgical_marl.engines.stepper import Stepper, describe
from surgical_marl.runtime import jax_scope, no_collection


def load_source(env: Stepper, vector: bool, phase: Phase = unsaid) -> Source:
    """Return the source of an environment's kernels: for a CPU, with vectors, or for CUDA.

    The source is kept on disk. For an environment of this package alone, the key is the code of the package and the
    environment's content. Code of somebody else can depend on anything, so it is traced, which takes seconds, and the
    jaxpr is the key. A dump (`options.py`) needs the compiler to run, so then nothing is read from disk.

    Args:
        env: the environment.
        vector: whether the kernels are for a CPU.
        phase: is told the phases in which the source is made.

    Raises:
        Unsupported: the environment can't be traced.
        ValueError: the environment variable of the passes names one that is not there.
    """
    options = read_options()
    about = f"vector={vector} {describe(env.parameters)} {options.switches}"
    make = partial(_make, env.parameters, vector, phase, env.title)
    if options.dump:
        made = make(_trace(env, phase))
    elif is_shipped(*env.classes):
        made = cached("fused", lambda: make(_trace(env, phase)), about, env.content, classes=env.classes)
    else:
        from surgical_marl.engines.fused.jaxpr_digest import jaxpr_digest  # imports JAX

        functions = _trace(env, phase)
        made = cached("fused", lambda: make(functions), about, jaxpr_digest(functions))
    found = json.loads(made.tobytes())
    tables = {dtype: np.array(table, dtype) for dtype, table in found.pop("tables").items()}
    trees = {name: _leaves(found.pop(name)) for name in TREES}
    return Source(tables=tables, stages=_stages(found.pop("stages")), **trees, **found)


@jax_scope()
def _trace(env: Stepper, phase: Phase) -> dict[str, Any]:
    from surgical_marl.engines.fused.compiler import trace_environment  # imports JAX

    # what tracing makes stays: to look for garbage among it takes a fifth of the time
    with no_collection():
        return trace_environment(env, phase)


@jax_scope()
def _make(parameters: Any, vector: bool, phase: Phase, title: str, functions: dict[str, Any]) -> np.ndarray:
    """Return a source as bytes."""
    from surgical_marl.engines.fused.compiler import make_source  # imports JAX

    with no_collection():
        source = make_source(functions, parameters, vector, phase, title)
    return np.frombuffer(json.dumps(asdict(source), default=np.ndarray.tolist).encode(), np.uint8)


def _leaves(tree: Any) -> Any:
    if "buffer" in tree and not isinstance(tree["buffer"], dict):
        return Leaf(tree["buffer"], tree["first"], tuple(tree["shape"]), tree["dtype"])
    return {name: _leaves(child) for name, child in tree.items()}


def _stages(stages: list[dict[str, Any]]) -> list[Stage]:
    trees = {"reads": _leaves, "writes": _leaves, "stages": _stages}
    return [Stage(**{name: trees[name](own) if name in trees else own for name, own in one.items()}) for one in stages]
