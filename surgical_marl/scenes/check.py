"""Finds faults of an arm, a scene or an object, one sentence each: of its files, then of its behaviour once loaded.

    for finding in check("my_arm"):
        print(finding)

`surgical-marl check my_arm` prints them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, combinations
from pathlib import Path

import mujoco
import numpy as np

from surgical_marl.content import as_name, find, list_arms, list_objects, list_scenes, unknown
from surgical_marl.robots.arm import Arm, list_tools, load_arm
from surgical_marl.robots.arm_findings import number_findings
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.robots.spec import COLLISION_GROUP, build_spec
from surgical_marl.scenes.build import set_physics
from surgical_marl.scenes.contact_count import crowding
from surgical_marl.scenes.contacts import neighbours
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.objects import load_object
from surgical_marl.scenes.scene import Scene, collision_geoms
from surgical_marl.scenes.timing import TIMESTEP
from surgical_marl.untrusted.files import is_file, is_folder, user_path
from surgical_marl.untrusted.schema import Faults, collecting
from surgical_marl.untrusted.values import plural
from surgical_marl.yaml_file import read_yaml

REACH = 0.001
"""A scene's workspace point must be within reach to this, m."""
CENTER = 1e-4
"""The shaft may miss the remote center by this, m: a URDF's angles are rounded."""
POSTURES = 20
"""Postures, besides home, in which the controller must be stable."""
GROWTH = 1e-3
"""A disturbance may grow by this share in a physics step. That of undamped joints stays the same except for
rounding."""


def check(source: str | Path) -> list[str]:
    """Return findings about an arm, a scene or an object, an empty list if nothing is wrong.

    Args:
        source: the name of a shipped arm, scene or object (of all that have it), an arm's folder, or the YAML file of a
            scene or an object.

    Raises:
        ValueError: if there is nothing of that name, or it is a file that is no YAML mapping.
    """
    findings = [finding for kind, path in _find(source).items() for finding in _CHECKS[kind](path)]
    return list(dict.fromkeys(findings))


def summary(source: str | Path) -> str:
    """Return what was checked, in a few words: "7 joints, 4 collision shapes; scene of 1 arm"."""
    return "; ".join(_SUMMARIES[kind](path) for kind, path in _find(source).items())


def _sum_up_arm(folder: Path) -> str:
    arm = load_arm(folder)
    shapes = sum(len(link.collisions) for link in arm.urdf.links)
    tools = f", {_count(len(arm.tools), 'tool')}" if arm.tools else ""
    return f"{_count(len(arm.actuated), 'joint')}, {_count(shapes, 'collision shape')}{tools}"


def _sum_up_scene(path: Path) -> str:
    scene = load_scene(path)
    objects = f", {_count(len(scene.placements), 'object')}" if scene.placements else ""
    return f"scene of {_count(len(scene.agents), 'arm')}{objects}"


def _sum_up_object(path: Path) -> str:
    item = load_object(path)
    if item.soft:
        return f"{item.soft.kind} of {1000 * item.mass:.3g} g"
    mass = f"free object of {1000 * item.mass:.3g} g" if item.free else "fixed object"
    return f"{mass}, {_count(len(item.shapes), 'shape')}"


def _count(number: int, noun: str) -> str:
    return f"{number} {plural(number, noun)}"


def _find(source: str | Path) -> dict[str, Path]:
    """Return the arm's folder, the scene's file and the object's file of this name, by their kind, as far as any."""
    text = as_name("arm, scene or object", source)
    named = {"arms": list_arms(), "scenes": list_scenes(), "objects": list_objects()}
    found = {kind: find(kind, text) for kind, names in named.items() if text in names}
    if found:
        return found
    path = user_path(text)
    if text and (is_file(path) or is_folder(path)):
        path = path.resolve()  # so that `./psm` is not taken for the shipped psm further down
    if text and path.name == "arm.yaml" and is_file(path):
        path = path.parent
    if text and is_folder(path):
        return {"arms": path}
    if text and is_file(path):
        return {"objects" if _is_object(path) else "scenes": path}
    raise unknown("arm, scene or object", text, list(dict.fromkeys(chain(*named.values()))))


