"""A scene: arms mounted in a world, as one MuJoCo model.

    scene = load_scene("bimanual_psm")
    scene.agents                                # ("psm_0", "psm_1")
    scene.model                                 # mujoco.MjModel; names of an arm start with "psm_0/"

A scene file names each agent's arm, where its base frame stands, and the point its targets are drawn around. Which
geoms can touch is found by a sweep (`surgical_marl/contacts.py`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from surgical_marl.arm import Arm, load_arm
from surgical_marl.arm_spec import COLLISION_GROUP, SOLREF
from surgical_marl.contacts import Capsule, capsule_distance, collision_geoms, contact_pairs
from surgical_marl.content import find
from surgical_marl.randomisation import Randomisation, read_randomisation
from surgical_marl.yaml_file import check_keys, read_yaml

STILL = {"contype": 0, "conaffinity": 0, "group": 1}
"""Of geoms for the eye alone: nothing collides with them."""
TISSUE_SHAPES = {
    "ellipsoid": (mujoco.mjtGeom.mjGEOM_ELLIPSOID, 3, "three semi-axes"),
    "box": (mujoco.mjtGeom.mjGEOM_BOX, 3, "three half sides"),
    "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, 2, "radius and half length along z"),
}
"""What `size` of a piece of tissue holds: how many lengths in m, and which."""
TIMESTEP = 0.0025
"""Physics step in s. docs/physics.md has the stability test that chose it."""
DECIMATION = 8
"""Physics steps a control step: control at 50 Hz."""
PAYLOAD = "payload"
"""The body at an arm's tool tip that stands for what it carries, where that is randomised: `<agent>/payload`."""


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
    randomisation: Randomisation
    """How far arms are from the model and from what is measured; not at all unless the file says so."""

    @property
    def agents(self) -> tuple[str, ...]:
        """Names `<arm>_<number>`, in the order of the scene file."""
        return tuple(self.mounts)

    @cached_property
    def types(self) -> dict[str, tuple[str, ...]]:
        """Agents by the arm they are: {"psm": ("psm_0", "psm_1")}."""
        names = dict.fromkeys(mount.arm.name for mount in self.mounts.values())
        return {name: tuple(a for a in self.agents if self.mounts[a].arm.name == name) for name in names}

    def alone(self, agent: str) -> mujoco.MjModel:
        """The model of one arm of the scene, its base frame at the origin."""
        mount = replace(self.mounts[agent], position=np.zeros(3), rotation=np.eye(3))
        return _compile(_build(self.name, {agent: mount}, self.control, self.randomisation))

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

    @cached_property
    def moment(self) -> np.ndarray:
        """What the actuators act on, [nu, nv]: 1 at a joint's own, the coefficients of a cable's joints at a cable's.

        `moment @ qpos` commands a posture to position control, `moment @ qvel` velocities to velocity control.
        """
        data, moment = mujoco.MjData(self.model), np.zeros((self.model.nu, self.model.nv))
        mujoco.mj_fwdPosition(self.model, data)
        rows = data.moment_rownnz, data.moment_rowadr, data.moment_colind
        mujoco.mju_sparse2dense(moment, data.actuator_moment, *rows)
        return moment

    @cached_property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Geoms that can touch, by their names `<agent>/<geom>`, in the order of `State.contacts`."""
        geom = self.model.geom
        ids = zip(self.model.pair_geom1, self.model.pair_geom2, strict=True)
        return tuple((geom(int(a)).name, geom(int(b)).name) for a, b in ids)

    @property
    def fingerprint(self) -> bytes:
        """What kinematics and shapes come from: equal for scenes that move and touch alike."""
        m = self.model
        numbers = (m.body_parentid, m.body_pos, m.body_quat, m.jnt_axis, m.jnt_pos, m.jnt_range, m.jnt_type, m.site_pos,
                   m.geom_bodyid, m.geom_group, m.geom_type, m.geom_size, m.geom_pos, m.geom_quat, self.home,
                   *(mount.workspace for mount in self.mounts.values()))  # fmt: skip
        joints = {
            agent: mount.arm.joints for agent, mount in self.mounts.items()
        }  # what mimics what is not in the model
        return repr(joints).encode() + b"".join(np.ascontiguousarray(number).tobytes() for number in numbers)

    def clearance(self, q: dict[str, np.ndarray], within: bool = False) -> np.ndarray:
        """Least distance in m of any two arms, or of parts within one arm; inf if there is no such pair.

        `q` holds each agent's joints [..., n]; the result is [...].
        """
        capsules = self.capsules(q)
        least: Any = np.full(np.broadcast_shapes(*(np.shape(value)[:-1] for value in q.values())), np.inf)
        ids = zip(self.model.pair_geom1, self.model.pair_geom2, strict=True)
        for (one, other), (a, b) in zip(self.pairs, ids, strict=True):
            if (one.split("/")[0] == other.split("/")[0]) == within:
                least = np.minimum(least, capsule_distance(capsules[a], capsules[b]))
        return np.asarray(least)

    def capsules(self, q: dict[str, np.ndarray]) -> dict[int, Capsule]:
        """Axis ends in the world and radius of every collision geom, by geom id; joints of each agent [..., n]."""
        model, capsules = self.model, {}
        for agent, mount in self.mounts.items():
            geoms = collision_geoms(model, agent)
            links = {geom: model.body(model.geom_bodyid[geom]).name.removeprefix(f"{agent}/") for geom in geoms}
            poses = mount.arm.link_poses(q[agent], tuple(dict.fromkeys(links.values())))
            for geom in geoms:
                rotation = np.zeros(9)
                mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
                # a sphere has no half length: MuJoCo leaves zero there
                half = rotation.reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
                pose = poses[links[geom]] @ _transform(model.geom_pos[geom])
                a, b = ((pose[..., :3, :3] @ end + pose[..., :3, 3]) @ mount.rotation.T + mount.position
                        for end in (-half, half))  # fmt: skip
                capsules[geom] = (a, b, float(model.geom_size[geom, 0]))
        return capsules


def load_scene(name: str | Path, control: str = "position") -> Scene:
    """Reads a scene by a shipped name (`list_scenes()`) or the path of a YAML file.

    Raises:
        ValueError: unknown name or control mode, or a file that does not hold what a scene must.
    """
    path = find("scenes", name)
    settings = read_yaml(path)
    check_keys(settings, ("description", "arms", "view", "tissue", "randomisation"), path)
    arms = settings.get("arms")
    if not isinstance(arms, dict) or not arms:
        raise ValueError(f"{path}: arms must map agent names such as psm_0 to arms")
    mounts = {agent: _read_mount(agent, mount, path) for agent, mount in arms.items()}
    randomisation = read_randomisation(settings.get("randomisation"), path)
    spec = _build(path.stem, mounts, control, randomisation)
    _add_surroundings(spec, mounts, settings.get("view"), path)
    for piece, what in _mapping(settings.get("tissue"), f"{path}, tissue").items():
        _add_tissue(spec, f"tissue/{piece}", what, f"{path}, tissue {piece!r}")
    model = _compile(spec)
    scene = Scene(path.stem, str(settings.get("description", "")), control, mounts, model, randomisation)
    for one, other in contact_pairs(scene):
        spec.add_pair(geomname1=one, geomname2=other, condim=1, solref=SOLREF)
    return replace(scene, model=_weigh_shapes(_compile(spec), scene.home))


def _read_mount(agent: str, settings: Any, path: Path) -> Mount:
    where = f"{path}, agent {agent!r}"
    if not isinstance(settings, dict) or "arm" not in settings:
        raise ValueError(f"{where}: must be a mapping that names its arm")
    check_keys(settings, ("arm", "position", "turn", "tilt", "workspace"), where)
    source = str(settings["arm"])
    local = path.parent / source  # a user's own arm may be named relative to the scene file
    arm = load_arm(local if (local / "arm.yaml").is_file() else source)
    if not re.fullmatch(re.escape(arm.name) + r"_\d+", str(agent)):
        raise ValueError(f"{where}: an agent of arm {arm.name!r} is called {arm.name}_0, {arm.name}_1 and so on")
    vectors = {key: _vector(settings.get(key, [0.0, 0.0, 0.0]), f"{where}, {key}") for key in
               ("position", "tilt", "workspace")}  # fmt: skip
    turn = _vector([0.0, 0.0, settings.get("turn", 0.0)], f"{where}, turn")
    rotation = _rotation(vectors["tilt"]) @ _rotation(turn)
    return Mount(arm, vectors["position"], rotation, vectors["workspace"])


def _vector(value: Any, where: str, count: int = 3, words: str = "three finite numbers") -> np.ndarray:
    try:
        vector = np.array(value, dtype=float)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (count,) or not np.isfinite(vector).all():
        raise ValueError(f"{where}: {value!r} must be {words}")
    return vector


def _rotation(tilt: np.ndarray) -> np.ndarray:
    """Rotation matrix of turns by `tilt` degrees about the fixed axes x, then y, then z."""
    quat, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_euler2Quat(quat, np.radians(tilt), "XYZ")
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _transform(position: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return matrix


def set_physics(spec: mujoco.MjSpec) -> None:
    """The physics options of every scene."""
    option = spec.option
    option.timestep = TIMESTEP
    # Implicit in velocity: the stiff wrist controllers stay stable even at 5 ms. docs/physics.md compares.
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # dVRK arms are balanced by counterweights (identified gravity torque under 0.4 N m), so gravity is off.
    option.gravity = [0.0, 0.0, 0.0]


def _build(name: str, mounts: dict[str, Mount], control: str, randomisation: Randomisation) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.compiler.degree = False
    spec.copy_during_attach = True
    set_physics(spec)
    for agent, mount in mounts.items():
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, mount.rotation.ravel())
        frame = spec.worldbody.add_frame(pos=mount.position, quat=quat)
        spec.attach(mount.arm.spec(control), prefix=f"{agent}/", frame=frame)
        if randomisation.payload:
            spec.body(f"{agent}/{mount.arm.tool_tip}").add_body(name=f"{agent}/{PAYLOAD}")
    return spec


def _compile(spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"scene {spec.modelname!r} does not compile: {' '.join(str(error).split())}") from None


def _weigh_shapes(model: mujoco.MjModel, home: np.ndarray) -> mujoco.MjModel:
    """Sets what a body weighs in a contact (`body_invweight0`, 1/kg) to what it weighs where its shapes are.

    MuJoCo takes the centre of mass. A balanced link has it at the pivot, where nothing can move it: its contacts would
    be infinitely stiff, and throw the arms about.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = home
    mujoco.mj_forward(model, data)
    for body in np.unique(model.geom_bodyid[model.geom_group == COLLISION_GROUP]):
        weights = []
        for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_group == COLLISION_GROUP)):
            jacobian, moved = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[geom], body)
            mujoco.mj_solveM(model, data, moved, jacobian)
            weights.append(np.sum(jacobian * moved) / 3)
        model.body_invweight0[body, 0] = np.mean(weights)
    return model


