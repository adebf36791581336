"""The interface of an environment that an engine runs."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from surgical_marl.cache import is_shipped

MOST_KEPT = 16
"""Steppers, and what was compiled for them, that a process keeps for later ones that are alike."""


class Stepper(Protocol):
    """One environment as pure JAX functions.

    An engine runs these functions for many environments, and uses nothing else of an environment. A step may call
    stages (`stages.py`), which engines run in other ways.
    """

    agents: tuple[str, ...]
    decimation: int
    """Physics steps in a step."""

    @property
    def title(self) -> str:
        """Name for messages, such as "reach on psm"."""

    @property
    def content(self) -> bytes:
        """Everything that the functions depend on except code and the values of `parameters`.

        Code that is not of this package may depend on more.
        """

    @property
    def classes(self) -> tuple[type, ...]:
        """Classes whose code the functions run."""

    @property
    def parameters(self) -> Any:
        """Numbers that are the same for all environments.

        They are a tree of numpy arrays, and the last argument of each function.
        """

    @property
    def pauses(self) -> bool:
        """True if a step calls a stage of the host, such as pictures."""

    def __hash__(self) -> int: ...

    def num_actions(self, agent: str) -> int: ...

    def reset(self, key: Any, episode: Any, parameters: Any) -> Any: ...

    def step(self, carry: Any, actions: dict[str, Any], parameters: Any) -> Any: ...


def representative(stepper: Stepper) -> Stepper:
    """Return the first stepper of this process that steps as this one does.

    Parameters of the two may differ in their values. What JAX traces and compiles for the one serves the other. Code
    that is not of this package may step otherwise the next time, so such a stepper stands for itself alone.
    """
    if not is_shipped(*stepper.classes):
        return stepper
    known = hashlib.sha256(f"{describe(stepper.parameters)} ".encode() + stepper.content).digest()
    return _first(_Alike(known, stepper.classes, stepper))


@dataclass(frozen=True)
class _Alike:
    """Equal for steppers that step alike."""

    digest: bytes
    classes: tuple[type, ...]
    stepper: Stepper = field(compare=False)


@lru_cache(maxsize=MOST_KEPT)
def _first(alike: _Alike) -> Stepper:
    return alike.stepper


def describe(parameters: Any) -> str:
    """Return names, shapes and types of parameters: their values are inputs of what is compiled."""
    if isinstance(parameters, Mapping):
        return repr({name: describe(value) for name, value in sorted(parameters.items())})
    return f"{np.shape(parameters)} {parameters.dtype.name}"
