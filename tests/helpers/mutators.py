"""Files of the kinds that are loaded as trees of lists, mappings and plain values, and random changes of such trees.

A kind has `parse`, which raises any error for a file of another kind, and `write`, which also writes files that lie: an
array that says it has other numbers than it has, two parts of the same name, a count that is wrong.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import random
import struct
import zipfile
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, tostring

import numpy as np
import torch
import yaml
from defusedxml.ElementTree import fromstring

from surgical_marl.yaml_file import parse_yaml

EDGES: list[Any] = [
    *(0, -1, 1, 2, 10**5, 2**31, 2**63, 10**400, 1e300, -1e300, 1e-300, 1e9, 1e-12, -0.0, 0.5, 1000.1),
    *(float("nan"), float("inf"), -float("inf"), True, False, None, [], {}, [[]], [1, 2, 3], [0, 0, 0], {"a": 1}),
    *("", "1e5", "~x", "a" * 300, "\0", "\n", "\x1b[31m", "..", "../..", "/dev/zero", "/etc/passwd", "psm", "world"),
    *("0 0 0", "1e300 0 0", "nan", "-1", "<b>", "{0}", "%s", "$\\frac{", "\ud800", "\u202e", "a b", "=1+1", "file:///"),
]
MOST = 4000
"""Places of a tree that are looked at."""
MOST_NUMBERS = 1_000_000
"""Numbers of an array that is written."""


class Kind(NamedTuple):
    """How files of a kind are read into a tree and written again."""

    parse: Callable[[bytes], Any]
    write: Callable[[Any], bytes]


def mutated(kind: str, data: bytes, rng: random.Random, words: list[Any]) -> bytes:
    """Return a file with some random changes of its tree; raises if it has none."""
    tree = KINDS[kind].parse(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        tree = _changed(tree, rng, words)
    return KINDS[kind].write(tree)


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return a file that may end early, with other bytes in some places."""
    copy = bytearray(data)
    for _ in range(rng.randrange(4)):
        start = rng.randrange(len(data))
        copy[start : start + rng.randint(1, 8)] = rng.randbytes(rng.randint(1, 8))
    return bytes(copy[: rng.choice((len(copy), rng.randrange(len(copy) + 1)))])


def changed(kinds: Sequence[str], data: bytes, rng: random.Random, words: list[Any]) -> bytes:
    """Return a file with random changes: of its tree in most cases, or else of its bytes."""
    if rng.random() < 0.75:
        with contextlib.suppress(Exception):  # a tree that is not of this kind, or that nothing writes
            return mutated(rng.choice(kinds), data, rng, words)
    return damaged(data, rng)


def words_of(kinds: Sequence[str], files: Sequence[bytes]) -> list[Any]:
    """Return all keys and leaves of files, for use in others."""
    words: list[Any] = []
    for data, kind in product(files, kinds):
        with contextlib.suppress(Exception):  # a file of another kind
            words += _parts(KINDS[kind].parse(data))
    return words


def _parts(tree: Any) -> list[Any]:
    found = [key for path in places(tree) for key in path[-1:] if isinstance(key, str)]
    return found + [value for path in places(tree) if not isinstance(value := _at(tree, path), (dict, list))]


