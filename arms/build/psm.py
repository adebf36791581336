"""The patient side manipulators, Classic and Si, each with a Large Needle Driver or Cadiere Forceps. One chain.

The base frame is the remote center of motion (RCM). At zero every link frame is parallel to it: z points out of the
patient, the shaft points along -z, and the arm's base stands on the -y side: the published yaw axis points from the RCM
to the base, and it is -y. Numbers and their sources: arms/psm/README.md and arms/psm_si/README.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import atan2, hypot, pi

from robot import Box, Cylinder, Inertial, Limits, Robot, Sphere, Vector

WRIST_TO_YAW = 0.0091  # a5 of the DH table: wrist-pitch axis to wrist-yaw axis, of all instruments here
ALONG_X, ALONG_Y = (0, pi / 2, 0), (pi / 2, 0, 0)  # turn a cylinder's z to the x or y axis


@dataclass(frozen=True)
class Finger:
    """A finger of a jaw, on the side of -x, along -z from the wrist-yaw axis. Lengths in m, mass in kg."""

    tip: float
    """From the wrist-yaw axis to the point between the jaws."""
    length: float
    """Likewise to the end of the finger."""
    radius: float
    """Of its capsule; the axis of the capsule is half of the drawn thickness beside the middle."""
    inertial: Inertial
    shapes: tuple[Box, ...]

    def beside(self, side: int) -> tuple[list[Box], Cylinder]:
        """Return the drawing of the finger on one side (-1 or 1), and its capsule."""
        drawn = [Box(box.size, (-side * box.at[0], *box.at[1:]), material=box.material) for box in self.shapes]
        return drawn, Cylinder(self.radius, self.length, (-side * self.shapes[0].at[0], 0, -self.length / 2))


NEEDLE_DRIVER = Finger(
    tip=0.0102, length=0.0106, radius=0.0012, inertial=Inertial(0.00025, (1e-8, 1e-8, 1e-8), at=(0, 0, -0.005)),
    shapes=(
        Box((0.0012, 0.0050, 0.0064), (-0.0006, 0, -0.0032), material="steel"),
        Box((0.0012, 0.0034, 0.0042), (-0.0006, 0, -0.0085), material="steel"),
    ),
)  # fmt: skip
# The window of the blade is 2.5 x 10 mm: two rails beside it, and a bridge at its far end.
CADIERE = Finger(
    tip=0.0155, length=0.0199, radius=0.0015, inertial=Inertial(0.00076, (3.2e-8, 3.2e-8, 1e-8), at=(0, 0, -0.0095)),
    shapes=(
        Box((0.0015, 0.0034, 0.0061), (-0.00075, 0, -0.00305), material="steel"),
        Box((0.0015, 0.0052, 0.0012), (-0.00075, 0, -0.0067), material="steel"),
        Box((0.0015, 0.00135, 0.0100), (-0.00075, -0.001925, -0.0123), material="steel"),
        Box((0.0015, 0.00135, 0.0100), (-0.00075, 0.001925, -0.0123), material="steel"),
        Box((0.0015, 0.0052, 0.0026), (-0.00075, 0, -0.0186), material="steel"),
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """Numbers that differ between machines and instruments. Lengths in m, angles in rad, efforts in N m, N m, N."""

    title: str
    offset: float
    """d3 of the DH table: height of the instrument's datum over the RCM at zero insertion."""
    shaft: float
    """d4 of the DH table: from there down the shaft to the wrist-pitch axis."""
    yaw: tuple[float, float]
    pitch: tuple[float, float]
    insertion: float
    efforts: tuple[float, float, float]
    shaft_capsule: tuple[float, float]
    """Radius and length."""
    cannula: tuple[float, float]
    """Radius and length."""
    finger: Finger = NEEDLE_DRIVER


CLASSIC = Variant(
    "da Vinci Classic patient side manipulator (PSM) with a Large Needle Driver (400006).",
    offset=0.4318, shaft=0.4162, yaw=(-1.588, 1.588), pitch=(-0.925025, 0.925025), insertion=0.24,
    efforts=(3.316101, 3.316101, 9.877926), shaft_capsule=(0.00423, 0.378), cannula=(0.007, 0.16),
)  # fmt: skip
SI = Variant(
    "da Vinci Si patient side manipulator (PSM) with a Large Needle Driver (420006).",
    offset=0.4826, shaft=0.4670, yaw=(-2.964, 2.964), pitch=(-1.265, 1.301), insertion=0.29,
    efforts=(17.0845, 17.0845, 40.9063), shaft_capsule=(0.0042, 0.4318), cannula=(0.008, 0.165),
)  # fmt: skip


def build() -> dict[str, str]:
    """URDF text by the name of its file in `arms/`."""
    return {
        "psm/psm.urdf": _build("psm", CLASSIC),
        "psm/psm_cadiere_forceps.urdf": _build("psm", _with_forceps(CLASSIC, "400049")),
        "psm_si/psm_si.urdf": _build("psm_si", SI),
        "psm_si/psm_si_cadiere_forceps.urdf": _build("psm_si", _with_forceps(SI, "420049")),
    }