def _add_surroundings(spec: mujoco.MjSpec, mounts: dict[str, Mount], view: Any, path: Path) -> None:
    """What a picture needs: the operating field, a trocar at each remote center, light, a camera. Nothing collides."""
    spec.worldbody.add_geom(
        name="field", type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=[0.22, 0.16, 0.04], pos=[0, 0, -0.075],
        rgba=[0.72, 0.34, 0.31, 1], **STILL,
    )  # fmt: skip
    for agent, mount in mounts.items():
        if mount.arm.remote_center is not None:
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, mount.rotation.ravel())
            spec.worldbody.add_geom(
                name=f"{agent}_trocar", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.011, 0.002, 0],
                pos=mount.position, quat=quat, rgba=[0.95, 0.78, 0.20, 1], **STILL,
            )  # fmt: skip
    spec.worldbody.add_light(pos=[0.2, 0.4, 0.9], dir=[-0.2, -0.4, -0.9])
    view = {"position": [0.0, 0.75, 0.40], "target": [0.0, 0.0, 0.07], **_mapping(view, f"{path}, view")}
    check_keys(view, ("position", "target"), f"{path}, view")
    position, target = (_vector(view[key], f"{path}, view, {key}") for key in ("position", "target"))
    back = position - target
    right = np.cross([0.0, 0.0, 1.0], back)
    if not np.linalg.norm(right) > 1e-6:
        raise ValueError(f"{path}, view: position {position} must not be straight above or at the target {target}")
    axes = np.concatenate([right, np.cross(back, right)])
    spec.worldbody.add_camera(name="overview", pos=position, xyaxes=axes, fovy=42)


