"""Observations: one array each, or a dict of arrays where `surgical_marl/envs/picture_terms.py` adds pictures.

The numbers of an array are in SI units, or scaled: each from -1 to 1 between its bounds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


class Scale:
    """The scaling of vectors between bounds: each number from -1 to 1. Numbers without finite bounds stay as they are.

    Args:
        low: least vector, [d].
        high: greatest vector, [d].

    Attributes:
        bounds: least and greatest scaled vector, [d] each.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        bounded = np.isfinite(low) & np.isfinite(high) & (low < high)
        self.bounds = np.where(bounded, -1.0, low), np.where(bounded, 1.0, high)
        low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
        self._middle, self._half = (low + high) / 2, (high - low) / 2

    def apply(self, vector: Any) -> Any:
        """Return vectors [..., d] of any array library, scaled, and clipped to `bounds`."""
        low, high, middle, half = (_like(vector, part) for part in (*self.bounds, self._middle, self._half))
        return ((vector - middle) / half).clip(low, high)

    def undo(self, vector: Any) -> Any:
        """Return scaled vectors [..., d] as they were."""
        return vector * _like(vector, self._half) + _like(vector, self._middle)


def _like(example: Any, values: np.ndarray) -> Any:
    """Return values as an array of the example's library and type of numbers."""
    return example.new_tensor(values) if hasattr(example, "new_tensor") else values.astype(example.dtype)


def each(tree: Any, change: Callable[[Any], Any]) -> Any:
    """Return the same observations, with `change` applied to each array."""
    return {name: change(value) for name, value in tree.items()} if isinstance(tree, dict) else change(tree)


def replaced(tree: Any, rows: np.ndarray, new: Any) -> Any:
    """Return a copy of a dict of dicts of arrays [N, ...], numpy's or torch's, with other values in some rows.

    Args:
        tree: the arrays.
        rows: numbers of the rows, [n].
        new: what stands there instead, arrays [n, ...].
    """
    if isinstance(tree, dict):
        return {name: replaced(own, rows, new[name]) for name, own in tree.items()}
    found = tree.clone() if hasattr(tree, "clone") else np.array(tree)
    found[rows] = new
    return found


def proprioception(tree: Any) -> Any:
    """Return the one array that observations hold besides pictures."""
    return tree["proprioception"] if isinstance(tree, dict) else tree


def with_vector(tree: Any, change: Callable[[Any], Any]) -> Any:
    """Return the same observations, with `change` applied to the array that is no picture."""
    return {**tree, "proprioception": change(tree["proprioception"])} if isinstance(tree, dict) else change(tree)
