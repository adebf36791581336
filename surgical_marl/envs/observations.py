"""Observations: one array each, or a dict of arrays where `surgical_marl/envs/sight.py` adds pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def each(tree: Any, change: Callable[[Any], Any]) -> Any:
    """Return the same observations, with `change` applied to each array."""
    return {name: change(value) for name, value in tree.items()} if isinstance(tree, dict) else change(tree)


def proprioception(tree: Any) -> Any:
    """Return the one array that observations hold besides pictures."""
    return tree["proprioception"] if isinstance(tree, dict) else tree
