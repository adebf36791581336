"""Postures from which arms grasp objects: the start of the motion `grasp`."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from surgical_marl.robots.rotation import quaternion, turned
from surgical_marl.scenes.scene import Scene

IDLE = 0.25
"""Share of environments in which all objects lie where the scene puts them."""
GAP = 3e-5
"""Space between a wire and the pads of a jaw that is about to close on it, m."""
_SPREAD = np.array([0.3, 0.3, 0.0, 1.0, 0.4, 0.4])
"""How far a posture is from home at most: two angles, insertion, roll and two angles of the wrist, rad."""


def graspers(scene: Scene) -> list[str]:
    """Return the agents whose jaws have pads, of arms built like a PSM."""
    return [a for a, mount in scene.mounts.items() if mount.arm.jaw and len(mount.arm.jaw.pads) == 2]


def grasps(scene: Scene, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw starts of grasps.

    In a share of them one arm's open jaw is around the first free object, at a site whose name begins with `grasp`. The
    wire or bar there lies across the pads.

    Returns:
        Joints [count, nq], and centres of mass [count, k, 3] and quaternions [count, k, 4] of the objects.

    Raises:
        ValueError: the scene has no free object with such a site, or no jaw with two pads.
    """
    free = scene.free_objects
    agents, first = graspers(scene), next(iter(free.values()), None)
    sites = [site for site in first.object.sites if site.startswith("grasp")] if first else []
    if not agents or not first or not sites:
        raise ValueError(
            f"scene {scene.name!r} has nothing to grasp: no free object with a site 'grasp', or no jaw with pads"
        )
    centers = np.array([place.position + place.rotation @ place.object.center for place in free.values()])
    turns = np.array([quaternion(place.rotation) for place in free.values()])
    qpos = np.repeat(scene.home[None], count, 0)
    positions, quaternions = (np.repeat(values[None], count, 0) for values in (centers, turns))
    data = mujoco.MjData(scene.model)
    for i in range(count):
        if rng.random() >= IDLE:
            site = first.object.sites[sites[rng.integers(len(sites))]]
            qpos[i], frame, origin = _posture(scene, str(rng.choice(agents)), first.object, data, rng)
            rotation = frame @ site[1].T
            positions[i, 0] = origin + rotation @ (first.object.center - site[0])
            quaternions[i, 0] = quaternion(rotation)
    return qpos, positions, quaternions


def _posture(
    scene: Scene, agent: str, item: Any, data: mujoco.MjData, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return joints [nq], and axes [3, 3] and origin [3] in the world of a wire that lies between an arm's pads.

    The x axis lies along the wire, across the pads.
    """
    arm, model = scene.mounts[agent].arm, scene.model
    q = {name: mount.arm.home.copy() for name, mount in scene.mounts.items()}
    q[agent][:6] += rng.uniform(-1, 1, 6) * _SPREAD
    q[agent][2] = rng.uniform(0.06, 0.1)
    deep, radius = rng.uniform(0.006, 0.009), min(shape.size[0] for shape in item.shapes)
    jaw = arm.joints[[joint.name for joint in arm.joints].index(arm.jaw.joint)]  # type: ignore[union-attr]
    q[agent][-1] = jaw.lower + (radius + GAP) / deep
    full = scene.full_qpos(q)
    data.qpos[:] = full
    mujoco.mj_kinematics(model, data)
    joint = model.joint(f"{agent}/{jaw.name}")
    hinge = int(model.body_parentid[joint.bodyid[0]])
    axes = data.xmat[hinge].reshape(3, 3)
    across, closing = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    wire = turned(np.degrees(rng.uniform(-0.5, 0.5)) * closing) @ np.stack(
        [across, np.cross(closing, across), closing], 1
    )
    wire = wire @ turned(np.array([np.degrees(rng.uniform(-np.pi, np.pi)), 0.0, 0.0]))
    return full, axes @ wire, data.xpos[hinge] + axes @ np.array([0.0, rng.uniform(-5e-4, 5e-4), -deep])
