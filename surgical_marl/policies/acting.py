"""The interface of a policy, and arrays on its way in and out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Policy = Callable[[Mapping[str, Any]], dict[str, Any]]
"""Maps the observations of all agents to their actions. A recurrent policy has a method `reset` (see `forget`), and one
that draws random numbers a method `seed`, which takes whole numbers and begins them anew."""


def forget(policy: Callable[..., Any], ended: Any = None) -> None:
    """Reset a policy's hidden state: in all environments, or where an episode has `ended`, [N] bool.

    For a policy without a hidden state this does nothing.
    """
    reset = getattr(policy, "reset", None)
    if reset is not None:
        reset(ended)


def to_numpy(values: Any) -> np.ndarray:
    """Return an array of any library as float64 of numpy."""
    return np.asarray(values.cpu() if hasattr(values, "cpu") else values, dtype=float)


def like(example: Any, action: np.ndarray) -> Any:
    """Return an action as float32 of the example's library."""
    if hasattr(example, "new_tensor"):
        return example.new_tensor(action)
    return np.asarray(action, np.float32)