def _add_tissue(spec: mujoco.MjSpec, name: str, settings: Any, where: str) -> None:
    """A coloured piece for an endoscope to look at. It belongs to the world and never moves."""
    settings = _mapping(settings, where)
    check_keys(settings, ("shape", "size", "position", "tilt", "colour"), where)
    if settings.get("shape") not in TISSUE_SHAPES:
        raise ValueError(f"{where}: shape {settings.get('shape')!r} must be one of {', '.join(TISSUE_SHAPES)}")
    kind, lengths, words = TISSUE_SHAPES[settings["shape"]]
    size = _vector(settings.get("size"), f"{where}, size", lengths, f"{words} in m")
    colour = _vector(settings.get("colour"), f"{where}, colour")
    if not (size > 0).all() or not ((colour >= 0) & (colour <= 1)).all():
        raise ValueError(f"{where}: size {size.tolist()} must be above 0, and colour {colour.tolist()} from 0 to 1")
    position, tilt = (_vector(settings.get(key, [0, 0, 0]), f"{where}, {key}") for key in ("position", "tilt"))
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, _rotation(tilt).ravel())
    spec.worldbody.add_geom(
        name=name, type=kind, size=[*size, 0][:3], pos=position, quat=quat, rgba=[*colour, 1], **STILL
    )


def _mapping(value: Any, where: str) -> dict[str, Any]:
    if value is not None and not isinstance(value, dict):
        raise ValueError(f"{where}: {value!r} must be a mapping")
    return value or {}
