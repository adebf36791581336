"""YAML files that people write: one mapping with known keys and finite numbers."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from yaml.composer import Composer

# The scanner in C, where PyYAML has it, reads a file in a sixth of the time. Nodes are composed in Python: in C, deeply
# nested brackets crash the process.
_BASES = (Composer, yaml.CSafeLoader) if yaml.__with_libyaml__ else (yaml.SafeLoader,)


class _Loader(*_BASES):  # type: ignore[misc]
    """PyYAML's safe loader without aliases."""

    def __init__(self, text: str) -> None:
        Composer.__init__(self)
        _BASES[-1].__init__(self, text)

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise ValueError("an alias (*name) can stand for more than fits in memory; write the value out")
        return super().compose_node(parent, index)


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML mapping from a file.

    Raises:
        ValueError: the file cannot be read, does not parse (the error has the line), or holds no mapping.
    """
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from None
    try:
        content = yaml.load(text, _Loader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise ValueError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a YAML mapping, not {type(content).__name__}")
    return content


def check_keys(mapping: dict[str, Any], known: tuple[str, ...], where: Path | str) -> None:
    """Raise ValueError if the mapping has an unknown key."""
    for key in mapping:
        if key not in known:
            raise ValueError(f"{where}: unknown key {key!r}; the keys are {', '.join(known)}")


def build(cls: type, mapping: Any, where: Path | str) -> Any:
    """Return a dataclass of floats and strings, made from a mapping.

    Raises:
        ValueError: a key or a number is wrong or missing.
    """
    if not isinstance(mapping, dict):
        raise ValueError(f"{where}: {mapping!r} must be a mapping with the keys of {cls.__name__.lower()}")
    names = tuple(f.name for f in fields(cls))
    check_keys(mapping, names, where)
    values: dict[str, Any] = {}
    for key, value in mapping.items():
        if cls.__annotations__[key] == "float":
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ValueError(f"{where}: {key} must be a finite number, not {value!r}")
            value = float(value)
        values[key] = value
    try:
        return cls(**values)
    except TypeError:
        missing = [name for name in names if name not in values]
        raise ValueError(f"{where}: a {cls.__name__.lower()} lacks {', '.join(missing)}") from None


def read_vector(value: Any, where: str, count: int = 3, words: str = "three finite numbers") -> np.ndarray:
    """Return numbers [count] that a person wrote.

    Raises:
        ValueError: not as many, or not numbers, or not finite.
    """
    try:
        vector = np.array(value, dtype=float)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (count,) or not np.isfinite(vector).all():
        raise ValueError(f"{where}: {value!r} must be {words}")
    return vector


def read_mapping(value: Any, where: str) -> dict[str, Any]:
    """Return a mapping, empty for None; raise ValueError for anything else."""
    if value is not None and not isinstance(value, dict):
        raise ValueError(f"{where}: {value!r} must be a mapping")
    return value or {}
