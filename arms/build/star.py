"""STAR: a KUKA LWR 4+ that carries an Endo360 suturing tool. Sources of every number: arms/star/README.md."""

from __future__ import annotations

import math

import numpy as np
from robot import Box, Cylinder, Inertial, Limits, Robot, Shape, Sphere, Vector

# ---- The tool. ASSUMPTION: no source publishes how it is mounted, what joint 8 turns, its limits or any mass. --------
# The README's section "The tool is our own assumption" gives the reasons. Lengths in m along the flange axis, from the
# flange; the tool's rear face lies on the flange and its axis on the flange's z axis.
TOOL_TIP = 0.613  # the needle driver
HEAD = (0.613 - 0.0515, 0.613 - 0.001)  # the distal link that joint 8 turns, 12 x 12 mm
SHAFT_END = 0.570  # housing and shaft together are 570 mm long, so shaft and head overlap by 8.5 mm
NEEDLE_PIVOT = (HEAD[0] + SHAFT_END) / 2  # the middle of that overlap
NEEDLE_AXIS = (0, 1, 0)  # across the tool, y of the flange
NEEDLE_LIMITS = Limits(-math.pi / 3, math.pi / 3, velocity=1.5, effort=2.0, viscous=0.01, coulomb=0.005)
HOUSING_SIZE = (0.080, 0.090, 0.200)  # 80 x 90 mm as the mesh; the share of the housing in the 570 mm is a guess
HOUSING_RADIUS = 0.045
SHAFT_RADIUS = 0.006  # as wide as the head
HOUSING_MASS, SHAFT_MASS, HEAD_MASS = 1.0, 0.10, 0.03  # motors and handle; a thin tube; a steel head
# ----------------------------------------------------------------------------------------------------------------------

DEGREE = math.pi / 180
BASE_MASS = 1.6
# joint, child, distance to the joint before it along z, axis, range, velocity (degrees), effort, viscous, Coulomb
JOINTS = [
    ("a1", "link_1", 0.1100, (0, 0, 1), 170, 110, 176, 1.0, 0.50),
    ("a2", "link_2", 0.2005, (0, -1, 0), 120, 110, 176, 1.2, 0.80),
    ("e1", "link_3", 0.2000, (0, 0, 1), 170, 128, 100, 0.9, 0.40),
    ("a3", "link_4", 0.2000, (0, 1, 0), 120, 128, 100, 0.8, 0.30),
    ("a4", "link_5", 0.2000, (0, 0, 1), 170, 204, 100, 0.5, 0.20),
    ("a5", "link_6", 0.1900, (0, -1, 0), 120, 184, 38, 0.3, 0.10),
    ("a6", "link_7", 0.0780, (0, 0, 1), 170, 184, 38, 0.2, 0.05),
]
# link: mass, and its capsule: radius, ends of its axis
LINKS = {
    "link_1": (2.7, 0.070, (0, 0.00, 0.000), (0, 0.06, 0.200)),
    "link_2": (2.7, 0.070, (0, -0.06, 0.000), (0, 0.00, 0.200)),
    "link_3": (2.7, 0.070, (0, 0.00, 0.000), (0, -0.06, 0.200)),
    "link_4": (2.7, 0.070, (0, 0.06, 0.000), (0, 0.00, 0.200)),
    "link_5": (1.7, 0.060, (0, 0.00, 0.000), (0, 0.016, 0.080)),
    "link_6": (1.6, 0.075, (0, 0.00, 0.000), (0, 0.00, 0.000)),
    "link_7": (0.3, 0.035, (0, 0.00, 0.000), (0, 0.00, 0.000)),
}


