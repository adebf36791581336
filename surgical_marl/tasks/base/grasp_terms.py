"""Observation terms about the grip at hand, of objects that a jaw can grip at several bars alike.

Which of the bars turns the tool least jumps as the object is turned. A network that is to say it from the object's pose
alone brings the tool between two of them (docs/tuning.md).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.physics.outputs import ObjectView
from surgical_marl.runtime import jnp
from surgical_marl.scenes.objects import Object
from surgical_marl.scenes.scene import Mount
from surgical_marl.tasks.base.object_task import FAR
from surgical_marl.tasks.base.terms import Term
from surgical_marl.tasks.base.world import World

if TYPE_CHECKING:
    from jax import Array


def grasp_terms(mount: Mount, agent: str, item: Object, body: Callable[[World], ObjectView]) -> dict[str, Term]:
    """Return `to_grasp` and `grasp_axis`, [3] each, in an arm's base frame and SI units.

    The bar at hand is the one that is most along the tool's x axis, of those with a site `grasp_0`, `grasp_1`, ...
    `to_grasp` is the way from the tool tip to its middle, `grasp_axis` its direction: the one that is less than a right
    angle from the tool's x axis.

    Args:
        mount: the arm.
        agent: its name.
        item: the object.
        body: returns where the object is in a world.
    """
    sites = [site for name, site in item.sites.items() if name.startswith("grasp_")]
    middles, axes = (np.array(part, np.float32) for part in zip(*sites, strict=True))
    turn, origin = mount.rotation.astype(np.float32), mount.position.astype(np.float32)

    def grasp(world: World) -> tuple[Array, Array]:
        here, view = body(world), world.arms[agent]
        along = axes[:, :, 0] @ (turn.T @ here.rotation).T
        share = along @ view.tool_axes[:, 0]
        best = jnp.argmax(jnp.abs(share))
        places = here.position + here.size * middles @ here.rotation.T - origin
        return (places @ turn)[best] - view.tool_tip, jnp.where(share[best] < 0, -along[best], along[best])

    far, one = np.full(3, FAR), np.ones(3)
    return {
        "to_grasp": Term(lambda world: grasp(world)[0], -far, far, "object"),
        "grasp_axis": Term(lambda world: grasp(world)[1], -one, one, "object"),
    }
