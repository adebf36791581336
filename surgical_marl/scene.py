"""A scene: arms mounted in a world, as one MuJoCo model.

    scene = load_scene("bimanual_psm")
    scene.agents                                # ("psm_0", "psm_1")
    scene.model                                 # mujoco.MjModel; names of an arm start with "psm_0/"

A scene file names each agent's arm, where its base frame stands, and the point its targets are drawn around.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from surgical_marl.arm import Arm, check_keys, load_arm, read_yaml
from surgical_marl.arm_spec import COLLISION_GROUP
from surgical_marl.content import find
from surgical_marl.geometry import segment_distance

TIMESTEP = 0.005
"""Physics step in s. docs/physics.md has the stability test that chose it."""
DECIMATION = 4
"""Physics steps a control step: control at 50 Hz."""


@dataclass(frozen=True)
class Mount:
    """An arm in a scene."""

    arm: Arm
    position: np.ndarray
    """Origin of the base frame in the world, m, shape [3]."""
    rotation: np.ndarray
    """Axes of the base frame in the world, shape [3, 3]."""
    workspace: np.ndarray
    """The point in front of the arm that targets are drawn around, base frame, m, shape [3]."""


@dataclass(frozen=True)
class Scene:
    """Arms in a world. `model` holds them all; `control` is how their actuators read commands."""

    name: str
    description: str
    control: str
    mounts: dict[str, Mount]
    model: mujoco.MjModel = field(repr=False)

    @property
    def agents(self) -> tuple[str, ...]:
        """Names `<arm>_<number>`, in the order of the scene file."""
        return tuple(self.mounts)

    @cached_property
    def types(self) -> dict[str, tuple[str, ...]]:
        """Agents by the arm they are: {"psm": ("psm_0", "psm_1")}."""
        names = dict.fromkeys(mount.arm.name for mount in self.mounts.values())
        return {name: tuple(a for a in self.agents if self.mounts[a].arm.name == name) for name in names}

    @property
    def home(self) -> np.ndarray:
        """`qpos` with every arm at its home, shape [nq]."""
        return self.full_qpos({agent: mount.arm.home for agent, mount in self.mounts.items()})

    def qpos_index(self, agent: str) -> np.ndarray:
        """Where the actuated joints of an agent stand in `qpos`, shape [n]."""
        names = [joint.name for joint in self.mounts[agent].arm.actuated]
        return np.array([self.model.joint(f"{agent}/{name}").qposadr[0] for name in names])

    def full_qpos(self, q: dict[str, np.ndarray]) -> np.ndarray:
        """`qpos` [..., nq] from each agent's actuated joints [..., n]: joints that mimic another follow it."""
        batch = np.broadcast_shapes(*(np.shape(value)[:-1] for value in q.values()))
        qpos = np.zeros((*batch, self.model.nq))
        for agent, mount in self.mounts.items():
            names = [joint.name for joint in mount.arm.actuated]
            for joint in mount.arm.joints:
                address = self.model.joint(f"{agent}/{joint.name}").qposadr[0]
                qpos[..., address] = joint.multiplier * q[agent][..., names.index(joint.leader)] + joint.offset
        return qpos

    def clearance(self, q: dict[str, np.ndarray]) -> np.ndarray:
        """Least distance in m between any two arms, from each agent's joints [..., n] -> [...]; inf for one arm."""
        capsules = {agent: self._capsules(agent, q[agent]) for agent in self.agents}
        least: Any = np.inf
        for one, other in combinations(self.agents, 2):
            for a, b, radius in capsules[one]:
                for c, d, thickness in capsules[other]:
                    least = np.minimum(least, segment_distance(a, b, c, d) - radius - thickness)
        return np.asarray(least)

    def _capsules(self, agent: str, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """End points [..., 3] in the world and radius of every collision geom of an agent."""
        model, mount = self.model, self.mounts[agent]
        geoms = collision_geoms(model, agent)
        links = {geom: model.body(model.geom_bodyid[geom]).name.removeprefix(f"{agent}/") for geom in geoms}
        poses = mount.arm.link_poses(q, tuple(dict.fromkeys(links.values())))
        capsules = []
        for geom in geoms:
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
            half = rotation.reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
            pose = poses[links[geom]]
            a, b = (
                (pose[..., :3, :3] @ (model.geom_pos[geom] + end) + pose[..., :3, 3]) @ mount.rotation.T
                + mount.position
                for end in (-half, half)
            )
            capsules.append((a, b, float(model.geom_size[geom, 0])))
        return capsules


def load_scene(name: str | Path, control: str = "position") -> Scene:
    """Reads a scene by a shipped name (`list_scenes()`) or the path of a YAML file.

    Raises:
        ValueError: unknown name or control mode, or a file that does not hold what a scene must.
    """
    path = find("scenes", name)
    settings = read_yaml(path)
    check_keys(settings, ("description", "arms"), path)
    arms = settings.get("arms")
    if not isinstance(arms, dict) or not arms:
        raise ValueError(f"{path}: arms must map agent names such as psm_0 to arms")
    mounts = {agent: _read_mount(agent, mount, path) for agent, mount in arms.items()}
    return Scene(
        name=path.stem,
        description=str(settings.get("description", "")),
        control=control,
        mounts=mounts,
        model=_compile(path.stem, mounts, control),
    )


def collision_geoms(model: mujoco.MjModel, agent: str) -> list[int]:
    """Ids of the geoms of one agent that can touch another arm."""
    ids = np.flatnonzero(model.geom_group == COLLISION_GROUP)
    return [int(i) for i in ids if model.geom(int(i)).name.startswith(f"{agent}/")]


def _read_mount(agent: str, settings: Any, path: Path) -> Mount:
    where = f"{path}, agent {agent!r}"
    if not isinstance(settings, dict) or "arm" not in settings:
        raise ValueError(f"{where}: must be a mapping that names its arm")
    check_keys(settings, ("arm", "position", "tilt", "workspace"), where)
    source = str(settings["arm"])
    local = path.parent / source  # a user's own arm may be named relative to the scene file
    arm = load_arm(local if (local / "arm.yaml").is_file() else source)
    if not re.fullmatch(re.escape(arm.name) + r"_\d+", str(agent)):
        raise ValueError(f"{where}: an agent of arm {arm.name!r} is called {arm.name}_0, {arm.name}_1 and so on")
    vectors = {key: _vector(settings.get(key, [0.0, 0.0, 0.0]), f"{where}, {key}") for key in
               ("position", "tilt", "workspace")}  # fmt: skip
    return Mount(arm, vectors["position"], _rotation(vectors["tilt"]), vectors["workspace"])


def _vector(value: Any, where: str) -> np.ndarray:
    try:
        vector = np.array(value, dtype=float)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{where}: {value!r} must be three finite numbers")
    return vector


def _rotation(tilt: np.ndarray) -> np.ndarray:
    """Rotation matrix of turns by `tilt` degrees about the fixed axes x, then y, then z."""
    quat, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_euler2Quat(quat, np.radians(tilt), "XYZ")
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _compile(name: str, mounts: dict[str, Mount], control: str) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.compiler.degree = False
    spec.copy_during_attach = True
    option = spec.option
    option.timestep = TIMESTEP
    # Implicit in velocity: the stiff wrist controllers stay stable at 5 ms. One Newton iteration with a warm start is
    # enough for limits and tool contacts, and lets MJX skip its loop. docs/physics.md compares.
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.iterations = 1
    option.ls_iterations = 4
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # dVRK arms are balanced by counterweights (identified gravity torque under 0.4 N m), so gravity is off.
    option.gravity = [0.0, 0.0, 0.0]
    _add_field(spec)
    for agent, mount in mounts.items():
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, mount.rotation.ravel())
        frame = spec.worldbody.add_frame(pos=mount.position, quat=quat)
        spec.attach(mount.arm.spec(control), prefix=f"{agent}/", frame=frame)
    for one, other in combinations(mounts, 2):
        geoms = [[g.name for g in spec.geoms if g.group == COLLISION_GROUP and g.name.startswith(f"{agent}/")]
                 for agent in (one, other)]  # fmt: skip
        for first in geoms[0]:
            for second in geoms[1]:
                spec.add_pair(geomname1=first, geomname2=second, condim=1)
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"scene {name!r} does not compile: {' '.join(str(error).split())}") from None


def _add_field(spec: mujoco.MjSpec) -> None:
    """What a picture needs: the operating field under the arms, light, a camera. Nothing here collides."""
    still = {"contype": 0, "conaffinity": 0, "group": 1}
    spec.worldbody.add_geom(
        name="field", type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=[0.22, 0.16, 0.04], pos=[0, 0, -0.075],
        rgba=[0.72, 0.34, 0.31, 1], **still,
    )  # fmt: skip
    spec.worldbody.add_light(pos=[0.2, -0.4, 0.9], dir=[-0.2, 0.4, -0.9])
    spec.worldbody.add_camera(name="overview", pos=[0, -0.52, 0.30], xyaxes=[1, 0, 0, 0, 0.45, 0.893], fovy=42)
