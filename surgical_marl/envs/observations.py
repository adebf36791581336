"""Observations: one array each, or a dict of arrays where `surgical_marl/envs/pictures.py` adds pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def each(tree: Any, change: Callable[[Any], Any]) -> Any:
    """The same with all of its arrays changed."""
    return {name: change(value) for name, value in tree.items()} if isinstance(tree, dict) else change(tree)


def proprioception(tree: Any) -> Any:
    """What it holds besides pictures: the one array."""
    return tree["proprioception"] if isinstance(tree, dict) else tree
