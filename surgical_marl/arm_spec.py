"""From an `Arm` to a `mujoco.MjSpec`: bodies, joints, geoms, actuators, the tool tip as a site.

Geoms come from the URDF's primitives. A `<collision>` cylinder becomes a capsule of the same length and radius:
capsules are the cheapest shape to collide, and slender tools lose nothing. Collision geoms collide only through the
explicit pairs that a scene makes of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from surgical_marl.arm import CONTROL_MODES, Joint

if TYPE_CHECKING:
    from surgical_marl.arm import Arm

VISUAL_GROUP, COLLISION_GROUP = 2, 3
DEFAULT_RGBA = (0.7, 0.7, 0.72, 1.0)


def build_spec(arm: Arm, control: str) -> mujoco.MjSpec:
    """A new MjSpec of the arm. ValueError for an unknown control mode or a geometry that is not a primitive."""
    if control not in CONTROL_MODES:
        raise ValueError(f"unknown control mode {control!r}; the modes are {', '.join(CONTROL_MODES)}")
    spec = mujoco.MjSpec()
    spec.modelname = arm.name
    spec.compiler.degree = False
    colors = {m.name: m.color.rgba for m in arm.urdf.materials if m.color is not None}
    links = {link.name: link for link in arm.urdf.links}
    children = {joint.child for joint in arm.urdf.joints}
    root = next(name for name in links if name not in children)
    bodies = {root: spec.worldbody.add_body(name=root)}
    _add_link(bodies[root], links[root], colors)
    joints = {joint.name: joint for joint in arm.joints}
    waiting = list(arm.urdf.joints)
    while waiting:  # the URDF may list joints in any order; parents come first in a spec
        ready = [joint for joint in waiting if joint.parent in bodies]
        if not ready:
            raise ValueError(f"arm {arm.name!r}: joint {waiting[0].name!r} hangs on no chain from link {root!r}")
        waiting = [joint for joint in waiting if joint not in ready]
        for element in ready:
            body = bodies[element.parent].add_body(name=element.child, **_place(element.origin))
            bodies[element.child] = body
            if element.name in joints:
                _add_joint(body, joints[element.name], element.axis)
            _add_link(body, links[element.child], colors)
    bodies[arm.tool_tip].add_site(name="tool_tip", size=[0.001] * 3, group=4)
    if arm.camera is not None:
        for name, side in (("left", -0.5), ("right", 0.5)):
            eye = [side * arm.camera.baseline, 0, 0]
            bodies[arm.camera.link].add_camera(name=name, pos=eye, fovy=arm.camera.fovy)
    for joint in arm.joints:
        _add_actuator(spec, joint, control)
    return spec


def _add_joint(body: Any, joint: Joint, axis: np.ndarray) -> None:
    body.add_joint(
        name=joint.name,
        type=mujoco.mjtJoint.mjJNT_SLIDE if joint.slides else mujoco.mjtJoint.mjJNT_HINGE,
        axis=axis,
        range=[joint.lower, joint.upper],
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        damping=[joint.viscous, 0, 0],
        armature=joint.drive.armature,
        frictionloss=joint.coulomb,
    )


def _add_actuator(spec: mujoco.MjSpec, joint: Joint, control: str) -> None:
    """One actuator a joint: force = gain * command + bias, clamped to the joint's effort.

    Position: the dVRK's PD law, stiffness * (target - q) - damping * qd. Velocity: damping * (command - qd). Torque:
    the command itself.
    """
    stiffness, damping = joint.drive.stiffness, joint.drive.damping
    laws: dict[str, tuple[float, list[float], float, float]] = {
        "position": (stiffness, [0, -stiffness, -damping], joint.lower, joint.upper),
        "velocity": (damping, [0, 0, -damping], -joint.velocity, joint.velocity),
        "torque": (1.0, [0, 0, 0], -joint.effort, joint.effort),
    }
    gain, bias, low, high = laws[control]
    spec.add_actuator(
        name=joint.name,
        target=joint.name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        gainprm=[gain] + [0] * 9,
        biasprm=bias + [0] * 7,
        ctrlrange=[low, high],
        ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        forcerange=[-joint.effort, joint.effort],
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
    )


def _add_link(body: Any, link: Any, colors: dict[str, np.ndarray]) -> None:
    if link.inertial is not None:
        origin = np.eye(4) if link.inertial.origin is None else link.inertial.origin
        tensor = origin[:3, :3] @ link.inertial.inertia @ origin[:3, :3].T
        body.explicitinertial = True
        body.mass = link.inertial.mass
        body.ipos = origin[:3, 3]
        body.fullinertia = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    for visual in link.visuals:
        material = visual.material
        rgba: Any = DEFAULT_RGBA
        if material is not None:
            rgba = material.color.rgba if material.color is not None else colors.get(material.name, rgba)
        shape = _shape(visual.geometry, link.name, capsules=False)
        _add_geom(body, shape, visual.origin, rgba=rgba, group=VISUAL_GROUP)
    for i, collision in enumerate(link.collisions):
        name = collision.name or f"{link.name}_{i}"
        shape = _shape(collision.geometry, link.name, capsules=True)
        _add_geom(body, shape, collision.origin, name=name, rgba=[0.9, 0.3, 0.2, 0.3], group=COLLISION_GROUP)


def _add_geom(body: Any, shape: dict[str, Any], origin: np.ndarray | None, **rest: Any) -> None:
    body.add_geom(**shape, **_place(origin), **rest, mass=0, contype=0, conaffinity=0)


def _shape(geometry: Any, link: str, capsules: bool) -> dict[str, Any]:
    if geometry.sphere is not None:
        return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [geometry.sphere.radius, 0, 0]}
    if geometry.cylinder is not None:
        radius, length = geometry.cylinder.radius, geometry.cylinder.length
        if not capsules:
            return {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [radius, length / 2, 0]}
        if length <= 2 * radius:
            return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [radius, 0, 0]}
        return {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": [radius, length / 2 - radius, 0]}
    if geometry.box is not None:
        return {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": np.asarray(geometry.box.size) / 2}
    raise ValueError(f"link {link!r} has a mesh; boxes, cylinders and spheres work")


def _place(origin: np.ndarray | None) -> dict[str, np.ndarray]:
    if origin is None:
        return {}
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(origin[:3, :3]).ravel())
    return {"pos": origin[:3, 3], "quat": quat}
