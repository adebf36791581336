"""Writes a scene as MJCF for plain MuJoCo: one text whose model steps as `Scene.model` does.

    Path("psm.xml").write_text(mjcf(load_scene("psm")), encoding="utf-8")
    model = mujoco.MjModel.from_xml_path("psm.xml")

The text is written from the compiled model with all digits, because `MjSpec.to_xml` rounds to six. Meshes are included
as numbers.
"""

from __future__ import annotations

import re
from dataclasses import astuple
from typing import Any
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import mujoco
import numpy as np

from surgical_marl.robots.rotation import quaternion
from surgical_marl.robots.spec import COLLISION_GROUP, PAD_GROUP
from surgical_marl.scenes.object_contacts import direct_solref, touches
from surgical_marl.scenes.objects import Object
from surgical_marl.scenes.scene import Scene

GRAVITY = (0.0, 0.0, -9.81)
"""In scenes with objects, m/s2. It acts on objects only: arms are balanced."""


def mjcf(scene: Scene, timestep: float | None = None) -> str:
    """Return the text of an MJCF file of a scene.

    The file has the same `qpos`, options, pairs and actuators as `scene.model`, and a keyframe `home`.

    MJCF can't store the inverse weight of a body in a contact: MuJoCo computes it at the body's centre of mass. So the
    collision shapes of a link are in a body of their own within it, `<link>/contact`, which has no mass. The centre of
    that body is the point where the link's weight is the one in `scene.model` (`weigh_shapes` in `scenes/build.py`), or
    comes nearest to it.

    A free object has a free joint of its name, after all joints of the arms; in `scene.model` it has none. Gravity acts
    on objects, and contacts of objects are pairs with friction and a stiffness in N/m (`object_contacts.py`).
    Systems, such as thread and tissue, and attachments are left out; a comment at the top names them (`left_out`).

    Args:
        scene: the scene.
        timestep: of the file's physics, s; that of `scene.model` by default. Contacts of objects are as stiff as it
            allows: those of a needle need 0.5 ms or less to have their full stiffness.
    """
    model, timestep = scene.model, timestep or scene.model.opt.timestep
    root = Element("mujoco", model=scene.name)
    if missing := left_out(scene):
        root.append(Comment(f" left out: {re.sub('--+', '-', ', '.join(missing))} "))
    _add(root, "compiler", angle="radian")
    _add(root, "option", timestep=timestep, gravity=GRAVITY if scene.objects else model.opt.gravity,
         integrator=_word(mujoco.mjtIntegrator(model.opt.integrator)),
         jacobian=_word(mujoco.mjtJacobian(model.opt.jacobian)),
         cone="elliptic" if scene.objects else None, impratio=10 if scene.objects else None)  # fmt: skip
    _add(_add(root, "default"), "geom", contype=0, conaffinity=0, mass=0)
    assets = _add(root, "asset")
    for mesh in map(model.mesh, range(model.nmesh)):
        rows = slice(mesh.vertadr[0], mesh.vertadr[0] + mesh.vertnum[0])
        faces = slice(mesh.faceadr[0], mesh.faceadr[0] + mesh.facenum[0])
        _add(assets, "mesh", name=mesh.name, vertex=model.mesh_vert[rows], face=model.mesh_face[faces], inertia="shell")
    bodies = [_add(root, "worldbody")]
    for body in range(model.nbody):
        if body > 0:
            if model.body(body).name.partition("/")[0] in scene.drawn:
                continue  # the last bodies of the model
            place = scene.objects.get(model.body(body).name)
            parent = bodies[model.body_parentid[body]]
            bodies.append(_add_body(parent, model, body, bool(scene.objects), place.object if place else None))
        _add_parts(bodies[body], model, body)
    pairs = _add(root, "contact")
    for (one, other), pair in zip(scene.pairs, range(model.npair), strict=True):
        _add(pairs, "pair", geom1=one, geom2=other, condim=model.pair_dim[pair], solref=model.pair_solref[pair])
    _add_touches(pairs, scene, timestep)
    _add_actuators(root, model)
    holding = np.where(model.actuator_biasprm[:, 1] != 0, scene.moment @ scene.home, 0.0)
    _add(_add(root, "keyframe"), "key", name="home", qpos=_home(scene), ctrl=holding)
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def left_out(scene: Scene) -> list[str]:
    """Return what an MJCF file of a scene lacks, in words: "suture (thread)", "grip (attachment)"."""
    systems = (scene.soft[name].object.soft.kind if name in scene.soft else "system" for name in scene.systems)
    kinds = zip((*scene.systems, *scene.attachments), (*systems, *["attachment"] * len(scene.attachments)), strict=True)
    return [f"{name} ({kind})" for name, kind in kinds]


