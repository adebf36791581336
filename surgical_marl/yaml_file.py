"""YAML files that people write: one mapping with known keys and finite numbers."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from yaml.composer import Composer

from surgical_marl.untrusted.files import MB, read_text
from surgical_marl.untrusted.values import LARGEST, LONGEST, as_number, listed, shown

MAX_YAML = MB
"""Bytes of a file."""
MAX_NODES, MAX_DEPTH = 50_000, 32
"""Values, lists and mappings in a file, and how deeply they are nested."""
MAX_KEY, MAX_NUMBER = 200, 100
"""Characters of a key, and of a number: whole numbers and numbers with colons take more than linear time."""

# The scanner in C, where PyYAML has it, reads a file in a sixth of the time. Nodes are composed in Python: in C, deeply
# nested brackets crash the process.
_BASES = (Composer, yaml.CSafeLoader) if yaml.__with_libyaml__ else (yaml.SafeLoader,)


class _Loader(*_BASES):  # type: ignore[misc]
    """PyYAML's safe loader without aliases, tags and dates, for texts of limited size."""

    def __init__(self, text: str) -> None:
        Composer.__init__(self)
        _BASES[-1].__init__(self, text)
        self._nodes = self._depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise ValueError("an alias (*name) can stand for more than fits in memory; write the value out")
        event = self.peek_event()
        line = f"line {event.start_mark.line + 1}"
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise ValueError(f"{line}: more than {MAX_NODES:,} values are not read")
        if self._depth == MAX_DEPTH:
            raise ValueError(f"{line}: lists and mappings are nested deeper than {MAX_DEPTH}")
        if getattr(event, "tag", None) is not None:
            raise ValueError(f"{line}: the tag {shown(event.tag)} is not read; leave it out")
        self._depth += 1
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(node, yaml.ScalarNode):
            _check_scalar(node, line, is_key=isinstance(parent, yaml.MappingNode) and index is None)
        return node


def _check_scalar(node: yaml.ScalarNode, line: str, is_key: bool) -> None:
    """Raise ValueError for a key or a number that is too long."""
    kind = node.tag.rpartition(":")[2]
    if is_key and len(node.value) > MAX_KEY:
        raise ValueError(f"{line}: the key {shown(node.value)} has {len(node.value):,} characters, more than {MAX_KEY}")
    if kind in ("int", "float") and len(node.value) > MAX_NUMBER:
        raise ValueError(
            f"{line}: the number {shown(node.value)} has {len(node.value):,} characters; write at most {MAX_NUMBER}"
        )
    if kind == "timestamp":
        node.tag = "tag:yaml.org,2002:str"


def parse_yaml(text: str) -> Any:
    """Return what a YAML text holds.

    Raises:
        ValueError: it does not parse (the error has the line), has aliases or tags, or is too large.
    """
    if len(text) > MAX_YAML:
        raise ValueError(f"it has {len(text):,} characters, more than {MAX_YAML:,}")
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())[:500]) from None


def load_yaml(path: Path) -> Any:
    """Return what a YAML file holds; ValueError if it cannot be read, or does not parse (the error has the line)."""
    text = read_text(path, MAX_YAML)
    try:
        return parse_yaml(text)
    except ValueError as error:
        raise ValueError(f"{path} is not valid YAML: {error}") from None


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML mapping from a file.

    Raises:
        ValueError: as of `load_yaml`, or the file holds no mapping.
    """
    content = load_yaml(path)
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a YAML mapping, not {type(content).__name__}")
    return content


def check_keys(mapping: dict[str, Any], known: tuple[str, ...], where: Path | str) -> None:
    """Raise ValueError if the mapping has an unknown key."""
    for key in mapping:
        if key not in known:
            raise ValueError(f"{where}: unknown key {shown(key)}; the keys are {listed(known)}")


def build(cls: type, mapping: Any, where: Path | str) -> Any:
    """Return a dataclass of floats and strings, made from a mapping.

    Raises:
        ValueError: a key or a number is wrong or missing.
    """
    if not isinstance(mapping, dict):
        raise ValueError(f"{where}: {shown(mapping)} must be a mapping with the keys of {cls.__name__.lower()}")
    names = tuple(f.name for f in fields(cls))
    check_keys(mapping, names, where)
    values: dict[str, Any] = {}
    for key, value in mapping.items():
        if cls.__annotations__[key] == "float":
            value = read_number(value, f"{where}: {key}")
        elif cls.__annotations__[key] == "str" and not isinstance(value, str):
            raise ValueError(f"{where}: {key} must be a text, not {shown(value)}")
        values[key] = value
    try:
        return cls(**values)
    except TypeError:
        missing = [name for name in names if name not in values]
        raise ValueError(f"{where}: a {cls.__name__.lower()} lacks {', '.join(missing)}") from None


def read_number(value: Any, where: str, most: float = LARGEST) -> float:
    """Return a number that a person wrote; raise ValueError if it is none, or not from -`most` to `most`."""
    number = as_number(value)
    if not abs(number) <= most:
        raise ValueError(f"{where} must be a finite number from {-most:g} to {most:g}, not {shown(value)}")
    return number


def read_vector(value: Any, where: str, count: int = 3, words: str = "three finite numbers") -> np.ndarray:
    """Return numbers [count] that a person wrote, lengths in m or angles in degrees.

    Raises:
        ValueError: not as many, or not numbers, or not from -1000 to 1000.
    """
    given = value if isinstance(value, list | tuple) else []
    vector = np.array([as_number(part, words=True) for part in given[: count + 1]])
    if vector.shape != (count,) or not (np.abs(vector) <= LONGEST).all():
        raise ValueError(f"{where}: {shown(value)} must be {words}, each from {-LONGEST:g} to {LONGEST:g}")
    return vector


def read_mapping(value: Any, where: str) -> dict[str, Any]:
    """Return a mapping, empty for None; raise ValueError for anything else."""
    if value is not None and not isinstance(value, dict):
        raise ValueError(f"{where}: {shown(value)} must be a mapping")
    return value or {}
