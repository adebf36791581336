"""Stages: parts of a step that do not run a thread an environment.

A step is one JAX function of one environment. Parts of it that need another shape of parallelism are called as stages:

    relax = block_stage(relaxed, cuda=SOURCE, threads=256)     # a CUDA kernel with a block of threads an environment
    found = relax(nodes, tip)                                  # as relaxed(nodes, tip)

    sense = host_stage("pictures", unseen)                     # the host computes it: pictures
    sensed = sense(carry)                                      # as unseen(carry) where nobody draws

The function that a stage is made from is its reference. JAX runs that one: under `jit`, `vmap` and derivatives, in the
engine mjx, and in the fused engine on a CPU, which compiles it into its kernel. An engine that runs a stage in another
way splits the step there (`split.py`).

A stage reads the leaves of its arguments and writes those of its result. Their names are paths, such as
`state.position` for a field of the argument `state`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple, TypeVar

import jax
from jax.extend import core
from jax.interpreters import ad, batching, mlir

R = TypeVar("R")
MOST_SHARED = 48 * 1024
"""Memory that the threads of a block can share on any GPU, bytes."""


class Call(NamedTuple):
    """The call of a stage: the parameter of its equation in a jaxpr."""

    name: str
    reference: core.ClosedJaxpr
    reads: tuple[str, ...]
    """Names of its inputs."""
    writes: tuple[str, ...]
    """Names of its results."""
    cuda: str | None = None
    """Body of the CUDA kernel; None for a stage of the host."""
    threads: int = 1
    """Threads of a block."""


def block_stage(reference: Callable[..., R], cuda: str, threads: int, name: str = "") -> Callable[..., R]:
    """Return a function that computes what `reference` does, on a GPU by a kernel with a block of threads a call.

    The kernel is CUDA code for the body of a function. In it `in.NAME[k]` is element k of an input, in C order, and
    `out.NAME[k]` one of a result, of type float, int, unsigned or bool; `in.NAME.size` is their number. `thread` is the
    number of the thread, and `threads` how many there are. A dot in a name is an underscore here, and the result of a
    function that returns one array is `out.result`. Results are not in the memory of inputs.

    Args:
        reference: a pure JAX function of arrays, or trees of arrays, given by position. All that differs between
            environments is an argument. It returns an array, or a tree with names: a dict or a NamedTuple.
        cuda: the kernel's body.
        threads: of a block, a multiple of 32 up to 1024.
        name: of the stage; that of the function by default.

    Raises:
        ValueError: a bad number of threads. The returned function raises it if `reference` uses a traced array that is
            not an argument.
    """
    if threads % 32 or not 32 <= threads <= 1024:
        raise ValueError(f"threads of a block must be a multiple of 32 from 32 to 1024, not {threads}")
    return _stage(name or reference.__name__, reference, cuda, threads)


def host_stage(name: str, reference: Callable[..., R]) -> Callable[..., R]:
    """Return a function whose results the host computes for all environments at once, outside of what is compiled.

    Args:
        name: of the stage. `engine.read` finds its inputs under it: "pictures.physics.arms.qpos".
        reference: a pure JAX function that gives the results where no host computes them. It takes one tree of arrays,
            and returns a dict of arrays.
    """
    return _stage(name, reference)


def _stage(name: str, reference: Callable[..., R], cuda: str | None = None, threads: int = 1) -> Callable[..., R]:
    given = inspect.signature(reference)

    @wraps(reference)
    def call(*arguments: Any) -> R:
        traced, shapes = jax.make_jaxpr(reference, return_shape=True)(*arguments)
        if any(isinstance(value, jax.core.Tracer) for value in traced.consts):
            raise ValueError(f"stage {name!r} uses a traced array that is not an argument: hand it over")
        named = given.bind(*arguments).arguments  # without those that have a default and are not given
        reads = [path for one, own in named.items() for path in _inputs(one, own)]
        if cuda is None:  # the host knows its only argument by the name of the stage
            reads = [path.removeprefix(f"{next(iter(named))}.") for path in reads]
        how = Call(name, traced, tuple(reads), paths(shapes), cuda, threads)
        found = _stage_p.bind(*jax.tree.leaves(arguments), call=how)
        return jax.tree.unflatten(jax.tree.structure(shapes), found)

    return call


def paths(tree: Any) -> tuple[str, ...]:
    """Return the names of a tree's leaves, as in "state.position"; of an array alone "result"."""
    found = jax.tree_util.tree_flatten_with_path(tree)[0]
    return tuple(".".join(str(_key(key)) for key in path) or "result" for path, _ in found)


def _inputs(name: str, tree: Any) -> list[str]:
    alone = jax.tree_util.all_leaves([tree])
    return [name] if alone else [f"{name}.{path}" for path in paths(tree)]


def _key(key: Any) -> Any:
    return next(getattr(key, kind) for kind in ("name", "key", "idx") if hasattr(key, kind))


def called(equation: Any) -> Call | None:
    """Return how an equation of a jaxpr calls a stage; None if it does not."""
    return equation.params["call"] if equation.primitive is _stage_p else None


# -- the primitive: to JAX, a call of the reference

_stage_p = core.Primitive("stage")
_stage_p.multiple_results = True


def _run(*arguments: Any, call: Call) -> list[Any]:
    return core.jaxpr_as_fun(call.reference)(*arguments)


def _batch(arguments: Any, axes: Any, call: Call) -> tuple[list[Any], list[int]]:
    found = jax.vmap(core.jaxpr_as_fun(call.reference), in_axes=tuple(axes))(*arguments)
    return found, [0] * len(found)


def _derive(values: Any, tangents: Any, call: Call) -> tuple[Any, Any]:
    moves = tuple(ad.instantiate_zeros(one) for one in tangents)
    return jax.jvp(core.jaxpr_as_fun(call.reference), tuple(values), moves)


_stage_p.def_impl(_run)
_stage_p.def_abstract_eval(lambda *_, call: call.reference.out_avals)
batching.primitive_batchers[_stage_p] = _batch
ad.primitive_jvps[_stage_p] = _derive
mlir.register_lowering(_stage_p, mlir.lower_fun(_run, multiple_results=True))