def places(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of a tree's values, at most so many."""
    found, waiting = [path], [(path, tree)]
    while waiting and len(found) < MOST:
        path, value = waiting.pop()
        for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
            found.append((*path, key))
            waiting.append(((*path, key), value[key]))
    return found


def _at(tree: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        tree = tree[key]
    return tree


def _changed(tree: Any, rng: random.Random, words: list[Any]) -> Any:
    """Return a tree with one change."""
    path = rng.choice(places(tree))
    return _with(tree, path, lambda old: _other(old, tree, rng, words))


def _with(tree: Any, path: tuple[Any, ...], change: Callable[[Any], Any]) -> Any:
    if not path:
        return change(tree)
    copy = dict(tree) if isinstance(tree, dict) else list(tree)
    copy[path[0]] = _with(tree[path[0]], path[1:], change)
    return copy


def _other(old: Any, tree: Any, rng: random.Random, words: list[Any]) -> Any:
    """Return what stands in the place of a value."""
    way = rng.random()
    if isinstance(old, (dict, list)) and way < 0.7:
        return _regrouped(old, rng, words)
    if isinstance(old, (int, float)) and not isinstance(old, bool) and way < 0.5:
        return _number(old, rng)
    if isinstance(old, str) and way < 0.4:
        return _text(old, rng, words)
    if way < 0.6 and words:
        return rng.choice(words)
    if way < 0.75:
        return _at(tree, rng.choice(places(tree)))
    if way < 0.8:
        return [old] if rng.random() < 0.5 else {str(old)[:20]: old}
    return rng.choice(EDGES)


def _regrouped(old: Any, rng: random.Random, words: list[Any]) -> Any:
    """Return a list or a mapping with something more, less or elsewhere."""
    items = list(old.items()) if isinstance(old, dict) else list(old)
    way, at = rng.random(), rng.randrange(len(items) + 1)
    inside = rng.choice(items) if items else 0
    if way < 0.3 and items:
        items.pop(rng.randrange(len(items)))
    elif way < 0.5 and isinstance(old, list):
        items.insert(at, inside)
    elif way < 0.6 and items and isinstance(old, list):
        items = items * rng.choice((2, 10, 100)) if len(places(old)) < 1000 else items[:3]
    elif way < 0.7:
        rng.shuffle(items)
    elif isinstance(old, dict):
        name = rng.choice([*map(str, words), "a", "a" * 100]) if words else "a"
        value = inside[1] if items and rng.random() < 0.5 else rng.choice(EDGES)
        if items and rng.random() < 0.5:
            items[rng.randrange(len(items))] = (name, value)
        else:
            items += [(f"{name}{k}" if k else name, value) for k in range(rng.choice((1, 1, 1, 40)))]
    else:
        items.insert(at, rng.choice(EDGES))
    return dict(items) if isinstance(old, dict) else items


def _number(old: float, rng: random.Random) -> Any:
    try:
        return rng.choice((old + 1, old - 1, -old, old * 10.0 ** rng.randint(-12, 12), old * 1.5, int(old), str(old)))
    except (OverflowError, ValueError):
        return 0


def _text(old: str, rng: random.Random, words: list[Any]) -> str:
    at = rng.randrange(len(old) + 1)
    new = rng.choice(
        (*map(str, rng.sample(words, min(3, len(words)))), "\0", " ", "-", "9" * 20, "é", "\n", "../", "<")
    )
    return rng.choice((old[:at] + new + old[at:], old[:at], old[at:], old * 3, old.upper(), new))


def _yaml_text(tree: Any) -> bytes:
    return yaml.safe_dump(tree, allow_unicode=True, width=10**9, sort_keys=False).encode("utf-8", "surrogatepass")


def _parse_xml(data: bytes) -> Any:
    def tree(element: Element) -> list[Any]:
        return [element.tag, dict(element.attrib), element.text or "", *map(tree, element)]

    return tree(fromstring(data))


def _write_xml(tree: Any) -> bytes:
    def element(of: Any) -> Element:
        tag, attributes, text = (*of[:3], {}, "")[:3] if isinstance(of, list) and of else (str(of), {}, "")
        made = Element(
            _name(tag), {_name(k): str(v) for k, v in attributes.items()} if isinstance(attributes, dict) else {}
        )
        made.text = str(text)
        made.extend(map(element, of[3:] if isinstance(of, list) else []))
        return made

    return tostring(element(tree), "utf-8").replace(b"\0", b"")


def _name(value: Any) -> str:
    return "".join(letter if letter.isalnum() or letter in "_-.:" else "_" for letter in str(value)) or "a"


def _parse_npz(data: bytes) -> Any:
    found: dict[str, Any] = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for info in archive.infolist()[:200]:
            array = np.lib.format.read_array(io.BytesIO(archive.read(info)), allow_pickle=False, max_header_size=10_000)
            if array.dtype.kind == "U" and not array.shape:
                found[info.filename] = json.loads(str(array))
            else:
                found[info.filename] = [array.dtype.str, list(array.shape), array.ravel()[:500].tolist()]
    return found


def _write_npz(tree: Any) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in tree.items():
            archive.writestr(_entry(name), _npy(value))
    return packed.getvalue()


def _npy(value: Any) -> bytes:
    if not (isinstance(value, list) and len(value) == 3):
        file = io.BytesIO()
        np.lib.format.write_array(file, np.array(json.dumps(value)), allow_pickle=False)
        return file.getvalue()
    kind, shape, numbers = value
    try:
        assert np.dtype(kind).itemsize <= 64
        data = _filled(np.array(numbers).astype(kind), shape).tobytes()
    except Exception:  # what it says is no array: it stays, over other data
        data = b"\0" * 64
    shown = f"({''.join(f'{size!r},' for size in shape)})" if isinstance(shape, list) else repr(shape)
    about = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shown}}}\n".encode("utf-8", "replace")[:60_000]
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(about)) + about + data


