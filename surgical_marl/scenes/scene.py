"""A scene: arms mounted in a world, as one MuJoCo model.

scene = load_scene("bimanual_psm")
scene.agents                                # ("psm_0", "psm_1")
scene.model                                 # mujoco.MjModel; names of an arm start with "psm_0/"
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from surgical_marl.content import unknown
from surgical_marl.robots.arm import Arm
from surgical_marl.robots.spec import COLLISION_GROUP, build_spec, own_name
from surgical_marl.scenes.geometry import Capsule, capsule_distance, link_capsule
from surgical_marl.scenes.objects import Placement
from surgical_marl.untrusted.schema import number
from surgical_marl.untrusted.values import LARGEST

SHARE = 0.999
"""The largest share of a value by which it may be off."""


@dataclass(frozen=True)
class Randomisation:
    """Ranges of what is randomised, all zero unless given.

    All values except noise are drawn once per episode, uniformly, and separately for every joint, arm or object. Jaws
    get only other gains and friction. docs/randomisation.md has the sources of sensible values.
    """

    offset_angle: float = number(0.0, 0.0, LARGEST, unit="rad")
    """A joint's reading is off by up to this, rad; `offset_slide`, m, for prismatic joints."""
    offset_slide: float = number(0.0, 0.0, LARGEST, unit="m")
    backlash_angle: float = number(0.0, 0.0, LARGEST, unit="rad")
    """Greatest play between a joint and its motor, which has the encoder, rad. Only under position control."""
    backlash_slide: float = number(0.0, 0.0, LARGEST, unit="m")
    noise_angle: float = number(0.0, 0.0, LARGEST, unit="rad")
    """Standard deviation of a reading at each step, rad."""
    noise_slide: float = number(0.0, 0.0, LARGEST, unit="m")
    stiffness: float = number(0.0, 0.0, SHARE)
    """Gains of the controllers are off by up to this share of their value."""
    damping: float = number(0.0, 0.0, SHARE)
    friction: float = number(0.0, 0.0, SHARE)
    """Viscous and Coulomb friction are off by up to this share of their value."""
    payload: float = number(0.0, 0.0, LARGEST, unit="kg")
    """Greatest mass at the tool tip, kg."""
    latency: int = number(0, 0, 50, unit="control steps")
    """Greatest number of control steps until an action acts."""
    object_shift: float = number(0.0, 0.0, LARGEST, unit="m")
    """Free objects begin up to this far from their place, m, along the world's x and y each."""
    object_turn: float = number(0.0, 0.0, LARGEST, unit="rad")
    """Largest turn of free objects about the vertical at the start, rad."""
    object_size: float = number(0.0, 0.0, SHARE)
    """All their lengths are off by up to this share. Mass grows with their cube, unless `object_mass` is given."""
    object_mass: float = number(0.0, 0.0, SHARE)
    """Their masses are off by up to this share of their value, whatever their size."""
    object_friction: float = number(0.0, 0.0, SHARE)
    """Their coefficients of friction likewise."""
    thread_stiffness: float = number(0.0, 0.0, SHARE)
    """Young's moduli of threads are off by up to this share of their value."""
    thread_friction: float = number(0.0, 0.0, SHARE)
    """Their coefficients of friction likewise."""
    tissue_stiffness: float = number(0.0, 0.0, SHARE)
    """Young's moduli of pieces of tissue are off by up to this share of their value."""
    tissue_friction: float = number(0.0, 0.0, SHARE)
    """Their coefficients of friction likewise."""

    def __bool__(self) -> bool:
        return any(getattr(self, item.name) for item in fields(self))


@dataclass(frozen=True)
class Mount:
    """An arm in a scene."""

    arm: Arm
    position: np.ndarray
    """Origin of the base frame in the world, m, shape [3]."""
    rotation: np.ndarray
    """Axes of the base frame in the world, shape [3, 3]."""
    workspace: np.ndarray
    """The point in front of the arm around which targets are drawn, base frame, m, shape [3]."""

    def to_base(self, points: np.ndarray) -> np.ndarray:
        """Return points [..., 3] of the world, m, in the arm's base frame."""
        return np.asarray((points - self.position) @ self.rotation)


