"""YAML files that people write: YAML 1.2, of limited size and depth, with the line of each value.

PyYAML's scanner, in C where it is compiled, splits a text into events, and this module makes values of them. PyYAML's
own values are those of YAML 1.1, where 010 is 8, 1:30 is 90, 1e-3 is a text, `no` is false, and a key given twice loses
one of its values. Libraries in Python that read YAML 1.2 take five times as long.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, TypeVar

import yaml

from surgical_marl.untrusted.files import MB, read_text
from surgical_marl.untrusted.schema import Place, check
from surgical_marl.untrusted.values import shown

MAX_YAML = MB
"""Bytes of a file."""
MAX_NODES, MAX_DEPTH = 50_000, 32
"""Values, lists and mappings in a file, and how deeply they are nested."""
MAX_KEY, MAX_NUMBER = 200, 100
"""Characters of a key, and of a number: whole numbers take more than linear time."""

T = TypeVar("T")
_WORDS: dict[str, Any] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
    **{f"{sign}{word}": float(f"{sign}inf") for sign in ("", "+", "-") for word in (".inf", ".Inf", ".INF")},
}
_WHOLE = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_REAL = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_BASES = {"0o": 8, "0x": 16}
_UNPRINTABLE = yaml.reader.Reader.NON_PRINTABLE
_Events = yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader


class YamlMapping(dict[str, Any]):
    """A mapping of a file, with the line of each key in `lines`."""

    def __init__(self) -> None:
        self.lines: dict[str, int] = {}


class YamlList(list[Any]):
    """A list of a file, with the line of each part in `lines`, by its index."""

    def __init__(self) -> None:
        self.lines: dict[int, int] = {}


class Malformed(ValueError):
    """A text that is not YAML, or more of it than is read; `line` is 0 if the whole text is meant."""

    def __init__(self, line: int, what: str) -> None:
        super().__init__(f"line {line}: {what}" if line else what)
        self.line, self.what = line, what


def parse_yaml(text: str) -> Any:
    """Return the value of a YAML text, mappings as `YamlMapping` and lists as `YamlList`.

    Raises:
        Malformed: it does not parse, has aliases, tags or a key twice, or is too large.
    """
    if len(text) > MAX_YAML:
        raise Malformed(0, f"it has {len(text):,} characters, more than {MAX_YAML:,}")
    try:
        return _Reader(text).document()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = ": ".join(" ".join(part.split()) for part in (error.context, error.problem) if part)
        raise Malformed(mark.line + 1 if mark else 0, what[:500]) from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, bad.start()) + 1 if (bad := _UNPRINTABLE.search(text)) else 0
        raise Malformed(line, f"{chr(error.character)!a} is a character that no text has") from None
    except UnicodeEncodeError:
        raise Malformed(0, "it holds a character that is no text in UTF-8") from None


def load_yaml(path: Path) -> Any:
    """Return the value of a YAML file.

    Raises:
        ValueError: it cannot be read, or is `Malformed`; the error has the file and the line.
    """
    text = read_text(path, MAX_YAML)
    try:
        return parse_yaml(text)
    except Malformed as error:
        line = f", line {error.line}" if error.line else ""
        raise ValueError(f"{path}{line} is not valid YAML: {error.what}") from None


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping that a YAML file holds.

    Raises:
        ValueError: as of `load_yaml`, or the file holds no mapping.
    """
    content = load_yaml(path)
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a YAML mapping, not {shown(content)}")
    return content


def read_as(kind: type[T], path: Path) -> T:
    """Return the content of a YAML file as a dataclass (see `surgical_marl.untrusted.schema`).

    Raises:
        ValueError: it cannot be read, or is not YAML.
        Faults: it lacks a key, has an unknown one, or a value of a wrong type or out of bounds.
    """
    found: T = check(Place(file=path), load_yaml(path), kind)
    return found


def merged(base: Any, patch: YamlMapping) -> YamlMapping:
    """Return a mapping of a file, changed by a merge patch (RFC 7396) of the same file; keys keep their lines.

    A value of the patch takes the place of the base's, a mapping changes a mapping key by key, and null removes a key.
    """
    found = YamlMapping()
    if isinstance(base, YamlMapping):
        found.update(base)
        found.lines.update(base.lines)
    for key, value in patch.items():
        if value is None:
            found.pop(key, None)
            found.lines.pop(key, None)
        else:
            found[key] = merged(found.get(key), value) if isinstance(value, YamlMapping) else value
            found.lines[key] = patch.lines[key]
    return found