def _is_object(path: Path) -> bool:
    """Return whether a file looks like an object's rather than a scene's; ValueError if it is no YAML mapping."""
    settings = read_yaml(path)
    return "arms" not in settings and not {"shapes", "free", "kind"}.isdisjoint(settings)


def _check_arm(folder: Path) -> list[str]:
    findings: list[str] = []
    with collecting(findings):
        for tool in tuple(list_tools(folder)) or (None,):
            with collecting(findings):
                findings.extend(_arm_findings(load_arm(folder, tool)))
    return findings


def _check_scene(path: Path) -> list[str]:
    try:
        scene = load_scene(path)
    except Faults as error:
        return error.faults
    except ValueError as error:
        return [str(error)]
    arms = {(mount.arm.folder, mount.arm.tool): mount.arm for mount in scene.mounts.values()}
    findings = [finding for arm in arms.values() for finding in _arm_findings(arm)]
    return findings + list(_scene_findings(scene))


def _check_object(path: Path) -> list[str]:
    try:
        load_object(path)
    except Faults as error:
        return error.faults
    except ValueError as error:
        return [str(error)]
    return []


_CHECKS = {"arms": _check_arm, "scenes": _check_scene, "objects": _check_object}
_SUMMARIES = {"arms": _sum_up_arm, "scenes": _sum_up_scene, "objects": _sum_up_object}


def _arm_findings(arm: Arm) -> Iterator[str]:
    where = f"arm {arm.title!r}"
    for finding in (*number_findings(arm), *_remote_center_findings(arm)):
        yield f"{where}: {finding}"
    model = _model(arm)
    for finding in (*_collision_findings(arm, model), *_controller_findings(arm, model)):
        yield f"{where}: {finding}"


def _remote_center_findings(arm: Arm) -> Iterator[str]:
    if arm.remote_center is None:
        return
    shares = np.random.default_rng(0).uniform(size=(200, len(arm.actuated)))
    worst = float(np.max(arm.remote_center_error(arm.lower + shares * (arm.upper - arm.lower))))
    if worst > CENTER:
        yield (
            f"the z axis of the remote_center link {arm.remote_center!r} misses the origin of the base frame by up to "
            f"{1000 * worst:.3g} mm; name the shaft's link and make that origin the remote center, or leave the key out"
        )


def _model(arm: Arm) -> mujoco.MjModel:
    """Return the model of the arm alone, under the physics of a scene."""
    spec = build_spec(arm, "position")
    set_physics(spec)
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"arm {arm.name!r} does not compile: {' '.join(str(error).split())}") from None


def _collision_findings(arm: Arm, model: mujoco.MjModel) -> Iterator[str]:
    geoms = [int(geom) for geom in np.flatnonzero(model.geom_group == COLLISION_GROUP)]
    if not geoms:
        yield "it has no <collision>, so other arms can't touch it; give at least its tool a cylinder"
    data = _at(arm, model, arm.home)
    for a, b in combinations(geoms, 2):
        if _meet_by_design(arm, model, a, b):
            continue
        depth = -mujoco.mj_geomDistance(model, data, a, b, 1.0, None)
        if depth > 0:
            yield (
                f"at home its collision shapes {model.geom(a).name!r} and {model.geom(b).name!r} overlap by "
                f"{1000 * depth:.3g} mm; change home or make the shapes smaller"
            )


def _meet_by_design(arm: Arm, model: mujoco.MjModel, a: int, b: int) -> bool:
    """Return whether two geoms are on one body, are neighbours with no collision geom between, or are jaw fingers."""
    if neighbours(model, a, b):
        return True
    one, other = (int(model.body_weldid[model.geom_bodyid[geom]]) for geom in (a, b))
    leaders = {joint.name: joint.leader for joint in arm.joints}
    moved_by = [leaders[model.joint(int(model.body_jntadr[body])).name] for body in (one, other) if body != 0]
    return len(moved_by) == 2 and moved_by[0] == moved_by[1]


