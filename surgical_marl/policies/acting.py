"""What a policy is to those who play it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Policy = Callable[[Mapping[str, Any]], dict[str, Any]]
"""Maps the observations of all agents to their actions. One that remembers has a method `reset` (see `forget`)."""


def forget(policy: Callable[..., Any], ended: Any = None) -> None:
    """Tell a policy that episodes begin: in all environments, or where the last one `ended`, [N] bool.

    A policy that remembers nothing does not mind.
    """
    reset = getattr(policy, "reset", None)
    if reset is not None:
        reset(ended)
