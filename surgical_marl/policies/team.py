"""A team in which partners play some of the roles.

policy = Team(env, "reach-bimanual_psm", {"psm_1": "frozen"})
actions = policy(observations)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.content import BASELINES, PARTNERS, unknown
from surgical_marl.plugins.adapters import is_adapted
from surgical_marl.policies.acting import forget, like, to_numpy
from surgical_marl.policies.frozen import Frozen
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.teammates import Teammates
from surgical_marl.runs.content import scene_label
from surgical_marl.runs.folder import find_run, read_settings
from surgical_marl.runs.identity import setting
from surgical_marl.scenes.load import load_scene
from surgical_marl.tasks.base.options import SAME

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.runs.settings import Settings

DELAY = 0.5
"""Time for which a "delayed" partner keeps still at the start of an episode, s."""


class Team:
    """The policy of a team with partners.

    Args:
        env: the environments that it acts in.
        name: as for `load_policy`.
        partners: agent -> who moves it instead: such a name, or "frozen", or "delayed": what the team itself would do,
            but not before `DELAY`.

    Raises:
        ValueError: an agent or a policy does not exist, or a policy is of another task or scene.
    """

    def __init__(self, env: BatchedEnv, name: str | Path, partners: Mapping[str, str]) -> None:
        _check_roles(partners, env.agents)
        for who in partners.values():
            check_fits(who, env)
        self._env = env
        self._late = [agent for agent, who in partners.items() if who == "delayed"]
        others = {agent: who for agent, who in partners.items() if who != "delayed"}
        own = [agent for agent in env.agents if agent not in others]
        self._own = oracle(env, own) if name == "oracle" else load_policy(name, env)
        self._mates = Teammates(env, others)
        self._still = Frozen(env, self._late)

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        actions = {**self._own(observations), **self._mates.actions(observations)}
        begun = (to_numpy(self._env.steps) * self._env.control_dt >= DELAY)[:, None]
        for agent, still in self._still(observations).items():
            actions[agent] = like(still, np.where(begun, to_numpy(actions[agent]), to_numpy(still)))
        return actions

    def reset(self, ended: Any = None) -> None:
        """Tell all that episodes begin: in all environments, or where the last one `ended`, [N] bool."""
        forget(self._own, ended)
        self._mates.forget(ended)
        self._still.reset(ended)


def check_partners(partners: Mapping[str, str], settings: Settings) -> None:
    """Raise ValueError as `Team` does, before an environment of these settings is made, which takes minutes."""
    _check_roles(partners, load_scene(settings.scene).agents)
    for who in partners.values():
        check_same(who, {key: getattr(settings, key) for key in SAME})


def check_fits(who: str, env: BatchedEnv) -> None:
    """Raise ValueError if a policy was trained for another environment than this one.

    The options `SAME` must be the same.
    """
    asked = env.env.options
    check_same(who, {key: getattr(asked, key) for key in SAME})


def _check_roles(partners: Mapping[str, str], agents: Sequence[str]) -> None:
    for agent in partners:
        if agent not in agents:
            raise unknown("role", agent, agents)


def check_same(who: str, own: Mapping[str, Any]) -> None:
    """Raise ValueError if a policy was trained with other settings than these, of `SAME`."""
    if who in (*PARTNERS, *BASELINES) or is_adapted(who):
        return
    settings = read_settings(find_run(who))
    for key, value in own.items():
        theirs = setting(settings, key)
        if key == "scene":
            value = scene_label(value)
        if theirs != value:
            raise ValueError(f"{who} is of {key} {theirs!r}, not {value!r}: a policy acts where it was trained")
