"""A task of another package: every arm takes up a posture that it is told, from wherever it stands.

The camera's agent also sees what its endoscope sees.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import surgical_marl as sm
from surgical_marl.tasks.base.task import Start
from surgical_marl.tasks.base.terms import Term

if TYPE_CHECKING:
    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.options import Options
    from surgical_marl.tasks.base.world import World

ROWS = 64
NEAR, AWAY = 0.05, 0.2
"""Shares of a joint's range: how near counts as there, and how far postures stray from home."""


class PostureGoal(NamedTuple):
    """The posture to be taken up."""

    qpos: Any
    """Joint positions of the whole scene, [nq]."""


class Salute(sm.Task):
    """Salute: every arm takes up a posture that it is told."""

    max_steps = 50
    weights = {"posture": -1.0, "clearance": -1.0, "collision": -2.0}  # noqa: RUF012
    stages = ("half", "all")
    wanted = {"success_rate": ("at least", 0.9)}  # noqa: RUF012

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        self.tables |= {"starts": self._draw(2 * self.seed), "goals": self._draw(2 * self.seed + 1)}

    def start(self, key: Any) -> Start:
        """Return a posture to begin with, and one to take up."""
        first, last = jax.random.randint(key, (2,), 0, ROWS)
        return Start(PostureGoal(self.tables["goals"][last]), self.tables["starts"][first])

    def terms(self, agent: str) -> dict[str, Any]:
        """Return those of every task, and `to_posture` [n], what each joint lacks."""
        n = len(self.scene.mounts[agent].arm.actuated)
        bound = np.full(n, 10.0)
        lack = Term(lambda world: self._lack(world, agent), -bound, bound, "goal")
        return {**super().terms(agent), "to_posture": lack}

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return what every task shows, and what the joints lack; the endoscope's picture too."""
        seen = ("image",) if self.scene.mounts[agent].arm.camera else ()
        return (*super().observes(agent), "to_posture", *seen)

    def reward_terms(self, world: World) -> dict[str, dict[str, Any]]:
        """Return those of every task, and `posture`, the mean share of its range that a joint lacks."""
        known = super().reward_terms(world)
        return {agent: {"posture": self._share(world, agent).mean(), **known[agent]} for agent in world.arms}

    def success(self, world: World) -> dict[str, Any]:
        """Return whether all joints of an arm are there."""
        return {agent: (self._share(world, agent) < NEAR).all() for agent in world.arms}

    def reached(self, world: World) -> dict[str, dict[str, Any]]:
        """Return whether half of the joints are there, and all of them."""
        there = {agent: self._share(world, agent) < NEAR for agent in world.arms}
        return {agent: {"half": own.mean() >= 0.5, "all": own.all()} for agent, own in there.items()}

    def _lack(self, world: World, agent: str) -> Any:
        return world.goal.qpos[self.scene.qpos_index(agent)] - world.arms[agent].qpos

    def _share(self, world: World, agent: str) -> Any:
        arm = self.scene.mounts[agent].arm
        return jnp.abs(self._lack(world, agent)) / np.float32(arm.upper - arm.lower)

    def _draw(self, seed: int) -> np.ndarray:
        """Postures of the whole scene near home, [ROWS, nq]."""
        rng, q = np.random.default_rng(seed), {}
        for agent, mount in self.scene.mounts.items():
            arm, low, high = mount.arm, mount.arm.lower, mount.arm.upper
            stray = AWAY * (high - low)
            q[agent] = np.clip(arm.home + rng.uniform(-stray, stray, (ROWS, len(stray))), low, high)
        return self.scene.full_qpos(q)
