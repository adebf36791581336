"""The visual surroundings of the arms in a scene: the operating field, tissue, light and the overview camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from surgical_marl.robots.rotation import quaternion, turned
from surgical_marl.scenes.scene import Mount
from surgical_marl.scenes.shapes import check_size
from surgical_marl.untrusted.values import shown
from surgical_marl.yaml_file import check_keys, read_mapping, read_vector

STILL = {"contype": 0, "conaffinity": 0, "group": 1}
"""Attributes of geoms that are only visible: nothing collides with them."""
TISSUE_SHAPES = {
    "ellipsoid": (mujoco.mjtGeom.mjGEOM_ELLIPSOID, 3, "three semi-axes"),
    "box": (mujoco.mjtGeom.mjGEOM_BOX, 3, "three half sides"),
    "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, 2, "radius and half length along z"),
}
"""The content of `size` for each shape of tissue: how many lengths in m, and which."""


def add_surroundings(spec: mujoco.MjSpec, mounts: dict[str, Mount], view: Any, path: Path) -> None:
    """Add what a picture needs: the operating field, a trocar at each remote center, light, a camera.

    None of these geoms collides.
    """
    spec.worldbody.add_geom(
        name="field", type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=[0.22, 0.16, 0.04], pos=[0, 0, -0.075],
        rgba=[0.72, 0.34, 0.31, 1], **STILL,
    )  # fmt: skip
    for agent, mount in mounts.items():
        if mount.arm.remote_center is not None:
            spec.worldbody.add_geom(
                name=f"{agent}_trocar", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.011, 0.002, 0],
                pos=mount.position, quat=quaternion(mount.rotation), rgba=[0.95, 0.78, 0.20, 1], **STILL,
            )  # fmt: skip
    spec.worldbody.add_light(pos=[0.2, 0.4, 0.9], dir=[-0.2, -0.4, -0.9])
    view = {"position": [0.0, 0.75, 0.40], "target": [0.0, 0.0, 0.07], **read_mapping(view, f"{path}, view")}
    check_keys(view, ("position", "target"), f"{path}, view")
    position, target = (read_vector(view[key], f"{path}, view, {key}") for key in ("position", "target"))
    back = position - target
    right = np.cross([0.0, 0.0, 1.0], back)
    if not np.linalg.norm(right) > 1e-6:
        raise ValueError(f"{path}, view: position {position} must not be straight above or at the target {target}")
    axes = np.concatenate([right, np.cross(back, right)])
    spec.worldbody.add_camera(name="overview", pos=position, xyaxes=axes, fovy=42)


def add_tissue(spec: mujoco.MjSpec, name: str, settings: Any, where: str) -> None:
    """Add a coloured piece of tissue for an endoscope to look at. It is fixed in the world."""
    settings = read_mapping(settings, where)
    check_keys(settings, ("shape", "size", "position", "tilt", "colour"), where)
    shape = settings.get("shape")
    if not isinstance(shape, str) or shape not in TISSUE_SHAPES:
        raise ValueError(f"{where}: shape {shown(shape)} must be one of {', '.join(TISSUE_SHAPES)}")
    kind, lengths, words = TISSUE_SHAPES[shape]
    size = read_vector(settings.get("size"), f"{where}, size", lengths, f"{words} in m")
    colour = read_vector(settings.get("colour"), f"{where}, colour")
    check_size(size, where)
    if not ((colour >= 0) & (colour <= 1)).all():
        raise ValueError(f"{where}: colour {colour.tolist()} must be from 0 to 1")
    position, tilt = (read_vector(settings.get(key, [0, 0, 0]), f"{where}, {key}") for key in ("position", "tilt"))
    quat = quaternion(turned(tilt))
    spec.worldbody.add_geom(
        name=name, type=kind, size=[*size, 0][:3], pos=position, quat=quat, rgba=[*colour, 1], **STILL
    )