def build() -> dict[str, str]:
    """The URDF's text, by the name of its file in `arms/`."""
    robot = Robot(
        "star",
        "STAR: a KUKA LWR 4+ with an Endo360 suturing tool. The base frame is the base plate, z up. At zero\n"
        "     every link frame is parallel to it and the arm stands upright. Sources of numbers: README.md beside it.",
    )
    robot.link("base", _cylinder_inertia(BASE_MASS, 0.081, 0.102, 0.051), _base_visuals())
    parent = "base"
    for name, child, height, axis, reach, velocity, effort, viscous, coulomb in JOINTS:
        mass, radius, start, end = LINKS[child]
        collision = _segment(radius, start, end, radius, name=child)
        robot.link(child, _capsule_inertia(mass, radius, start, end), _visuals(child), [collision])
        limits = Limits(-reach * DEGREE, reach * DEGREE, velocity * DEGREE, effort, viscous, coulomb)
        robot.joint(name, "revolute", parent, child, at=(0, 0, height), axis=axis, limits=limits)
        parent = child
    robot.link("flange")
    robot.joint("flange", "fixed", "link_7", "flange")
    _add_tool(robot)
    return {"star/star.urdf": robot.text()}


def _add_tool(robot: Robot) -> None:
    x, y, length = HOUSING_SIZE
    housing = Inertial(
        HOUSING_MASS,
        _rounded(HOUSING_MASS / 12 * np.array([y * y + length**2, x * x + length**2, x * x + y * y])),
        at=(0, 0, length / 2),
    )
    robot.link("tool_body", housing, _housing_visuals(),
               [Cylinder(HOUSING_RADIUS, length, at=(0, 0, length / 2), name="tool_body")])  # fmt: skip
    robot.joint("tool_body", "fixed", "flange", "tool_body")

    start, end = (0, 0, length), (0, 0, SHAFT_END)
    robot.link("tool_shaft", _capsule_inertia(SHAFT_MASS, SHAFT_RADIUS, start, end),
               [_segment(SHAFT_RADIUS, start, end, material="steel")],
               [_segment(SHAFT_RADIUS, start, end, name="tool_shaft")])  # fmt: skip
    robot.joint("tool_shaft", "fixed", "tool_body", "tool_shaft")

    start, end = (0, 0, HEAD[0] - NEEDLE_PIVOT), (0, 0, HEAD[1] - NEEDLE_PIVOT)
    robot.link("needle_head", _capsule_inertia(HEAD_MASS, SHAFT_RADIUS, start, end), _head_visuals(start[2], end[2]),
               [_segment(SHAFT_RADIUS, start, end, name="needle")])  # fmt: skip
    robot.joint("needle", "revolute", "tool_shaft", "needle_head", at=(0, 0, _tidy(NEEDLE_PIVOT)), axis=NEEDLE_AXIS,
                limits=NEEDLE_LIMITS)  # fmt: skip
    robot.link("tool_tip")
    robot.joint("tool_tip", "fixed", "needle_head", "tool_tip", at=(0, 0, _tidy(TOOL_TIP - NEEDLE_PIVOT)))


def _segment(
    radius: float, start: Vector, end: Vector, overhang: float = 0.0, material: str = "grey", name: str = ""
) -> Cylinder:
    """A cylinder from `start` to `end`, which differ in y and z only, longer by `overhang` at both ends."""
    dy, dz = end[1] - start[1], end[2] - start[2]
    middle = [_tidy((a + b) / 2) for a, b in zip(start, end, strict=True)]
    tilt = -math.atan2(dy, dz) if dy else 0.0
    return Cylinder(radius, _tidy(math.hypot(dy, dz) + 2 * overhang), middle, (_tidy(tilt), 0, 0), material, name)


