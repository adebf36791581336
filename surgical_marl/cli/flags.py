"""Flags of commands, made from the fields of a dataclass: each field that has a text for `--help` is a flag."""

from __future__ import annotations

import argparse
import types
from collections.abc import Callable, Collection, Sequence
from dataclasses import fields
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from surgical_marl.content import unknown
from surgical_marl.plugins.adapters import list_adapters
from surgical_marl.plugins.tasks import list_tasks


def flagged(of: type) -> list[str]:
    """Return the names of a dataclass's fields that are flags."""
    return [item.name for item in fields(of) if item.metadata.get("help")]


def add_flags(
    parser: argparse.ArgumentParser, of: type, only: Collection[str] | None = None, default: str = ""
) -> None:
    """Add a flag for each field of a dataclass that has a text for `--help`.

    A flag that is not given is None.

    Args:
        parser: of a command.
        of: the dataclass. Choices and ranges of a flag are those of its field.
        only: names of the fields; all of `flagged(of)` if None.
        default: a text for `--help` on what is taken where a flag is not given.
    """
    hints = get_type_hints(of)
    for item in fields(of):
        if item.name not in (flagged(of) if only is None else only):
            continue
        check, metavar = _reader(hints[item.name], item.metadata.get("range"))
        if names := item.metadata.get("names"):
            check, metavar = one_of(names()), "|".join(names())
        text = item.metadata["help"] + (f" (default: {default})" if default else "")
        parser.add_argument(f"--{item.name.replace('_', '-')}", type=check, metavar=metavar, help=text)


def given(arguments: argparse.Namespace, of: type) -> dict[str, Any]:
    """Return the values of the flags of a dataclass that were given, by the names of its fields."""
    values = {name: getattr(arguments, name, None) for name in flagged(of)}
    return {name: value for name, value in values.items() if value is not None}


def task_help() -> str:
    """Return the text for `--help` of a flag or an argument that names a task."""
    return f"one of: {', '.join(list_tasks())}; or a task file, my_task.py or my_task.py:Class"


def adapted_help() -> str:
    """Return the text for `--help` of a flag or an argument that names a policy, on those of other libraries."""
    return f"{' or '.join(f'{name}:PLACE' for name in list_adapters())} (docs/your_own_policy.md)"


def _reader(kind: Any, limits: tuple[int, int] | None) -> tuple[Callable[[str], Any], str]:
    """Return a reader for the text of a flag, and its placeholder."""
    if get_origin(kind) in (Union, types.UnionType):
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        return one_of(get_args(kind)), "|".join(get_args(kind))
    if kind is int:
        return whole(*(limits or (0,))), "N"
    return str, "NAME"


def one_of(good: Sequence[str]) -> Callable[[str], str]:
    """Return a reader, for `add_argument(type=...)`, of one of some names."""

    def check(text: str) -> str:
        if text not in good:
            raise argparse.ArgumentTypeError(str(unknown("choice", text, good)))
        return text

    return check


def some_of(good: Sequence[str]) -> Callable[[str], tuple[str, ...]]:
    """Return a reader, for `add_argument(type=...)`, of one or more of some names, with commas between them."""
    check = one_of(good)
    return lambda text: tuple(dict.fromkeys(check(name) for name in text.split(",")))


def whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """Return a reader, for `add_argument(type=...)`, of a whole number from `least` to `most`."""
    good = f"of {least} or more" if most is None else f"from {least} to {most}"

    def check(text: str) -> int:
        if not text.isdecimal() or int(text) < least or (most is not None and int(text) > most):
            raise argparse.ArgumentTypeError(f"must be a whole number {good}, not {text!r}")
        return int(text)

    return check
