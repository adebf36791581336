"""The reference engine: `Env` under `jax.vmap`, physics by MuJoCo MJX."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.env import Carry, Env, State

DEVICES = ("auto", "cpu", "cuda")
LEAST_SHARE = 32
"""Environments that are worth a thread."""


class MjxEngine:
    """`num_envs` copies of an environment; every array gains a leading axis of that length."""

    name = "mjx"

    def __init__(self, env: Env, num_envs: int, device: str = "auto") -> None:
        self.env, self.num_envs = env, num_envs
        self.device = find_device(device)
        self._first_keys = jax.jit(jax.vmap(jax.random.fold_in, (None, 0)))
        self._reset = jax.jit(jax.vmap(env.reset))
        self._step = jax.jit(jax.vmap(env.step), donate_argnums=0)
        # XLA runs a step on one CPU core: every core takes a share of the environments
        shares = min(os.cpu_count() or 1, num_envs // LEAST_SHARE) if self.device.platform == "cpu" else 1
        self._shares = next(n for n in range(max(shares, 1), 0, -1) if num_envs % n == 0)
        self._pool = ThreadPoolExecutor(self._shares, "surgical_marl")
        self._split = jax.jit(lambda tree: [jax.tree.map(share, tree) for share in self._slices()])
        self._join = jax.jit(lambda *parts: jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts))
        self._announced = False
        self._traced = False

    def reset(self, seed: int) -> State:
        """First episodes. Environment i depends on `seed` and i alone, not on how many there are."""
        with jax.default_device(self.device):
            keys = self._first_keys(jax.random.PRNGKey(seed), jnp.arange(self.num_envs))
            return self.restart(keys, jnp.zeros(self.num_envs, jnp.int32))

    def restart(self, keys: Array, episodes: Array) -> State:
        """The start of given episodes: keys [N, 2], episode numbers [N]."""
        self._announce()
        with jax.default_device(self.device):
            return self._reset(keys, episodes)

    def step(self, carry: Carry, actions: dict[str, Array]) -> State:
        """One control step of all environments; `carry` may not be used again."""
        with contextlib.nullcontext() if self._traced else _no_collection():
            if self._shares == 1:
                state = self._step_share((carry, actions))
            else:
                shares = self._split((carry, actions))
                first = [] if self._traced else [self._step_share(shares.pop(0))]  # compiles once, not in every thread
                state = self._join(*first, *self._pool.map(self._step_share, shares))
            self._traced = True
        return state

    def _step_share(self, share: tuple[Carry, dict[str, Array]]) -> State:
        with jax.default_device(self.device):  # of this thread
            state: State = jax.block_until_ready(self._step(*share)) if self._shares > 1 else self._step(*share)
            return state

    def _slices(self) -> list[Callable[[Array], Array]]:
        size = self.num_envs // self._shares
        return [lambda x, i=i: x[i * size : (i + 1) * size] for i in range(self._shares)]  # type: ignore[misc]

    def to_device(self, value: Any) -> Array:
        """Any array on the engine's device."""
        return jax.device_put(value, self.device)

    def _announce(self) -> None:
        if not self._announced:
            envs = "1 environment" if self.num_envs == 1 else f"{self.num_envs} environments"
            print(
                f"surgical-marl: compiling {self.env.task_name} on {self.env.scene.name} for {envs} "
                f"({self.name}, {self.device.platform}); a second start takes it from the cache",
                file=sys.stderr,
                flush=True,
            )
            self._announced = True


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Tracing makes some million objects that all stay: looking for garbage among them takes a quarter of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def find_device(device: str) -> Any:
    """The JAX device for "auto", "cpu" or "cuda". ValueError if it is not there."""
    if device not in DEVICES:
        raise ValueError(f"unknown device {device!r}; the devices are {', '.join(DEVICES)}")
    if device == "auto":
        return jax.devices()[0]
    try:
        return jax.devices(device)[0]
    except RuntimeError:
        raise ValueError(f"device {device!r} is not there: JAX sees {jax.default_backend()} only") from None
