"""The visual surroundings of the arms in a scene: the operating field, tissue, light and the overview camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from surgical_marl.robots.rotation import quaternion, turned
from surgical_marl.scenes.scene import Mount
from surgical_marl.untrusted.schema import REQUIRED, Vector, angles, extent, lengths, rgb

STILL = {"contype": 0, "conaffinity": 0, "group": 1}
"""Attributes of geoms that are only visible: nothing collides with them."""
TISSUE_SHAPES = {
    "ellipsoid": (mujoco.mjtGeom.mjGEOM_ELLIPSOID, 3, "three semi-axes"),
    "box": (mujoco.mjtGeom.mjGEOM_BOX, 3, "three half sides"),
    "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, 2, "radius and half length along z"),
}
"""MuJoCo's geom for each shape of tissue, how many lengths in m its `size` has, and which."""


@dataclass(frozen=True)
class View:
    """Place of the overview camera, and the point that it looks at, in the world."""

    position: Vector = lengths((0.0, 0.75, 0.40))
    target: Vector = lengths((0.0, 0.0, 0.07))

    def __post_init__(self) -> None:
        if not np.linalg.norm(self.right) > 1e-6:
            raise ValueError(f"position {self.position} must not be straight above or at the target {self.target}")

    @property
    def back(self) -> np.ndarray:
        """The way from the target to the camera, m, [3]."""
        return np.subtract(self.position, self.target)

    @property
    def right(self) -> np.ndarray:
        """The picture's x axis, not normalised, [3]."""
        return np.cross([0.0, 0.0, 1.0], self.back)


@dataclass(frozen=True)
class TissueEntry:
    """A coloured piece of tissue in a scene file, for an endoscope to look at."""

    shape: Literal["ellipsoid", "box", "capsule"]
    size: tuple[float, ...] = extent()
    colour: Vector = rgb(REQUIRED)
    position: Vector = lengths()
    tilt: Vector = angles()

    def __post_init__(self) -> None:
        _, count, words = TISSUE_SHAPES[self.shape]
        if len(self.size) != count:
            raise ValueError(f"size must be {words} in m, not {list(self.size)}")


def add_surroundings(spec: mujoco.MjSpec, mounts: dict[str, Mount], view: View) -> None:
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
    axes = np.concatenate([view.right, np.cross(view.back, view.right)])
    spec.worldbody.add_camera(name="overview", pos=view.position, xyaxes=axes, fovy=42)


def add_tissue(spec: mujoco.MjSpec, name: str, piece: TissueEntry) -> None:
    """Add a piece of tissue. It is fixed in the world."""
    spec.worldbody.add_geom(
        name=name, type=TISSUE_SHAPES[piece.shape][0], size=[*piece.size, 0][:3], pos=piece.position,
        quat=quaternion(turned(piece.tilt)), rgba=[*piece.colour, 1], **STILL,
    )  # fmt: skip