def dump_yaml(value: Any, flow: bool = False) -> str:
    """Return a text that `parse_yaml` reads as this value, keys in their order; with `flow` on one line."""
    text: str = yaml.dump(value, Dumper=_Dumper, sort_keys=False, default_flow_style=flow, width=10**9)
    return text.removesuffix("...\n").strip() if flow else text


class _Dumper(yaml.SafeDumper):
    """PyYAML's safe dumper, with quotes around texts that are numbers in YAML 1.2 too."""


for _tag, _pattern in (("int", _WHOLE), ("float", _REAL)):
    _Dumper.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern.pattern})$"), list("-+.0123456789")
    )
for _kind, _represent in ((dict, yaml.SafeDumper.represent_dict), (list, yaml.SafeDumper.represent_list)):
    _Dumper.add_multi_representer(_kind, _represent)


class _Reader:
    """Makes values of the events of a text."""

    def __init__(self, text: str) -> None:
        self._events = _Events(text)
        self._nodes = 0

    def document(self) -> Any:
        """Return the value of the only document; None if there is none."""
        self._events.get_event()  # the start of the stream
        if self._events.check_event(yaml.StreamEndEvent):
            return None
        self._events.get_event()  # the start of the document
        value = self._value(self._events.get_event(), depth=0)
        self._events.get_event()  # its end
        if not self._events.check_event(yaml.StreamEndEvent):
            line = self._events.peek_event().start_mark.line + 1
            raise Malformed(line, "a second document begins; a file holds one")
        return value

    def _value(self, event: yaml.Event, depth: int) -> Any:
        line = event.start_mark.line + 1
        self._check(event, line, depth)
        if isinstance(event, yaml.ScalarEvent):
            return _scalar(event.value, line) if event.implicit[0] else event.value
        return self._mapping(depth) if isinstance(event, yaml.MappingStartEvent) else self._sequence(depth)

    def _check(self, event: yaml.Event, line: int, depth: int) -> None:
        """Raise Malformed for aliases and tags, and for too many values or too deep ones."""
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise Malformed(line, f"more than {MAX_NODES:,} values are not read")
        if depth >= MAX_DEPTH:
            raise Malformed(line, f"lists and mappings are nested deeper than {MAX_DEPTH}")
        if isinstance(event, yaml.AliasEvent):
            raise Malformed(line, "an alias (*name) can stand for more than fits in memory; write the value out")
        if event.tag is not None:
            raise Malformed(line, f"the tag {shown(event.tag)} is not read; leave it out")

    def _sequence(self, depth: int) -> YamlList:
        items = YamlList()
        while not isinstance(event := self._events.get_event(), yaml.SequenceEndEvent):
            items.lines[len(items)] = event.start_mark.line + 1
            items.append(self._value(event, depth + 1))
        return items

    def _mapping(self, depth: int) -> YamlMapping:
        mapping = YamlMapping()
        while not isinstance(event := self._events.get_event(), yaml.MappingEndEvent):
            key, line = self._key(event, depth + 1), event.start_mark.line + 1
            if key in mapping:
                raise Malformed(line, f"the key {shown(key)} is given twice, first in line {mapping.lines[key]}")
            mapping[key], mapping.lines[key] = self._value(self._events.get_event(), depth + 1), line
        return mapping

    def _key(self, event: yaml.Event, depth: int) -> str:
        """Return a key as it is written: keys are names, also those that look like a number."""
        line = event.start_mark.line + 1
        self._check(event, line, depth)
        if not isinstance(event, yaml.ScalarEvent) or not event.value:
            raise Malformed(line, "a key must be a text")
        key: str = event.value
        if len(key) > MAX_KEY:
            raise Malformed(line, f"the key {shown(key)} has {len(key):,} characters, more than {MAX_KEY}")
        return key


def _scalar(text: str, line: int) -> Any:
    """Return the value of a plain scalar, by the core schema of YAML 1.2."""
    if text in _WORDS:
        return _WORDS[text]
    if text[0] not in "-+.0123456789":
        return text
    whole = _WHOLE.fullmatch(text)
    if not whole and not _REAL.fullmatch(text):
        return text
    if len(text) > MAX_NUMBER:
        raise Malformed(line, f"the number {shown(text)} has {len(text):,} characters; write at most {MAX_NUMBER}")
    return int(text, _BASES.get(text[:2], 10)) if whole else float(text)
