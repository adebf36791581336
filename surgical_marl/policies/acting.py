"""The interface of a policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Policy = Callable[[Mapping[str, Any]], dict[str, Any]]
"""Maps the observations of all agents to their actions. A recurrent policy has a method `reset` (see `forget`), and one
that draws random numbers a method `seed`, which takes whole numbers and begins them anew."""


def forget(policy: Callable[..., Any], ended: Any = None) -> None:
    """Reset a policy's hidden state: in all environments, or where an episode has `ended`, [N] bool.

    For a policy without a hidden state this does nothing.
    """
    reset = getattr(policy, "reset", None)
    if reset is not None:
        reset(ended)