@dataclass(frozen=True)
class AttachmentEntry:
    """A free object that a link of an arm holds, until it is released."""

    body: str
    """Name of the object."""
    link: str
    """Name of the link in the scene's model, as in "psm_0/jaw_left_link"."""
    active: bool = True
    """Whether it holds at the beginning of an episode."""


@dataclass(frozen=True)
class Scene:
    """Arms in a world. `model` holds all of them; `control` is the control mode of their actuators."""

    name: str
    description: str
    control: str
    mounts: dict[str, Mount]
    model: mujoco.MjModel = field(repr=False)
    randomisation: Randomisation
    """Ranges of domain randomisation; all zero unless the scene file sets them."""
    observe: dict[str, list[str]] = field(default_factory=dict)
    """Agent -> names of the observation terms that it observes, instead of the task's own choice."""
    objects: dict[str, Placement] = field(default_factory=dict)
    """Name -> rigid object and where it is. In `model` free ones are mocap bodies of this name, without joints."""
    attachments: dict[str, AttachmentEntry] = field(default_factory=dict)
    """Name -> a free object and the link that it can be attached to."""
    systems: dict[str, Any] = field(default_factory=dict)
    """Name -> a thread, tissue, or a system of a plug-in (`surgical_marl.physics.systems.system.System`)."""
    soft: dict[str, Placement] = field(default_factory=dict)
    """Name -> thread or tissue and where its frame is; `systems` has what moves."""

    @property
    def agents(self) -> tuple[str, ...]:
        """Names `<arm>_<number>`, in the order of the scene file."""
        return tuple(self.mounts)

    @cached_property
    def free_objects(self) -> dict[str, Placement]:
        """The objects that move, by name, in the order of the mocap bodies of `model` and of physical states."""
        return {name: place for name, place in self.objects.items() if place.object.free}

    @property
    def holders(self) -> list[str]:
        """The agents whose jaws have two pads, in order: they can hold things."""
        return [agent for agent, mount in self.mounts.items() if mount.arm.jaw and len(mount.arm.jaw.pads) == 2]

    @property
    def placements(self) -> dict[str, Placement]:
        """All objects by name, rigid, thread and tissue."""
        return self.objects | self.soft

    @cached_property
    def drawn(self) -> dict[str, Any]:
        """The bars of each system that pictures show (`Bars`). In `model` each is a mocap body, `<system>/<number>`."""
        return {name: bars for name, system in self.systems.items() if (bars := system.bars)}

    @cached_property
    def types(self) -> dict[str, tuple[str, ...]]:
        """Agents by type, which is the content of their arm's model: {"psm": ("psm_0", "psm_1")}.

        A type has the name of its first arm's folder. If another type already has that name, a number follows.
        """
        groups: list[list[str]] = []
        for agent, mount in self.mounts.items():
            same = (group for group in groups if are_alike(self.mounts[group[0]].arm, mount.arm))
            group = next(same, None)
            groups.append([agent]) if group is None else group.append(agent)
        found: dict[str, tuple[str, ...]] = {}
        for group in groups:
            name = self.mounts[group[0]].arm.name
            taken = sum(other.partition("-")[0] == name for other in found)
            found[f"{name}-{taken + 1}" if taken else name] = tuple(group)
        return found

    def type_of(self, agent: str) -> str:
        """Return the name of an agent's type in `types`."""
        return next(name for name, agents in self.types.items() if agent in agents)

    def label(self, agent: str) -> str:
        """Return an agent's name, with its tool if that is not the usual one, as in "psm_1 with cadiere_forceps"."""
        arm = self.mounts[agent].arm
        return agent + arm.title.removeprefix(arm.name)

    def find_camera(self, agent: str | None = None) -> str:
        """Return the agent whose camera is used: `agent` if it is given, otherwise the first that has a camera.

        Raises ValueError if no agent has a camera, or the one given has none.
        """
        found = [name for name, mount in self.mounts.items() if mount.arm.camera is not None]
        if not found:
            raise ValueError(f"scene {self.name!r} has no endoscope: no arm of {', '.join(self.agents)} has a camera")
        if agent is not None and agent not in found:
            raise unknown("agent with a camera", agent, found)
        return agent or found[0]

    @property
    def home(self) -> np.ndarray:
        """Return `qpos` with every arm at its home, shape [nq]."""
        return self.full_qpos({agent: mount.arm.home for agent, mount in self.mounts.items()})

    def qpos_index(self, agent: str) -> np.ndarray:
        """Return the indices of an agent's actuated joints in `qpos`, shape [n]."""
        names = [joint.name for joint in self.mounts[agent].arm.actuated]
        return np.array([self.model.joint(f"{agent}/{name}").qposadr[0] for name in names])

    def full_qpos(self, q: dict[str, np.ndarray]) -> np.ndarray:
        """Return `qpos` [..., nq] from agents' actuated joints [..., n]; joints that mimic another follow it.

        Agents that are not in `q` are at home.
        """
        batch = np.broadcast_shapes(*(np.shape(value)[:-1] for value in q.values()))
        qpos = np.zeros((*batch, self.model.nq))
        for agent, mount in self.mounts.items():
            names = [joint.name for joint in mount.arm.actuated]
            for joint in mount.arm.joints:
                address = self.model.joint(f"{agent}/{joint.name}").qposadr[0]
                own = q.get(agent, mount.arm.home)
                qpos[..., address] = joint.multiplier * own[..., names.index(joint.leader)] + joint.offset
        return qpos

    @cached_property
    def moment(self) -> np.ndarray:
        """Moments of the actuators, [nu, nv]: 1 for a joint's own actuator, the joints' coefficients for a cable's.

        `moment @ qpos` are the commands of a posture under position control, `moment @ qvel` those of velocities under
        velocity control.
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
        """A fingerprint of kinematics and shapes, equal for scenes that move and touch in the same way."""
        m = self.model
        numbers = (m.body_parentid, m.body_pos, m.body_quat, m.jnt_axis, m.jnt_pos, m.jnt_range, m.jnt_type, m.site_pos,
                   m.geom_bodyid, m.geom_group, m.geom_type, m.geom_size, m.geom_pos, m.geom_quat, self.home,
                   *(mount.workspace for mount in self.mounts.values()))  # fmt: skip
        joints = {
            agent: mount.arm.joints for agent, mount in self.mounts.items()
        }  # the model does not have the mimic relations
        return repr(joints).encode() + b"".join(np.ascontiguousarray(number).tobytes() for number in numbers)

    def clearance(self, q: dict[str, np.ndarray], within: bool = False) -> np.ndarray:
        """Return the least distance in m of any two arms, or of parts within one arm; inf if there is no such pair.

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
        """Return every collision geom in the world, by geom id; joints of each agent [..., n]."""
        model, capsules = self.model, {}
        for agent, mount in self.mounts.items():
            geoms = collision_geoms(model, agent)
            links = {geom: model.body(model.geom_bodyid[geom]).name.removeprefix(f"{agent}/") for geom in geoms}
            poses = mount.arm.link_poses(q[agent], tuple(dict.fromkeys(links.values())))
            for geom in geoms:
                pose = poses[links[geom]]
                on_arm = link_capsule(model, geom).placed(pose[..., :3, :3], pose[..., :3, 3])
                capsules[geom] = on_arm.placed(mount.rotation, mount.position)
        return capsules


def payload_body(agent: str, arm: Arm) -> str:
    """Return the name of the body at an arm's tool tip that represents a payload, if payloads are randomised."""
    return f"{agent}/{own_name('payload', [link.name for link in arm.urdf.links])}"


def are_alike(one: Arm, other: Arm) -> bool:
    """Return whether two arms have the same model: bodies, joints, drives, shapes and colours."""
    if (one.folder, one.tool) == (other.folder, other.tool):
        return True
    if [joint.name for joint in one.joints] != [joint.name for joint in other.joints]:
        return False
    return _model_content(one) == _model_content(other)


def _model_content(arm: Arm) -> bytes:
    spec = build_spec(arm, pads=True)
    spec.modelname = ""
    model = spec.compile()
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return content.tobytes()


def collision_geoms(model: mujoco.MjModel, agent: str) -> list[int]:
    """Return the ids of the collision geoms of one agent."""
    ids = np.flatnonzero(model.geom_group == COLLISION_GROUP)
    return [int(i) for i in ids if model.geom(int(i)).name.startswith(f"{agent}/")]
