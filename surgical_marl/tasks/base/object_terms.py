"""Observation terms about the free objects of a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.runtime import jnp
from surgical_marl.scenes.scene import Scene
from surgical_marl.tasks.base.terms import STRONGEST, Term
from surgical_marl.tasks.base.world import World

if TYPE_CHECKING:
    from jax import Array


WIDE = 1.0
"""Bound of an object's observed place, m: one that has fallen off the field counts as there."""
FASTEST = 5.0
"""Bound of an object's observed speed, m/s."""
SPINNING = 500.0
"""Bound of its observed angular speed, rad/s."""
FURTHEST = 0.1
"""Bound of an observed slip, m."""
PARTS = ("position", "rotation", "velocity", "grip")
"""Names of the terms about an object."""
AT_HAND = "object"
"""Name in observation terms of the object to be moved now, where a task moves several objects in turn."""


def object_terms(scene: Scene, agent: str) -> dict[str, Term]:
    """Return the terms of an arm about every free object of a scene, in its base frame and SI units.

    Of an object `needle` they are `needle_position` [3] of its origin, `needle_rotation` [6], the first two columns of
    its rotation matrix, `needle_velocity` [6], of its centre of mass and angular, and `needle_grip` [3]: the force of
    the arm's fingers on it, whether the arm holds it, and how far it has slid along the fingers.
    """
    return {term: value for name in scene.free_objects for term, value in _terms(scene, agent, name).items()}


def _terms(scene: Scene, agent: str, name: str) -> dict[str, Term]:
    mount = scene.mounts[agent]
    turn, origin = mount.rotation.astype(np.float32), mount.position.astype(np.float32)

    def position(world: World) -> Array:
        return (world.objects[name].position - origin) @ turn

    def rotation(world: World) -> Any:
        return (turn.T @ world.objects[name].rotation)[:, :2].T.ravel()

    def velocity(world: World) -> Array:
        return (world.objects[name].velocity.reshape(2, 3) @ turn).ravel()

    def grip(world: World) -> Array:
        return jnp.stack([value.astype(jnp.float32) for value in world.arms[agent].handles[name]])

    space, fast = np.full(3, WIDE), np.repeat([FASTEST, SPINNING], 3)
    return {
        f"{name}_position": Term(position, -space, space, "object"),
        f"{name}_rotation": Term(rotation, -np.ones(6), np.ones(6), "object"),
        f"{name}_velocity": Term(velocity, -fast, fast, "object"),
        f"{name}_grip": Term(grip, np.zeros(3), np.array([STRONGEST, 1.0, FURTHEST]), "arm"),
    }
