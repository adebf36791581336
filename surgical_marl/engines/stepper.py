"""What an engine runs."""

from __future__ import annotations

import sys
from typing import Any, Protocol


class Stepper(Protocol):
    """One environment as pure JAX functions. An engine runs them for many, and knows nothing else of it."""

    agents: tuple[str, ...]

    @property
    def title(self) -> str:
        """What people call it, as in "reach on psm"."""

    @property
    def content(self) -> bytes:
        """All that the functions depend on besides code."""

    @property
    def roots(self) -> tuple[str, ...]:
        """Modules whose code the functions run, with all that these import."""

    def num_actions(self, agent: str) -> int: ...

    def reset(self, key: Any, episode: Any = 0) -> Any: ...

    def step(self, carry: Any, actions: dict[str, Any]) -> Any: ...


def announce(stepper: Stepper, engine: str, device: str) -> None:
    """Says on stderr why nothing happens for a while."""
    print(
        f"surgical-marl: compiling {stepper.title} ({engine}, {device}); a second start takes it from the cache",
        file=sys.stderr,
        flush=True,
    )
