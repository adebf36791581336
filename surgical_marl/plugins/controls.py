"""Finds controls by name; no other module does."""

from __future__ import annotations

from surgical_marl.plugins.registry import Registry

CONTROLS = Registry(
    "control",
    package="surgical_marl.control.terms",
    group="surgical_marl.controls",
    base="surgical_marl.control.action_term:ActionTerm",
)


def list_controls() -> list[str]:
    """Return the names of all controls: shipped, of installed packages, and registered."""
    return CONTROLS.names()


def register_control(name: str, cls: type) -> None:
    """Make a subclass of `surgical_marl.control.action_term.ActionTerm` known by a name, in this program.

    A package declares its controls in the entry-point group `surgical_marl.controls` instead (docs/control.md).

    Raises:
        ValueError: the name belongs to another class, or the class is not a subclass of `ActionTerm`.
    """
    CONTROLS.register(name, cls)
