"""Schemas: dataclasses whose fields say what files, calls and commands may give, by type, bounds and unit.

    @dataclass(frozen=True)
    class Camera:
        link: str
        fovy: float = number(REQUIRED, 1.0, 179.0, unit="degrees")

    camera = check(Place("camera"), {"link": "eye", "fovy": 60}, Camera)

`surgical_marl.yaml_file.read_as` reads a file as such a dataclass, and says in which line it is not one.

A key that Python reserves has a field with an underscore at its end: `from_` is the field of `from`.
"""

from __future__ import annotations

import math
import numbers
import types
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

from surgical_marl.untrusted.values import LARGEST, LONGEST, SHORTEST, as_number, check_count, listed, one_line, shown

REQUIRED: Any = MISSING
"""The default of a field that must be given."""
Vector = tuple[float, float, float]
ORIGIN: Vector = (0.0, 0.0, 0.0)
MOST_PARTS, MOST_FAULTS = 100, 100
"""Parts of a list or a mapping whose field does not say how many, and faults that are listed."""
_COUNTS = {1: "one", 2: "two", 3: "three"}
_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


def number(
    default: Any, low: float = -LARGEST, high: float = LARGEST, text: str = "", *, unit: str = "", least: int = 0
) -> Any:
    """Return a dataclass field for a number, or for a list or a mapping of numbers.

    Args:
        default: of the field, or `REQUIRED`.
        low: the smallest number, included.
        high: the largest number, included.
        text: for `--help`.
        unit: of the number, for errors.
        least: the fewest numbers of a list or a mapping.
    """
    return field(default=default, metadata={"range": (low, high), "help": text, "unit": unit, "least": least})


def lengths(default: Any = ORIGIN) -> Any:
    """Return a dataclass field for a `Vector` in m."""
    return number(default, -LONGEST, LONGEST, unit="m")


def extent() -> Any:
    """Return a dataclass field for a length in m that must be given and is not 0, or for a `Vector` of them."""
    return number(REQUIRED, SHORTEST, LONGEST, unit="m")


def angles() -> Any:
    """Return a dataclass field for a `Vector` of angles about x, then y, then z, in degrees, all 0 by default."""
    return number(ORIGIN, -LONGEST, LONGEST, unit="degrees")


def rgb(default: Any = None) -> Any:
    """Return a dataclass field for a `Vector` of red, green and blue, each from 0 to 1."""
    return number(default, 0.0, 1.0)


def choice(default: Any, text: str, names: Callable[[], Sequence[str]] | None = None) -> Any:
    """Return a dataclass field with a text for `--help`; its type, or `names`, says which values are good."""
    return field(default=default, metadata={"help": text, "names": names})


def several(noun: str, most: int, least: int = 0, empty: Any = dict) -> Any:
    """Return a dataclass field for a mapping or a list of parts.

    Args:
        noun: plural of the parts, for errors.
        most: the most parts.
        least: the fewest parts; above 0 the field is required.
        empty: the type of the default.
    """
    default: Any = {} if least else {"default_factory": empty}
    return field(**default, metadata={"noun": noun, "most": most, "least": least})


class Checked:
    """A dataclass whose values are checked against their types and ranges when it is made."""

    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        kind: Any = type(self)
        for item, hint in fields_of(kind).values():
            place = Place(self.prefix + item.name)
            object.__setattr__(self, item.name, check(place, getattr(self, item.name), hint, item.metadata))


class Faults(ValueError):
    """Everything that is wrong with a file, one sentence each in `faults`; the error's message is the first one."""

    def __init__(self, faults: Iterable[str]) -> None:
        self.faults = list(faults)[:MOST_FAULTS]
        super().__init__(self.faults[0])


@contextmanager
def collecting(faults: list[str]) -> Iterator[None]:
    """Append the sentences of a ValueError to `faults` instead of raising it."""
    try:
        yield
    except Faults as error:
        faults += error.faults
    except ValueError as error:
        faults.append(str(error))


@dataclass(frozen=True)
class Place:
    """The place of a value: "psm.yaml, line 5: arms.psm_0.turn", or only its name if it is in no file."""

    name: str = ""
    file: Path | None = None
    line: int = 0

    def part(self, key: str | int, whole: Any) -> Place:
        """Return the place of a part of the value at this place, which is `whole`."""
        line = getattr(whole, "lines", {}).get(key, self.line)
        return Place(f"{self.name}.{one_line(key, 80)}".lstrip("."), self.file, line)

    def at(self, whole: Any, *keys: str | int) -> Place:
        """Return the place of the part of `whole`, the value at this place, that the keys lead to."""
        if not keys:
            return self
        return self.part(keys[0], whole).at(whole[keys[0]], *keys[1:])

    @property
    def folder(self) -> Path:
        """The folder of the file, which paths in it are relative to."""
        return self.file.parent if self.file else Path()

    def __str__(self) -> str:
        line = f", line {self.line}" if self.line else ""
        return ": ".join(part for part in (f"{self.file}{line}" if self.file else "", self.name) if part)


