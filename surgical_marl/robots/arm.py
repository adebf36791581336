"""One surgical arm, read from its folder: a URDF for the body, `arm.yaml` for how it is driven.

    arm = load_arm("psm")
    arm.forward_kinematics(arm.home)            # tool tip in the base frame, 4 x 4

`arms/<name>/README.md` has every number of a shipped arm with its source.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.content import find, unknown
from surgical_marl.robots.description import MOVING, Robot, RobotJoint, Vector
from surgical_marl.robots.drives import Cable, Drive, TipSpeed
from surgical_marl.robots.jaw import Jaw, JawEntry
from surgical_marl.robots.mesh import MAX_MESH, mesh_files, resolve_meshes
from surgical_marl.robots.reach import Box, box_of
from surgical_marl.robots.urdf import link_name, read_urdf
from surgical_marl.robots.urdf_faults import robot_faults
from surgical_marl.untrusted.files import is_file, read_bytes
from surgical_marl.untrusted.markup import check_name
from surgical_marl.untrusted.schema import (
    REQUIRED,
    Faults,
    Place,
    as_mapping,
    check,
    collecting,
    fields_of,
    number,
    several,
    unknown_keys,
)
from surgical_marl.untrusted.values import LONGEST, listed, shown
from surgical_marl.yaml_file import merged, read_yaml

MAX_JOINTS, MAX_TOOLS = 200, 50
"""Joints of an `arm.yaml`, or cables; and its tools."""


@dataclass(frozen=True)
class Camera:
    """A stereo endoscope. It looks along -z of `link`, x to the right, y up, as a MuJoCo camera does."""

    link: str
    fovy: float = number(REQUIRED, 0.1, 179.0, unit="degrees")
    """Vertical field of view in degrees."""
    baseline: float = number(REQUIRED, 0.0, LONGEST, unit="m")
    """Distance of the two eyes along x in m."""


@dataclass(frozen=True)
class Joint:
    """A moving joint of the URDF with its drive. `leader` is the joint it mimics, or its own name."""

    name: str
    slides: bool
    lower: float
    """Joint limits of the simulation: those of the URDF, reduced by the drive's `margin`."""
    upper: float
    velocity: float
    effort: float
    """Limit of the total effort on the joint, of its own actuator and of cables."""
    viscous: float
    """Viscous friction, effort per velocity."""
    coulomb: float
    """Coulomb friction, effort."""
    leader: str
    multiplier: float
    offset: float
    drive: Drive