def _with_forceps(variant: Variant, number: str) -> Variant:
    """The same machine with Cadiere Forceps."""
    machine, _, _ = variant.title.partition(" with ")
    return replace(variant, title=f"{machine} with Cadiere Forceps ({number}).", finger=CADIERE)


def _build(name: str, variant: Variant) -> str:
    robot = Robot(name, f"{variant.title}\n     Numbers and their sources: README.md in this folder.")
    _positioning(robot, variant)
    _instrument(robot, variant)
    _jaw(robot, variant.finger)
    return robot.text()


def _positioning(robot: Robot, variant: Variant) -> None:
    """Yaw, pitch and insertion. Masses are chosen for the identified mass matrix, not to look like the parts."""
    extra = variant.offset - 0.4318  # how much higher than on the Classic the instrument rides: 50.8 mm on the Si
    robot.link("remote_center", visuals=_base())
    robot.link("yaw_link", Inertial(1.0, (0.005, 0.005, 0.005)), _linkage())
    yaw = Limits(*variant.yaw, velocity=1.5708, effort=variant.efforts[0], viscous=0.0905, coulomb=0.05)
    robot.joint("yaw", "revolute", "remote_center", "yaw_link", axis=(0, -1, 0), limits=yaw)

    height = round(0.455 + extra, 6)
    middle = (0, -0.047, round(0.084 + height / 2, 6))
    # The column is 78 mm wide and 41 mm deep: the capsule's radius is half the mean of the two.
    column = Cylinder(0.03, height, middle, name="column")
    visuals = _column(height, middle, variant.cannula)
    robot.link("pitch_link", Inertial(1.0, (0.180, 0.177, 0.0352, 0, 0, 0.038)), visuals, [column])
    pitch = Limits(*variant.pitch, velocity=1.5708, effort=variant.efforts[1], viscous=0.2181, coulomb=0.0668)
    robot.joint("pitch", "revolute", "yaw_link", "pitch_link", axis=(-1, 0, 0), limits=pitch)

    carriage = Cylinder(0.038, 0.14, (0, -0.004, round(0.448 + extra, 6)), name="carriage")
    inertial = Inertial(0.711, (0.0002, 0.0002, 0.0002), at=(0, 0, round(0.3183 + extra, 6)))
    robot.link("insertion_link", inertial, _carriage(round(0.448 + extra, 6)), [carriage])
    slide = Limits(0, variant.insertion, velocity=0.2, effort=variant.efforts[2], viscous=1.2036, coulomb=0.4476)
    robot.joint("insertion", "prismatic", "pitch_link", "insertion_link", axis=(0, 0, -1), limits=slide)


def _instrument(robot: Robot, variant: Variant) -> None:
    """Roll, wrist pitch and wrist yaw; the roll link's frame lies on the wrist-pitch axis."""
    radius, length = variant.shaft_capsule
    robot.link(
        "roll_link",
        Inertial(0.0005, (6e-6, 6e-6, 1e-8), at=(0, 0, 0.19)),
        [Cylinder(0.0042, variant.shaft, (0, 0, variant.shaft / 2), material="dark")],
        [Cylinder(radius, length, (0, 0, round(0.001 + length / 2, 6)), name="shaft")],
    )
    start = round(variant.offset - variant.shaft, 6)
    limits = Limits(-4.53786, 4.53786, velocity=18.8496, effort=0.22, viscous=0.00111, coulomb=0.00247)
    robot.joint("roll", "revolute", "insertion_link", "roll_link", (0, 0, start), axis=(0, 0, -1), limits=limits)

    robot.link(
        "wrist_pitch_link",
        Inertial(0.0005, (1e-8, 1e-8, 1e-8), at=(0, 0, -0.0045)),
        [
            Cylinder(0.0033, 0.0084, (0, 0, -0.0018), material="steel"),
            Box((0.0048, 0.0012, 0.0066), (0, 0.0026, -0.0077), material="steel"),
            Box((0.0048, 0.0012, 0.0066), (0, -0.0026, -0.0077), material="steel"),
            Cylinder(0.0009, 0.0074, rpy=ALONG_X, material="dark"),
        ],
        [Cylinder(0.0035, 0.013, (0, 0, -0.0041), name="wrist")],
    )
    limits = Limits(-1.39626, 1.39626, velocity=18.8496, effort=0.25, viscous=0.0122, coulomb=0.0070)
    robot.joint("wrist_pitch", "revolute", "roll_link", "wrist_pitch_link", axis=(-1, 0, 0), limits=limits)

    visuals = [Cylinder(0.0022, 0.0040, rpy=ALONG_Y, material="steel"), Sphere(0.0018, material="dark")]
    robot.link("wrist_yaw_link", Inertial(0.0005, (1e-8, 1e-8, 1e-8)), visuals)
    limits = Limits(-1.39626, 1.39626, velocity=18.8496, effort=0.20, viscous=0.0020, coulomb=0.0008)
    at = (0, 0, -WRIST_TO_YAW)
    robot.joint("wrist_yaw", "revolute", "wrist_pitch_link", "wrist_yaw_link", at, axis=(0, -1, 0), limits=limits)


