"""Builds a `mujoco.MjSpec` from an `Arm`: bodies, joints, geoms, actuators, the tool tip as a site.

Visual geoms come from the URDF's primitives and meshes as they are. Every `<collision>` becomes a capsule or a sphere,
the cheapest shapes to collide. A cylinder becomes the capsule of the same length and radius, so that slender tools keep
their shape. A box or a mesh becomes the capsule around it, along the longest side of its bounding box, or the sphere
around it if that is smaller. Collision geoms collide only through the explicit pairs that a scene makes of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from surgical_marl.robots.arm import Arm, Joint
from surgical_marl.robots.description import Link, Shape, Vector
from surgical_marl.robots.drives import CONTROL_MODES, Cable, Drive
from surgical_marl.robots.mesh import read_mesh
from surgical_marl.robots.rotation import quaternion

VISUAL_GROUP, COLLISION_GROUP, PAD_GROUP = 2, 3, 4
SOLREF = (0.005, 1.0)
"""Time constant in s and damping ratio of joint limits and contacts: as stiff as a step of 2.5 ms allows."""
DEFAULT_RGBA = (0.7, 0.7, 0.72, 1.0)
GEAR = 5.0
"""Stiffness of what ties a joint to the one that it mimics, relative to its drive's. Two fingers that close on
something at their full effort would otherwise swing aside together, as nothing but friction held them. There is no
damper: `implicitfast` leaves out what couples joints of two branches, and would damp both fingers alike."""


def own_name(name: str, taken: Iterable[str]) -> str:
    """Return the name of a part that the builder adds, with a slash behind it if a link or joint has that name.

    No link and no joint has a slash in its name, so that this one is free.
    """
    return f"{name}/" if name in taken else name


def build_spec(arm: Arm, control: str = "position", pads: bool = False) -> mujoco.MjSpec:
    """Return a new MjSpec of the arm.

    Args:
        arm: what to build.
        control: the control mode of its actuators.
        pads: whether to add the plates of its jaw, `<link>/pad`. Only objects touch them, so that the model of an arm
            in a scene without objects doesn't have them.

    Raises ValueError for an unknown control mode or a mesh that can't be read.
    """
    if control not in CONTROL_MODES:
        raise ValueError(f"unknown control mode {control!r}; the modes are {', '.join(CONTROL_MODES)}")
    spec = mujoco.MjSpec()
    spec.modelname = arm.name
    spec.compiler.degree = False
    links = {link.name: link for link in arm.urdf.links}
    children = {joint.child for joint in arm.urdf.joints}
    root = next(name for name in links if name not in children)
    bodies = {root: spec.worldbody.add_body(name=root)}
    _add_link(spec, bodies[root], links[root], arm.folder)
    joints = {joint.name: joint for joint in arm.joints}
    waiting = list(arm.urdf.joints)
    while waiting:  # the URDF may list joints in any order; parents come first in a spec
        ready = [joint for joint in waiting if joint.parent in bodies]
        if not ready:
            raise ValueError(f"arm {arm.name!r}: joint {waiting[0].name!r} hangs on no chain from link {root!r}")
        waiting = [joint for joint in waiting if joint not in ready]
        for element in ready:
            body = bodies[element.parent].add_body(name=element.child, **_place(np.array(element.origin)))
            bodies[element.child] = body
            if element.name in joints:
                joint = joints[element.name]
                _add_joint(body, joint, element.axis, _mode(arm, joint, control))
            _add_link(spec, body, links[element.child], arm.folder)
    for pad in arm.jaw.pads if pads and arm.jaw else ():
        shape = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": np.array(pad.size) / 2}
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = pad.rotation, pad.position
        _add_geom(bodies[pad.link], shape, place, name=f"{pad.link}/pad", rgba=[0.2, 0.5, 0.9, 0.3], group=PAD_GROUP)
    bodies[arm.tool_tip].add_site(name="tool_tip", size=[0.001] * 3, group=4)
    if arm.camera is not None:
        for name, side in (("left", -0.5), ("right", 0.5)):
            eye = [side * arm.camera.baseline, 0, 0]
            bodies[arm.camera.link].add_camera(name=name, pos=eye, fovy=arm.camera.fovy)
    for joint in arm.joints:
        mode = _mode(arm, joint, control)
        _add_actuator(spec, joint.name, joint.drive, joint.effort, mode, _commands(joint, mode))
    for number, cable in enumerate(arm.cables):
        _add_cable(spec, own_name(f"cable_{number}", joints), cable, joints, control)
    for joint in arm.joints:
        if joint.leader != joint.name:
            _add_gear(spec, joint)
    return spec


def _mode(arm: Arm, joint: Joint, control: str) -> str:
    """Return the control mode of a joint. A jaw is under position control in every mode."""
    return "position" if arm.jaw and joint.leader == arm.jaw.joint else control


def _add_joint(body: Any, joint: Joint, axis: Vector, control: str) -> None:
    """Add a joint to a body.

    A joint under torque control has the speed-torque line of a motor: its available effort falls linearly to zero at
    its greatest speed.
    """
    drag = joint.effort / joint.drive.speed if control == "torque" else 0.0
    body.add_joint(
        name=joint.name,
        type=mujoco.mjtJoint.mjJNT_SLIDE if joint.slides else mujoco.mjtJoint.mjJNT_HINGE,
        axis=axis,
        range=[joint.lower, joint.upper],
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        damping=[joint.viscous + drag, 0, 0],
        solref_limit=SOLREF,
        armature=joint.drive.armature,
        frictionloss=joint.coulomb,
        # its own actuator and all cables together
        actfrcrange=[-joint.effort, joint.effort],
        actfrclimited=mujoco.mjtLimited.mjLIMITED_TRUE,
    )


def _add_cable(spec: mujoco.MjSpec, name: str, cable: Cable, joints: dict[str, Joint], control: str) -> None:
    """Add a cable as a fixed tendon with an actuator of its own.

    Under torque control the tendon only has inertia and no actuator. A commanded torque is then the sum of the torques
    of all motors, however they share it.
    """
    tendon = spec.add_tendon(name=name, armature=cable.armature)
    for joint, coefficient in cable.joints.items():
        tendon.wrap_joint(joint, coefficient)
    if control != "torque":
        ends = [coefficient * _commands(joints[joint], control) for joint, coefficient in cable.joints.items()]
        _add_actuator(spec, name, cable, cable.effort, control, np.sort(ends).sum(0), mujoco.mjtTrn.mjTRN_TENDON)


def _add_gear(spec: mujoco.MjSpec, joint: Joint) -> None:
    """Add the fixed tendon that ties a joint to the one that it mimics: a spring without a limit."""
    stiffness, length = [GEAR * joint.drive.stiffness, 0, 0], [joint.offset, joint.offset]
    tendon = spec.add_tendon(name=f"{joint.name}/gear", stiffness=stiffness, springlength=length)
    tendon.wrap_joint(joint.name, 1.0)
    tendon.wrap_joint(joint.leader, -joint.multiplier)


def _commands(joint: Joint, control: str) -> np.ndarray:
    """Return the least and the greatest command of a joint, [2]."""
    high = joint.drive.speed if control == "velocity" else joint.effort
    return np.array([joint.lower, joint.upper] if control == "position" else [-high, high])


def _add_actuator(
    spec: mujoco.MjSpec,
    name: str,
    drive: Drive | Cable,
    effort: float,
    control: str,
    commands: np.ndarray,
    transmission: mujoco.mjtTrn = mujoco.mjtTrn.mjTRN_JOINT,
) -> None:
    """Add the actuator of a joint or of a cable: force = gain * command + bias, clamped to the effort.

    Position control is the dVRK's PD law, stiffness * (target - q) - damping * qd. Velocity control is damping *
    (command - qd). Torque control is the command itself.
    """
    laws: dict[str, tuple[float, list[float]]] = {
        "position": (drive.stiffness, [0, -drive.stiffness, -drive.damping]),
        "velocity": (drive.damping, [0, 0, -drive.damping]),
        "torque": (1.0, [0, 0, 0]),
    }
    gain, bias = laws[control]
    spec.add_actuator(
        name=name,
        target=name,
        trntype=transmission,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        gainprm=[gain] + [0] * 9,
        biasprm=bias + [0] * 7,
        ctrlrange=commands,
        ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        forcerange=[-effort, effort],
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
    )


def _add_link(spec: mujoco.MjSpec, body: Any, link: Link, folder: Path) -> None:
    if link.inertial is not None and np.any(link.inertial.inertia):  # all zeros mean the same as no <inertial>
        origin = np.array(link.inertial.origin)
        tensor = origin[:3, :3] @ np.array(link.inertial.inertia) @ origin[:3, :3].T
        body.explicitinertial = True
        body.mass = link.inertial.mass
        body.ipos = origin[:3, 3]
        body.fullinertia = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    for i, visual in enumerate(link.visuals):
        shape = _visual_shape(spec, visual, f"{link.name}_{i}", folder)
        rgba = DEFAULT_RGBA if visual.rgba is None else visual.rgba
        _add_geom(body, shape, np.array(visual.origin), rgba=rgba, group=VISUAL_GROUP)
    for i, collision in enumerate(link.collisions):
        # in a URDF shapes may have the same name, in MuJoCo they may not; no shape has the last of these names
        given = (collision.name or f"{link.name}_{i}").replace("/", "_")
        names = given, f"{link.name}_{i}_{given}", f"{link.name}/{i}"
        name = next(name for name in names if spec.geom(name) is None)
        shape, place = _collision_shape(collision, folder)
        place = np.array(collision.origin) @ place
        _add_geom(body, shape, place, name=name, rgba=[0.9, 0.3, 0.2, 0.3], group=COLLISION_GROUP)


def _add_geom(body: Any, shape: dict[str, Any], origin: np.ndarray, **rest: Any) -> None:
    body.add_geom(**shape, **_place(origin), **rest, mass=0, contype=0, conaffinity=0)


def _visual_shape(spec: mujoco.MjSpec, shape: Shape, name: str, folder: Path) -> dict[str, Any]:
    if shape.kind == "sphere":
        return _sphere(shape.size[0])
    if shape.kind == "cylinder":
        radius, length = shape.size
        return {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [radius, length / 2, 0]}
    if shape.kind == "box":
        return {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": np.array(shape.size) / 2}
    vertices, faces = read_mesh(folder / str(shape.mesh), shape.size)
    # As a shell a mesh may be open or inside out: its volume, which is not needed here, is not computed.
    spec.add_mesh(
        name=name,
        uservert=vertices.ravel(),
        userface=faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    return {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name}


def _collision_shape(shape: Shape, folder: Path) -> tuple[dict[str, Any], np.ndarray]:
    """Return a capsule or a sphere, and its pose [4, 4] in the frame of the shape."""
    if shape.kind == "sphere":
        return _sphere(shape.size[0]), np.eye(4)
    if shape.kind == "cylinder":
        radius, length = shape.size
        return _capsule(radius, max(length / 2 - radius, 0.0)), np.eye(4)
    if shape.kind == "box":
        return _bounding_capsule(np.array(list(product((-0.5, 0.5), repeat=3))) * shape.size)
    return _bounding_capsule(read_mesh(folder / str(shape.mesh), shape.size)[0])


def _bounding_capsule(points: np.ndarray) -> tuple[dict[str, Any], np.ndarray]:
    """Return a capsule that holds points [n, 3], or a sphere if that is smaller, and its pose [4, 4].

    The capsule is the shortest one whose axis passes through the middle of the points' bounding box, along the longest
    side of the box.
    """
    low, high = points.min(0), points.max(0)
    place = np.eye(4)
    # cyclic permutations are rotations: z of the capsule becomes the longest side
    place[:3, :3] = np.roll(np.eye(3), int(np.argmax(high - low)) + 1, axis=0)
    place[:3, 3] = (low + high) / 2
    local = (points - place[:3, 3]) @ place[:3, :3]
    away = np.linalg.norm(local[:, :2], axis=1)
    radius = away.max()
    half = max(float((np.abs(local[:, 2]) - np.sqrt(radius**2 - away**2)).max()), 0.0)
    around = np.linalg.norm(local, axis=1).max()
    if around**3 <= radius**3 + 1.5 * radius**2 * half:  # volumes, both over 4/3 pi
        radius, half = around, 0.0
    return _capsule(float(radius), half), place


def _capsule(radius: float, half: float) -> dict[str, Any]:
    """Return a capsule whose axis is `2 * half` long, or a sphere if `half` is zero."""
    if half == 0:
        return _sphere(radius)
    return {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": [radius, half, 0]}


def _sphere(radius: float) -> dict[str, Any]:
    return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [radius, 0, 0]}


def _place(origin: np.ndarray) -> dict[str, np.ndarray]:
    return {"pos": origin[:3, 3], "quat": quaternion(origin[:3, :3])}
