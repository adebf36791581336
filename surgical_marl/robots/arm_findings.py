"""Finds numbers of an arm that can be read but are likely mistakes: units, axes, mimic limits, homes.

    for finding in number_findings(load_arm("my_arm")):
        print(finding)

`surgical_marl.robots.urdf_faults` has the numbers with which an arm does not load.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from surgical_marl.robots.arm import Arm, Joint
from surgical_marl.robots.description import MOVING

MOST_TURN, MOST_TURNING = 3 * math.pi, 20 * math.pi
"""Limits of a revolute joint beyond which they are likely degrees: 1.5 turns from zero, and 10 turns a second, rad."""
MOST_SLIDE, MOST_SLIDING = 5.0, 10.0
"""Limits of a prismatic joint beyond which they are likely millimetres, m and m/s."""
AXIS = 0.01
"""The length of an axis may differ from 1 by this: digits are rounded."""
KEPT = 0.01
"""Share of the range of a joint that the limits of those that mimic it may keep it from."""
WIDEST = 3.0
"""Radius of gyration of a link, m; one with more is likely given in another unit."""


def number_findings(arm: Arm) -> Iterator[str]:
    """Yield one sentence for each finding, with the numbers and what to write instead."""
    yield from (units := list(_unit_findings(arm)))
    joints = {joint.name: joint for joint in arm.joints}
    for joint in arm.joints:
        if joint.leader == joint.name:
            yield from _home_findings(arm, joint)
        elif not units:  # limits in two units never fit
            yield from _mimic_findings(joint, joints[joint.leader])
    yield from _axis_findings(arm)
    yield from _inertia_findings(arm)


def _home_findings(arm: Arm, joint: Joint) -> Iterator[str]:
    """Yield positions in `arm.yaml` outside a joint's limits, and a speed above the URDF's."""
    unit, limits = _unit(joint.slides), f"[{joint.lower:g}, {joint.upper:g}]"
    home, speed = joint.drive.home, joint.drive.speed
    if not joint.lower <= home <= joint.upper:
        yield f"joint {joint.name!r} has its home at {home:g} {unit}, outside its limits {limits} {unit}"
    if speed > joint.velocity:
        yield (
            f"joint {joint.name!r} has the speed {speed:g} {unit}/s in arm.yaml, above its velocity limit of "
            f"{joint.velocity:g} {unit}/s in the URDF; lower the speed"
        )
    if arm.jaw is not None and arm.jaw.joint == joint.name:
        for what, value in (("open", arm.jaw.open), ("closed", arm.jaw.closed)):
            if not joint.lower <= value <= joint.upper:
                yield f"the jaw is {what} at {value:g} {unit}, outside the limits {limits} of joint {joint.name!r}"


def _mimic_findings(joint: Joint, leader: Joint) -> Iterator[str]:
    """Yield that a joint's limits keep the one that it mimics from a part of its range."""
    low, high = sorted(joint.multiplier * end + joint.offset for end in (leader.lower, leader.upper))
    unit, margin = _unit(joint.slides), joint.drive.margin
    if low == high:
        stays = f"stays at {low:g} {unit}; make it fixed"
        yield f"joint {joint.name!r} mimics {leader.name!r} with multiplier 0, so it {stays}"
        return
    lost = 1 - max(min(high, joint.upper) - max(low, joint.lower), 0.0) / (high - low)
    if lost <= KEPT:
        return
    yield (
        f"joint {joint.name!r} mimics {leader.name!r}, whose range takes it from {low:g} to {high:g} {unit}, but its "
        f"limits [{joint.lower:g}, {joint.upper:g}] {unit} keep both from {100 * lost:.0f} % of that; write "
        f'lower="{low - margin:g}" upper="{high + margin:g}", or give {leader.name!r} narrower limits'
    )


def _unit_findings(arm: Arm) -> Iterator[str]:
    """Yield limits that are likely degrees or millimetres. Small ones can't be told from rad and m."""
    for joint in arm.urdf.joints:
        if joint.type not in MOVING or (limit := joint.limit) is None:
            continue
        slides = joint.type == "prismatic"
        factor, other = (1e-3, "mm") if slides else (math.pi / 180, "degrees")
        far, fast = (MOST_SLIDE, MOST_SLIDING) if slides else (MOST_TURN, MOST_TURNING)
        wrong: dict[str, float] = {}
        if max(abs(limit.lower), abs(limit.upper)) > far:
            wrong |= {"lower": limit.lower, "upper": limit.upper}
        if limit.velocity > fast:
            wrong["velocity"] = limit.velocity
        if wrong:
            given, right = (
                " ".join(f'{name}="{value * scale:.4g}"' for name, value in wrong.items()) for scale in (1, factor)
            )
            much = "far" if "lower" in wrong else "fast"
            yield (
                f"joint {joint.name!r} has the limits {given}, which look like {other}: a URDF's are in "
                f"{_unit(slides)}; write {right}, unless it really moves so {much}"
            )


def _axis_findings(arm: Arm) -> Iterator[str]:
    """Yield axes that are not of unit length: programs differ in whether the length scales a joint's motion."""
    for joint in arm.urdf.joints:
        length = float(np.linalg.norm(joint.axis))
        if joint.type in MOVING and abs(length - 1) > AXIS:
            given, right = (" ".join(f"{part / by:.6g}" for part in joint.axis) for by in (1, length))
            yield (
                f"joint {joint.name!r} has the axis {given} of length {length:.4g}, which is read as one of length 1; "
                f'write xyz="{right}"'
            )


def _inertia_findings(arm: Arm) -> Iterator[str]:
    """Yield inertias so large for their mass that they are likely in another unit."""
    for link in arm.urdf.links:
        if link.inertial is None or not link.inertial.mass > 0:
            continue
        most = float(np.linalg.eigvalsh(np.array(link.inertial.inertia))[-1])
        radius = math.sqrt(most / link.inertial.mass)
        if radius > WIDEST:
            yield (
                f"link {link.name!r} has a moment of inertia of {most:.4g} kg m2 with {link.inertial.mass:g} kg, a "
                f"radius of gyration of {radius:.3g} m; a URDF's are in kg m2, of which 1 kg mm2 is 1e-6"
            )


def _unit(slides: bool) -> str:
    return "m" if slides else "rad"