@dataclass(frozen=True)
class Arm:
    """A surgical arm. Angles in rad, lengths in m, in the frame of the URDF's root link (the base frame)."""

    name: str
    folder: Path
    description: str
    tool_tip: str
    remote_center: str | None
    """The link whose z axis, the shaft, always passes through the base frame's origin; None without such a point."""
    jaw: Jaw | None
    camera: Camera | None
    joints: tuple[Joint, ...]
    """All moving joints in the order of the chain, those that mimic another included."""
    cables: tuple[Cable, ...]
    tip_speed: TipSpeed
    """How fast Cartesian control moves the tool tip."""
    urdf: Robot = field(repr=False)
    """Links, joints and shapes; meshes by their files in `folder`."""
    tool: str | None = field(default=None, repr=False)
    """The instrument that the arm holds; None if its `arm.yaml` has no choice of tools."""
    tools: tuple[str, ...] = field(default=(), repr=False)
    """The instruments to choose from; the first is the usual one."""

    @property
    def title(self) -> str:
        """The arm's name, and that of its tool if it is another than the usual one."""
        return f"{self.name} with {self.tool}" if self.tool in self.tools[1:] else self.name

    @property
    def content(self) -> tuple[bytes, ...]:
        """Everything that a model of the arm is made from, meshes included, wherever its folder is.

        It is a key for caches.
        """
        said = repr((replace(self, folder=Path()), self.urdf)).encode()
        return said, *(read_bytes(self.folder / name, MAX_MESH) for name in mesh_files(self.urdf))

    @cached_property
    def actuated(self) -> tuple[Joint, ...]:
        """Joints with a command of their own, in the order of `q`, actions and observations."""
        return tuple(joint for joint in self.joints if joint.leader == joint.name)

    @property
    def moves_jaw(self) -> np.ndarray:
        """Which of `actuated` is the joint of the jaw, bool, shape [n]."""
        return np.array([self.jaw is not None and joint.name == self.jaw.joint for joint in self.actuated])

    @property
    def home(self) -> np.ndarray:
        """Joint positions at the start of an episode, shape [n]."""
        return np.array([joint.drive.home for joint in self.actuated])

    @property
    def lower(self) -> np.ndarray:
        """Lower joint limits, shape [n]."""
        return np.array([joint.lower for joint in self.actuated])

    @property
    def upper(self) -> np.ndarray:
        """Upper joint limits, shape [n]."""
        return np.array([joint.upper for joint in self.actuated])

    @property
    def joint_box(self) -> Box:
        """Bounds of joint positions, [n] each, a tenth of a joint's range beyond its limits.

        Stops give way, and readings may be off.
        """
        return Box(self.lower, self.upper).widened(0.1)

    @cached_property
    def reach(self) -> Box:
        """Bounds of where the tool tip can be, [3] each, in the base frame, m, with a tenth to spare at each end."""
        limits = Box(self.lower, self.upper)

        def search() -> np.ndarray:
            return np.stack(box_of(lambda q: self.forward_kinematics(q)[..., :3, 3], limits))

        chain = repr((self.tool_tip, self.joints, self.urdf.joints))
        return Box(*cached("reach", search, chain)).widened(0.1, 0.01)

    @property
    def speed(self) -> np.ndarray:
        """How fast an action of 1 moves each joint's target, shape [n], rad/s (m/s for prismatic joints)."""
        return np.array([joint.drive.speed for joint in self.actuated])

    def forward_kinematics(self, q: Any) -> Any:
        """Return the pose of the tool tip in the base frame.

        Args:
            q: joint positions, shape [..., n], in the order of `actuated`; joints that don't move the tip (the jaw)
                may be left out at the end. A numpy or a JAX array.

        Returns:
            Homogeneous transforms, shape [..., 4, 4], of the same kind of array.

        Raises:
            ValueError: if the last axis is too short or too long.
        """
        return self.link_poses(q, (self.tool_tip,))[self.tool_tip]

    def jacobian(self, q: Any) -> Any:
        """Return the geometric Jacobian [..., 6, n] of the tool tip, per joint rate.

        The upper three rows are linear velocity, the lower three angular velocity, both in the base frame.

        `q` is as in `forward_kinematics`. n counts all of `actuated`, and joints that don't move the tip have zero
        columns.
        """
        return self.pose_and_jacobian(q)[1]

    def pose_and_jacobian(self, q: Any) -> tuple[Any, Any]:
        """Return what `forward_kinematics` and `jacobian` do, in little more time than the second alone."""
        chain = [joint for joint in self._chain(self.tool_tip) if joint.type in MOVING]
        poses = self.link_poses(q, (self.tool_tip, *(joint.child for joint in chain)))
        tip = poses[self.tool_tip][..., :3, 3]
        xp = tip.__array_namespace__()
        joints = {joint.name: joint for joint in self.joints}
        columns = {joint.name: xp.zeros((*tip.shape[:-1], 6), dtype=tip.dtype) for joint in self.actuated}
        for element in chain:
            joint, pose = joints[element.name], poses[element.child]
            axis = xp.broadcast_to(pose[..., :3, :3] @ _unit(element.axis), tip.shape)
            linear = axis if joint.slides else xp.linalg.cross(axis, tip - pose[..., :3, 3])
            angular = xp.zeros_like(axis) if joint.slides else axis
            columns[joint.leader] = columns[joint.leader] + joint.multiplier * xp.concatenate([linear, angular], -1)
        return poses[self.tool_tip], xp.stack(list(columns.values()), -1)

    def link_poses(self, q: Any, links: tuple[str, ...]) -> dict[str, Any]:
        """Return the poses [..., 4, 4] of some links in the base frame; `q` as in `forward_kinematics`."""
        if not hasattr(q, "__array_namespace__"):
            q = np.asarray(q, dtype=float)
        xp = q.__array_namespace__()
        names = [joint.name for joint in self.actuated]
        joints = {joint.name: joint for joint in self.joints}
        chains = {link: self._chain(link) for link in links}
        moved_by = {joints[j.name].leader for chain in chains.values() for j in chain if j.type in MOVING}
        least = max((names.index(name) + 1 for name in moved_by), default=0)
        if q.ndim == 0 or not least <= q.shape[-1] <= len(names):
            raise ValueError(
                f"q of shape {tuple(q.shape)} does not fit arm {self.name!r}: "
                f"its last axis must hold the joints {', '.join(names)}"
            )
        known: dict[str, Any] = {}
        for link, chain in chains.items():
            pose = xp.eye(4, dtype=q.dtype)
            for element in chain:
                if element.child not in known:
                    known[element.child] = pose @ np.array(element.origin)
                    if element.type in MOVING:
                        joint = joints[element.name]
                        value = joint.multiplier * q[..., names.index(joint.leader)] + joint.offset
                        known[element.child] = known[element.child] @ _motion(value, element.axis, joint.slides)
                pose = known[element.child]
            known[link] = pose
        return {link: xp.broadcast_to(known[link], (*q.shape[:-1], 4, 4)) for link in links}

    def remote_center_error(self, q: Any) -> Any:
        """Return the distance [...] in m of the shaft's axis from the remote center; `q` is as in `forward_kinematics`.

        Raises:
            ValueError: for an arm without a remote center.
        """
        if self.remote_center is None:
            raise ValueError(f"arm {self.name!r} has no remote center of motion")
        pose = self.link_poses(q, (self.remote_center,))[self.remote_center]
        axis, origin = pose[..., :3, 2], pose[..., :3, 3]
        xp = axis.__array_namespace__()
        return xp.linalg.vector_norm(xp.linalg.cross(axis, origin), axis=-1)

    def _chain(self, link: str) -> list[RobotJoint]:
        parents = {joint.child: joint for joint in self.urdf.joints}
        chain: list[RobotJoint] = []
        while link in parents:
            chain.append(parents[link])
            link = parents[link].parent
        return chain[::-1]