def _capsule_inertia(mass: float, radius: float, start: Vector, end: Vector) -> Inertial:
    """A solid capsule of uniform density, the ends of its axis at `start` and `end`; a ball where they coincide."""
    length = math.dist(start, end)
    direction = (np.array(end) - start) / length if length else np.array([0.0, 0.0, 1.0])
    share = length / (length + 4 / 3 * radius)  # of the volume in the cylinder between the two half balls
    tube, balls = mass * share, mass * (1 - share)
    along = tube * radius**2 / 2 + balls * 0.4 * radius**2
    across = tube * (radius**2 / 4 + length**2 / 12)
    across += balls * (0.4 * radius**2 + length**2 / 4 + 0.375 * length * radius)
    tensor = across * np.eye(3) + (along - across) * np.outer(direction, direction)
    middle = [_tidy((a + b) / 2) for a, b in zip(start, end, strict=True)]
    return Inertial(mass, _rounded(tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]), middle)


def _cylinder_inertia(mass: float, radius: float, length: float, height: float) -> Inertial:
    across = mass * (3 * radius**2 + length**2) / 12
    return Inertial(mass, _rounded(np.array([across, across, mass * radius**2 / 2])), (0, 0, height))


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    """Six significant digits: what a reader can compare, and the same text on every machine."""
    return tuple(float(f"{value:.6g}") + 0.0 for value in values)


def _tidy(value: float) -> float:
    """A length or angle without the last digits that sums leave behind."""
    return round(value, 12) + 0.0


def _base_visuals() -> list[Shape]:
    return [
        Cylinder(0.081, 0.024, at=(0, 0, 0.012), material="dark"),
        Cylinder(0.070, 0.090, at=(0, 0, 0.057), material="grey"),
    ]


def _visuals(link: str) -> list[Shape]:
    _, radius, start, end = LINKS[link]
    if link == "link_7":
        return [Cylinder(0.040, 0.031, at=(0, 0, -0.0155), material="dark")]
    if link == "link_6":
        caps = [Cylinder(0.045, 0.012, at=(0, side * 0.064, 0), rpy=(math.pi / 2, 0, 0)) for side in (-1, 1)]
        return [Sphere(0.066, material="white"), *caps]
    slim = _tidy(radius - 0.008)
    if link == "link_5":  # the collision capsule ends where the wrist's ball begins; the shell reaches the ball
        return [Sphere(slim, start, material="white"), _segment(slim, start, (0, 0.02, 0.10), material="orange"),
                _segment(0.036, (0, 0.02, 0.10), (0, 0.03, 0.15), material="grey")]  # fmt: skip
    fork, neck = (end, start) if end[1] else (start, end)
    side = math.copysign(1, fork[1])
    cap = (0, _tidy(fork[1] + side * (slim - 0.002)), fork[2])
    return [
        Sphere(slim, neck, material="white"),
        _segment(slim, start, end, material="orange"),
        Sphere(slim, fork, material="orange"),
        Cylinder(0.042, 0.016, at=cap, rpy=(math.pi / 2, 0, 0), material="grey"),
    ]


def _housing_visuals() -> list[Shape]:
    x, y, length = HOUSING_SIZE
    return [
        Cylinder(0.040, 0.012, at=(0, 0, 0.006), material="dark"),
        Box((x, y, length - 0.042), at=(0, 0, _tidy((length - 0.018) / 2)), material="white"),
        Box((0.056, 0.063, 0.030), at=(0, 0, length - 0.015), material="grey"),
        Cylinder(0.012, 0.050, at=(0, 0, length + 0.025), material="dark"),
    ]


def _head_visuals(start: float, end: float) -> list[Shape]:
    """Head with its tissue gap, and the pin that it turns about."""
    return [
        Cylinder(0.0045, 0.0125, rpy=(math.pi / 2, 0, 0), material="dark"),
        Box((0.012, 0.012, _tidy(end - start - 0.010)), at=(0, 0, _tidy((start + end - 0.010) / 2)), material="steel"),
        Box((0.0035, 0.010, 0.010), at=(-0.0042, 0, _tidy(end - 0.005)), material="steel"),
        Box((0.0035, 0.010, 0.010), at=(0.0042, 0, _tidy(end - 0.005)), material="steel"),
    ]
