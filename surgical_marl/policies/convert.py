"""Converts what policies see and do between torch and numpy."""

from __future__ import annotations

from typing import Any

import numpy as np


def to_numpy(values: Any) -> np.ndarray:
    """Return an array of any library as float64 of numpy."""
    return np.asarray(values.cpu() if hasattr(values, "cpu") else values, dtype=float)


def like(example: Any, action: np.ndarray) -> Any:
    """Return an action as float32 of the example's library."""
    if hasattr(example, "new_tensor"):
        return example.new_tensor(action)
    return np.asarray(action, np.float32)
