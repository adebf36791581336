"""Chooses the engine that runs an environment."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from typing import Any, Literal, Protocol, get_args

import numpy as np

from surgical_marl.engines.stepper import Stepper

EngineName = Literal["auto", "fused", "mjx"]
DeviceName = Literal["auto", "cpu", "cuda"]
ENGINES, DEVICES = get_args(EngineName), get_args(DeviceName)


class Engine(Protocol):
    """`num_envs` copies of an environment and their state. Arrays are of "numpy", "torch" or "jax" by `library`."""

    name: str
    device: str
    """"cpu" or "cuda"."""
    carry_shapes: dict[str, tuple[int, ...]]
    """The parts of an environment's `Carry` by path, as in ".physics.arms.qpos", and their shapes."""

    def reset(self, seed: int, first: int = 0) -> None: ...

    def begin(self, keys: np.ndarray, episodes: np.ndarray) -> None: ...

    def set_parameters(self) -> None: ...

    def step(self, actions: dict[str, Any], sense: Callable[[], dict[str, Any]] | None = None) -> None: ...

    def outcome(self, library: str) -> dict[str, Any]: ...

    @property
    def fault_places(self) -> list[str]: ...

    def end_faulty(self, limit: int, library: str) -> Any: ...

    def expect_end(self, leaving: Any) -> None: ...

    def read(self, name: str, library: str) -> Any: ...

    def write(self, name: str, values: Any) -> None: ...

    def close(self) -> None: ...


def make_engine(env: Stepper, num_envs: int, engine: str = "auto", device: str = "auto") -> Engine:
    """Return the engine of that name, or the fastest one that can run the environment.

    Raises:
        ValueError: an unknown engine or device, one that is not there, or an environment that the engine can't run.
    """
    if engine not in ENGINES:
        raise ValueError(f"unknown engine {engine!r}; the engines are {', '.join(ENGINES)}")
    if device not in DEVICES:
        raise ValueError(f"unknown device {device!r}; the devices are {', '.join(DEVICES)}")
    if engine != "mjx":
        if importlib.util.find_spec("warp") is None:
            if engine == "fused":
                raise ValueError("engine 'fused' needs the package warp-lang, which is not installed")
            _say("warp-lang is not installed")
        else:
            from surgical_marl.engines.fused.engine import FusedEngine
            from surgical_marl.engines.fused.symbolic_array import Unsupported

            try:
                return FusedEngine(env, num_envs, device)
            except Unsupported as error:
                if engine == "fused":
                    raise ValueError(f"engine 'fused' can't run {env.title}: {error}") from None
                _say(f"{env.title} uses {error}")
    from surgical_marl.engines.mjx import MjxEngine

    return MjxEngine(env, num_envs, device)


def _say(why: str) -> None:
    print(f"surgical-marl: engine mjx instead of fused: {why}", file=sys.stderr, flush=True)