def _at(arm: Arm, model: mujoco.MjModel, q: np.ndarray) -> mujoco.MjData:
    """Return the arm at rest at joint positions [n], with its position targets there too."""
    data = mujoco.MjData(model)
    values = dict(zip((joint.name for joint in arm.actuated), q, strict=True))
    for joint in arm.joints:
        value = joint.multiplier * values[joint.leader] + joint.offset
        data.joint(joint.name).qpos = value
    mujoco.mj_fwdPosition(model, data)
    data.ctrl[:] = data.actuator_length
    mujoco.mj_forward(model, data)
    return data


def _controller_findings(arm: Arm, model: mujoco.MjModel) -> Iterator[str]:
    """Yield a finding if a slight disturbance grows in a step of C MuJoCo, at home or at other postures.

    In a stable arm it does not grow. Joint limits, dry friction and effort limits are left out. They would only bound a
    growing disturbance, which then becomes chatter.
    """
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.actuator_forcelimited[:], model.jnt_actfrclimited[:] = 0, 0
    shares = np.random.default_rng(0).uniform(size=(POSTURES, len(arm.actuated)))
    for q in (arm.home, *(arm.lower + shares * (arm.upper - arm.lower))):
        data, step = _at(arm, model, q), np.zeros((2 * model.nv, 2 * model.nv))
        with _no_log():
            mujoco.mjd_transitionFD(model, data, 1e-6, True, step, None, None, None)
        if data.warning.number.any() or not np.isfinite(step).all():  # overflow in a single step
            name = max(arm.joints, key=lambda joint: joint.drive.stiffness).name
        else:
            growth, modes = np.linalg.eig(step)
            worst = int(np.argmax(np.abs(growth)))
            if np.abs(growth[worst]) <= 1 + GROWTH:
                continue
            name = model.joint(int(np.argmax(np.abs(modes[: model.nv, worst])))).name
        yield (
            f"its controller is unstable at the physics step of {1000 * TIMESTEP:g} ms, joint {name!r} most of all; "
            "lower stiffness, or raise armature or damping"
        )
        return


@contextmanager
def _no_log() -> Iterator[None]:
    """Suppress MUJOCO_LOG.TXT, which MuJoCo writes if numbers diverge; here that is a finding instead."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _scene_findings(scene: Scene) -> Iterator[str]:
    where = f"scene {scene.name!r}"
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    mujoco.mj_kinematics(model, data)
    geoms = {agent: collision_geoms(model, agent) for agent in scene.agents}
    for one, other in combinations(scene.agents, 2):
        pairs = [(a, b) for a in geoms[one] for b in geoms[other]]
        depths = {pair: -mujoco.mj_geomDistance(model, data, *pair, 1.0, None) for pair in pairs}
        worst = max(depths, key=lambda pair: depths[pair], default=None)
        if worst is not None and depths[worst] > 0:
            names = " and ".join(repr(model.geom(geom).name) for geom in worst)
            yield (
                f"{where}: {one} and {other} overlap at home, {names} by {1000 * depths[worst]:.3g} mm; "
                "move one of them or change a home"
            )
    for agent, mount in scene.mounts.items():
        q = inverse_kinematics(mount.arm, mount.workspace)
        off = float(np.linalg.norm(mount.arm.forward_kinematics(q)[:3, 3] - mount.workspace))
        if off > REACH:
            yield (
                f"{where}: the workspace point {mount.workspace.tolist()} of {agent} is {1000 * off:.3g} mm out of its "
                "reach; it is in the arm's base frame, in m"
            )
    crowded = crowding(scene)
    if crowded:
        yield f"{where}: {crowded}"
