"""The interface of an environment that an engine runs."""

from __future__ import annotations

import sys
from typing import Any, Protocol


class Stepper(Protocol):
    """One environment as pure JAX functions.

    An engine runs these functions for many environments, and uses nothing else of an environment.

    A step is `finish(move(carry, actions), sensed)`. If nothing is sensed in between, `step` does both.
    """

    agents: tuple[str, ...]

    @property
    def title(self) -> str:
        """Name for messages, such as "reach on psm"."""

    @property
    def content(self) -> bytes:
        """Everything that the functions depend on except code and the values of `parameters`."""

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
        """Whether `move` and `finish` are run separately, so that pictures can be drawn in between."""

    @property
    def senses(self) -> tuple[str, ...]:
        """Names of numbers that are measured outside, between `move` and `finish`."""

    def num_actions(self, agent: str) -> int: ...

    def reset(self, key: Any, episode: Any, parameters: Any) -> Any: ...

    def step(self, carry: Any, actions: dict[str, Any], parameters: Any) -> Any: ...

    def move(self, carry: Any, actions: dict[str, Any], parameters: Any) -> Any: ...

    def finish(self, moved: Any, sensed: dict[str, Any], parameters: Any) -> Any: ...


def announce(stepper: Stepper, engine: str, device: str) -> None:
    """Say on stderr that a compilation takes a while."""
    print(
        f"surgical-marl: compiling {stepper.title} ({engine}, {device}); a second start takes it from the cache",
        file=sys.stderr,
        flush=True,
    )
