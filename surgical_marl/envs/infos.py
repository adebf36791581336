"""What is told of every agent after a step, besides its observation and reward."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.envs.costs import costs
from surgical_marl.runtime import jnp

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.physics.outputs import ArmView
    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.task import Task
    from surgical_marl.tasks.base.world import World


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
    speeds, found = jnp.linalg.norm(moved, axis=-1) / np.float32(dt), {}
    for i, (agent, view) in enumerate(world.arms.items()):
        broken = costs(scene.mounts[agent].arm, view, speeds[i])
        found[agent] = {
            "success": success[agent],
            "collision": view.collision,
            "min_distance": view.min_distance,
            "contact_force": view.contact_force,
            "contact_overflow": view.contact_overflow,
            **{f"stage_{name}": reached for name, reached in stages[agent].items()},
            **{f"reward_{name}": value for name, value in terms[agent].items()},
            **_handling(view),
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
