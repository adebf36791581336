"""What an engine runs."""

from __future__ import annotations

import sys
from typing import Any, Protocol


class Stepper(Protocol):
    """One environment as pure JAX functions. An engine runs them for many, and knows nothing else of it.

    A step is `finish(move(carry, actions), sensed)`. Where nothing is to be sensed in between, `step` is both.
    """

    agents: tuple[str, ...]

    @property
    def title(self) -> str:
        """What people call it, as in "reach on psm"."""

    @property
    def content(self) -> bytes:
        """All that the functions depend on besides code and the values of `parameters`."""

    @property
    def roots(self) -> tuple[str, ...]:
        """Modules whose code the functions run, with all that these import."""

    @property
    def parameters(self) -> Any:
        """Numbers that are the same for all environments.

        They are a tree of numpy arrays, and the last argument of each function.
        """

    @property
    def pauses(self) -> bool:
        """Whether `move` and `finish` are run apart, so that what has moved can be looked at in between."""

    @property
    def senses(self) -> tuple[str, ...]:
        """Names of numbers that are measured outside, between `move` and `finish`."""

    def num_actions(self, agent: str) -> int: ...

    def reset(self, key: Any, episode: Any, parameters: Any) -> Any: ...

    def step(self, carry: Any, actions: dict[str, Any], parameters: Any) -> Any: ...

    def move(self, carry: Any, actions: dict[str, Any], parameters: Any) -> Any: ...

    def finish(self, moved: Any, sensed: dict[str, Any], parameters: Any) -> Any: ...


def announce(stepper: Stepper, engine: str, device: str) -> None:
    """Say on stderr why nothing happens for a while."""
    print(
        f"surgical-marl: compiling {stepper.title} ({engine}, {device}); a second start takes it from the cache",
        file=sys.stderr,
        flush=True,
    )
