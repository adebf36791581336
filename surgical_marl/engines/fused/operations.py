"""The kinds of values, the operations on them, and what each operation does to constants."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np

KINDS = {"float32": "f", "int32": "i", "uint32": "u", "bool": "b"}
DTYPES = {kind: np.dtype(name).type for name, kind in KINDS.items()}
KIND_OF = {np.dtype(name): kind for name, kind in KINDS.items()}
"""By dtype: a dtype's name is written anew, in Python, each time it is asked for."""

COMMUTATIVE = {"add", "mul", "min", "max", "and", "or", "xor", "eq", "ne"}


def _divide(a: Any, b: Any) -> Any:
    return np.divide(a, b) if a.dtype.kind == "f" else np.trunc(np.divide(a, b, dtype=np.float64)).astype(a.dtype)


FOLD: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": _divide, "neg": np.negative, "abs": np.abs,
    "sqrt": np.sqrt, "floor": np.floor, "ceil": np.ceil, "rint": np.rint, "rem": np.fmod, "pow": np.power,
    "log": np.log, "tan": np.tan, "acos": np.arccos, "asin": np.arcsin, "atan2": np.arctan2, "tanh": np.tanh,
    "max": np.maximum, "min": np.minimum, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal, "and": np.bitwise_and, "or": np.bitwise_or,
    "xor": np.bitwise_xor, "not": np.bitwise_not, "shl": np.left_shift, "shr": np.right_shift,
    "sar": np.right_shift, "isfinite": np.isfinite, "f2i": lambda a: a.astype(np.int32),
    "i2f": lambda a: a.astype(np.float32), "u2f": lambda a: a.astype(np.float32),
    "f2u": lambda a: a.astype(np.uint32), "i2u": lambda a: a.astype(np.uint32), "u2i": lambda a: a.astype(np.int32),
    "bits": lambda a: a.view(np.uint32), "float": lambda a: a.view(np.float32),
}  # fmt: skip
"""Operations on constants, for folding: by numpy, in the operands' own type."""

RESULT = {name: "b" for name in ("lt", "le", "gt", "ge", "eq", "ne", "isfinite")} | {
    "f2i": "i", "u2i": "i", "i2f": "f", "u2f": "f", "float": "f", "f2u": "u", "i2u": "u", "bits": "u",
}  # fmt: skip


def combined_bounds(op: str, bounds: list[tuple[int, int]]) -> tuple[int, int] | None:
    """Return the least and the greatest result of a sum, a difference or a product of int32 within bounds.

    Return None if it may overflow.
    """
    corners = [int(FOLD[op](*np.array(corner, np.int64))) for corner in product(*bounds)]
    low, high = min(corners), max(corners)
    return (low, high) if low >= -(2**31) and high < 2**31 else None
