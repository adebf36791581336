"""Finds systems that scenes hold beside arms and rigid bodies, by name; no other module does."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from surgical_marl.plugins.registry import Registry
from surgical_marl.untrusted.schema import Place, as_mapping, check

SYSTEMS = Registry(
    "system", package=None, group="surgical_marl.systems", base="surgical_marl.physics.systems.system:System"
)

SOFT = {
    "thread": "surgical_marl.physics.systems.thread:Thread",
    "tissue": "surgical_marl.physics.systems.tissue:Tissue",
}
"""Kinds of objects that are no rigid bodies, and the systems that they are."""


def soft_kind(kind: str) -> Any:
    """Return the class of a kind of objects that are no rigid bodies."""
    module, _, name = SOFT[kind].partition(":")
    return getattr(import_module(module), name)


def list_systems() -> list[str]:
    """Return the names of all systems: of installed packages, and registered."""
    return SYSTEMS.names()


def register_system(name: str, cls: type) -> None:
    """Make a dataclass that is a subclass of `surgical_marl.physics.systems.system.System` known by a name.

    It is known in this program. A package declares its systems in the entry-point group `surgical_marl.systems`.

    Raises:
        ValueError: the name belongs to another class, or the class is not a subclass of `System`.
    """
    SYSTEMS.register(name, cls)


def read_systems(entries: Mapping[str, Any], place: Place, taken: Mapping[str, Any]) -> dict[str, Any]:
    """Return the systems of a scene file by name: each entry has a `type`, and the fields of that type's dataclass.

    Args:
        entries: of the scene file.
        place: where they are in it.
        taken: names that the scene uses for something else.

    Raises:
        ValueError: an unknown type, a name that is taken, or a bad value.
    """
    systems = {}
    for name, entry in entries.items():
        where = place.part(name, entries)
        given = dict(as_mapping(where, entry, "a type and its settings"))
        kind = given.pop("type", None)
        if name in ("arms", "rigid_bodies", "attachments", *taken):
            raise ValueError(f"{where}: the scene has something else of this name already; take another one")
        if not isinstance(kind, str):
            raise ValueError(
                f"{where} lacks its type, one of {', '.join(list_systems()) or 'none: register one first'}"
            )
        systems[name] = check(where, given, SYSTEMS.load(kind))
    return systems
