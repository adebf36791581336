"""Some arms of a scene seen as one agent, for faces that know a single agent."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from surgical_marl.content import unknown
from surgical_marl.envs.actions import check_actions
from surgical_marl.envs.observations import each, proprioception

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

Infos = Mapping[str, Mapping[str, Any]]
"""agent -> name -> [N]"""

_TEAM: dict[str, Callable[[Any, Any], Any]] = {
    "tip_error": np.maximum,
    "success": np.logical_and,
    "collision": np.logical_or,
    "min_distance": np.minimum,
    "contact_force": np.maximum,
    "contact_overflow": np.maximum,
    "goal_error": np.maximum,
    "goal_angle": np.maximum,
    "drop": np.logical_or,
    "holding": np.logical_or,
}
"""Functions that make one value of those of two arms, by the name of the info; see also `JointAgent._combine`."""


class JointAgent:
    """An agent that observes all that its arms observe, and moves all of them.

    Its action is those of its arms one after the other, in the order of the scene, and its reward is their sum.
    Pictures stand beside the vector, in a dict.

    Args:
        batch: the environments.
        agent: the one arm that it is, or None for all arms but `others`.
        others: the arms that someone else moves.
        alone: its actions are [sum], of the only environment, instead of [N, sum].

    Raises:
        ValueError: an arm that does not exist, one that nobody moves or two do, or none left.
    """

    def __init__(
        self, batch: BatchedEnv, agent: str | None = None, others: Sequence[str] = (), alone: bool = False
    ) -> None:
        self.arms = _arms(batch, agent, others)
        self.every = batch.agents if len(batch.agents) > 1 else []
        own = {arm: batch.observation_space(arm) for arm in self.arms}
        boxes = [proprioception(space.spaces if isinstance(space, spaces.Dict) else space) for space in own.values()]
        low, high = (np.concatenate([getattr(box, end) for box in boxes]) for end in ("low", "high"))
        self.observation_space: spaces.Space[Any] = spaces.Box(low, high, dtype=np.float32)
        if any(isinstance(space, spaces.Dict) for space in own.values()):
            self.observation_space = spaces.Dict({"proprioception": self.observation_space, **_pictures(own)})
        ends = np.cumsum([batch.action_space(arm).shape[0] for arm in self.arms]).tolist()
        self._slices = {arm: slice(a, b) for arm, a, b in zip(self.arms, [0, *ends], ends, strict=False)}
        self.action_space = spaces.Box(-1.0, 1.0, (ends[-1],), np.float32)
        self._alone, self._name = alone, ", ".join(self.arms)
        self._reported = {name for system in batch.scene.systems.values() for name in system.reports}
        self._shapes = {self._name: (ends[-1],) if alone else (batch.num_envs, ends[-1])}

    def observation(self, observations: Mapping[str, Any], index: int | slice = slice(None)) -> Any:
        """Return the observation of all environments or of one: an array, or a dict of it and the pictures."""
        felt = np.concatenate([proprioception(observations[arm])[index] for arm in self.arms], -1)
        pictures = _pictures({arm: observations[arm] for arm in self.arms})
        return {"proprioception": felt, **each(pictures, lambda part: np.array(part[index]))} if pictures else felt

    def actions(self, action: Any) -> dict[str, Any]:
        """Return the actions of the arms, [N, n] each. ValueError for a bad one, as `check_actions` says."""
        checked = check_actions({self._name: action}, self._shapes)[self._name]
        joint = checked[None] if self._alone else checked
        return {arm: joint[:, part] for arm, part in self._slices.items()}

    def reward(self, rewards: Mapping[str, Any]) -> Any:
        """Return the sum of the arms' rewards, [N]."""
        return reduce(np.add, [rewards[arm] for arm in self.arms])

    def info(self, infos: Infos, of: Callable[[Any], Any] = lambda values: values) -> dict[str, Any]:
        """Return the infos of the agent and, under "agents", of each arm of a scene with several.

        Args:
            infos: of all arms.
            of: what to make of each array [N], such as the value of one environment.
        """
        own = [infos[arm] for arm in self.arms]
        if len(own) == 1:
            team = {name: of(values) for name, values in own[0].items()}
        else:
            shared = [name for name in own[0] if self._combine(name) and all(name in info for info in own)]
            team = {name: of(reduce(self._combine(name), [info[name] for info in own])) for name in shared}  # type: ignore[arg-type]
        if self.every:
            team["agents"] = {arm: {name: of(values) for name, values in infos[arm].items()} for arm in self.every}
        return team

    def _combine(self, name: str) -> Callable[[Any, Any], Any] | None:
        """Return a function that makes one value of two arms' values of that name; None if there is none."""
        if name.startswith(("reward_", "cost")):
            return np.add
        if name in self._reported:
            return np.maximum
        return np.logical_and if name.startswith("stage_") else _TEAM.get(name)


def _arms(batch: BatchedEnv, agent: str | None, others: Sequence[str]) -> list[str]:
    """Return the arms that are not the others', in the scene's order, once it is clear who moves each."""
    for other in others:
        if other not in batch.agents:
            raise unknown("teammate", other, batch.agents)
    if agent is None:
        free = [arm for arm in batch.agents if arm not in others]
        if not free:
            raise ValueError(f"teammates move all arms ({', '.join(others)}): leave out the one that the agent moves")
        return free
    if agent not in batch.agents:
        raise unknown("agent", agent, batch.agents)
    if agent in others:
        raise ValueError(f"{agent!r} is the agent and cannot be a teammate too: leave it out of one of them")
    if missing := [arm for arm in batch.agents if arm not in (agent, *others)]:
        raise ValueError(
            f"no teammate moves {missing[0]!r}: say who does, as in teammates={{{missing[0]!r}: 'frozen'}}"
        )
    return [agent]


def _pictures(observations: Mapping[str, Any]) -> dict[str, Any]:
    """Return the pictures of all arms, or the spaces of the pictures, under their names.

    If several arms see pictures, the names are "<arm>/<name>".
    """
    own = {arm: part for arm, part in observations.items() if hasattr(part, "keys")}
    several = len(own) > 1
    return {
        f"{arm}/{name}" if several else name: picture
        for arm, parts in own.items()
        for name, picture in parts.items()
        if name != "proprioception"
    }
