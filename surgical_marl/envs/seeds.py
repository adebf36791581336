"""Seeds: whole numbers that JAX's keys are made of."""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from typing import Any

import numpy as np

from surgical_marl.engines.fused.threefry import episode_keys


def check_seed(seed: Any) -> int | None:
    """Return a seed as an int, or None for none; ValueError if it is no whole number in range."""
    if seed is not None and not (is_whole(seed) and 0 <= seed < 2**63):
        raise ValueError(f"seed must be a whole number from 0 to 2**63 - 1, not {seed!r}")
    return None if seed is None else int(seed)


def is_whole(value: Any) -> bool:
    """Whether a value is a whole number, of Python or of numpy."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def keys_of(seed: Any, num_envs: int, first: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which environments get a seed, [N] bool, and the keys that the seeds lead to, [N, 2].

    Args:
        seed: one for all, or a list with one for each environment; None leaves an environment without.
        num_envs: how many environments.
        first: the number of the first one.
    """
    if not isinstance(seed, Sequence | np.ndarray):
        one = check_seed(seed)
        return np.full(num_envs, one is not None), episode_keys(one or 0, num_envs, first)
    if len(seed) != num_envs:
        raise ValueError(f"a list of {len(seed)} seeds does not fit {num_envs} environments: give one for each")
    seeds = [check_seed(own) for own in seed]
    keys = np.concatenate([episode_keys(own or 0, 1) for own in seeds])
    return np.array([own is not None for own in seeds]), keys
