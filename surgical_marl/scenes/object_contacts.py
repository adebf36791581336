"""Find the shapes of a scene that can touch an object, and the friction between them, without names.

An object can touch every arm and every other object, except that fixed objects touch neither each other nor what no
force moves, such as the base of an arm. The plates of a jaw stand for their fingers; elsewhere the shapes are those
that touch other arms too.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from itertools import combinations, product
from typing import NamedTuple

import mujoco
import numpy as np

from surgical_marl.robots.rotation import quaternion, turned
from surgical_marl.robots.spec import COLLISION_GROUP, PAD_GROUP
from surgical_marl.scenes.objects import JAW, LINK, Surface
from surgical_marl.scenes.poses import Pose
from surgical_marl.scenes.scene import Scene

SLOTS = 16
"""Contacts of objects that a scene can feel at one time, each between two bodies. A fixed shape is a body of its
own."""
DRAWS = 64
"""Draws of the places of objects that are looked at."""
FAR = 0.05
"""Distance of objects and arms up to which it is measured, m."""
RESTING = 1e-5
"""Largest overlap of an object with its support at the start, m: numbers in files are rounded."""


class Touch(NamedTuple):
    """Two geoms that can touch."""

    one: str
    other: str
    surface: Surface
    """Of the contact."""
    weight: float
    """Sum of the inverse weights of the two bodies, 1/kg."""


def check_apart(scene: Scene) -> None:
    """Raise ValueError if an object overlaps another one at the start, or an arm at its home.

    Fixed objects may overlap each other. Where the scene randomises places or sizes of objects, some draws are looked
    at.
    """
    random, rng = scene.randomisation, np.random.default_rng(0)
    reach = np.array([random.object_shift, random.object_shift, 0.0, random.object_turn, random.object_size])
    poses, sizes, count = {}, {}, DRAWS if reach.any() else 1
    for name, place in scene.free_objects.items():
        draws = reach * rng.uniform(-1, 1, (count, 5)) * (np.arange(count) > 0)[:, None]
        turns = np.stack(
            [quaternion(turned(np.array([0.0, 0.0, np.degrees(own[3])])) @ place.rotation) for own in draws]
        )
        growth = [0.0, 0.0, place.object.height(place.rotation)] * draws[:, 4:] if reach[4] else 0.0
        poses[name], sizes[name] = Pose(place.position + draws[:, :3] + growth, turns), 1 + draws[:, 4]
    depths = -distances(scene, poses, sizes)
    for touch, depth in zip(touches(scene), depths.T, strict=True):
        if depth.max() > RESTING:
            what = "place or size" if random.object_size else "place"
            cure = "move the object" if depth[0] > RESTING else f"move the object, or randomise its {what} less"
            raise ValueError(
                f"scene {scene.name!r}: {touch.one!r} and {touch.other!r} overlap at the start by "
                f"{1000 * depth.max():.3g} mm; {cure}"
            )


def distances(scene: Scene, poses: Mapping[str, Pose], sizes: Mapping[str, np.ndarray] | None = None) -> np.ndarray:
    """Return the distances of all pairs that can touch, below 0 where they overlap, with all arms at home.

    Args:
        scene: arms and objects.
        poses: of n each of some free objects, by name. The others are where the scene places them.
        sizes: by what the lengths of some of these are multiplied, [n] each.

    Returns:
        [n, touches] in the order of `touches`, m; `FAR` for all that are further away.
    """
    model, data = copy.copy(scene.model), mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    pairs = [[model.geom(name).id for name in (touch.one, touch.other)] for touch in touches(scene)]
    count = max((len(pose.position) for pose in poses.values()), default=1)
    found = np.full((count, len(pairs)), FAR)
    for row in range(count):
        for name, pose in poses.items():
            mocap = model.body(name).mocapid[0]
            data.mocap_pos[mocap], data.mocap_quat[mocap] = pose.position[row], pose.quaternion[row]
        for name, size in (sizes or {}).items():
            own = model.geom_bodyid == model.body(name).id
            for lengths, given in ((model.geom_size, scene.model.geom_size), (model.geom_pos, scene.model.geom_pos)):
                lengths[own] = size[row] * given[own]
        mujoco.mj_kinematics(model, data)
        found[row] = [distance(model, data, one, other, FAR) for one, other in pairs]
    return found


def distance(model: mujoco.MjModel, data: mujoco.MjData, one: int, other: int, most: float = 1.0) -> float:
    """Return the distance of two geoms, below 0 where they overlap, m; `most` if they are further away.

    It is C MuJoCo's (3.17), but for a capsule whose axis goes through a box: there that is above 0 in 3 % of random
    poses.
    """
    found = float(mujoco.mj_geomDistance(model, data, one, other, most, None))
    kinds = {int(model.geom_type[geom]): geom for geom in (one, other)}
    box, capsule = kinds.get(mujoco.mjtGeom.mjGEOM_BOX), kinds.get(mujoco.mjtGeom.mjGEOM_CAPSULE)
    if box is None or capsule is None or not _goes_through(model, data, box, capsule):
        return found
    return min(found, -float(model.geom_size[capsule, 0]))


def _goes_through(model: mujoco.MjModel, data: mujoco.MjData, box: int, capsule: int) -> bool:
    """Return whether the axis of a capsule has a point within a box."""
    apart, half = data.geom_xpos[capsule] - data.geom_xpos[box], model.geom_size[capsule, 1]
    if apart @ apart > (half + np.linalg.norm(model.geom_size[box])) ** 2:
        return False
    axes = data.geom_xmat[box].reshape(3, 3)
    middle, way = apart @ axes, half * data.geom_xmat[capsule].reshape(3, 3)[:, 2] @ axes
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    ends = (np.stack([-model.geom_size[box], model.geom_size[box]]) - middle) / way
    return bool(max(-1.0, ends.min(0).max()) <= min(1.0, ends.max(0).min()))


class _Side(NamedTuple):
    """A geom that can touch."""

    name: str
    surface: Surface
    weight: float


def touches(scene: Scene) -> Iterator[Touch]:
    """Yield the pairs of geoms of which one is an object's and one can move, in the order of the scene."""
    arms = [(True, _arm_sides(scene, agent)) for agent in scene.agents]
    objects = [(False, _object_sides(scene, name)) for name in scene.objects]
    for (arm, sides), (other_arm, others) in combinations(arms + objects, 2):
        for one, other in product(sides, others) if not (arm and other_arm) else ():
            if one.weight + other.weight > 0:  # 0 is that of fixed objects, and of a base: no force moves them
                yield Touch(one.name, other.name, one.surface.against(other.surface), one.weight + other.weight)


