"""Policies that act: of a run, of another library, zero and random.

A policy maps the observations of all agents `{agent: [..., d]}` to their actions `{agent: [..., a]}` in [-1, 1]. It
returns NumPy arrays for NumPy arrays and tensors for tensors. A recurrent policy must be told where episodes begin
(`surgical_marl/policies/acting.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.envs.observations import proprioception
from surgical_marl.plugins.adapters import is_adapted
from surgical_marl.policies.acting import Policy, forget, like
from surgical_marl.policies.layout import fitting_layout
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.plain import PlainNetwork, PlainPolicy, is_plain
from surgical_marl.policies.weights import NOT_OF_THIS_NETWORK, read_weights
from surgical_marl.runs.folder import CHECKPOINT, find_run, holds_weights, read_settings

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


def load_policy(run: str | Path, env: BatchedEnv) -> Policy:
    """Load the deterministic policy of a run for the agents of an environment.

    Args:
        run: a run folder, or the name of a policy that ships, or "zero", "random" or "oracle"; or a policy of another
            library by its adapter, such as "lerobot:outputs/act".
        env: the environment that the policy will act in.

    Raises:
        ValueError: there is no such run, its checkpoint is damaged, or it was trained on other
            agents; or what `adapted` refuses.
    """
    if run == "zero":
        return zero_policy(env)
    if run == "random":
        return random_policy(env)
    if run == "oracle":
        return oracle(env)
    if is_adapted(run):
        from surgical_marl.policies.adapted import adapted

        return adapted(str(run), env)
    trained = read_settings(find_run(run)).observations
    policy = _load(run, env)
    return policy if trained == env.env.options.observations else _Restating(policy, env, trained)


def zero_policy(env: BatchedEnv) -> Policy:
    """Make the policy whose actions are always zero."""
    return _Zero(env)


def random_policy(env: BatchedEnv, seed: int = 0) -> Policy:
    """Make the policy of uniform random actions in [-1, 1]."""
    return _Random(env, seed)


def _load(run: str | Path, env: BatchedEnv) -> Policy:
    """Load the networks of a run: without torch where they and the environment's arrays allow it."""
    if env.arrays == "numpy" and env.device == "cpu" and (plain := _load_plain(run, env)) is not None:
        return plain
    from surgical_marl.policies.actor import acting_policy, load_actor

    return acting_policy(*load_actor(run, env), str(env.device))


def _load_plain(run: str | Path, env: BatchedEnv) -> Policy | None:
    """Load a policy that ships as weights; None if it is more than plain networks."""
    folder = find_run(run)
    settings = read_settings(folder)
    if not is_plain(settings.network) or not holds_weights(folder) or (folder / CHECKPOINT).is_file():
        return None
    trained, weights = read_weights(folder)
    layout = fitting_layout(env, trained, run, settings.scene)
    if any(layout.pictures.values()):
        return None
    try:
        return PlainPolicy(
            layout,
            {name: PlainNetwork(settings.network, weights, name, *widths[1:]) for name, widths in trained.items()},
        )
    except ValueError:
        raise ValueError(NOT_OF_THIS_NETWORK.format(run)) from None


class _Restating:
    """A policy that observes as an environment with other `observations` than this one would show it."""

    def __init__(self, policy: Policy, env: BatchedEnv, observations: str) -> None:
        self._policy, self._env, self._observations = policy, env, observations

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        return self._policy(self._env.restated(observations, self._observations))

    def reset(self, ended: Any = None) -> None:
        """Tell the policy that episodes begin."""
        forget(self._policy, ended)


class _Zero:
    """The policy of zeros. It reads the shapes of observations alone."""

    def __init__(self, env: BatchedEnv) -> None:
        self._widths = {agent: env.action_space(agent).shape for agent in env.agents}

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        actions = {}
        for agent, width in self._widths.items():
            seen = proprioception(observations[agent])
            actions[agent] = like(seen, self._act((*seen.shape[:-1], *(width or ()))))
        return actions

    def _act(self, shape: tuple[int, ...]) -> np.ndarray:
        return np.zeros(shape, np.float32)


class _Random(_Zero):
    """Uniform random actions, of a generator that `seed` begins anew."""

    def __init__(self, env: BatchedEnv, seed: int) -> None:
        super().__init__(env)
        self._generator = np.random.default_rng(seed)

    def seed(self, seed: Sequence[int]) -> None:
        self._generator = np.random.default_rng(seed)

    def _act(self, shape: tuple[int, ...]) -> np.ndarray:
        return self._generator.uniform(-1, 1, shape).astype(np.float32)