@dataclass(frozen=True)
class ArmFile:
    """The content of an `arm.yaml`."""

    urdf: str
    tool_tip: str
    description: str = ""
    remote_center: str | None = None
    camera: Camera | None = None
    joints: dict[str, Drive] = several("drives", MAX_JOINTS)
    cables: tuple[Cable, ...] | None = several("cables", MAX_JOINTS, empty=tuple)
    tip_speed: TipSpeed = field(default_factory=TipSpeed)
    jaw: JawEntry | None = None
    tools: dict[str, Any] = several("tools", MAX_TOOLS)
    """Name -> merge patch of this file. The first is the usual one."""


def load_arm(name: str | Path, tool: str | None = None) -> Arm:
    """Read an arm by a shipped name (`list_arms()`) or the path of a folder that holds `arm.yaml`.

    Args:
        name: of the arm, or its folder.
        tool: a name under `tools` in its `arm.yaml`; None for the first one there, if there are any.

    Raises:
        ValueError: if the name or the tool is unknown, or a URDF or `arm.yaml` lacks something or has a bad value. In
            most cases the error is a `Faults`, which lists everything that is wrong.
    """
    folder = find("arms", name)
    check_name(folder.name, "an arm's folder")
    place = Place(file=folder / "arm.yaml")
    settings, tools = _read_settings(folder, tool)
    about: ArmFile | None = None
    robot: Robot | None = None
    faults: list[str] = []
    with collecting(faults):
        about = check(place, settings, ArmFile)
    if isinstance(settings.get("urdf"), str):
        with collecting(faults):
            robot, wrong = _read_robot(folder, settings["urdf"], place.part("urdf", settings))
            faults += wrong
    if about and robot:
        faults += _misfits(about, robot, place, settings)
    if faults or not about or not robot:
        raise Faults(faults)
    drives = place.part("joints", settings)
    return Arm(
        name=folder.name,
        folder=folder,
        description=about.description,
        tool_tip=link_name(about.tool_tip),
        remote_center=link_name(about.remote_center),
        jaw=about.jaw.make() if about.jaw else None,
        camera=about.camera and replace(about.camera, link=link_name(about.camera.link)),
        joints=tuple(_joint(joint, about.joints, drives) for joint in robot.joints if joint.type in MOVING),
        cables=about.cables or (),
        tip_speed=about.tip_speed,
        urdf=robot,
        tool=tool or next(iter(tools), None),
        tools=tuple(tools),
    )


