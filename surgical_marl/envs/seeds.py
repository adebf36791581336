"""Seeds: whole numbers that JAX's keys are made of."""

from __future__ import annotations

import numbers
from typing import Any


def check_seed(seed: Any) -> int | None:
    """Return a seed as an int, or None for none; ValueError if it is no whole number in range."""
    if seed is not None and not (is_whole(seed) and 0 <= seed < 2**63):
        raise ValueError(f"seed must be a whole number from 0 to 2**63 - 1, not {seed!r}")
    return None if seed is None else int(seed)


def is_whole(value: Any) -> bool:
    """Whether a value is a whole number, of Python or of numpy."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)