def _home(scene: Scene) -> np.ndarray:
    """Return `qpos` of arms at home and of free objects where the scene has them."""
    free = [place for place in scene.objects.values() if place.object.free]
    return np.concatenate([scene.home, *((*place.position, *quaternion(place.rotation)) for place in free)])


def _add(parent: Element, tag: str, **attributes: Any) -> Element:
    """Add a child element and return it; an attribute of None is left out."""
    given = {key: value for key, value in attributes.items() if value is not None}
    texts = {key.rstrip("_"): value if isinstance(value, str) else _numbers(value) for key, value in given.items()}
    return SubElement(parent, tag, texts)


def _numbers(value: Any) -> str:
    """Return numbers as text that reads back as the same numbers."""
    return " ".join(repr(number) for number in np.ravel(value).tolist())


def _word(value: Any) -> str:
    """Return MJCF's name for a value of an enumeration: mjINT_IMPLICITFAST is implicitfast."""
    return str(value.name.split("_")[1].lower())


def _add_body(parent: Element, model: mujoco.MjModel, body: int, balanced: bool, item: Object | None) -> Element:
    """Add a body: a link, balanced against gravity if asked for, or an object."""
    balance = 1 if balanced and model.body_mass[body] > 0 else None
    element = _add(parent, "body", name=model.body(body).name, pos=model.body_pos[body], quat=model.body_quat[body],
                   gravcomp=balance)  # fmt: skip
    if item is not None and item.free:
        tensor = item.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        _add(element, "inertial", pos=item.center, mass=item.mass, fullinertia=tensor)
        _add(element, "freejoint", name=model.body(body).name)
    if model.body_mass[body] > 0:
        _add(element, "inertial", pos=model.body_ipos[body], quat=model.body_iquat[body], mass=model.body_mass[body],
             diaginertia=model.body_inertia[body])  # fmt: skip
    for joint in np.flatnonzero(model.jnt_bodyid == body):
        dof = model.jnt_dofadr[joint]
        _add(element, "joint", name=model.joint(joint).name, type=_word(mujoco.mjtJoint(model.jnt_type[joint])),
             pos=model.jnt_pos[joint], axis=model.jnt_axis[joint], range=model.jnt_range[joint],
             solreflimit=model.jnt_solref[joint], actuatorfrcrange=model.jnt_actfrcrange[joint],
             damping=model.dof_damping[dof], armature=model.dof_armature[dof],
             frictionloss=model.dof_frictionloss[dof])  # fmt: skip
    return element


def _add_parts(element: Element, model: mujoco.MjModel, body: int) -> None:
    """Add what is fixed to a body: shapes, sites, cameras, lights."""
    shapes = np.flatnonzero(model.geom_bodyid == body)
    collides = model.geom_group[shapes] == COLLISION_GROUP
    touching = element
    if collides.any() and model.body_weldid[body] > 0:
        touching = _add(element, "body", name=f"{model.body(body).name}/contact")
        # with the link's axes, MuJoCo keeps the orientation of its shapes
        _add(touching, "inertial", pos=_contact_center(model, body, shapes[collides]), quat=model.body_iquat[body],
             mass=0, diaginertia=np.zeros(3))  # fmt: skip
    solid = collides | (model.geom_group[shapes] == PAD_GROUP)
    for geom, touches_others in zip(shapes, solid, strict=True):
        kind, mesh = mujoco.mjtGeom(model.geom_type[geom]), int(model.geom_dataid[geom])
        _add(touching if touches_others else element, "geom", name=model.geom(geom).name or None, type=_word(kind),
             size=model.geom_size[geom] if mesh < 0 else None, mesh=model.mesh(mesh).name if mesh >= 0 else None,
             pos=model.geom_pos[geom], quat=model.geom_quat[geom], group=model.geom_group[geom],
             rgba=model.geom_rgba[geom].astype(float).round(6))  # fmt: skip
    for site in np.flatnonzero(model.site_bodyid == body):
        _add(element, "site", name=model.site(site).name, pos=model.site_pos[site], quat=model.site_quat[site],
             size=model.site_size[site], group=model.site_group[site])  # fmt: skip
    for camera in np.flatnonzero(model.cam_bodyid == body):
        _add(element, "camera", name=model.camera(camera).name, pos=model.cam_pos[camera],
             quat=model.cam_quat[camera], fovy=model.cam_fovy[camera])  # fmt: skip
    for light in np.flatnonzero(model.light_bodyid == body):
        _add(element, "light", pos=model.light_pos[light], dir=model.light_dir[light])


