"""Which collision geoms of a scene can touch: found by a sweep over the joint ranges, not by hand.

MJX computes every pair it is given at every step, so a scene names only those that can meet. Geoms of two arms are a
pair if any posture of the two arms brings them close; geoms of one arm likewise, unless a joint holds them next to each
other or they overlap at home, as neighbours in a chain do by design.
"""

from __future__ import annotations

from itertools import combinations, product

import mujoco
import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.spec import COLLISION_GROUP
from surgical_marl.scenes.geometry import capsule_distance
from surgical_marl.scenes.scene import Scene, collision_geoms

SAMPLES = 20_000
NEAR, NEAR_WITHIN = 0.01, 0.001
"""Geoms of two arms, and of one arm, that come this close in the sweep, in m, are a pair: it can't try every posture,
and two arms have more joints between two geoms than one."""


def contact_pairs(scene: Scene) -> list[tuple[str, str]]:
    """Names of the geoms that can touch, by pairs. Kept on disk by content, so a second call is quick."""
    model = scene.model
    candidates = _candidates(scene)
    near = cached("pairs", lambda: _sweep(scene, candidates), repr(candidates), scene.fingerprint)
    return [(model.geom(a).name, model.geom(b).name) for (a, b), kept in zip(candidates, near, strict=True) if kept]


def _candidates(scene: Scene) -> list[tuple[int, int]]:
    """Pairs of geom ids that are neither on one body nor next to each other in a chain."""
    model = scene.model
    geoms = {agent: collision_geoms(model, agent) for agent in scene.agents}
    between = [pair for one, other in combinations(scene.agents, 2) for pair in product(geoms[one], geoms[other])]
    within = [pair for own in geoms.values() for pair in combinations(own, 2) if not neighbours(model, *pair)]
    return between + within


def neighbours(model: mujoco.MjModel, a: int, b: int) -> bool:
    """Whether two geoms are on one body, or the way up the tree from one to the other passes nothing that collides."""
    solid = {int(model.body_weldid[model.geom_bodyid[g]]) for g in np.flatnonzero(model.geom_group == COLLISION_GROUP)}
    one, other = (int(model.body_weldid[model.geom_bodyid[geom]]) for geom in (a, b))
    for body, target in ((one, other), (other, one)):
        while body not in (0, target):
            body = int(model.body_weldid[model.body_parentid[body]])
            if body in solid:
                break
        if body == target:
            return True
    return False


def _sweep(scene: Scene, candidates: list[tuple[int, int]]) -> np.ndarray:
    """Which candidates come near each other, [candidates] bool."""
    rng = np.random.default_rng(0)
    arms = {agent: mount.arm for agent, mount in scene.mounts.items()}
    postures = {agent: rng.uniform(arm.lower, arm.upper, (SAMPLES, len(arm.lower))) for agent, arm in arms.items()}
    swept = scene.capsules(postures)
    home = scene.capsules({agent: arm.home[None] for agent, arm in arms.items()})
    owner = {geom: agent for agent in scene.agents for geom in collision_geoms(scene.model, agent)}
    near = []
    for a, b in candidates:
        least = capsule_distance(swept[a], swept[b]).min()
        if owner[a] != owner[b]:
            near.append(least < NEAR)
        else:
            near.append(least < NEAR_WITHIN and capsule_distance(home[a], home[b])[0] > 0)
    return np.array(near, dtype=bool)
