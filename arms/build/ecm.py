"""The endoscopic camera manipulator (ECM), da Vinci Classic, with a straight scope or one bent 30 degrees up or down.

The base frame is the remote center of motion (RCM), as for the PSM: at zero every link frame is parallel to it, z
points out of the patient, the scope points along -z, and the arm's base stands on the -y side. Numbers and their
sources: arms/ecm/README.md.
"""

from __future__ import annotations

from math import pi, radians

import numpy as np
from psm import ALONG_X, ALONG_Y, bar
from robot import Box, Cylinder, Inertial, Limits, Robot

OFFSET, SCOPE = 0.3822, 0.3829  # d3 and d4 of the DH table
TUBE, LENGTH = 0.37365, 0.603  # the scope from its tip: where the head begins, where it ends

# Tilt of the scope's end about the x axis of the published tip frame (x left, y up, z along the view).
TILTS = {"ecm": 0.0, "ecm_30_up": radians(-30), "ecm_30_down": radians(30)}
SCOPES = {"ecm": "straight scope", "ecm_30_up": "30 degree scope that looks up",
          "ecm_30_down": "30 degree scope that looks down"}  # fmt: skip

# Mass in kg, centre of mass in the base frame at zero with what turns with the pitch joint, size of the part's box, m.
# The two long bars of the parallelogram only shift: they count as points at their pins.
YAW_PARTS = [(6.4168, (0, -0.4327, -0.0290), (0.170, 0.267, 0.176))]
PITCH_PARTS = [
    (2.0321, (0, -0.0849, 0.3139), (0.051, 0.129, 0.519)),  # pitch_end, the column
    (1.6069, (0, -0.0306, 0.1358), (0.101, 0.253, 0.365)),  # pitch_front, from its own pivot
    (0.4214, (0, -0.0329, 0.1500), (0.030, 0.123, 0.307)),  # pitch_back, likewise
    (0.3593, (0, -0.1030, 0.2868), (0, 0, 0)),  # pitch_bottom, a bar
    (0.4385, (0, -0.1085, 0.3242), (0, 0, 0)),  # pitch_top, a bar
]
INSERTION_PARTS = [(0.2311, (0, -0.0524, 0.4209), (0.054, 0.033, 0.118))]
SCOPE_PARTS = [(1.5, (0, 0, 0.481), (0.070, 0.079, 0.229))]  # in the scope's own frame; the tube weighs nothing


def build() -> dict[str, str]:
    """URDF text by the name of its file in `arms/`."""
    return {f"{name}/{name}.urdf": _build(name, tilt) for name, tilt in TILTS.items()}


def _build(name: str, tilt: float) -> str:
    title = f"da Vinci Classic endoscopic camera manipulator (ECM), {SCOPES[name]}."
    robot = Robot(name, f"{title}\n     Numbers and their sources: README.md in arms/ecm.")
    _positioning(robot)
    _scope(robot)
    robot.link("camera")
    # The published tip looks along +z with x to the left, a MuJoCo camera along -z with x to the right.
    robot.joint("camera", "fixed", "roll_link", "camera", rpy=(-tilt, 0, pi))
    robot.link("tool_tip")
    robot.joint("tool_tip", "fixed", "roll_link", "tool_tip", rpy=(pi + tilt, 0, 0))
    return robot.text()


def _positioning(robot: Robot) -> None:
    """Yaw, pitch and insertion."""
    robot.link("remote_center", visuals=_base())
    robot.link("yaw_link", _lump(YAW_PARTS), _linkage())
    yaw = Limits(-1.5708, 1.5708, velocity=0.523599, effort=26.93208, viscous=0.735, coulomb=0.406)
    robot.joint("yaw", "revolute", "remote_center", "yaw_link", axis=(0, -1, 0), limits=yaw)

    robot.link("pitch_link", _lump(PITCH_PARTS), _column(), [Cylinder(0.025, 0.519, (0, -0.105, 0.29), name="column")])
    pitch = Limits(-0.76794, 1.1344, velocity=0.523599, effort=26.93208, viscous=1.771, coulomb=0.543)
    robot.joint("pitch", "revolute", "yaw_link", "pitch_link", axis=(-1, 0, 0), limits=pitch)

    carriage = [
        Box((0.054, 0.044, 0.118), (0, -0.0555, 0.43), material="grey"),
        Cylinder(0.034, 0.020, (0, 0, 0.43), material="grey"),
    ]
    robot.link("insertion_link", _lump(INSERTION_PARTS), carriage)
    slide = Limits(0, 0.255, velocity=0.06, effort=80.6589483, viscous=9.828, coulomb=3.655)
    robot.joint("insertion", "prismatic", "pitch_link", "insertion_link", axis=(0, 0, -1), limits=slide)