def _filled(numbers: np.ndarray, shape: Any) -> np.ndarray:
    """Return an array of a shape, unless that is larger than what is worth to try."""
    if math.prod(shape) > MOST_NUMBERS:
        raise ValueError(shape)
    return np.resize(numbers, shape)


def _entry(name: Any) -> str:
    return str(name).encode("utf-8", "replace").decode()[:1000] or "a"


def _parse_zip(data: bytes) -> Any:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return [[i.filename, i.compress_type, archive.read(i).decode("latin1")] for i in archive.infolist()]


def _write_zip(tree: Any) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, way, data in tree:
            kind = zipfile.ZIP_DEFLATED if way else zipfile.ZIP_STORED
            archive.writestr(_entry(name), str(data).encode("latin1", "replace"), kind)
    return packed.getvalue()


def _parse_checkpoint(data: bytes) -> Any:
    def tree(value: Any) -> Any:
        if isinstance(value, torch.Tensor):
            assert value.numel() <= MOST_NUMBERS  # it may repeat the few that the file holds
            return {"~": [str(value.dtype), list(value.shape), value.flatten()[:200].tolist()]}
        if isinstance(value, dict):
            return {key: tree(part) for key, part in value.items()}
        return [tree(part) for part in value] if isinstance(value, (list, tuple)) else value

    return tree(torch.load(io.BytesIO(data), weights_only=True))


def _write_checkpoint(tree: Any) -> bytes:
    def value(of: Any) -> Any:
        if isinstance(of, dict) and "~" in of:
            try:
                kind, shape, numbers = of["~"]
                made = _filled(np.array(numbers, float), shape)
                return torch.from_numpy(made).to(getattr(torch, kind.removeprefix("torch.")))
            except Exception:
                return of
        if isinstance(of, dict):
            return {key: value(part) for key, part in of.items()}
        return [value(part) for part in of] if isinstance(of, list) else of

    file = io.BytesIO()
    torch.save(value(tree), file)
    return file.getvalue()


def _parse_weights(data: bytes) -> Any:
    length = int.from_bytes(data[:8], "little")
    return [length, json.loads(data[8 : 8 + length]), data[8 + length :].decode("latin1")]


def _write_weights(tree: Any) -> bytes:
    length, header, data = tree
    about = json.dumps(header).encode()
    same = isinstance(length, int) and 0 <= length < 2**63 and length % 8 != 0
    return struct.pack("<Q", length if same else len(about)) + about + str(data).encode("latin1", "replace")


def _parse_stl(data: bytes) -> Any:
    count = int.from_bytes(data[80:84], "little")
    rows = [list(struct.unpack("<12fH", data[84 + 50 * k : 134 + 50 * k])) for k in range((len(data) - 84) // 50)]
    return [data[:80].decode("latin1"), count, rows]


def _write_stl(tree: Any) -> bytes:
    head, count, rows = tree
    data = b""
    for row in rows if isinstance(rows, list) else []:
        numbers = np.nan_to_num(np.array([_real(value) for value in (row if isinstance(row, list) else [row])]))
        data += np.resize(numbers, 12).astype("<f4").tobytes() + b"\0\0"
    right = not isinstance(count, int) or not 0 <= count < 2**32 or count % 7
    return (
        str(head).encode("latin1", "replace").ljust(80)[:80] + struct.pack("<I", len(rows) if right else count) + data
    )


def _real(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return 1e38


def _separated(mark: str) -> Kind:
    def write(tree: Any) -> bytes:
        lines = (mark.join(map(str, line)) if isinstance(line, list) else str(line) for line in tree)
        return "\n".join(lines).encode("utf-8", "surrogatepass")

    return Kind(lambda data: [line.split(mark) for line in data.decode().split("\n")], write)


KINDS: dict[str, Kind] = {
    "yaml": Kind(lambda data: parse_yaml(data.decode()), _yaml_text),
    "json": Kind(json.loads, lambda tree: json.dumps(tree).encode()),
    "xml": Kind(_parse_xml, _write_xml),
    "npz": Kind(_parse_npz, _write_npz),
    "zip": Kind(_parse_zip, _write_zip),
    "checkpoint": Kind(_parse_checkpoint, _write_checkpoint),
    "weights": Kind(_parse_weights, _write_weights),
    "stl": Kind(_parse_stl, _write_stl),
    "csv": _separated(","),
    "words": _separated(" "),
}
