"""Choose the view of a scene: the direction in which arms and objects hide the least of what matters.

    view = best_view(scene)
    Renderer(scene.model).render(data, view)

What matters are tool tips, the points that targets are drawn around, objects, thread and tissue. The directions are
tried with the arms in several postures about home. The same scene always gives the same view.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgical_marl.robots.spec import VISUAL_GROUP
from surgical_marl.scenes.scene import Scene
from surgical_marl.view.render import View
from surgical_marl.vision.skin import skins

if TYPE_CHECKING:
    from surgical_marl.tasks.base.task import Task

Array = NDArray[np.float64]

_AZIMUTHS, _ELEVATIONS = range(0, 360, 15), (-25.0, -33.0, -42.0)
_FOVY = 40.0
_POSTURES = 6
_NEAR = 0.15
"""Part of every joint's range about home that postures are drawn from."""
_AROUND = 0.03
"""Distance from the point in front of an arm within which its targets are looked for, m."""
_SLACK = 0.012
"""A point counts as seen if a ray ends at most so far in front of it, m: it may lie within a tool."""
_FILLED, _LEAST = 0.8, 0.25
"""Part of the picture that the points fill; least distance, over that of the scene's own camera."""
_TABLES = {"points": 3, "starts": 7}
"""Tables of a task that hold places in the world, and how many numbers a row has."""
_STEEP, _NEAREST = -40.0, 0.02
"""Elevation of a view from near at most, degrees, and half of the height that it shows at least, m."""
_PLACES = 16
"""Rows of a task's tables that are looked at, about."""
_TURNED, _CLOSE = 0.25, 0.5
"""Costs of a view from the other side than the scene's own camera, and of one that something close by fills."""
_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)


class _Moment(NamedTuple):
    """The arms in one posture, and the points that should be seen then, [P, 3]."""

    data: mujoco.MjData
    points: Array


def best_view(scene: Scene, places: Array | None = None, aspect: float = 4 / 3, whole: bool = False) -> View:
    """Return the view of a scene in which the least is hidden.

    Args:
        scene: what is looked at.
        places: further points in the world that should be seen, [P, 3], m.
        aspect: width over height of the picture.
        whole: hold all of the arms too, from farther away.
    """
    moments = _moments(scene, np.zeros((0, 3)) if places is None else places)
    points = moments[0].points
    middle = (points.min(0) + points.max(0)) / 2
    own = moments[0].data.camera("overview").xpos - middle
    least = _LEAST * float(np.linalg.norm(own))
    if whole:
        parts = _parts(scene.model, moments[0].data)
        own = middle - parts.mean(0)  # from across the arms
        points = np.concatenate([points, parts])
        middle = (points.min(0) + points.max(0)) / 2
    ways = [(azimuth, elevation) for elevation in _ELEVATIONS for azimuth in _AZIMUTHS]
    views = [_fitted(points, middle, least, aspect, *way) for way in ways]
    return max(views, key=lambda view: _score(scene, moments, view, own))


class Focus:
    """A view from near that follows what a scene is about.

    That is the needle that a thread is tied to, else the only free object, else tissue, else the tool tips.

    Args:
        scene: what is looked at.
        view: from which side.
    """

    def __init__(self, scene: Scene, view: View) -> None:
        self._view = replace(view, elevation=min(view.elevation, _STEEP), fovy=_FOVY)
        model = scene.model
        needles = [tie.body for system in scene.systems.values() for tie in system.ties if tie.body]
        only = list(scene.free_objects) if len(scene.free_objects) == 1 else []
        names = (needles or only or [skin.name for skin in skins(scene.systems, model)])[:1]
        owners = [model.body(int(body)).name.partition("/")[0] for body in model.geom_bodyid]
        self._geoms = [geom for geom, owner in enumerate(owners) if owner in names]
        self._tips = [model.site(f"{agent}/tool_tip").id for agent in scene.agents]

    def __call__(self, data: mujoco.MjData) -> View:
        """Return the view at a pose, after `mj_kinematics`."""
        points = data.geom_xpos[self._geoms] if self._geoms else data.site_xpos[self._tips]
        middle = (points.min(0) + points.max(0)) / 2
        half = max(_NEAREST, 0.7 * float(np.ptp(points, axis=0).max()))
        return replace(self._view, lookat=tuple(middle.tolist()), distance=half / np.tan(np.radians(_FOVY / 2)))