def _scope(robot: Robot) -> None:
    """The endoscope with its camera head: one body, turned by the roll joint. Its frame lies at the scope's end."""
    visuals = [
        # Half a millimetre short of the tip, so that the camera never looks at the tube from inside.
        Cylinder(0.006, TUBE - 0.0005, (0, 0, (TUBE + 0.0005) / 2), material="steel"),
        Cylinder(0.0175, 0.040, (0, 0, 0.390), material="dark"),
        Cylinder(0.0315, 0.070, (0, 0, 0.440), material="grey"),
        Box((0.070, 0.079, 0.128), (0, 0, LENGTH - 0.064), material="white"),
        Box((0.071, 0.080, 0.012), (0, 0, 0.492), material="dark"),
        Cylinder(0.007, 0.030, (0.050, 0, 0.520), ALONG_X, material="dark"),
        Cylinder(0.012, 0.030, (0, 0, LENGTH + 0.015), material="dark"),
    ]
    head = LENGTH - TUBE
    collisions = [
        Cylinder(0.006, TUBE, (0, 0, TUBE / 2), name="shaft"),
        Cylinder(0.0375, head, (0, 0, TUBE + head / 2), name="camera_head"),
    ]
    robot.link("roll_link", _lump(SCOPE_PARTS), visuals, collisions)
    roll = Limits(-1.552, 1.552, velocity=0.523599, effort=0.87658808, viscous=0.00442, coulomb=0.00984)
    start = (0, 0, round(OFFSET - SCOPE, 6))
    robot.joint("roll", "revolute", "insertion_link", "roll_link", start, axis=(0, 0, -1), limits=roll)


def _lump(parts: list[tuple[float, tuple[float, float, float], tuple[float, float, float]]]) -> Inertial:
    """One rigid body of uniform boxes: mass, centre of mass, inertia about it."""
    masses = np.array([mass for mass, _, _ in parts])
    places = np.array([place for _, place, _ in parts])
    sizes = np.array([size for _, _, size in parts])
    centre = masses @ places / masses.sum()
    tensor = np.zeros((3, 3))
    for mass, arm, size in zip(masses, places - centre, sizes, strict=True):
        tensor += mass * (np.eye(3) * (arm @ arm) - np.outer(arm, arm))
        tensor += mass / 12 * np.diag(size @ size - size**2)
    moments = [tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return Inertial(round(float(masses.sum()), 6), [round(float(m), 6) + 0.0 for m in moments],
                    [round(float(c), 6) + 0.0 for c in centre])  # fmt: skip


def _base() -> list[Box | Cylinder]:
    """The plate on the setup joint with the yaw axis' drive."""
    return [
        Box((0.15, 0.14, 0.16), (0, -0.70, -0.02), material="white"),
        Cylinder(0.07, 0.05, (0, -0.606, 0), ALONG_Y, material="grey"),
    ]


def _linkage() -> list[Box | Cylinder]:
    """Yaw body and the parallelogram in its posture at zero pitch: pins of the published linkage, bars as boxes."""
    shapes: list[Box | Cylinder] = [
        Box((0.170, 0.240, 0.150), (0, -0.460, -0.025), material="white"),
        Cylinder(0.055, 0.18, (0, -0.3404, 0), ALONG_X),
        bar((-0.3404, 0), (-0.4434, 0.2868), 0.10, 0.08, "white"),
        bar((-0.377, -0.0098), (-0.4855, 0.3144), 0.03, 0.03, "dark"),
    ]
    # The two long bars run beside the column, so that the picture holds together when the pitch turns it.
    for x in (-0.031, 0.031):
        shapes += [bar((-0.4434, 0.2868), (-0.103, 0.2868), 0.010, 0.045, "white", x),
                   bar((-0.4489, 0.3242), (-0.1085, 0.3242), 0.010, 0.018, "grey", x)]  # fmt: skip
    return [*shapes, Cylinder(0.016, 0.11, (0, -0.4434, 0.2868), ALONG_X, material="dark")]


def _column() -> list[Box | Cylinder]:
    """The column with the pins of its bars, and the camera's cannula in its mount; all rigid with the pitch."""
    return [
        Box((0.051, 0.060, 0.519), (0, -0.108, 0.29), material="white"),
        Box((0.034, 0.002, 0.470), (0, -0.077, 0.29), material="dark"),
        Cylinder(0.014, 0.080, (0, -0.103, 0.2868), ALONG_X, material="dark"),
        Cylinder(0.009, 0.080, (0, -0.1085, 0.3242), ALONG_X, material="dark"),
        Box((0.036, 0.070, 0.030), (0, -0.045, 0.060), material="grey"),
        Cylinder(0.016, 0.03, (0, 0, 0.060), material="grey"),
        Cylinder(0.0085, 0.13, (0, 0, 0.020), material="steel"),
    ]
