"""The reference engine: `Env` under `jax.vmap`, physics by MuJoCo MJX."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend import core

from surgical_marl.engines.compilation import compiling
from surgical_marl.engines.faults import FINE, NEXT, checked, is_reward, places
from surgical_marl.engines.fused.threefry import episode_keys
from surgical_marl.engines.split import Part, Run, Stage, split, walk
from surgical_marl.engines.stepper import MOST_KEPT, Stepper, representative
from surgical_marl.machine import cores
from surgical_marl.runtime import jax_scope, no_collection

LEAST_SHARE = 32
"""Environments that are worth a thread."""


@dataclass
class Functions:
    """An environment's functions for a number of environments. All engines for such environments share them."""

    reset: Any
    step: Any
    """A function, or the parts of a step that calls stages of the host."""
    carry: Any
    """Shapes of one environment's `Carry`."""
    traced: set[str] = field(default_factory=set)
    """Which were called before, and so are compiled."""


@lru_cache(MOST_KEPT)
def _functions(env: Stepper, num_envs: int) -> Functions:
    def every(function: Any, axes: Any) -> Any:
        return jax.jit(jax.vmap(function, (*axes, None)))

    key, number = jax.ShapeDtypeStruct((2,), jnp.uint32), jax.ShapeDtypeStruct((), jnp.int32)
    carry = jax.eval_shape(env.reset, key, number, env.parameters).carry
    step = _Parts(env, carry) if env.pauses else jax.jit(jax.vmap(env.step, (0, 0, None)), donate_argnums=0)
    return Functions(every(env.reset, (0, 0)), step, carry)


class _Parts:
    """A step that is split where the host computes something, such as pictures.

    Attributes:
        parts: of the step. They read and write values by variable.
        arguments: variables of the carry and the actions.
        functions: name and function of each `Run`, which takes values [N, ...] of the variables `given`, and the
            parameters.
        state: structure of the `State`, whose leaves have numbers as variables: the first `results`.
    """

    def __init__(self, env: Stepper, carry: Any) -> None:
        actions = {agent: jax.ShapeDtypeStruct((env.num_actions(agent),), jnp.float32) for agent in env.agents}
        step, state = jax.make_jaxpr(env.step, return_shape=True)(carry, actions, env.parameters)
        arguments, self.parts = split(step, lambda call: call.cuda is None)
        count = len(jax.tree.leaves(env.parameters))
        self.arguments, self._shared = arguments[: len(arguments) - count], arguments[len(arguments) - count :]
        self.state, self.results = jax.tree.structure(state), len(jax.tree.leaves(state))
        runs = [part for part in walk(self.parts) if isinstance(part, Run)]
        self.given = {id(part): [one for one in part.reads if one not in self._shared] for part in runs}
        self.functions = {id(part): (f"step_{number}", self._every(part)) for number, part in enumerate(runs)}

    def _every(self, part: Run) -> Any:
        def run(given: Any, parameters: Any) -> Any:
            known = dict(zip(self.given[id(part)], given, strict=True))
            known |= dict(zip(self._shared, jax.tree.leaves(parameters), strict=True))
            return core.jaxpr_as_fun(part.jaxpr)(*(known[one] for one in part.reads))

        return jax.jit(jax.vmap(run, (0, None)))


@partial(jax.jit, static_argnums=1)
def _split(tree: Any, shares: int) -> list[Any]:
    """Return `shares` trees of arrays, each with an equal part of the environments."""
    return [jax.tree.map(lambda x, i=i: jnp.split(x, shares)[i], tree) for i in range(shares)]


@jax.jit
def _join(*parts: Any) -> Any:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


@jax.jit
def _end_faulty(state: Any, leaving: Array, limit: int) -> tuple[Any, Array, Array]:
    """Return the state with faulty episodes ended, where the next step ends one, [N] bool, and the codes of faults."""
    count, results = len(leaving), {name: value for name, value in state._asdict().items() if name != "carry"}

    def bad_in(leaf: Any) -> Any:
        return ~jnp.isfinite(leaf).reshape(count, -1)

    carry = [bad_in(leaf) for leaf in _floats(state.carry).values()]
    found = {name: bad_in(leaf) for name, leaf in checked(results)}
    bad = jnp.concatenate([*carry, *found.values()], 1)
    broken = jnp.concatenate(carry + [own for name, own in found.items() if name.partition(".")[0] in NEXT], 1).any(1)
    faulty = bad.any(1)

    def clean(name: str, tree: Any) -> Any:
        if isinstance(tree, dict):
            return {key: clean(f"{name}.{key}", child) for key, child in tree.items()}
        if name not in found:
            return tree
        zero = found[name].reshape(tree.shape)
        return jnp.where(faulty if is_reward(name) else zero, 0.0, tree)

    cleaned = {name: clean(name, results[name]) for name in {name.partition(".")[0] for name in found}}
    steps = jnp.where(broken, jnp.int32(limit), state.carry.steps)
    state = state._replace(
        **cleaned,
        carry=state.carry._replace(steps=steps),
        terminated=state.terminated | faulty,
        truncated=state.truncated & ~faulty,
    )
    codes = jnp.where(faulty & ~(leaving & ~broken), bad.argmax(1), FINE)
    return state, broken, codes.astype(jnp.int32)


