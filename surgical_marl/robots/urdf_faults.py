"""Checks whether a URDF can be an arm: one sentence for each thing that is wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from surgical_marl.robots.description import MOVING, SHAPES, Robot
from surgical_marl.robots.safe_xml import Document
from surgical_marl.untrusted.values import LARGEST, LONGEST, SHORTEST, as_number, listed, shown

LEAST = 1e-15
"""MuJoCo treats masses (kg) and moments of inertia (kg m2) up to this value as zero."""

MAX_PARTS = {"link": 200, "joint": 200, "collision": 200, "visual": 1000, "material": 1000}
"""How many tags of each kind are read."""
MAX_TEXT = 1000
"""Characters of an attribute."""
MAX_FAULTS = 100
"""Sentences about one file."""


class _Kind(NamedTuple):
    """What a number must be: in words, and its least and greatest value."""

    words: str
    least: float
    most: float


_ANY, _PLACE = _Kind("finite", -LARGEST, LARGEST), _Kind("finite", -LONGEST, LONGEST)
_NOT_NEGATIVE, _SIDE = _Kind("finite and not negative", 0.0, LARGEST), _Kind("finite and above 0", SHORTEST, LONGEST)
# Numbers of a URDF by tag and attribute: how many there must be, and of what kind.
_NUMBERS: dict[tuple[str, str], tuple[tuple[int, ...], _Kind]] = {
    **dict.fromkeys([("origin", "xyz"), ("origin", "rpy")], ((3,), _PLACE)),
    ("axis", "xyz"): ((3,), _Kind("finite and not all 0", -LONGEST, LONGEST)),
    **dict.fromkeys([("inertia", key) for key in ("ixx", "iyy", "izz")], ((1,), _NOT_NEGATIVE)),
    **dict.fromkeys([("inertia", key) for key in ("ixy", "ixz", "iyz")], ((1,), _ANY)),
    **dict.fromkeys([("cylinder", "radius"), ("cylinder", "length"), ("sphere", "radius")], ((1,), _SIDE)),
    **dict.fromkeys([("limit", "lower"), ("limit", "upper")], ((1,), _ANY)),
    **dict.fromkeys([("limit", "velocity"), ("limit", "effort"), ("mass", "value")], ((1,), _NOT_NEGATIVE)),
    **dict.fromkeys([("dynamics", "damping"), ("dynamics", "friction")], ((1,), _NOT_NEGATIVE)),
    **dict.fromkeys([("mimic", "multiplier"), ("mimic", "offset")], ((1,), _ANY)),
    **dict.fromkeys([("calibration", key) for key in ("rising", "falling")], ((1,), _ANY)),
    **dict.fromkeys(
        [("safety_controller", f"soft_{side}_limit") for side in ("lower", "upper")]
        + [("safety_controller", f"k_{of}") for of in ("position", "velocity")],
        ((1,), _ANY),
    ),
    ("box", "size"): ((3,), _SIDE),
    ("mesh", "scale"): ((1, 3), _ANY),
    ("color", "rgba"): ((4,), _NOT_NEGATIVE),
}
_ATTRIBUTES = {
    "link": ("name",), "joint": ("name", "type"), "parent": ("link",), "child": ("link",), "mimic": ("joint",),
    "mass": ("value",), "inertia": ("ixx", "iyy", "izz"),
    "box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",), "mesh": ("filename",),
}  # fmt: skip
_CHILDREN = {"joint": ("parent", "child"), "inertial": ("mass", "inertia"),
             "visual": ("geometry",), "collision": ("geometry",)}  # fmt: skip


def robot_faults(robot: Robot, path: Path) -> list[str]:
    """Return what is wrong with links, joints and inertias: one sentence each that names the file."""
    faults = [*_name_faults(robot), *_tree_faults(robot)] or list(_inertia_faults(robot))
    return [f"{path}: {fault}" for fault in (*faults, *_joint_faults(robot))]


def xml_faults(document: Document, path: Path) -> Iterator[str]:
    """Yield tags that lack what they must have, and values that must be numbers but are not valid ones.

    Tags such as `<gazebo>` and `<transmission>` are not read.
    """
    root = document.root
    if root.tag != "robot" or not root.get("name"):
        yield f"{path} is not a URDF: its root must be <robot name=...>, not <{root.tag[:80]}>"
        return
    counts = Counter(element.tag for element in root.iter())
    if many := [f"{counts[tag]:,} {tag}s" for tag, most in MAX_PARTS.items() if counts[tag] > most]:
        limits = listed(f"{most:,} {tag}s" for tag, most in MAX_PARTS.items())
        yield f"{path} has {' and '.join(many)}; at most {limits} are read"
        return
    for part in root:
        if part.tag not in ("link", "joint", "material"):
            continue
        for element in part.iter():
            where = f"{path}, line {document.lines[element]}"
            for key in _ATTRIBUTES.get(element.tag, ()):
                if not element.get(key):
                    yield f"{where}: <{element.tag}> needs {key}=..."
            for tag in _CHILDREN.get(element.tag, ()):
                if element.find(tag) is None:
                    yield f"{where}: <{element.tag}> of {part.tag} {part.get('name')!r} needs <{tag}>"
            if element.tag == "geometry" and (not len(element) or element[0].tag not in SHAPES):
                yield f"{where}: <geometry> of link {part.get('name')!r} needs one of {', '.join(SHAPES)}"
            for key, text in element.attrib.items():
                if len(text) > MAX_TEXT:
                    yield f"{where}: {shown(key)} has {len(text):,} characters; at most {MAX_TEXT:,} are read"
                elif (fault := _number_fault(element.tag, key, text)) is not None:
                    yield f"{where}: {fault}"


def _number_fault(tag: str, key: str, text: str) -> str | None:
    if (tag, key) not in _NUMBERS:
        return None
    counts, kind = _NUMBERS[tag, key]
    numbers = [as_number(word, words=True) for word in text.split()]
    good = len(numbers) in counts and all(kind.least <= number <= kind.most for number in numbers)
    if good and (tag != "axis" or max(map(abs, numbers)) >= SHORTEST):
        return None
    much = " or ".join(map(str, counts))
    return (
        f"{key}={shown(text)} of <{tag}> must be {much} number{'s' * (much != '1')}, {kind.words}, "
        f"from {kind.least:g} to {kind.most:g}"
    )


def _name_faults(robot: Robot) -> Iterator[str]:
    """Yield names that two links or joints have, or that names of the model's own parts could be equal to."""
    for noun, parts in (("link", robot.links), ("joint", robot.joints)):
        for name, count in Counter(part.name for part in parts).items():
            if count > 1:
                read = " ('world', which MuJoCo reserves, is read as 'world_link')" * (name == "world_link")
                yield f"{count} {noun}s are called {name!r}{read}; each needs a name of its own"
            if "/" in name:
                free = shown(name.replace("/", "_"))
                yield f"{noun} {shown(name)} has a slash in its name, as only parts of the model have; call it {free}"


