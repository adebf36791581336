"""Surroundings of a scene in pictures for people: a draped table, a floor, stands under boards, booms for arms.

    Renderer(scene.model, stage=stage(scene), paint=paint(scene))

None of it is part of the scene: nothing touches it, and no endoscope sees it.
"""

from __future__ import annotations

import mujoco
import numpy as np

from surgical_marl.robots.spec import VISUAL_GROUP
from surgical_marl.scenes.scene import Mount, Scene
from surgical_marl.view.drawn import Extra
from surgical_marl.view.lighting import DRAPE, FLOOR, PLAIN
from surgical_marl.view.shading import AGENTS, CLOTH, GAMMA, PLASTIC, Material, material, named, visual_rgba
from surgical_marl.view.tracer import PLANE
from surgical_marl.vision.rays import BOX, CYLINDER, ELLIPSOID

TABLE = -0.045
"""Height of the table's top, m: the operating field, which ends at -0.035, is a low mound in the drape."""
_HALF = np.array([0.60, 0.42])
"""Half sides of the table at least, m."""
_HEIGHT = 0.9
"""Height of the table's top above the floor, m."""
_EDGE = 0.12
"""Distance from the middle of an arm's foot to the edge of the table, m."""
_BED = 0.075
"""Reach of the mound under tissue beyond the middles of the pieces, m."""
_BOOM, _BOOM_RADIUS = 1.5, 0.045
_INSET = 0.006
"""Distance of a stand's sides from the sides of the board on it, inwards, m."""


def stage(scene: Scene) -> list[Extra]:
    """Return the shapes that stand around a scene."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    mujoco.mj_kinematics(scene.model, data)
    feet = np.array([mount.position[:2] for mount in scene.mounts.values() if mount.arm.remote_center is None])
    half = np.maximum(_HALF, np.abs(feet).max(0) + _EDGE) if len(feet) else _HALF
    drape = Material(_linear(0.24, 0.46, 0.50), CLOTH, int(DRAPE))
    floor = Material(_linear(0.60, 0.63, 0.66), CLOTH, int(FLOOR))
    found = [
        Extra(int(BOX), (*half, 0.2), np.array([0.0, 0.0, TABLE - 0.2]), np.eye(3), drape, casts=False),
        Extra(int(PLANE), (0.0, 0.0, 0.0), np.array([0.0, 0.0, TABLE - _HEIGHT]), np.eye(3), floor),
    ]
    found += [_boom(scene, data, agent, mount) for agent, mount in scene.mounts.items() if mount.arm.remote_center]
    return found + _stands(scene, data) + _bed(scene.model)


def paint(scene: Scene) -> dict[int, Material]:
    """Return geom -> material of objects whose files name one, and of parts in the colour of an agent.

    That is its trocar or its foot, and its accent if it has just one: they have the agent's colour.
    """
    model, found = scene.model, named(scene.model, scene.objects)
    rgba = visual_rgba(model)
    for number, agent in enumerate(scene.agents):
        own = [geom for geom in range(model.ngeom) if _body(model, geom).startswith(f"{agent}/")]
        own = [geom for geom in own if model.geom_group[geom] == VISUAL_GROUP]
        coloured = [geom for geom in own if np.ptp(rgba[geom, :3]) > 0.5 * rgba[geom, :3].max()]
        marks = [geom for geom in range(model.ngeom) if model.geom(geom).name == f"{agent}_trocar"]
        marks = marks or [geom for geom in own if _body(model, geom) == _body(model, own[0])]
        for geom in [*marks, *(coloured if len(coloured) == 1 else ())]:
            found[geom] = material(np.array(AGENTS[number % len(AGENTS)]))
    return found


def _boom(scene: Scene, data: mujoco.MjData, agent: str, mount: Mount) -> Extra:
    """Return a tube that an arm hangs from."""
    model = scene.model
    bodies = [body for body in range(model.nbody) if model.body(body).name.startswith(f"{agent}/")]
    root = min(bodies)  # parents come first
    geoms = np.flatnonzero((model.geom_bodyid == root) & (model.geom_group == VISUAL_GROUP))
    foot = data.geom_xpos[geoms[0]] if len(geoms) else mount.position
    white = Material(_linear(0.88, 0.89, 0.91), PLASTIC, int(PLAIN))
    return Extra(
        int(CYLINDER), (_BOOM_RADIUS, _BOOM / 2, 0.0), foot + np.array([0.0, 0.0, _BOOM / 2]), np.eye(3), white
    )


def _stands(scene: Scene, data: mujoco.MjData) -> list[Extra]:
    """Return a block under each fixed board that would hang in the air."""
    model, found = scene.model, []
    grey = Material(_linear(0.80, 0.81, 0.83), PLASTIC, int(PLAIN))
    for name, placement in scene.objects.items():
        if placement.object.free:
            continue
        for geom in range(model.ngeom):
            if not model.geom(geom).name.startswith(f"{name}/") or model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_BOX:
                continue
            axes, place, size = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom], model.geom_size[geom]
            bottom = place[2] - size[2]
            if abs(axes[2, 2]) > 0.99 and bottom > TABLE + 1e-3 and size[:2].min() > 4 * _INSET:
                height = (bottom - TABLE) / 2
                centre = np.array([*place[:2], TABLE + height])
                found.append(Extra(int(BOX), (*(size[:2] - _INSET), height), centre, axes, grey))
    return found


def _bed(model: mujoco.MjModel) -> list[Extra]:
    """Return a mound under the pieces of tissue that lie about, so that none lies on the drape."""
    pieces = [geom for geom in range(model.ngeom) if model.geom(geom).name.startswith("tissue/")]
    lying = [geom for geom in pieces if model.geom_pos[geom][2] < 0]
    if not lying:
        return []
    places = model.geom_pos[lying][:, :2]
    middle, half = (places.min(0) + places.max(0)) / 2, np.ptp(places, axis=0) / 2 + _BED
    flesh = material(np.array([0.74, 0.38, 0.34]), fleshy=True)
    return [Extra(int(ELLIPSOID), (*half, 0.03), np.array([*middle, TABLE - 0.018]), np.eye(3), flesh)]


def _body(model: mujoco.MjModel, geom: int) -> str:
    name: str = model.body(model.geom_bodyid[geom]).name
    return name


def _linear(*rgb: float) -> np.ndarray:
    return np.array(rgb) ** GAMMA
