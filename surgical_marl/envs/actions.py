"""Actions that a caller gives, checked before an engine takes them: bad ones end in one sentence and change nothing."""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

_NUMBERS = "fiu"
"""Kinds of numpy's types that are numbers: floating point, signed and unsigned whole ones."""


def check_actions(actions: Any, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    """Return the actions of all agents as arrays of finite numbers, in the order of `shapes`.

    What is in the host's memory becomes a numpy array, without a copy where none is needed. What is on a GPU stays
    there, as an array of its own library. To know whether it is finite, the host waits for the GPU once, for all
    agents together; while a CUDA graph is captured nothing may wait, and these values are not looked at.

    Args:
        actions: agent -> array of numpy, torch (a gradient is left behind) or JAX, or nested lists of numbers.
        shapes: agent -> shape of its action.

    Raises:
        ValueError: it is no dict, an agent is missing or unknown, a shape is wrong, or a value is masked or not a
            finite number.
    """
    check_agents(actions, shapes.keys())
    checked, away = {}, {}
    for agent, shape in shapes.items():
        action = as_array(agent, actions[agent])
        if tuple(action.shape) != shape:
            raise ValueError(f"action of {agent!r} has shape {tuple(action.shape)}, it must be {shape}")
        if not isinstance(action, np.ndarray):
            away[agent] = action
        elif not np.isfinite(action).all():
            raise _not_finite(agent)
        checked[agent] = action if action.dtype == np.float32 or agent in away else _single(action)
    if away:
        _check_finite(away)
    return checked


def check_agents(actions: Any, agents: Collection[str]) -> None:
    """Raise a ValueError unless actions are a dict with just these agents."""
    if isinstance(actions, dict) and actions.keys() == agents:
        return  # as nearly always, and quick
    if not isinstance(actions, Mapping):
        raise ValueError(f"actions must be a dict of agents to arrays, not {shown(actions)}")
    for agent in actions:
        if agent not in agents:
            raise ValueError(f"action for {agent!r}, which is not an agent of the scene ({', '.join(agents)})")
    for agent in agents:
        if agent not in actions:
            raise ValueError(f"no action for agent {agent!r}")


def as_array(agent: str, given: Any) -> Any:
    """Return an action of any shape as an array of numbers: of numpy, or of its own library if it is on a GPU.

    Raises:
        ValueError: it holds something else than real numbers, or masked entries.
    """
    check_unmasked(agent, given)
    array = np.asarray(given) if isinstance(given, np.ndarray) else _converted(agent, given)
    if getattr(array.dtype, "kind", "f") not in _NUMBERS:  # torch's types have no kind, and are checked already
        raise _no_numbers(agent, given if array.dtype.kind == "O" else array.dtype)
    return array


def check_unmasked(agent: str, given: Any) -> None:
    """Raise a ValueError if an action has masked entries: as an array it would hold what is under the mask."""
    if _is_masked(given):
        raise ValueError(f"action of {agent!r} has masked entries, which are no numbers: fill them, as filled(0) does")


def _is_masked(given: Any) -> bool:
    """Return whether an array of numpy, or one in nested lists, has masked entries."""
    if isinstance(given, list | tuple):
        return any(isinstance(part, list | tuple | np.ndarray) and _is_masked(part) for part in given)
    return isinstance(given, np.ma.MaskedArray) and bool(np.ma.is_masked(given))


def _converted(agent: str, given: Any) -> Any:
    """Return what is no array of numpy as one, or as an array of its own library if it is on a GPU."""
    torch, jax = sys.modules.get("torch"), sys.modules.get("jax")
    if torch is not None and isinstance(given, torch.Tensor):
        if given.dtype == torch.bool or given.is_complex():
            raise _no_numbers(agent, given.dtype)
        tensor = given.detach()
        if given.device.type != "cpu":
            return tensor
        try:
            return tensor.float().numpy() if given.dtype == torch.bfloat16 else tensor.numpy()
        except (TypeError, RuntimeError):  # a sparse, quantised or masked tensor
            raise _no_numbers(agent, given) from None
    if jax is not None and isinstance(given, jax.Array):
        if given.dtype == jax.numpy.bfloat16:
            given = given.astype(np.float32)
        return np.asarray(given) if given.devices() <= set(jax.devices("cpu")) else given
    try:
        return np.asarray(given)
    except (ValueError, TypeError, RuntimeError):  # lists of different lengths, or what has a fault of its own
        raise _no_numbers(agent, given) from None


def _single(action: np.ndarray) -> np.ndarray:
    return np.clip(action, -1.0, 1.0).astype(np.float32)  # clipped first: there are larger numbers than float32 holds


def _check_finite(actions: dict[str, Any]) -> None:
    """Raise a ValueError if a value of an array on a GPU is not finite."""
    torch = sys.modules.get("torch")
    tensors = {agent: a for agent, a in actions.items() if torch is not None and isinstance(a, torch.Tensor)}
    if tensors and not torch.cuda.is_current_stream_capturing():  # type: ignore[union-attr]
        every = torch.cat([tensor.flatten() for tensor in tensors.values()])  # type: ignore[union-attr]
        if not every.isfinite().all():
            raise _not_finite(next(agent for agent, tensor in tensors.items() if not tensor.isfinite().all()))
    for agent in actions.keys() - tensors.keys():
        if not sys.modules["jax"].numpy.isfinite(actions[agent]).all():
            raise _not_finite(agent)


def _not_finite(agent: str) -> ValueError:
    return ValueError(f"action of {agent!r} holds a value that is not finite")


def _no_numbers(agent: str, found: Any) -> ValueError:
    return ValueError(f"action of {agent!r} must hold real numbers, not {shown(found)}")


def shown(value: Any) -> str:
    """Return a value as a message shows it: short, in one line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
