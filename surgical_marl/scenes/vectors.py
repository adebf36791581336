"""Vectors and mappings as people write them in a scene file."""

from __future__ import annotations

from typing import Any

import numpy as np


def read_vector(value: Any, where: str, count: int = 3, words: str = "three finite numbers") -> np.ndarray:
    try:
        vector = np.array(value, dtype=float)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (count,) or not np.isfinite(vector).all():
        raise ValueError(f"{where}: {value!r} must be {words}")
    return vector


def read_mapping(value: Any, where: str) -> dict[str, Any]:
    if value is not None and not isinstance(value, dict):
        raise ValueError(f"{where}: {value!r} must be a mapping")
    return value or {}