def list_tools(name: str | Path) -> list[str]:
    """Return the names of the tools that an arm can hold, the usual one first; none if its `arm.yaml` has no `tools`.

    Raises:
        ValueError: if the arm is unknown, or its `arm.yaml` can't be read.
    """
    return _read_settings(find("arms", name))[1]


def arm_files(name: str | Path) -> list[str]:
    """Return the names of all files of an arm, in its folder: `arm.yaml`, and the URDF and meshes of every tool.

    Raises:
        ValueError: as `load_arm`.
    """
    folder, found = find("arms", name), ["arm.yaml"]
    for tool in tuple(list_tools(folder)) or (None,):
        arm = load_arm(folder, tool)
        found += [_read_settings(folder, tool)[0]["urdf"], *mesh_files(arm.urdf)]
    return list(dict.fromkeys(found))


def _read_settings(folder: Path, tool: str | None = None) -> tuple[dict[str, Any], list[str]]:
    """Return the mapping of an `arm.yaml` as a tool changes it, by default the first, and the names of all tools."""
    place, settings = Place(file=folder / "arm.yaml"), read_yaml(folder / "arm.yaml")
    where, keys = place.part("tools", settings), [key for key in fields_of(ArmFile) if key != "tools"]
    tools = as_mapping(where, settings.get("tools") or {}, "names to what a tool changes")
    faults: list[str] = []
    for name, patch in tools.items():
        check_name(name, "a tool")
        at = where.part(name, tools)
        faults += unknown_keys(at, as_mapping(at, {} if patch is None else patch, listed(keys)), keys)
    if faults:
        raise Faults(faults)
    if tool is not None and tool not in tools:
        raise unknown(f"tool of arm {folder.name!r}", tool, list(tools))
    patch = tools[tool or next(iter(tools))] if tools else None
    return (merged(settings, patch) if patch else settings), list(tools)


def _read_robot(folder: Path, name: str, place: Place) -> tuple[Robot, list[str]]:
    """Return the content of an arm's URDF, and a sentence for everything that is wrong with it."""
    path = _urdf_path(folder, name, place)
    robot, faults = resolve_meshes(read_urdf(path), path, folder)
    faults = [*robot_faults(robot, path), *faults]
    if not _leaders(robot):
        faults.append(f"{path}: no joint moves; an arm needs one that is revolute or prismatic")
    return robot, faults


def _leaders(robot: Robot) -> list[str]:
    """Return the names of the joints that move on their own, also those of a type that an arm may not have."""
    return [joint.name for joint in robot.joints if joint.type != "fixed" and not joint.mimic]


