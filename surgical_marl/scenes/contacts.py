"""Find the pairs of collision geoms of a scene that can touch, from the joint limits.

Every pair is checked in every physics step, so a scene has only the pairs that can meet. Two geoms of two arms are a
pair unless they are proven to stay apart in all postures (`separation.py`). So are two geoms of one arm, unless they
are next to each other in the chain, or overlap at home as neighbours in a chain do by design.
"""

from __future__ import annotations

from itertools import combinations, product

import mujoco
import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.spec import COLLISION_GROUP
from surgical_marl.scenes.geometry import capsule_distance
from surgical_marl.scenes.scene import Scene, collision_geoms
from surgical_marl.scenes.separation import BOXES, ball, can_meet, joints_to
from surgical_marl.untrusted.values import check_count

NEAR, NEAR_WITHIN = 0.01, 0.001
"""Distances in m below which geoms of two arms, or of one arm, are a pair. Between arms it is the clearance that goals
leave, so that any smaller `min_distance` is exact. Within an arm it covers rounding and how far joints pass their
limits."""
FEWEST, MOST = 2_000, 1_000_000
"""Boxes that the search of each pair may take in any case (some 10 ms), and boxes that all searches of a scene share
before that (some 5 s); shipped scenes take 610,000 at most. No search takes more than half of the remaining ones."""
SPARE = 60_000
"""Boxes that all searches share after that; a pair for which none are left counts as one that can meet."""
EASY, SETUP = 16, 200
"""Joints of two geoms up to which a box takes the usual time, and what a search takes more to begin, in boxes."""
MANY = 400
"""Pairs from which on the searches of a scene share only half of `MOST`, so that a scene of any size loads in time."""
MAX_PAIRS, MAX_NEAR = 30_000, 6_000
"""Pairs of collision shapes of the arms of a scene, and those of them that are not far apart. Twelve PSMs side by side
have 4,500."""


def contact_pairs(scene: Scene) -> list[tuple[str, str]]:
    """Return the names of the geoms that can touch, by pairs. Kept on disk by content, so a second call is quick."""
    geom, candidates = scene.model.geom, _candidates(scene)
    kept = cached("pairs", lambda: _can_meet(scene, candidates), repr(candidates), scene.fingerprint)
    return [(geom(a).name, geom(b).name) for (a, b, _), meet in zip(candidates, kept, strict=True) if meet]


def _candidates(scene: Scene) -> list[tuple[int, int, float]]:
    """Return pairs of geom ids that may touch, each with the distance in m below which it is near.

    Left out are geoms on one body, and geoms next to each other in a chain. So are geoms of one arm that overlap at
    home, and those of two bases: they never move.
    """
    model, at_home = scene.model, scene.capsules({agent: mount.arm.home for agent, mount in scene.mounts.items()})
    geoms = {agent: collision_geoms(model, agent) for agent in scene.agents}
    sizes = [len(own) for own in geoms.values()]
    count = sum(sizes) * (sum(sizes) - 1) // 2
    check_count(count, MAX_PAIRS, f"pairs of the {sum(sizes):,} collision shapes of all arms", f"scene {scene.name!r}")
    solid = _solid(model)
    still = {geom for own in geoms.values() for geom in own if model.body_weldid[model.geom_bodyid[geom]] == 0}
    every = [pair for one, other in combinations(scene.agents, 2) for pair in product(geoms[one], geoms[other])]
    between = [pair for pair in every if not still.issuperset(pair)]
    within = [pair for own in geoms.values() for pair in combinations(own, 2) if not _follow(model, *pair, solid)]
    free = [(a, b) for a, b in within if capsule_distance(at_home[a], at_home[b]) > 0]
    return [(*pair, NEAR_WITHIN) for pair in free] + [(*pair, NEAR) for pair in between]


def neighbours(model: mujoco.MjModel, a: int, b: int) -> bool:
    """Return whether two geoms are on one body or next to each other in a chain.

    They are next to each other if nothing that collides lies on the way up the tree from one to the other.
    """
    return _follow(model, a, b, _solid(model))


def _solid(model: mujoco.MjModel) -> set[int]:
    """Return the bodies that collide, each as the one that it is welded to."""
    return {int(model.body_weldid[model.geom_bodyid[g]]) for g in np.flatnonzero(model.geom_group == COLLISION_GROUP)}


def _follow(model: mujoco.MjModel, a: int, b: int, solid: set[int]) -> bool:
    """Return what `neighbours` does, given the bodies that collide."""
    one, other = (int(model.body_weldid[model.geom_bodyid[geom]]) for geom in (a, b))
    for body, target in ((one, other), (other, one)):
        while body not in (0, target):
            body = int(model.body_weldid[model.body_parentid[body]])
            if body in solid:
                break
        if body == target:
            return True
    return False


def _can_meet(scene: Scene, candidates: list[tuple[int, int, float]]) -> np.ndarray:
    """Return which candidates can come near each other, [candidates] bool."""
    model, left, spare = scene.model, MOST if len(candidates) <= MANY else MOST // 2, SPARE
    owner = {geom: agent for agent in scene.agents for geom in collision_geoms(model, agent)}
    balls = {geom: ball(model, geom) for geom in owner} if len(scene.agents) > 1 else {}
    joints = {geom: joints_to(model, geom) for geom in owner}

    def are_far(a: int, b: int, near: float) -> bool:
        if owner[a] == owner[b]:
            return False
        (one, reach), (other, its_reach) = balls[a], balls[b]
        return bool(np.linalg.norm(one - other) > reach + its_reach + near)

    far = [are_far(*candidate) for candidate in candidates]
    check_count(len(far) - sum(far), MAX_NEAR, "pairs of collision shapes near each other", f"scene {scene.name!r}")
    known: dict[object, bool] = {}  # an arm that is in a scene twice is searched once
    found = []
    for (a, b, near), apart in zip(candidates, far, strict=True):
        key: object = (a, b)
        if owner[a] == owner[b]:
            arm = scene.mounts[owner[a]].arm
            key = (arm.folder, arm.tool, *(model.geom(geom).name.split("/", 1)[1] for geom in (a, b)))
        if apart:
            known[key] = False
        if key not in known:
            weight = max(1.0, 2 * (joints[a] + joints[b]) / EASY - 1)  # a box takes time for each joint
            if left // 2 >= FEWEST:
                known[key], boxes = can_meet(model, a, b, near, most=int(min(BOXES, left // 2) / weight))
                left -= int((boxes + SETUP * (weight - 1)) * weight)
            elif spare > 0:
                known[key], boxes = can_meet(model, a, b, near, most=int(FEWEST / weight))
                spare -= int((boxes + SETUP) * weight)
            else:
                known[key] = True
        found.append(known[key])
    return np.array(found, dtype=bool)