def check(place: Place, value: Any, kind: Any, metadata: Mapping[str, Any] = types.MappingProxyType({})) -> Any:
    """Return a value as its type, or raise a ValueError that names its place, the good values and itself."""
    if kind is Any:  # checked by its own reader
        return value
    if get_origin(kind) in (Union, types.UnionType):
        if value is None:
            return None
        kind = get_args(kind)[0]
    origin = get_origin(kind)
    if isinstance(kind, type) and is_dataclass(kind):
        return value if isinstance(value, kind) else _dataclass(place, value, kind)
    if origin in (dict, Mapping):
        return _mapping(place, value, get_args(kind)[1], metadata)
    if origin is tuple and get_args(kind)[-1] is not Ellipsis:
        return _vector(place, value, len(get_args(kind)), metadata)
    if origin in (tuple, Sequence):
        return _list(place, value, get_args(kind)[0], metadata)
    if origin is Literal:
        if not isinstance(value, str) or value not in get_args(kind):
            raise ValueError(f"{place} must be one of {', '.join(get_args(kind))}, not {shown(value)}")
        return value
    return _scalar(place, value, kind, metadata)


def as_mapping(place: Place | str, value: Any, what: str = "settings") -> Mapping[str, Any]:
    """Return a value that must be a mapping; ValueError if it is none."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{place} must be a mapping of {what}, not {shown(value)}")
    return value


def unknown_keys(place: Place, given: Iterable[str], known: Iterable[str], faulty: Collection[str] = ()) -> list[str]:
    """Return a sentence for each key of the mapping at a place that is not one of `known`, or `faulty` already."""
    known, faults = list(known), []
    for key in given:
        if key not in known and key not in faulty:
            where = replace(place, line=place.part(key, given).line)
            faults.append(f"{where}: unknown key {shown(key)}; the keys are {listed(known)}")
    return faults


@cache
def fields_of(kind: Any) -> dict[str, tuple[Field[Any], Any]]:
    """Return the fields of a dataclass with their types, by the keys of a mapping that is read as one."""
    hints = get_type_hints(kind)
    return {item.name.rstrip("_"): (item, hints[item.name]) for item in fields(kind)}


def _dataclass(place: Place, value: Any, kind: type) -> Any:
    table = fields_of(kind)
    required = [key for key, (item, _) in table.items() if item.default is item.default_factory is MISSING]
    given = as_mapping(place, {} if value is None and not required else value, listed(table))
    values: dict[str, Any] = {}
    faults = unknown_keys(place, given, table)
    if lacking := [key for key in required if key not in given]:
        faults.append(f"{place} lacks {listed(lacking)}")
    for key in (key for key in given if key in table):
        item, hint = table[key]
        with collecting(faults):
            values[item.name] = check(place.part(key, given), given[key], hint, item.metadata)
    if faults:
        raise Faults(faults)
    try:
        return kind(**values)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from None


def _mapping(place: Place, value: Any, kind: Any, metadata: Mapping[str, Any]) -> dict[str, Any]:
    given = as_mapping(place, {} if value is None else value, f"names to {_noun(kind, metadata)}")
    return dict(zip(map(str, given), _parts(place, given, given.items(), kind, metadata), strict=True))


def _list(place: Place, value: Any, kind: Any, metadata: Mapping[str, Any]) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise ValueError(f"{place} must be a list of {_noun(kind, metadata)}, not {shown(value)}")
    return tuple(_parts(place, value, enumerate(value), kind, metadata))


def _parts(
    place: Place, whole: Any, items: Iterable[tuple[Any, Any]], kind: Any, metadata: Mapping[str, Any]
) -> list[Any]:
    """Return the parts of a list or a mapping, each checked."""
    noun, least = _noun(kind, metadata), metadata.get("least", 0)
    if len(whole) < least:
        raise ValueError(f"{place} must hold {_COUNTS[least]} or more {noun}, not {shown(whole)}")
    check_count(len(whole), metadata.get("most", MOST_PARTS), noun, place)
    found: list[Any] = []
    faults: list[str] = []
    for key, part in items:
        with collecting(faults):
            own = {name: metadata[name] for name in ("range", "unit") if name in metadata}
            found.append(check(place.part(key, whole), part, kind, own))
    if faults:
        raise Faults(faults)
    return found


def _noun(kind: Any, metadata: Mapping[str, Any]) -> str:
    """Return the plural of the parts of a list or a mapping."""
    usual = {int: "whole numbers", float: "numbers", str: "names"}
    return str(metadata.get("noun") or usual.get(kind, "lists of names"))


def _vector(place: Place, value: Any, count: int, metadata: Mapping[str, Any]) -> tuple[float, ...]:
    low, high = metadata["range"]
    parts = tuple(map(as_number, value)) if isinstance(value, (list, tuple)) else ()
    if len(parts) != count or not all(low <= part <= high for part in parts):
        words = f"{_COUNTS[count]} finite numbers, each{_bounds(metadata)}"
        raise ValueError(f"{place} must be a list of {words}, not {shown(value)}")
    return parts


def _scalar(place: Place, value: Any, kind: type, metadata: Mapping[str, Any]) -> Any:
    low, high = metadata.get("range", (-math.inf, math.inf))
    if kind is int and isinstance(value, numbers.Integral) and not isinstance(value, bool):
        value = int(value)  # numpy's whole numbers too
    if kind is float and math.isfinite(found := as_number(value)):
        value = found
    good = isinstance(value, kind) and isinstance(value, bool) == (kind is bool)
    if not good or (kind in (int, float) and not low <= value <= high):
        raise ValueError(f"{place} must be {_WORDS[kind]}{_bounds(metadata)}, not {shown(value)}")
    return value


def _bounds(metadata: Mapping[str, Any]) -> str:
    if "range" not in metadata:
        return ""
    low, high = metadata["range"]
    unit = f" ({metadata['unit']})" if metadata.get("unit") else ""
    return f" from {low:,.12g} to {high:,.12g}{unit}"
