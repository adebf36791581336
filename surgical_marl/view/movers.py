"""Movers of arms: a policy that ships, a run, a policy of another library, the oracle, nobody, or a person.

movers = Movers(env, "reach-bimanual_psm")
movers.set("psm_1", "you", observations)
movers.hands["psm_1"].nudge([0, 0, 0.01])
actions = movers.actions(observations)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.content import find, list_policies, unknown
from surgical_marl.plugins.adapters import is_adapted
from surgical_marl.policies.target_mover import moves_targets
from surgical_marl.policies.team import check_fits
from surgical_marl.policies.teammates import FROZEN, Teammates
from surgical_marl.untrusted.markup import check_name
from surgical_marl.view.hand import Hand

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

YOU = "you"
"""A person moves the arm."""
SIMPLE = ("oracle", "zero", FROZEN, "random")
"""Movers that need no learning."""


class Movers:
    """The policies and the person that move the arms of an environment with numpy arrays.

    Agents of the same policy share one, as in training. A policy that is replaced for one arm stays as it is for the
    others.

    Args:
        env: the environment.
        who: moves all arms at first; or agent -> who moves it.

    Raises:
        ValueError: there is no such policy, or it is of another task or scene.
    """

    def __init__(self, env: BatchedEnv, who: str | Mapping[str, str]) -> None:
        self._env = env
        self.hands: dict[str, Hand] = {}
        """Hands of the arms that a person moves, by agent."""
        self.who: dict[str, str] = {}
        self._groups: dict[str, Teammates] = {}
        self._assign(dict.fromkeys(env.agents, who) if isinstance(who, str) else dict(who))

    def set(self, agent: str, who: str, observations: Mapping[str, Any]) -> None:
        """Let somebody else move an arm. If that can't be done, who moves it stays the same.

        Args:
            agent: the arm.
            who: as for all arms.
            observations: what agents observe now: a person starts with the arm where it is.
        """
        if agent not in self._env.agents:
            raise unknown("agent", agent, self._env.agents)
        before = self.hands
        self._assign({**self.who, agent: who})
        for new in self.hands.keys() - before.keys():
            self.hands[new].hold(observations[new])

    def actions(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return the actions of all agents for their observations, {agent: [N, d]}."""
        actions: dict[str, Any] = {}
        for group in self._groups.values():
            actions |= group.actions(observations)
        return {agent: np.asarray(actions[agent]) for agent in self._env.agents}

    def begin(self, observations: Mapping[str, Any], ended: np.ndarray | None = None) -> None:
        """Tell all that episodes begin: in all environments, or where the last one `ended`, [N] bool.

        What a person wanted in the last episode of the first environment is forgotten.
        """
        for group in self._groups.values():
            group.forget(ended)
        if ended is None or ended[0]:
            for agent, hand in self.hands.items():
                hand.hold(observations[agent])

    def _assign(self, who: dict[str, str]) -> None:
        groups: dict[str, Teammates] = {}
        hands: dict[str, Hand] = {}
        for name in dict.fromkeys(who.values()):
            agents = [agent for agent, mover in who.items() if mover == name]
            if name == YOU:
                hands = {agent: self.hands.get(agent) or Hand(self._env, agent) for agent in agents}
                groups[name] = Teammates(self._env, hands)
            elif agents == [agent for agent, mover in self.who.items() if mover == name]:
                groups[name] = self._groups[name]
            else:
                groups[name] = Teammates(self._env, dict.fromkeys(agents, _place(name, self._env)))
        self.who, self.hands, self._groups = who, hands, groups


def choices(env: BatchedEnv, further: Iterable[str] = ()) -> list[str]:
    """Return who can move arms of an environment: a person, shipped policies of its task and scene, and others.

    Args:
        env: the environment.
        further: runs, by their folders.
    """
    found = [YOU] if moves_targets(env.control) else []
    for name in (*further, *list_policies(), *SIMPLE):
        if name not in found and _fits(name, env):
            found.append(name)
    return found


def first(env: BatchedEnv) -> str:
    """Return who moves the arms if nobody is named: the policy that ships, or the oracle, or "frozen"."""
    known = choices(env)
    return next(name for name in (f"{env.task_name}-{env.scene.name}", "oracle", FROZEN) if name in known)


def _fits(name: str, env: BatchedEnv) -> bool:
    if name == "oracle":
        return moves_targets(env.control) and (env.task.has_targets or bool(env.task.script()))
    try:
        check_fits(str(_place(name, env)), env)
    except ValueError:
        return False
    return True


def _place(name: str, env: BatchedEnv) -> str | Path:
    """Return a policy as `Teammates` takes it; ValueError if there is none, or it does not fit the environment."""
    if name in SIMPLE or is_adapted(name):
        return name
    check_name(name, "a run")
    folder = find("policies", name)
    check_fits(str(folder), env)
    return folder
