"""The fused engine: a control step of an environment is one kernel, or several where it has stages.

    engine = FusedEngine(env, num_envs=4096, device="cuda")
    engine.reset(seed=0)
    engine.step(actions)
    engine.outcome("torch")["rewards"]

The state of all environments stays in arrays on the device, [field, column], between steps. Which environment is in
which column may change (`env_sorting.py`).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from surgical_marl.engines.compilation import Phase, compiling
from surgical_marl.engines.fused.arrays import make_arrays
from surgical_marl.engines.fused.env_sorting import sorted_every
from surgical_marl.engines.fused.finite_check import FiniteCheck
from surgical_marl.engines.fused.kernel import Block, Kernel, compile_block, compile_kernels, has_cuda
from surgical_marl.engines.fused.kernel_layout import Source, Stage, all_stages
from surgical_marl.engines.fused.macros import LANES
from surgical_marl.engines.fused.source_cache import load_source
from surgical_marl.engines.fused.threefry import episode_keys
from surgical_marl.engines.stepper import Stepper
from surgical_marl.machine import cores

LEAST_SHARE = 32
"""Least number of environments per thread."""


class FusedEngine:
    """`num_envs` copies of an environment.

    Raises:
        Unsupported: the environment uses something that has no kernel code.
        ValueError: the device is not there, or has no room for so many environments.
    """

    name = "fused"

    def __init__(self, env: Stepper, num_envs: int, device: str = "auto") -> None:
        if device == "cuda" and not has_cuda():
            raise ValueError("device 'cuda' is not there: Warp finds no CUDA device; the other is cpu")
        self.env, self.num_envs = env, num_envs
        self.device = ("cuda" if has_cuda() else "cpu") if device == "auto" else device
        with compiling(f"{env.title} ({self.name}, {self.device})") as phase:
            self.source: Source = load_source(env, vector=self.device == "cpu", phase=phase)
            self._kernels, self._blocks = self._compile(phase)
        carry = flatten(self.source.carry)
        self.carry_shapes = {name: leaf.shape for name, leaf in carry.items()}
        self._leaves = dict(carry)
        for stage in all_stages(self.source.stages):
            if stage.kind == "host":
                self._leaves |= {f"{stage.name}.{name}": leaf for name, leaf in stage.reads.items()}
        self._stride = -(-num_envs // LANES) * LANES
        self._arrays = make_arrays(self.device, self.source, self._filled_tables(), self._stride, num_envs)
        self._finite_check: FiniteCheck | None = None
        vectors = self._stride // LANES
        shares = min(cores(), max(1, num_envs // LEAST_SHARE)) if self.device == "cpu" else 1
        edges = [round(vectors * k / shares) * LANES for k in range(shares + 1)]
        self._shares = [(a, b - a) for a, b in pairwise(edges)]
        if shares == 1:
            self._shares = [(0, num_envs if self.device == "cuda" else self._stride)]
        if every := sorted_every(self.source.large_branches, self.device, num_envs, env.decimation):
            self._arrays.sort_columns(every, shares, any(kernel.split for kernel in self._kernels.values()))
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0

    def _compile(self, phase: Phase) -> tuple[dict[str, Kernel], dict[str, Block]]:
        """Return the kernels by name, with a thread or a block an environment; stages are compiled side by side."""
        source = self.source

        def compiled(bodies: dict[str, str]) -> dict[str, Kernel]:
            return compile_kernels(bodies, self.device, self.num_envs, source.large_branches, phase=phase)

        blocks = [one for one in all_stages(source.stages) if one.kind == "block"]
        if not blocks:
            return compiled(source.bodies), {}
        with ThreadPoolExecutor(cores(), "surgical_marl") as pool:
            made = pool.map(lambda one: compile_block(one.name, one.code, one.threads, phase), blocks)
            kernels = pool.map(lambda name: compiled({name: source.bodies[name]})[name], source.bodies)
            names = [one.name for one in blocks]
            return dict(zip(source.bodies, kernels, strict=True)), dict(zip(names, made, strict=True))

    def reset(self, seed: int, first: int = 0) -> None:
        """Start first episodes. Environment i depends on `seed` and `first` + i alone, and not on `num_envs`."""
        self.begin(episode_keys(seed, self.num_envs, first), np.zeros(self.num_envs, np.int32))

    def begin(self, keys: np.ndarray, episodes: np.ndarray) -> None:
        """Begin episodes by their number, [N] int32, among those of each environment's key, [N, 2] uint32."""
        self.write(".key", keys)
        self.write(".episode", episodes)
        self._arrays.renew_results()
        self._launch("reset")

    def set_parameters(self) -> None:
        """Read the environment's `parameters` again."""
        self._arrays.set_tables(self._filled_tables())

    def step(self, actions: dict[str, Any], sense: Callable[[], dict[str, Any]] | None = None) -> None:
        """Do one control step of all environments.

        Args:
            actions: [N, n] by agent, of any array library.
            sense: computes what the host does in a step: returns the results, [N] each, of a stage whose inputs can be
                read by its name. Without it, these results stay as they are.
        """
        if self._arrays.order:
            self._arrays.order.sort_if_due()
        for agent, action in actions.items():
            self._arrays.write(self.source.actions[agent], action)
        self._arrays.renew_results()
        self._run(self.source.stages, sense)

    def _run(self, stages: list[Stage], sense: Callable[[], dict[str, Any]] | None) -> None:
        for stage in stages:
            if stage.kind == "thread":
                self._launch(stage.name)
            elif stage.kind == "block":
                self._blocks[stage.name].launch(self._arrays.all, self._stride, self.num_envs)
            elif stage.kind == "copy":
                self._arrays.copy(stage.reads[""], stage.writes[""])
            elif stage.kind == "loop":
                for _ in range(stage.length):
                    self._run(stage.stages, sense)
            else:
                for name, values in (sense() if sense else {}).items():
                    self._arrays.write(stage.writes[name], values)

    @property
    def finite_check(self) -> FiniteCheck:
        """Return the check for numbers that are not finite, made when it is first needed."""
        if self._finite_check is None:
            carry = {name: self._leaves[name] for name in self.carry_shapes}
            self._finite_check = FiniteCheck(self.source, carry, self._arrays)
        return self._finite_check

    @property
    def fault_places(self) -> list[str]:
        """Names of the places where a fault can be, by code (see `surgical_marl/engines/faults.py`)."""
        return self.finite_check.names

    def end_faulty(self, limit: int, library: str) -> Any:
        """End the episode of every environment that the last step left NaN or infinite; call it before `outcome`.

        The episode is terminated. Its rewards, and observations that are not finite, become 0. If numbers of the state
        are at fault, the environment's count of steps is set to `limit`, so that the next step resets it; faults in the
        results of that step are not reported again. It does not wait for a GPU, and can be part of a CUDA graph.

        Args:
            limit: steps after which an episode ends.
            library: of the returned array: "numpy", "torch" or "jax".

        Returns:
            Code of the fault in each environment, [N] int32; -1 where there is none.
        """
        return self._arrays.presented(self.finite_check.check(limit), library)

    def expect_end(self, leaving: np.ndarray) -> None:
        """Say which environments, [N] bool, the next step resets because of a fault: it is not reported again."""
        self.finite_check.clear(leaving)

    def outcome(self, library: str) -> dict[str, Any]:
        """Return the results of the last step or reset: fields of the environment's `State` as dicts of dicts.

        The arrays are [N, ...] of "numpy", "torch" or "jax". Later steps do not change them, but each replay of a CUDA
        graph overwrites the arrays that were made while it was captured.
        """
        return self._arrays.read_tree(self.source.results, library)

    def read(self, name: str, library: str) -> Any:
        """Return a copy, [N, ...], of a part of the state.

        A part of the `Carry` has a name in `carry_shapes`; what a stage of the host reads has one such as
        "pictures.physics.arms.qpos".
        """
        return self._arrays.read(self._leaves[name], library)

    def write(self, name: str, values: Any) -> None:
        """Set a part of the `Carry`."""
        leaf = self._leaves[name]
        self._arrays.write(leaf, values)
        if leaf.buffer == "state":  # a kernel checks what it stores alone
            self._arrays.rows(self.source.fault)[:] = 1

    def close(self) -> None:
        """End the threads. The arrays are freed with the engine."""
        if self._pool is not None and self._process == os.getpid():
            self._pool.shutdown()
        self._pool = None

    def _filled_tables(self) -> dict[str, np.ndarray]:
        """Return the constant tables with the parameters in their places."""
        filled = {dtype: table.copy() for dtype, table in self.source.tables.items()}
        for name, values in _paths(self.env.parameters).items():
            leaf = self.source.parameters[name]
            filled[leaf.buffer][leaf.first : leaf.first + leaf.size] = np.ravel(values)
        return filled

    def _launch(self, name: str) -> None:
        launch = partial(self._kernels[name].launch, self._arrays.all, self._stride)
        if len(self._shares) == 1:
            launch(*self._shares[0])
        else:
            list(self._threads().map(launch, *zip(*self._shares, strict=True)))

    def _threads(self) -> ThreadPoolExecutor:
        """Return the threads of this process: one that was forked has none of its parent's."""
        if self._pool is None or self._process != os.getpid():
            self._pool, self._process = ThreadPoolExecutor(len(self._shares), "surgical_marl"), os.getpid()
        return self._pool


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Leaves of a dict of dicts by their path, as in ".physics.arms.qpos"."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        path = f"{prefix}.{name}"
        found.update(flatten(value, path) if isinstance(value, dict) else {path: value})
    return found


def _paths(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Leaves of a dict of dicts by their path, as JAX writes it: ['weights']['distance']."""
    if not isinstance(tree, dict):
        return {prefix: tree}
    return {path: leaf for name, child in tree.items() for path, leaf in _paths(child, f"{prefix}[{name!r}]").items()}
