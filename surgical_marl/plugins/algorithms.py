"""Finds learning algorithms by name; no other module does."""

from __future__ import annotations

from surgical_marl.plugins.registry import Registry

ALGORITHMS = Registry(
    "algorithm",
    package="surgical_marl.learning.algorithms",
    group="surgical_marl.algorithms",
    base="surgical_marl.learning.algorithm:Algorithm",
)


def list_algorithms() -> list[str]:
    """Return the names of all learning algorithms: shipped, of installed packages, and registered."""
    return ALGORITHMS.names()


def register_algorithm(name: str, cls: type) -> None:
    """Make a subclass of `surgical_marl.learning.algorithm.Algorithm` known by a name, in this program.

    A package declares its algorithms in the entry-point group `surgical_marl.algorithms` instead (docs/algorithms.md).

    Raises:
        ValueError: the name belongs to another class, or the class is not a subclass of `Algorithm`.
    """
    ALGORITHMS.register(name, cls)