def _tree_faults(robot: Robot) -> Iterator[str]:
    """Yield the reasons why links and joints are not one tree."""
    links = [link.name for link in robot.links]
    ends = [(joint, role, getattr(joint, role)) for joint in robot.joints for role in ("parent", "child")]
    lost = [end for end in ends if end[2] not in links]
    for joint, role, name in lost:
        yield f"joint {joint.name!r} has the {role} {name!r}, which is not a link of the URDF"
    for name, count in Counter(joint.child for joint in robot.joints).items():
        if count > 1:
            yield f"link {name!r} is the child of {count} joints; a link of a tree has one parent"
    parents = {joint.child: joint.parent for joint in robot.joints}
    roots = [name for name in dict.fromkeys(links) if name not in parents]
    if not links:
        yield "it has no links"
    if len(roots) > 1 and not lost:  # a child that is no link leaves another link without its parent
        yield f"the links {listed(map(repr, roots))} have no parent; a tree has one root"
    if (looped := _looped(parents)) is not None:
        yield f"link {looped!r} is its own ancestor; links must form a tree"


def _looped(parents: dict[str, str]) -> str | None:
    """Return a link that is its own ancestor, going from child to parent, or None if there is none."""
    clear: set[str] = set()
    for start in parents:
        way: set[str] = set()
        link = start
        while link in parents and link not in clear:
            if link in way:
                return link
            way.add(link)
            link = parents[link]
        clear |= way
    return None


def _joint_faults(robot: Robot) -> Iterator[str]:
    moving = {joint.name: joint for joint in robot.joints if joint.type != "fixed"}
    for joint in robot.joints:
        name, limit, mimic = joint.name, joint.limit, joint.mimic
        if joint.type == "continuous":
            yield f"joint {name!r} is continuous, so it has no limits; make it revolute with a lower and an upper limit"
            continue
        if joint.type not in (*MOVING, "fixed"):
            yield f"joint {name!r} is {joint.type}; revolute, prismatic and fixed work"
        if joint.type not in MOVING:
            continue
        if mimic is not None and mimic.joint not in moving:
            yield f"joint {name!r} mimics {mimic.joint!r}, which is not a moving joint of the URDF"
        elif mimic is not None and moving[mimic.joint].mimic is not None:
            cure = "leave its <mimic> out" if mimic.joint == name else "let both mimic the same joint"
            yield f"joint {name!r} mimics {mimic.joint!r}, which mimics a joint itself; {cure}"
        if limit is None:
            yield f"joint {name!r} needs a limit with lower, upper, velocity and effort"
        elif not limit.lower < limit.upper:
            yield f"joint {name!r} has lower limit {limit.lower} not below upper {limit.upper}"
        elif limit.velocity == 0 or limit.effort == 0:
            which = "velocity" if limit.velocity == 0 else "effort"
            yield f"joint {name!r} has the {which} limit 0, so it can't move; give the one of its motor"


def _inertia_faults(robot: Robot) -> Iterator[str]:
    """Yield masses and inertias that are not physically possible; MuJoCo refuses to compile them."""
    masses = {}
    for link in robot.links:
        masses[link.name] = mass = 0.0 if link.inertial is None else link.inertial.mass
        inertia = np.zeros((3, 3)) if link.inertial is None else np.array(link.inertial.inertia)
        moments = np.linalg.eigvalsh(inertia)
        three = ", ".join(f"{moment:.4g}" for moment in moments)
        if not inertia.any():
            if mass > 0:
                yield f"link {link.name!r} has a mass of {mass:g} kg but zero inertia"
        elif moments[0] <= LEAST:
            yield f"link {link.name!r} has the moments of inertia {three} kg m2; all three must be above 0"
        elif moments[0] + moments[1] < moments[2] * (1 - 1e-9):
            yield f"link {link.name!r} has the moments of inertia {three} kg m2; no body has one above the sum of two"
    fixed = [joint for joint in robot.joints if joint.type not in MOVING]
    for joint in robot.joints:
        if joint.type not in MOVING:
            continue
        welded = {joint.child}  # a link without mass is fine if a fixed joint connects it to one with mass
        while more := {j.child for j in fixed if j.parent in welded} - welded:
            welded |= more
        if sum(masses[name] for name in welded) <= LEAST:
            yield f"link {joint.child!r} is moved by joint {joint.name!r} but has no mass"
