"""Finds adapters of other libraries' policies by name; no other module does.

Such a policy is named `SCHEME:PLACE`, as in `onnx:act.onnx,rate=25,actions=joint`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from typing import NamedTuple

from surgical_marl.content import unknown
from surgical_marl.plugins.registry import Registry

ADAPTERS = Registry(
    "policy adapter",
    package="surgical_marl.policies.adapters",
    group="surgical_marl.policies",
    base="surgical_marl.policies.adapter:PolicyAdapter",
)

COMMON = ("rate", "actions", "horizon")
"""Settings that go before what any adapter says itself."""
_NAME = re.compile(r"([A-Za-z_][\w-]+):(.*)", re.DOTALL)  # two letters or more: C: is a drive
_SETTING = re.compile(r"(.*),(\w+)=([^,]*)", re.DOTALL)


class AdaptedName(NamedTuple):
    """A policy of another library as it is named."""

    scheme: str
    place: str
    settings: Mapping[str, str]


def is_adapted(policy: object) -> bool:
    """Return whether a policy is named by an adapter, such as "onnx:act.onnx"."""
    return isinstance(policy, str) and _NAME.fullmatch(policy) is not None


def read_adapted(policy: str) -> AdaptedName:
    """Take a name apart.

    Raises:
        ValueError: there is no such adapter, it takes no such setting, a setting is named twice, or no place is named.
    """
    match = _NAME.fullmatch(policy)
    assert match is not None, policy
    scheme, place = match.groups()
    settings: dict[str, str] = {}
    while found := _SETTING.fullmatch(place):
        place, key, value = found.groups()
        if key in settings:
            raise ValueError(f"{policy!r} names {key!r} twice")
        settings[key] = value
    own = list(inspect.signature(ADAPTERS.load(scheme)).parameters)[1:]
    for key in settings:
        if key not in (*COMMON, *own):
            raise unknown(f"setting of {scheme}:", key, [*COMMON, *own])
    if not place:
        raise ValueError(f"{policy!r} names no place: write {scheme}:PLACE")
    return AdaptedName(scheme, place, settings)


def list_adapters() -> list[str]:
    """Return the names of all adapters: shipped, of installed packages, and registered."""
    return ADAPTERS.names()


def register_adapter(name: str, cls: type) -> None:
    """Make a subclass of `surgical_marl.policies.adapter.PolicyAdapter` known by a name, in this program.

    A package declares its adapters in the entry-point group `surgical_marl.policies` instead
    (docs/your_own_policy.md).

    Raises:
        ValueError: the name belongs to another class, or the class is not a subclass of `PolicyAdapter`.
    """
    ADAPTERS.register(name, cls)
