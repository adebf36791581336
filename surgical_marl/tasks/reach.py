"""Target reaching: every arm brings its tool tip to a target of its own, and no two arms touch.

With one arm this is the paper's target reaching, with several its multi-tool reaching.

Agents        every arm of the scene.
Observation   joint positions and velocities, tool tip, position targets, goal, goal minus tip; with other arms also the
              way from this tip to the nearest other tip, and the least distance to any other arm. Base frame, SI units.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        per agent, each step: -10 / m times the distance of tip and goal, plus exp(-distance / 5 mm) for
              precision, minus up to 1 as another arm comes closer than 10 mm, minus 2 if they touch. The sum over the
              agents is the team's: the paper's summed distance, made dense at the end of the way.
Success       tip within 2 mm of the goal.
Termination   none; an episode is truncated after 100 control steps (2 s).
Randomisation goals from N(0, 0.05 m) about the point in front of each arm, kept only if reachable without collision
              (`surgical_marl/workspace.py`). Arms start at home.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.workspace import CLEARANCE, target_table

if TYPE_CHECKING:
    from surgical_marl.physics import ArmView
    from surgical_marl.scene import Scene

SPREAD = 0.05
"""Standard deviation of the goals in m, as in the paper."""
PRECISION = 0.005
"""Distance in m over which the reward for precision falls to a third."""
FAR = 2.0
"""Bound in m of everything observed in space; no arm reaches that far."""


class Task:
    """The pure functions of the task. `views` and results are keyed by agent, for one environment."""

    max_steps = 100
    success = 0.002

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.table = jnp.asarray(target_table(scene, SPREAD), jnp.float32)

    def goal(self, key: Array) -> Array:
        """Goals of all arms, [arms, 3], each in its arm's base frame."""
        return self.table[jax.random.randint(key, (), 0, len(self.table))]

    def tip_errors(self, views: dict[str, ArmView], goal: Array) -> dict[str, Array]:
        """Distance of tool tip and goal in m."""
        return {agent: jnp.linalg.norm(goal[i] - view.tool_tip) for i, (agent, view) in enumerate(views.items())}

    def observations(self, views: dict[str, ArmView], goal: Array) -> dict[str, Array]:
        """[d] each, in the order of the module's docstring."""
        found = {}
        for i, (agent, view) in enumerate(views.items()):
            parts = [view.qpos, view.qvel, view.tool_tip, view.command, goal[i], goal[i] - view.tool_tip]
            if len(views) > 1:
                parts += [view.nearest_tip, view.min_distance[None]]
            found[agent] = jnp.concatenate(parts)
        return found

    def bounds(self, agent: str) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest observation of an agent, [d] each."""
        joints = self.scene.mounts[agent].arm.actuated
        slack = np.array([0.1 * (joint.upper - joint.lower) for joint in joints])
        low = np.array([joint.lower for joint in joints]) - slack
        high = np.array([joint.upper for joint in joints]) + slack
        speed = 2 * np.array([joint.velocity for joint in joints])
        if self.scene.control == "position":
            command_low, command_high = low, high
        else:
            command_high = np.array([max(joint.velocity, joint.effort, joint.upper) for joint in joints])
            command_low = -command_high
        space = np.full(9, FAR)
        lows = [low, -speed, -space[:3], command_low, -space[:3], -2 * space[:3]]
        highs = [high, speed, space[:3], command_high, space[:3], 2 * space[:3]]
        if len(self.scene.agents) > 1:
            lows += [-2 * space[:3], -space[:1]]
            highs += [2 * space[:3], 2 * space[:1]]
        return np.concatenate(lows), np.concatenate(highs)

    def rewards(self, views: dict[str, ArmView], goal: Array) -> dict[str, Array]:
        """Reward of each agent for the step that led here."""
        errors = self.tip_errors(views, goal)
        return {
            agent: -10.0 * errors[agent]
            + jnp.exp(-errors[agent] / PRECISION)
            - jnp.clip(1.0 - view.min_distance / CLEARANCE, 0.0, 1.0)
            - 2.0 * view.collision
            for agent, view in views.items()
        }

    def terminated(self, views: dict[str, ArmView], goal: Array) -> Array:
        """Never: arms go on holding their targets."""
        return jnp.bool_(False)
