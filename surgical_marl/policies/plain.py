"""Plain networks that act by numpy alone: MLPs behind a normaliser, as nearly all policies that ship are.

A film of two arms, the viewer and an environment with teammates so need no torch, whose import takes longer than an
episode. `policies/actor.py` does the same for all networks and on all devices; a test holds both together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgical_marl.envs.observations import proprioception
from surgical_marl.policies.acting import like
from surgical_marl.policies.layout import Layout
from surgical_marl.runs.settings import NetworkSettings

Array = NDArray[np.float32]

EPSILON = 1e-2
"""Added to the standard deviations of observations, as rsl_rl does."""
FURTHEST = 10.0
"""Standard deviations to which normalised observations are limited. A needle that is flung away spins at a thousand of
them: a network's answer to that would outweigh all it should learn."""
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "relu": lambda x: np.maximum(x, 0),
    "tanh": np.tanh,
}


def is_plain(network: NetworkSettings) -> bool:
    """Return whether a network without pictures is an MLP that is computed here."""
    return network.recurrent == "none" and not network.attention and network.activation in ACTIVATIONS


class PlainNetwork:
    """An MLP behind its normaliser.

    Args:
        network: its settings.
        weights: of all groups, as `policies/weights.py` reads them.
        group: whose network it is.
        observation, action: widths of what an agent sees and does.

    Raises:
        ValueError: the weights of the group are not those of such a network.
    """

    def __init__(
        self, network: NetworkSettings, weights: Mapping[str, Any], group: str, observation: int, action: int
    ) -> None:
        start = f"models.{group}."
        own = {name.removeprefix(start): array for name, array in weights.items() if name.startswith(start)}
        shapes = _shapes(network, observation, action)
        if {name: array.shape for name, array in own.items()} != shapes:
            raise ValueError(f"the weights of {group!r} are of another network")
        layers = range(0, 2 * len(network.hidden) + 1, 2)
        self._layers = [(own[f"mlp.{layer}.weight"].T, own[f"mlp.{layer}.bias"]) for layer in layers]
        self._activation = network.activation  # its name, because a policy can be pickled and a lambda can not
        self._normaliser: tuple[Array, Array] | None = None
        if network.normalise_observations:
            self._normaliser = own["obs_normalizer._mean"], own["obs_normalizer._std"] + EPSILON

    def __call__(self, seen: Array) -> Array:
        """Return mean actions [..., a] for observations [..., d]."""
        if self._normaliser is not None:
            mean, deviation = self._normaliser
            seen = ((seen - mean) / deviation).clip(-FURTHEST, FURTHEST)
        (weight, bias), *further = self._layers
        made = seen @ weight + bias
        for weight, bias in further:
            made = ACTIVATIONS[self._activation](made) @ weight + bias
        return made


class PlainPolicy:
    """The policy of plain networks, one for each group of a layout."""

    def __init__(self, layout: Layout, networks: Mapping[str, PlainNetwork]) -> None:
        self._layout, self._networks = layout, networks

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return the actions of all agents."""
        seen = {agent: proprioception(observations[agent]) for agent in self._layout.agents}
        stacked = self._layout.stack({agent: np.asarray(vector) for agent, vector in seen.items()})
        parts = [self._networks[name](group) for name, group in stacked.items()]
        flat = np.concatenate([part.reshape(*part.shape[:-2], -1) for part in parts], -1).clip(-1, 1)
        return {agent: like(seen[agent], action) for agent, action in self._layout.split(flat).items()}


def _shapes(network: NetworkSettings, observation: int, action: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a network's weights by their names."""
    shapes: dict[str, tuple[int, ...]] = {"distribution.log_std_param": (action,)}
    for number, (before, after) in enumerate(pairwise((observation, *network.hidden, action))):
        shapes |= {f"mlp.{2 * number}.weight": (after, before), f"mlp.{2 * number}.bias": (after,)}
    if network.normalise_observations:
        shapes |= {f"obs_normalizer.{name}": (1, observation) for name in ("_mean", "_var", "_std")}
        shapes["obs_normalizer.count"] = ()
    return shapes
