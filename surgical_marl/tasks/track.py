"""Active tracking: every arm keeps its tool tip on a target that moves at random, and no two arms touch.

Agents        every arm of the scene.
Observation   as in `reach`, with the target's place now for the goal, and the target's velocity. Base frame, SI units.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        per agent, each step, the terms and weights of `reach`.
Success       tip within 2 mm of the target.
Termination   none; an episode is truncated after 250 control steps (5 s).
Randomisation targets rest at the tool tips at first. Then their velocities walk at random, as in the paper, but never
              faster than a greatest speed, and never further than a greatest distance from where they began. Walks are
              kept only if all arms can follow them together (`surgical_marl/tasks/base/paths.py`). Arms start at home,
              or with `start=random` with joints up to a quarter of their ranges from there.
Difficulty    greatest speed and distance: easy 10 mm/s, 50 mm; default 20 mm/s, 50 mm; hard 30 mm/s, 70 mm. The ways of
              two arms' targets come within 20 mm of each other, at different times, in no episode if easy, in a tenth
              by default, in half if hard (where arms can meet at all).
"""

from __future__ import annotations

import numpy as np

from surgical_marl.tasks.base.path_task import PathTask
from surgical_marl.tasks.base.paths import walks
from surgical_marl.tasks.base.task import Level
from surgical_marl.tasks.base.terms import Picture, Term


class Task(PathTask):
    """Active tracking of targets on random walks."""

    draw = staticmethod(walks)
    levels = {  # noqa: RUF012
        "easy": Level(0.05, 0.0, 0.01),
        "default": Level(0.05, 0.1, 0.02),
        "hard": Level(0.07, 0.5, 0.03),
    }

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return the terms of `reach`, and `target_velocity` [3], m/s."""
        i, fastest = self.scene.agents.index(agent), np.full(3, 2 * max(level.speed for level in self.levels.values()))
        return {
            **super().terms(agent),
            "target_velocity": Term(lambda w: self.velocities(w.goal)[i], -fastest, fastest, "goal"),
        }

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the names of the terms observed in `reach`, then `target_velocity`."""
        return (*super().observes(agent), "target_velocity")