def _arm_sides(scene: Scene, agent: str) -> list[_Side]:
    model = scene.model
    own = [geom for geom in range(model.ngeom) if model.geom(geom).name.startswith(f"{agent}/")]
    pads = [geom for geom in own if model.geom_group[geom] == PAD_GROUP]
    fingers = set(model.geom_bodyid[pads].tolist())
    links = [
        geom
        for geom in own
        if model.geom_group[geom] == COLLISION_GROUP and int(model.geom_bodyid[geom]) not in fingers
    ]
    weights = model.body_invweight0[model.geom_bodyid, 0]
    return [
        _Side(model.geom(geom).name, surface, float(weights[geom]))
        for geoms, surface in ((pads, JAW), (links, LINK))
        for geom in geoms
    ]


def _object_sides(scene: Scene, name: str) -> list[_Side]:
    item = scene.objects[name].object
    weight = 1 / item.mass if item.free else 0.0
    return [_Side(f"{name}/{number}", item.surface, weight) for number in range(len(item.shapes))]


def direct_solref(surface: Surface, weight: float, timestep: float) -> tuple[np.ndarray, np.ndarray]:
    """Return MuJoCo's `solref` and `solimp` of a contact point with a stiffness in N/m, critically damped.

    MuJoCo's own stiffness k is an acceleration per depth. In a contact at rest the force is k / ((1 - d) weight) times
    the depth, where d is the impedance, the same at all depths here. So k follows from d, which is as low as keeps k
    within what a time step allows. Where even the greatest impedance, 0.9999, is not enough, the contact is softer than
    asked for: it is then as stiff as the step allows.

    Args:
        surface: of the contact.
        weight: sum of the inverse weights of the two bodies, 1/kg.
        timestep: s.

    Returns:
        `solref` [2] in MuJoCo's direct format, (-stiffness, -damping), and `solimp` [5].
    """
    most = 1 / (2 * timestep) ** 2
    per_share = surface.stiffness * weight
    share = float(np.clip(most / per_share, 1e-4, 0.1))
    stiffness = min(share * per_share, most)
    return np.array([-stiffness, -2 * np.sqrt(stiffness)]), np.array([1 - share, 1 - share, 0.001, 0.5, 2.0])
