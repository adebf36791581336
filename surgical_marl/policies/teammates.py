"""Teammates: policies of the arms that a learner does not move.

mates = Teammates(env, {"psm_0": "reach-bimanual_psm", "ecm_0": "frozen"})
mates.seed(0)                              # random ones play the same again
mates.forget()                             # where episodes begin
actions = mates.actions(observations)      # of psm_0 and ecm_0
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.content import BASELINES, unknown
from surgical_marl.envs.actions import as_array
from surgical_marl.envs.observations import each
from surgical_marl.policies.acting import Policy, forget
from surgical_marl.policies.frozen import Frozen
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.policy import load_policy

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

FROZEN = "frozen"
"""An arm that keeps still, its jaw too."""

_TEAMMATES = 1
"""Put before a seed, so that teammates draw other numbers than an agent whose generator has the same seed."""

Teammate = str | os.PathLike[str] | Callable[[Any], Any]
"""A policy by its name or folder, as `surgical-marl eval` takes it, or "frozen", or a function from what an arm
observes to its action."""


class Teammates:
    """Policies of some arms of an environment with numpy arrays.

    Args:
        env: the environment that they act in.
        given: agent -> who moves it. Agents with the same policy share one, which then plays them together.
        alone: functions get what one environment observes and return its action, instead of [N, ...].

    Raises:
        ValueError: an agent that does not exist, or a policy that does not exist or was trained on other agents.
    """

    def __init__(self, env: BatchedEnv, given: Mapping[str, Teammate], alone: bool = False) -> None:
        named: dict[str, list[str]] = {}
        self._functions: dict[str, Callable[[Any], Any]] = {}
        for agent, who in given.items():
            if agent not in env.agents:
                raise unknown("teammate", agent, env.agents)
            if isinstance(who, str | os.PathLike):
                named.setdefault(os.fspath(who), []).append(agent)
            elif callable(who):
                self._functions[agent] = who
            else:
                names = ", ".join((FROZEN, *BASELINES))
                raise ValueError(
                    f"teammate {agent!r} must be a policy's name or folder, {names} or a function, not {who!r}"
                )
        self._policies = [(_load(name, env, agents), agents) for name, agents in named.items()]
        self._alone = alone

    def actions(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return the teammates' actions {agent: [N, a]} for the observations of all agents, {agent: [N, d]}."""
        actions: dict[str, Any] = {}
        for policy, agents in self._policies:
            found = policy(observations)
            actions |= {agent: found[agent] for agent in agents}
        for agent, function in self._functions.items():
            if self._alone:
                actions[agent] = as_array(agent, function(each(observations[agent], lambda part: part[0])))[None]
            else:
                actions[agent] = function(observations[agent])
        return actions

    def seed(self, seed: int | Sequence[int | None] | None) -> None:
        """Let policies that draw random numbers begin them anew, by a seed or all seeds of a list that are not None.

        Without a seed they go on, and functions always do.
        """
        seeds = seed if isinstance(seed, Sequence | np.ndarray) else [seed]
        whole = [int(own) for own in seeds if own is not None]
        for policy, _ in self._policies:
            if whole and hasattr(policy, "seed"):
                policy.seed((_TEAMMATES, *whole))

    def forget(self, ended: np.ndarray | None = None) -> None:
        """Tell all that episodes begin: in all environments, or where the last one `ended`, [N] bool."""
        for player in (*(policy for policy, _ in self._policies), *self._functions.values()):
            forget(player, ended)


def _load(name: str, env: BatchedEnv, agents: list[str]) -> Policy:
    if name == "oracle":
        return oracle(env, agents)
    if name == FROZEN:
        return Frozen(env, agents)
    try:
        return load_policy(name, env)
    except ValueError as error:
        raise ValueError(f"teammate {agents[0]!r}: {error}") from None