def _misfits(about: ArmFile, robot: Robot, place: Place, settings: dict[str, Any]) -> list[str]:
    """Return a sentence for each name of an `arm.yaml` that its URDF does not have, and for each drive that is missing.

    Args:
        about: the content of the file.
        robot: the URDF.
        place: of the file.
        settings: the mapping that `about` was read from.
    """
    leaders, links = _leaders(robot), [link.name for link in robot.links]
    drives, given = place.part("joints", settings), settings.get("joints") or {}
    still = {joint.name: joint for joint in robot.joints if joint.name not in leaders}
    faults = [
        f"{drives.part(name, given)} {f'mimics {follower.mimic.joint!r}' if follower.mimic else 'is fixed'} and has no "
        "drive of its own; leave its line out"
        for name, follower in still.items()
        if name in about.joints
    ]
    faults += unknown_keys(drives, given, leaders, faulty=still)
    # a joint of a type that an arm may not have is a fault already, with or without a drive
    driven = [joint.name for joint in robot.joints if joint.name in leaders and joint.type in MOVING]
    if lacking := [name for name in driven if name not in about.joints]:
        faults.append(f"{drives} lacks {listed(lacking)}")
    pulled = [name for name in leaders if about.jaw is None or name != about.jaw.joint]
    for index, cable in enumerate(settings.get("cables") or ()):
        # a jaw is under position control in every mode, so no cable may drive it
        faults += unknown_keys(place.at(settings, "cables", index, "joints"), cable["joints"], pulled)
    named: dict[tuple[str, ...], str | None] = {("tool_tip",): about.tool_tip, ("remote_center",): about.remote_center}
    if about.camera:
        named |= {("camera", "link"): about.camera.link}
    if about.jaw:
        named |= {("jaw", "pads", link): link for link in about.jaw.pads}
        if about.jaw.joint not in leaders:
            at = place.at(settings, "jaw", "joint")
            faults.append(f"{at} {shown(about.jaw.joint)} is not one of {listed(leaders)}")
    for keys, link in named.items():
        if link is not None and link_name(link) not in links:
            faults.append(f"{place.at(settings, *keys)} {shown(link)} is not a link of the URDF ({listed(links)})")
    return faults


def _urdf_path(folder: Path, name: str, place: Place) -> Path:
    path = folder / name
    try:
        inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):  # an impossible file name, or a cycle of links
        raise ValueError(f"{place} {shown(name)} is not a name that a file can have") from None
    if not inside:
        raise ValueError(f"{place} {shown(name)} leaves the arm's folder; copy it into the folder")
    if not is_file(path):
        raise ValueError(f"{place}: there is no URDF file {shown(name)} in the folder")
    return path


def _joint(joint: RobotJoint, drives: dict[str, Drive], place: Place) -> Joint:
    limit, mimic = joint.limit, joint.mimic
    assert limit is not None  # `robot_faults` has checked this
    leader = mimic.joint if mimic else joint.name
    margin = drives[leader].margin
    if not 2 * margin < limit.upper - limit.lower:
        span = f"[{limit.lower:g}, {limit.upper:g}]"
        raise ValueError(f"{place}.{joint.name}: a margin of {margin:g} leaves nothing of {span}")
    return Joint(
        name=joint.name,
        slides=joint.type == "prismatic",
        lower=limit.lower + margin,
        upper=limit.upper - margin,
        velocity=limit.velocity,
        effort=limit.effort,
        viscous=joint.damping,
        coulomb=joint.friction,
        leader=leader,
        multiplier=mimic.multiplier if mimic else 1.0,
        offset=mimic.offset if mimic else 0.0,
        drive=drives[leader],
    )


def _unit(axis: Vector) -> np.ndarray:
    return np.asarray(axis, dtype=float) / np.linalg.norm(axis)


def _motion(value: Any, axis: Vector, slides: bool) -> Any:
    """Return the transform [..., 4, 4] of a joint: a translation along its axis, or a rotation (Rodrigues' formula)."""
    xp = value.__array_namespace__()
    value, (unit, step, cross, square) = value[..., None, None], _motion_parts(axis)
    if slides:
        return unit + value * step
    return unit + xp.sin(value) * cross + (1 - xp.cos(value)) * square


@lru_cache(maxsize=1024)  # a search for joint positions asks for the same ones a million times
def _motion_parts(axis: Vector) -> tuple[np.ndarray, ...]:
    """Return matrices [4, 4]: the identity, a step along an axis, the cross product with it, and that one squared."""
    step, cross = np.zeros((2, 4, 4))
    step[:3, 3] = x, y, z = _unit(axis)
    cross[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return np.eye(4), step, cross, cross @ cross
