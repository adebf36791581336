"""Observation terms: the named parts of an agent's observation.

A term is declared once, with the function that reads it and its bounds. The vector of an observation, its space, and
the names and slices within it all follow from this declaration.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from surgical_marl.robots.reach import Box
from surgical_marl.runtime import jnp
from surgical_marl.scenes.scene import Scene, collision_geoms
from surgical_marl.tasks.base.world import World

if TYPE_CHECKING:
    from jax import Array


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


STRONGEST = 100.0
"""Bound of an observed contact force, N."""
EYES, CHANNELS = ("left", "right"), ("rgb", "depth")
About = Literal["arm", "others", "object", "goal", "team_goal", "messages"]
"""Subject of a term: the arm itself, of other arms, of objects and what cameras show; where this arm itself should
be, or what all arms are after together; what other arms said. Levels of knowledge go by it:
`envs/information_level.py`."""


class Term(NamedTuple):
    """A part of an observation that is a vector."""

    read: Callable[[World], Array]
    """The value [d] in a world."""
    low: np.ndarray
    """Least value, [d]: observations are clipped to the bounds."""
    high: np.ndarray
    about: About | None = None
    """Subject of the term. A task whose terms don't say it can be played at knowledge "task" alone."""


class Picture(NamedTuple):
    """A part of an observation that is a picture: of colours uint8 [64, 64, 3], of depth float32 [64, 64, 1] in m."""

    camera: str
    """The agent of the endoscope."""
    eye: str = "left"
    channel: str = "rgb"
    table: str | None = None
    """For a target picture: the name of the task's table of postures `qpos` [rows, nq]. An episode has the picture of
    row `goal.row`."""

    @property
    def about(self) -> About:
        """Subject of the picture: the goal for a target picture, the camera's view for any other."""
        return "object" if self.table is None else "goal"


def arm_terms(scene: Scene, agent: str) -> dict[str, Term]:
    """Return the terms of every arm about itself and the others, in its base frame and SI units.

    `qpos` and `qvel` [n] of its joints, `tool_tip` [3], `command` [n], `contact_force` [1] on it; with other arms also
    `to_nearest_tip` [3] from its tip, and the least distance `min_distance` [1] to any of them.
    """
    arm = scene.mounts[agent].arm
    joints = arm.joint_box
    speed = 2 * np.array([joint.velocity for joint in arm.actuated])
    furthest = np.array([max(joint.velocity, joint.effort, joint.upper) for joint in arm.actuated])
    commands = joints if scene.control == "position" else (-furthest, furthest)

    def of(name: str) -> Callable[[World], Array]:
        return lambda world: getattr(world.arms[agent], name)

    def single(name: str) -> Callable[[World], Array]:
        return lambda world: of(name)(world)[None]

    terms = {
        "qpos": Term(of("qpos"), *joints, "arm"),
        "qvel": Term(of("qvel"), -speed, speed, "arm"),
        "tool_tip": Term(of("tool_tip"), *arm.reach, "arm"),
        "command": Term(of("command"), *commands, "arm"),
    }
    if len(scene.agents) > 1:
        terms["to_nearest_tip"] = Term(of("nearest_tip"), *ways_between_tips(scene), "others")
        terms["min_distance"] = Term(single("min_distance"), *distances_between_arms(scene), "others")
    terms["contact_force"] = Term(single("contact_force"), np.zeros(1), np.full(1, STRONGEST), "arm")
    return terms


def picture_terms(scene: Scene, agent: str) -> dict[str, Picture]:
    """Return the pictures that an agent of a scene may observe, by name.

    `image`, `image_right`, `depth` and `depth_right` are of the agent's own endoscope; if it has none, they are of the
    scene's first. The pictures of any endoscope are there too, as `<its agent>/image` and so on.
    """
    cameras = [name for name, mount in scene.mounts.items() if mount.arm.camera is not None]
    own = agent if agent in cameras else next(iter(cameras), None)
    found: dict[str, Picture] = {}
    for camera in cameras:
        for channel, word in zip(CHANNELS, ("image", "depth"), strict=True):
            for eye, end in zip(EYES, ("", "_right"), strict=True):
                picture = Picture(camera, eye, channel)
                found |= {f"{word}{end}": picture} if camera == own else {}
                found[f"{camera}/{word}{end}"] = picture
    return found


def read_vector(terms: dict[str, Term], names: tuple[str, ...], world: World) -> Array:
    """Return the terms of these names one after the other, each clipped to its bounds, [d] float32."""
    parts = []
    for name in names:
        low, high = (bound.astype(np.float32) for bound in (terms[name].low, terms[name].high))
        parts.append(jnp.clip(terms[name].read(world).astype(jnp.float32), low, high))
    return jnp.concatenate(parts) if parts else jnp.zeros(0, jnp.float32)


def slices(terms: dict[str, Any], names: tuple[str, ...]) -> dict[str, slice]:
    """Return the slice of each term in the vector of these terms."""
    found, start = {}, 0
    for name in names:
        found[name] = slice(start, start + len(terms[name].low))
        start += len(terms[name].low)
    return found
