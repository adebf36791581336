"""The infos of every agent after a step, besides its observation and reward."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.runtime import jnp
from surgical_marl.scenes.tissue_file import OVERLOAD

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.physics.outputs import ArmView
    from surgical_marl.robots.arm import Arm
    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.task import Task
    from surgical_marl.tasks.base.world import World


ERRORS = ("tip_error", "goal_error")
"""Infos of how far a tool tip, or an object, is from its goal, m: readers take the first that there is."""
NEAR = 0.005
"""Least distance between arms, m: half the clearance of targets (`workspace.CLEARANCE`), and the way that a tool at
0.25 m/s moves in a control step."""
FORCE = 1.0
"""Greatest contact force but for a grip, N. It is our own choice: more than that of a graze, which `collision` reports
anyway, and less than that of an arm that pushes."""
LIMIT = 0.01
"""A joint that is this near to a limit, as a share of its range, is at the limit."""
SPEED = 0.2
"""Greatest speed of a tip, m/s: that of the PSM's insertion, and ten times a target's speed."""


def infos(
    scene: Scene,
    task: Task,
    world: World,
    moved: Array,
    dt: float,
    terms: dict[str, dict[str, Array]],
    told: dict[str, dict[str, Array]],
) -> dict[str, dict[str, Array]]:
    """Return agent -> name -> value, as `State.infos` says.

    Args:
        scene: the arms.
        task: what they do.
        world: after the step.
        moved: how far the tool tips moved in the step, [arms, 3], m.
        dt: time of the step, s.
        terms: agent -> reward term -> its weighted value.
        told: what action terms tell of the step, by agent and name.
    """
    success, stages, metrics = task.success(world), task.reached(world), task.metrics(world)
    speeds, found, reported = jnp.linalg.norm(moved, axis=-1) / np.float32(dt), {}, _reported(scene, world)
    overload = {"tissue": reported["tissue_force"] > OVERLOAD} if "tissue_force" in reported else {}
    for i, (agent, view) in enumerate(world.arms.items()):
        broken = costs(scene.mounts[agent].arm, view, speeds[i]) | overload
        found[agent] = {
            "success": success[agent],
            "collision": view.collision,
            "min_distance": view.min_distance,
            "contact_force": view.contact_force,
            "contact_overflow": view.contact_overflow,
            **{f"stage_{name}": reached for name, reached in stages[agent].items()},
            **{f"reward_{name}": value for name, value in terms[agent].items()},
            **_handling(view),
            **reported,
            "cost": sum((cost.astype(jnp.float32) for cost in broken.values()), start=jnp.float32(0.0)),
            **{f"cost_{name}": cost for name, cost in broken.items()},
            **told[agent],
            **metrics[agent],
        }
    return found


def _handling(view: ArmView) -> dict[str, Array]:
    """Return the infos about the objects that an arm handles; none in a scene without free objects."""
    if not view.handles:
        return {}
    found = {"holding": jnp.stack([handled.holding for handled in view.handles.values()]).any()}
    for name, handled in view.handles.items():
        found |= {f"{name}_{field}": value for field, value in handled._asdict().items()}
    return found


def _reported(scene: Scene, world: World) -> dict[str, Array]:
    """Return the infos about the systems of a scene: of each number that some report, the largest."""
    found: dict[str, list[Array]] = {}
    for name, system in scene.systems.items():
        for field in system.reports:
            found.setdefault(field, []).append(jnp.max(getattr(world.systems[name], field)))
    return {field: jnp.stack(values).max() for field, values in found.items()}


def costs(arm: Arm, view: ArmView, tip_speed: Array) -> dict[str, Array]:
    """Return which limits an arm breaks, [] bool each: the costs of a step for safe learning, beside its reward.

    As in Safety Gymnasium (Ji et al., "Safety-Gymnasium: a unified safe reinforcement learning benchmark", 2023) each
    cost is 0 or 1, and their sum is what a constraint bounds.

    Args:
        arm: the arm.
        view: the arm's state after the step.
        tip_speed: mean speed of its tool tip during the control step, m/s.

    Returns:
        `distance` to another arm, contact `force` (except that of a grip), a joint's `limit` (except the jaw's, because
        a closed jaw rests there), tip `speed`.
    """
    moves = ~arm.moves_jaw
    edge = LIMIT * (arm.upper - arm.lower)
    low, high = ((arm.lower + edge)[moves].astype(np.float32), (arm.upper - edge)[moves].astype(np.float32))
    q = view.qpos[np.flatnonzero(moves)]
    return {
        "distance": view.min_distance < NEAR,
        "force": view.bump_force > FORCE,
        "limit": jnp.any((q < low) | (q > high)),
        "speed": tip_speed > SPEED,
    }