class MjxEngine:
    """`num_envs` copies of an environment; every array gains a leading axis of that length."""

    name = "mjx"

    @jax_scope()
    def __init__(self, env: Stepper, num_envs: int, device: str = "auto") -> None:
        self.env, self.num_envs = env, num_envs
        self._on = find_device(device)
        self.device = "cpu" if self._on.platform == "cpu" else "cuda"
        self.set_parameters()
        self._functions = _functions(representative(env), num_envs)
        # XLA runs a step on one CPU core: every core takes a share of the environments
        shares = min(cores(), num_envs // LEAST_SHARE) if self.device == "cpu" else 1
        self._shares = next(n for n in range(max(shares, 1), 0, -1) if num_envs % n == 0)
        self._pool = ThreadPoolExecutor(self._shares, "surgical_marl")
        self._state: Any = None
        self._seen: dict[str, Any] = {}
        self._leaving: Any = np.zeros(num_envs, bool)
        self._tree = jax.tree.structure(self._functions.carry)
        self.carry_shapes = {name: leaf.shape for name, leaf in _paths(self._functions.carry).items()}

    def reset(self, seed: int, first: int = 0) -> None:
        """Begin the first episodes. Environment i depends on `seed` and `first` + i alone, not on their number."""
        self.begin(episode_keys(seed, self.num_envs, first), np.zeros(self.num_envs, np.int32))

    @jax_scope()
    def begin(self, keys: np.ndarray, episodes: np.ndarray) -> None:
        """Begin episodes by their number, [N] int32, among those of each environment's key, [N, 2] uint32."""
        with self._compiling("reset"), jax.default_device(self._on):
            self._state = self._functions.reset(self._take(keys), self._take(episodes), self._parameters)

    @jax_scope()
    def set_parameters(self) -> None:
        """Read the environment's `parameters` again."""
        self._parameters = jax.device_put(self.env.parameters, self._on)

    @jax_scope()
    def step(self, actions: dict[str, Any], sense: Callable[[], dict[str, Any]] | None = None) -> None:
        """Make one control step of all environments.

        Args:
            actions: [N, n] by agent, of any array library.
            sense: computes what the host does in a step: returns the results, [N] each, of a stage whose inputs can be
                read by its name.
        """
        given = {agent: self._take(action).astype(jnp.float32) for agent, action in actions.items()}
        step = self._functions.step
        if not isinstance(step, _Parts):
            self._state = self._run("step", step, self._state.carry, given)
            return
        values = dict(zip(step.arguments, jax.tree.leaves((self._state.carry, given)), strict=True))
        self._run_parts(step, step.parts, values, sense)
        self._state = jax.tree.unflatten(step.state, [values[k] for k in range(step.results)])

    def _run_parts(
        self, step: _Parts, parts: list[Part], values: dict[Any, Any], sense: Callable[[], dict[str, Any]] | None
    ) -> None:
        """Run parts of a step, which read and write values [N, ...] by variable."""
        for part in parts:
            if isinstance(part, Run):
                given = tuple(values[one] for one in step.given[id(part)])
                found = self._run(*step.functions[id(part)], given)
                values.update(zip(part.writes, found, strict=True))
            elif isinstance(part, Stage):
                name, sees = part.call.name, zip(part.call.reads, part.reads, strict=True)
                self._seen = {f"{name}.{path}": values[one] for path, one in sees}
                sensed = sense() if sense else {}
                for result, one in zip(part.call.writes, part.writes, strict=True):
                    nothing = jnp.zeros((self.num_envs, *one.aval.shape), one.aval.dtype)
                    values[one] = self._take(sensed[result]) if result in sensed else nothing
            else:
                for _ in range(part.length):
                    self._run_parts(step, part.parts, values, sense)

    def _run(self, name: str, function: Any, *given: Any) -> Any:
        """Run a function on all environments, with a share of them on each core."""
        traced = name in self._functions.traced
        # Tracing makes some million objects that all stay: looking for garbage among them takes a quarter of the time.
        with self._compiling(name), contextlib.nullcontext() if traced else no_collection():
            if self._shares == 1:
                found = self._run_share(function, given)
            else:
                shares = _split(given, self._shares)
                first = (
                    [] if traced else [self._run_share(function, shares.pop(0))]
                )  # compiles once, not in each thread
                rest = self._pool.map(lambda share: self._run_share(function, share), shares)
                found = _join(*first, *rest)
        return found

    @contextlib.contextmanager
    def _compiling(self, name: str) -> Iterator[None]:
        """Say that a function is compiled, if this block is the first that calls it."""
        if name in self._functions.traced:
            yield
            return
        with compiling(f"{self.env.title} ({self.name}, {self.device})") as phase:
            phase(f"tracing and compiling the {name}")
            yield
        self._functions.traced.add(name)

    @property
    def fault_places(self) -> list[str]:
        """Names of the places where a fault can be, by code (see `surgical_marl/engines/faults.py`)."""
        results = {name: value for name, value in self._state._asdict().items() if name != "carry"}
        leaves = _floats(self._state.carry) | dict(checked(results))
        return [place for name, leaf in leaves.items() for place in places(name, leaf.shape[1:])]

    @jax_scope()
    def end_faulty(self, limit: int, library: str) -> Any:
        """End the episode of every environment that the last step left NaN or infinite, as `FusedEngine` does it."""
        self._state, self._leaving, codes = _end_faulty(self._state, self._leaving, limit)
        return self._present(codes, library)

    @jax_scope()
    def expect_end(self, leaving: np.ndarray) -> None:
        """Take note of the environments, [N] bool, whose next step ends an episode because of an older fault."""
        self._leaving = jax.device_put(leaving, self._on)

    @jax_scope()
    def outcome(self, library: str) -> dict[str, Any]:
        """Return what the last step or reset led to: fields of the environment's `State` as dicts.

        The arrays are [N, ...] of "numpy", "torch" or "jax".
        """
        known = {name: value for name, value in self._state._asdict().items() if name != "carry"}
        found = {name: self._present(value, library) for name, value in known.items() if jax.tree.leaves(value)}
        return {**found, "contacts": found["contacts"]._asdict()}

    @jax_scope()
    def read(self, name: str, library: str) -> Any:
        """Return a part of the `Carry` or of what a stage of the host reads, [N, ...].

        A part of the `Carry` has a name in `carry_shapes`. What a stage reads has a name such as
        "pictures.physics.arms.qpos".
        """
        seen = self._seen.get(name)
        return self._present(_paths(self._state.carry)[name] if seen is None else seen, library)

    @jax_scope()
    def write(self, name: str, values: Any) -> None:
        """Set a part of the `Carry`."""
        parts = _paths(self._state.carry)
        parts[name] = jnp.array(self._take(values), parts[name].dtype)  # a copy: a step gives its carry away
        carry = jax.tree.unflatten(self._tree, list(parts.values()))
        self._state = self._state._replace(carry=carry)

    def close(self) -> None:
        """End the threads. The arrays are freed with the engine."""
        self._pool.shutdown()

    @jax_scope()
    def _run_share(self, function: Any, share: tuple[Any, ...]) -> Any:
        with jax.default_device(self._on):  # of this thread
            found = function(*share, self._parameters)
            return jax.block_until_ready(found) if self._shares > 1 else found

    def _take(self, values: Any) -> Array:
        """Return values of any array library on the engine's device."""
        if type(values).__module__.startswith("torch"):
            values = jax.dlpack.from_dlpack(values.detach().contiguous())
        return jax.device_put(values, self._on)

    def _present(self, tree: Any, library: str) -> Any:
        if library == "jax":
            return tree
        if library == "torch":
            import torch

            return jax.tree.map(torch.utils.dlpack.from_dlpack, tree)
        return jax.tree.map(np.asarray, tree)


def find_device(device: str) -> Any:
    """Return the JAX device for "auto", "cpu" or "cuda".

    Raises:
        ValueError: the device is not there.
    """
    if device == "auto":
        return jax.devices()[0]
    try:
        return jax.devices(device)[0]
    except RuntimeError:
        raise ValueError(f"device {device!r} is not there: JAX sees {jax.default_backend()} only") from None


def _paths(tree: Any) -> dict[str, Any]:
    """Return the leaves of a tree by their path, as in ".physics.arms.qpos"."""
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]}


def _floats(tree: Any) -> dict[str, Any]:
    """Return the leaves of a tree that hold real numbers, by their path."""
    return {name: leaf for name, leaf in _paths(tree).items() if jnp.issubdtype(leaf.dtype, jnp.floating)}
