"""States from which arms grasp objects: the start of the motion `grasp`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from surgical_marl.robots.rotation import quaternion
from surgical_marl.scenes.grasps import Jaw, graspers
from surgical_marl.scenes.scene import Scene

IDLE, SHARED = 0.25, 0.25
"""Shares of environments in which all objects lie where the scene puts them, and in which two arms, if there are so
many, hold one object: a handover. In all others one arm does."""


class Starts(NamedTuple):
    """Where n environments begin."""

    qpos: np.ndarray
    """[n, nq]"""
    position: np.ndarray
    """Centres of mass of the free objects, m, [n, k, 3]."""
    quaternion: np.ndarray
    """Of the free objects, [n, k, 4]."""
    arms: np.ndarray
    """How many arms' jaws are around the first object, [n]."""


def grasps(scene: Scene, count: int, rng: np.random.Generator) -> Starts:
    """Draw starts of grasps: open jaws around the first free object, at a site whose name begins with `grasp`.

    Raises:
        ValueError: the scene has no free object with such a site, or no jaw with two pads.
    """
    free, jaws = scene.free_objects, [Jaw(scene, agent) for agent in graspers(scene)]
    name, place = next(iter(free.items()), ("", None))
    sites = [site for site in place.object.sites if site.startswith("grasp")] if place else []
    if not jaws or not place or not sites:
        raise ValueError(
            f"scene {scene.name!r} has nothing to grasp: no free object with a site 'grasp', or no jaw with pads"
        )
    centers = np.array([each.position + each.rotation @ each.object.center for each in free.values()])
    turns = np.array([quaternion(each.rotation) for each in free.values()])
    qpos, arms = np.repeat(scene.home[None], count, 0), np.zeros(count, int)
    positions, quaternions = (np.repeat(values[None], count, 0) for values in (centers, turns))
    for i, kind in enumerate(rng.random(count)):
        if kind < IDLE:
            continue
        shared = len(jaws) > 1 and kind < IDLE + SHARED
        while True:
            first, second = rng.permutation(len(jaws))[:2] if len(jaws) > 1 else (0, 0)
            grasp = jaws[first].draw(name, place.object.sites[sites[rng.integers(len(sites))]], rng)
            q = {jaws[first].agent: grasp.q}
            joined = jaws[second].join(name, grasp, q, rng) if shared else None
            if joined is not None or not shared:
                break
        if joined is not None:
            q[jaws[second].agent] = joined
        qpos[i], arms[i] = scene.full_qpos(q), len(q)
        positions[i, 0] = grasp.position + grasp.rotation @ place.object.center
        quaternions[i, 0] = quaternion(grasp.rotation)
    return Starts(qpos, positions, quaternions, arms)
