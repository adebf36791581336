"""One moment of N environments as numbers, for any drawing.

    moment = Observer(env.scene).look(env)
    moment.nearest[0]                       # the shortest line between two arms of the first environment

Places follow from joint positions and object poses by C MuJoCo's kinematics, so that they fit the pictures.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from surgical_marl.robots.spec import PAD_GROUP

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.scenes.scene import Scene

FAR = 10.0
"""Distance in m beyond which two shapes need not be compared."""


class Near(NamedTuple):
    """The shortest line between two arms."""

    distance: float
    """m; below 0 where they overlap."""
    ends: np.ndarray
    """Ends of the line in the world, [2, 3], m."""


class Push(NamedTuple):
    """A contact of two shapes."""

    place: np.ndarray
    """Place of the contact in the world, [3], m."""
    direction: np.ndarray
    """Unit vector from the first shape into the second one, [3]: this way the first one pushes."""
    force: float
    """Normal force, N."""


class Grip(NamedTuple):
    """A finger of a jaw that presses on an object."""

    arm: int
    """Number of the arm."""
    push: Push
    """Force of the finger on the object."""


class Moment(NamedTuple):
    """N environments at one moment, each in its own world; lengths in m, quaternions w, x, y, z."""

    positions: np.ndarray
    """Origins of all bodies of the scene's model, [N, bodies, 3]."""
    quaternions: np.ndarray
    """Orientations of all bodies, [N, bodies, 4]."""
    tips: np.ndarray
    """Tool tips, [N, arms, 3]."""
    objects: np.ndarray
    """Origins of free objects, [N, k, 3]."""
    held: np.ndarray
    """True where an arm holds a free object, [N, k, arms] bool."""
    marks: np.ndarray
    """Places that the task marks as goals, [N, marks, 3]."""
    nearest: list[Near | None]
    """Shortest line between two arms, for each environment; None in a scene of one arm."""
    pushes: list[list[Push]]
    """Contacts of arms in the last step, for each environment."""
    grips: list[list[Grip]]
    """Fingers that pressed on free objects at the end of the last step, for each environment."""
    nodes: dict[str, np.ndarray]
    """Nodes of thread and tissue by name, [N, n, 3] each."""


class Observer:
    """Reads moments from environments of one scene."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._data = mujoco.MjData(scene.model)
        names = scene.pairs
        self._geoms = list(zip(scene.model.pair_geom1.tolist(), scene.model.pair_geom2.tolist(), strict=True))
        self._between = [k for k, (one, other) in enumerate(names) if _owner(one) != _owner(other)]
        self._sites = [scene.model.site(f"{agent}/tool_tip").id for agent in scene.agents]
        self._fingers = [
            (arm, int(geom))
            for arm, agent in enumerate(scene.agents)
            for geom in np.flatnonzero(scene.model.geom_group == PAD_GROUP)
            if _owner(scene.model.geom(int(geom)).name) == agent
        ]
        """Number of the arm and geom of each finger, in the order of `env.grip_forces`."""
        self._shapes = [
            [scene.model.geom(f"{name}/{number}").id for number in range(len(place.object.shapes))]
            for name, place in scene.free_objects.items()
        ]
        """Geoms of each free object."""

    def look(self, env: BatchedEnv, forces: np.ndarray | None = None) -> Moment:
        """Return the moment in which the environments are now.

        Args:
            env: environments of the scene, with numpy arrays.
            forces: normal forces of `scene.pairs` in the last step, [N, P], N; None where there was no such step.
        """
        qpos, poses, marks = env.qpos, env.drawn_poses, env.task.marks(env.goal)
        count, bodies = len(qpos), self._scene.model.nbody
        positions, quaternions = np.empty((count, bodies, 3)), np.empty((count, bodies, 4))
        tips = np.empty((count, len(self._sites), 3))
        nearest: list[Near | None] = []
        pushes: list[list[Push]] = []
        grips: list[list[Grip]] = []
        pressed = env.grip_forces
        for row in range(count):
            self._place(qpos[row], poses.origin[row], poses.quaternion[row])
            positions[row], quaternions[row] = self._data.xpos, self._data.xquat
            tips[row] = self._data.site_xpos[self._sites]
            nearest.append(self._nearest())
            pushes.append([] if forces is None else self._pushes(forces[row]))
            grips.append(self._grips(pressed[row]))
        marks = np.asarray(marks, float) if marks.size else np.zeros((count, 0, 3))
        objects = poses.origin[:, : len(self._shapes)]
        return Moment(positions, quaternions, tips, objects, env.held, marks, nearest, pushes, grips, env.drawn_nodes)

    def _place(self, qpos: np.ndarray, origins: np.ndarray, quaternions: np.ndarray) -> None:
        data = self._data
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = qpos, origins, quaternions
        mujoco.mj_kinematics(self._scene.model, data)

    def _nearest(self) -> Near | None:
        lines = [self._line(*self._geoms[k]) for k in self._between]
        return min(lines, key=lambda line: line.distance) if lines else None

    def _line(self, one: int, other: int) -> Near:
        ends = np.zeros(6)
        distance = mujoco.mj_geomDistance(self._scene.model, self._data, one, other, FAR, ends)
        return Near(float(distance), ends.reshape(2, 3))

    def _pushes(self, forces: np.ndarray) -> list[Push]:
        return [
            _push(self._line(*self._geoms[pair]), float(forces[pair])) for pair in np.flatnonzero(forces > 0).tolist()
        ]

    def _grips(self, forces: np.ndarray) -> list[Grip]:
        """Return which fingers press on which objects where their surfaces are nearest; forces [k, fingers], N."""
        found = []
        for item, finger in np.argwhere(forces > 0).tolist():
            arm, pad = self._fingers[finger]
            lines = [self._line(pad, geom) for geom in self._shapes[item]]
            line = min(lines, key=lambda line: line.distance)
            found.append(Grip(arm, _push(line, float(forces[item, finger]))))
        return found


def _push(line: Near, force: float) -> Push:
    """Return the push of the first shape on the second one, at the shortest line between the two."""
    start, end = line.ends
    way = start - end if line.distance < 0 else end - start  # shapes that overlap have each end inside the other
    length = float(np.linalg.norm(way))
    direction = way / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
    return Push((start + end) / 2, direction, force)


def _owner(geom: str) -> str:
    return geom.split("/")[0]