def _add_touches(pairs: Element, scene: Scene, timestep: float) -> None:
    """Add the contacts of objects."""
    for touch in touches(scene):
        sliding, torsion, _ = astuple(touch.surface)
        solref, solimp = direct_solref(touch.surface, touch.weight, timestep)
        friction = [sliding, sliding, sliding * torsion, 0.0, 0.0]  # MuJoCo's torsion is a length times the coefficient
        _add(pairs, "pair", geom1=touch.one, geom2=touch.other, condim=4, friction=friction, solref=solref,
             solimp=solimp)  # fmt: skip


def _contact_center(model: mujoco.MjModel, body: int, geoms: np.ndarray) -> np.ndarray:
    """Return the point of a link where its inverse weight is `body_invweight0` (1/kg), in the link's frame, [3].

    All joints are at zero. The inverse weight is a quadratic function of the point. So the point lies on the line from
    where the function is least through the shapes.
    """
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)

    def spread(point: np.ndarray, turning: bool = False) -> np.ndarray:
        jacobians = np.zeros((2, 3, model.nv))
        mujoco.mj_jac(model, data, *jacobians, point, body)
        jacobian, moved = jacobians[int(turning)], np.zeros((3, model.nv))
        mujoco.mj_solveM(model, data, moved, jacobian)
        return jacobian @ moved.T

    def weight(point: np.ndarray) -> float:
        return float(np.trace(spread(point))) / 3

    shapes = data.geom_xpos[geoms].mean(0)
    turns = spread(shapes, turning=True)
    curvature = (np.trace(turns) * np.eye(3) - turns) / 3
    slope = np.array([weight(shapes + way) - weight(shapes - way) for way in np.eye(3)]) / 2
    least = shapes - np.linalg.pinv(curvature, rcond=1e-9) @ slope / 2
    way, lightest = shapes - least, weight(least)
    if weight(shapes) - lightest <= 1e-6 * lightest:  # the shapes are at that point already
        way = np.linalg.eigh(curvature)[1][:, 2]
    grown = weight(least + way) - lightest
    share = max(model.body_invweight0[body, 0] - lightest, 0.0) / grown if grown > 0 else 1.0
    point = least + np.sqrt(share) * way
    return data.xmat[body].reshape(3, 3).T @ (point - data.xpos[body])


def _add_actuators(root: Element, model: mujoco.MjModel) -> None:
    tendons = _add(root, "tendon")
    for i in range(model.ntendon):
        fixed = _add(tendons, "fixed", name=model.tendon(i).name, armature=model.tendon_armature[i],
                     stiffness=model.tendon_stiffness[i], springlength=model.tendon_lengthspring[i])  # fmt: skip
        for wrap in range(model.tendon_adr[i], model.tendon_adr[i] + model.tendon_num[i]):
            _add(fixed, "joint", joint=model.joint(model.wrap_objid[wrap]).name, coef=model.wrap_prm[wrap])
    actuators = _add(root, "actuator")
    for i in range(model.nu):
        pulls_joint, target = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT, model.actuator_trnid[i, 0]
        _add(actuators, "general", name=model.actuator(i).name,
             joint=model.joint(target).name if pulls_joint else None,
             tendon=None if pulls_joint else model.tendon(target).name,
             gainprm=model.actuator_gainprm[i, :1], biastype="affine", biasprm=model.actuator_biasprm[i, :3],
             ctrlrange=model.actuator_ctrlrange[i], forcerange=model.actuator_forcerange[i])  # fmt: skip
