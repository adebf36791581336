"""History of one environment, for plots: errors, distances, forces, grips, terms of the reward."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.envs.infos import ERRORS

if TYPE_CHECKING:
    from surgical_marl.scenes.scene import Scene

REWARD = "reward_"
"""Beginning of the names of infos of reward terms."""
GRIP = ("force", "holding", "slip")
"""Infos of each arm's grip on each free object, `<object>_<one of these>`: N, whether it is held, m."""


class History:
    """The last steps of one environment.

    Args:
        agents: names of the agents.
        dt: time of a step, s.
        seconds: how long a step is remembered.
        objects: names of the free objects.
        reports: infos of thread and tissue, the same for all agents (`reported`).
    """

    def __init__(
        self,
        agents: Sequence[str],
        dt: float,
        seconds: float = 10.0,
        objects: Sequence[str] = (),
        reports: Sequence[str] = (),
    ) -> None:
        self.agents, self.objects, self.reports, self._dt = list(agents), list(objects), list(reports), dt
        grips = (f"{name}_{what}" for name in objects for what in GRIP)
        self._wanted = {*ERRORS, "min_distance", "contact_force", *grips, *reports}
        self._room = max(2, round(seconds / dt))
        self._rows: dict[tuple[str, str], np.ndarray] = {}
        self._count = 0

    def add(self, infos: Mapping[str, Mapping[str, Any]], rewards: Mapping[str, Any], index: int = 0) -> None:
        """Remember a step: infos and rewards of all agents, [N] each, of environment `index`."""
        place = self._count % self._room
        for agent in self.agents:
            kept = {name: value for name, value in infos[agent].items() if self._keeps(name)}
            own = {name: float(np.asarray(value)[index]) for name, value in kept.items()}
            own["reward"] = float(np.asarray(rewards[agent])[index])
            for name, value in own.items():
                row = self._rows.setdefault((agent, name), np.full(self._room, np.nan))
                row[place] = value if np.isfinite(value) else np.nan
        self._count += 1

    def clear(self) -> None:
        """Forget all steps."""
        self._rows, self._count = {}, 0

    @property
    def time(self) -> np.ndarray:
        """Times of the remembered steps, s before the last one, [T], 0 at the end."""
        return np.arange(1 - min(self._count, self._room), 1) * self._dt

    def names(self, agent: str) -> list[str]:
        """Return the names of the values that are remembered of an agent."""
        return [name for owner, name in self._rows if owner == agent]

    def read(self, agent: str, name: str) -> np.ndarray:
        """Return the remembered values, oldest first, [T]; NaN where there was none."""
        kept = min(self._count, self._room)
        row = self._rows.get((agent, name))
        if row is None:
            return np.full(kept, np.nan)
        return np.roll(row, -(self._count % self._room))[-kept:] if self._count > self._room else row[:kept].copy()

    def _keeps(self, name: str) -> bool:
        return name in self._wanted or name.startswith(REWARD)

    def error(self, agent: str) -> tuple[str, np.ndarray]:
        """Return the name of the agent's error and its values in mm, [T]; an empty name if it has none."""
        name = next((name for name in ERRORS if (agent, name) in self._rows), "")
        return name, 1000 * self.read(agent, name)


def reported(scene: Scene) -> list[str]:
    """Return the names of infos of the systems of a scene, such as `tension` of thread and `tissue_force`."""
    return list(dict.fromkeys(name for system in scene.systems.values() for name in system.reports))


def summary(info: Mapping[str, Any], index: int = 0) -> list[str]:
    """Summarise an agent's infos of a step: error, stages, success, collision, drop, and contacts without room."""

    def read(name: str) -> float:
        return float(np.asarray(info[name])[index])

    words = [f"{1000 * read(name):.2f} mm" for name in ERRORS if name in info][:1]
    done = [name.removeprefix("stage_") for name in info if name.startswith("stage_") and read(name)]
    if done:
        words.append("stages " + ", ".join(done))
    words += [name for name in ("success", "holding", "collision", "drop") if name in info and read(name)]
    if "contact_overflow" in info and (left_out := round(read("contact_overflow"))):
        words.append(f"{left_out} contacts left out")
    return words