def _jaw(robot: Robot, finger: Finger) -> None:
    """Two fingers that turn by half of the jaw's angle each, and the tip between them."""
    # A finger carries twice the jaw's friction: the jaw's angle is the sum of two fingers'.
    limits = Limits(0, 0.69813, velocity=18.8496, effort=0.16, viscous=0.0044, coulomb=0.0044)
    for name, side in (("jaw_left", -1), ("jaw_right", 1)):
        drawn, capsule = finger.beside(side)
        robot.link(f"{name}_link", finger.inertial, drawn, [replace(capsule, name=name)])
        mimic = "jaw_left" if side > 0 else None
        axis = (0, -side, 0)
        robot.joint(name, "revolute", "wrist_yaw_link", f"{name}_link", axis=axis, limits=limits, mimic=mimic)
    robot.link("tool_tip")
    robot.joint("tool_tip", "fixed", "wrist_yaw_link", "tool_tip", at=(0, 0, -finger.tip), rpy=(pi, 0, pi / 2))


def _base() -> list[Box | Cylinder]:
    """The plate on the setup joint with the yaw axis' drive."""
    return [
        Box((0.134, 0.19, 0.12), (0, -0.765, -0.055), material="white"),
        Cylinder(0.05, 0.04, (0, -0.675, 0), ALONG_Y, material="grey"),
    ]


def _linkage() -> list[Box | Cylinder]:
    """Yaw body and the parallelogram in its posture at zero pitch: pins of the published linkage, bars as boxes."""
    shapes: list[Box | Cylinder] = [
        Box((0.12, 0.22, 0.10), (0, -0.545, -0.03), material="white"),
        Cylinder(0.04, 0.14, (0, -0.516, 0), ALONG_X),
        Cylinder(0.03, 0.10, (0, -0.42, 0), ALONG_X),
    ]
    back, front = (-0.559, 0.1437), (-0.468, 0.161)
    shapes += [bar((-0.516, 0), back, 0.09, 0.05, "grey"), bar((-0.42, 0), front, 0.034, 0.018, "dark")]
    # The two long bars run beside the column, so that the picture holds together when the pitch turns it.
    for x in (-0.044, 0.044):
        shapes += [bar(back, (-0.043, 0.1437), 0.008, 0.045, "white", x), bar((-0.555, 0.180), (-0.043, 0.180), 0.008,
                                                                              0.018, "grey", x)]  # fmt: skip
    return [*shapes, Cylinder(0.012, 0.10, (0, back[0], back[1]), ALONG_X, material="dark")]


def _column(height: float, middle: Vector, cannula: tuple[float, float]) -> list[Box | Cylinder]:
    """The instrument column with the two pins of its bars, and the cannula in its mount; all rigid with the pitch."""
    radius, length = cannula
    return [
        Box((0.0776, 0.0405, height), middle, material="white"),
        Box((0.05, 0.002, height - 0.04), (0, -0.0262, middle[2]), material="dark"),
        Cylinder(0.012, 0.098, (0, -0.043, 0.1437), ALONG_X, material="dark"),
        Cylinder(0.008, 0.098, (0, -0.043, 0.180), ALONG_X, material="dark"),
        Box((0.046, 0.05, 0.034), (0, -0.030, 0.098), material="grey"),
        Cylinder(0.015, 0.03, (0, 0, 0.098), material="grey"),
        Cylinder(radius, length, (0, 0, round(0.124 - length / 2, 6)), material="steel"),
    ]


def _carriage(height: float) -> list[Box | Cylinder]:
    """The carriage on the column, the sterile adapter and the instrument's body with the shaft's collar."""
    return [
        Box((0.083, 0.033, 0.122), (0, -0.0285, height), material="grey"),
        Box((0.060, 0.006, 0.090), (0, -0.009, height), material="blue"),
        Box((0.052, 0.040, 0.090), (0, 0.014, height), material="dark"),
        Box((0.040, 0.003, 0.030), (0, 0.0355, height + 0.02), material="steel"),
        Cylinder(0.010, 0.014, (0, 0, height - 0.05), material="grey"),
    ]


def bar(
    start: tuple[float, float], end: tuple[float, float], width: float, depth: float, material: str, x: float = 0.0
) -> Box:
    """A straight bar between two pins (y, z), `width` along x and a little longer than the pins are apart."""
    y, z = end[0] - start[0], end[1] - start[1]
    centre = (x, (start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
    size = (width, round(hypot(y, z) + 0.02, 6), depth)
    return Box(size, tuple(round(v, 6) for v in centre), (round(atan2(z, y), 6), 0, 0), material)