def task_places(task: Task) -> Array:
    """Return points in the world that episodes of a task are about, [P, 3], m: where objects begin and should be.

    Goals of tool tips are near the points in front of the arms, which every view shows.
    """
    tables = {name.removeprefix("work_"): np.asarray(table) for name, table in task.tables.items()}
    known = [tables[name] for name, width in _TABLES.items() if name in tables and tables[name].shape[1:] == (width,)]
    found = [table[:: -(-len(table) // _PLACES), :3] for table in known]
    extremes = [table[[*table[:, :3].argmin(0), *table[:, :3].argmax(0)], :3] for table in known]
    return np.concatenate([np.zeros((0, 3)), *found, *extremes]).astype(float)


def _fitted(points: Array, middle: Array, least: float, aspect: float, azimuth: float, elevation: float) -> View:
    """Return a view in this direction from so far that it shows all points, and from `least` away or farther."""
    view = View(tuple(middle.tolist()), least, azimuth, elevation, _FOVY)
    _, axes = view.pose()
    across, up, back = ((points - middle) @ axes).T
    side = _FILLED * np.tan(np.radians(_FOVY / 2))
    needed = back + np.maximum(np.abs(across) / aspect, np.abs(up)) / side
    return replace(view, distance=max(least, float(needed.max())))


def seen(model: mujoco.MjModel, data: mujoco.MjData, eye: Array, points: Array) -> NDArray[np.bool_]:
    """Return which points [P, 3] nothing hides from a place."""
    ways = points - eye
    away = np.linalg.norm(ways, axis=1)
    hit = _hits(model, data, eye, ways / away[:, None])
    return (hit < 0) | (hit > away - _SLACK)


def _score(scene: Scene, moments: list[_Moment], view: View, own: Array) -> float:
    """Return the score of a view, 1 at most: the share of points that are seen, less costs of side and closeness."""
    eye, axes = view.pose()
    shares = [seen(scene.model, moment.data, eye, moment.points).mean() for moment in moments]
    side = np.tan(np.radians(_FOVY / 2)) * np.linspace(-1, 1, 9)
    rays = np.stack([*np.meshgrid(4 / 3 * side, side), np.full((9, 9), -1.0)], axis=-1).reshape(-1, 3)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ axes.T
    hit = _hits(scene.model, moments[0].data, eye, rays)
    close = ((hit >= 0) & (hit < 0.6 * view.distance)).mean()
    towards = (eye - np.asarray(view.lookat)) / view.distance
    turned = (1 - towards @ own / np.linalg.norm(own)) / 2
    return float(np.mean(shares) - _CLOSE * close - _TURNED * turned)


def _moments(scene: Scene, places: Array) -> list[_Moment]:
    """Return the arms at home and in postures about it, with tool tips, targets and objects."""
    rng, model = np.random.default_rng(0), scene.model
    still = [*places, *(model.body(name).pos for name in scene.free_objects)]
    for system in scene.systems.values():
        if system.bars is not None:
            nodes = system.bars.start
            still += list(nodes[:: -(-len(nodes) // _PLACES)]) + list(nodes[[*nodes.argmin(0), *nodes.argmax(0)]])
    for mount in scene.mounts.values():
        steps = _AROUND * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        still += list(mount.position + (mount.workspace + steps) @ mount.rotation.T)
    found = []
    for number in range(_POSTURES):
        spread = _NEAR if number else 0.0
        drawn = {
            agent: mount.arm.home + spread * (rng.uniform(mount.arm.lower, mount.arm.upper) - mount.arm.home)
            for agent, mount in scene.mounts.items()
        }
        data = mujoco.MjData(model)
        data.qpos[:] = scene.full_qpos(drawn)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        tips = [data.site(f"{agent}/tool_tip").xpos for agent in scene.agents]
        found.append(_Moment(data, np.array([*tips, *still])))
    return found


def _parts(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Return the corners of boxes about all visible parts of arms, [P, 3], m."""
    parts = np.flatnonzero(model.geom_group == VISUAL_GROUP)
    corners = np.stack(np.meshgrid(*3 * [[-1.0, 1.0]]), -1).reshape(-1, 3)
    local = model.geom_aabb[parts, None, :3] + corners * model.geom_aabb[parts, None, 3:]
    turned = np.einsum("gij,gcj->gci", data.geom_xmat[parts].reshape(-1, 3, 3), local)
    return (turned + data.geom_xpos[parts, None]).reshape(-1, 3)


def _hits(model: mujoco.MjModel, data: mujoco.MjData, eye: Array, rays: Array) -> Array:
    """Return the distances at which rays from a place first meet a geom, -1 for none."""
    count = len(rays)
    geom, distance = np.empty(count, np.int32), np.empty(count)
    mujoco.mj_multiRay(
        m=model,
        d=data,
        pnt=eye,
        vec=np.ascontiguousarray(rays).reshape(-1),
        geomgroup=_GROUPS,
        flg_static=True,
        bodyexclude=-1,
        geomid=geom,
        dist=distance,
        normal=None,
        nray=count,
        cutoff=1e10,
    )
    return np.where(geom >= 0, distance, -1.0)
