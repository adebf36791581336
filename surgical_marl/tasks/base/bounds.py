"""Bounds of what arms observe of each other, from their reach, their shapes and where they stand.

What is observed is clipped to its bounds, so they must hold whatever an episode can bring. Observations may be scaled
by them (`surgical_marl/envs/observations.py`), so they are not much wider than that. They are the same for all arms of
a scene: arms of a kind share networks and spaces.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from surgical_marl.robots.reach import Box
from surgical_marl.scenes.scene import Scene, collision_geoms


def ways_between_tips(scene: Scene) -> Box:
    """Return the bounds of the ways from any tool tip to another, [3] each, in the base frame of the first arm, m."""
    furthest = np.zeros(3)
    for own, other in permutations(scene.mounts.values(), 2):
        corners = other.arm.reach.corners @ other.rotation.T + other.position
        seen = (corners - own.position) @ own.rotation
        way = Box(seen.min(0), seen.max(0)).minus(own.arm.reach)
        furthest = np.maximum(furthest, np.maximum(-way.low, way.high))
    return Box(-furthest, furthest)


def distances_between_arms(scene: Scene) -> Box:
    """Return the bounds of the least distance of any two arms, [1] each, m.

    They overlap at most as two capsules do whose axes meet, and are at most as far apart as tool tips can be.
    """
    model = scene.model
    radii = [model.geom_size[geom, 0] for agent in scene.agents for geom in collision_geoms(model, agent)]
    return Box(np.array([-2 * max(radii, default=0.0)]), np.array([np.linalg.norm(ways_between_tips(scene).high)]))
