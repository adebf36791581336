"""Reads URDFs and meshes, which anybody may have written: plain data, nothing outside the arm's folder, no surprises.

    robot = read_urdf(folder / "arm.urdf")              # yourdfpy's Robot
    faults = urdf_faults(robot, folder / "arm.urdf")    # one sentence each, empty if all is well
    resolve_meshes(robot, folder / "arm.urdf", folder)  # mesh file names become paths inside the folder

`surgical_marl.robots.arm.load_arm` does all three.
"""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.parsers import expat

import numpy as np

if TYPE_CHECKING:
    from yourdfpy import urdf as yourdf

MOVING = ("revolute", "prismatic")
SHAPES = ("box", "cylinder", "sphere", "mesh")
MESHES = (".stl", ".obj", ".dae")
MAX_URDF = 10_000_000
MAX_MESH = 50_000_000
"""Bytes; more is a mistake or an attack."""
LEAST = 1e-15
"""Masses (kg) and moments of inertia (kg m2) up to here are zero to MuJoCo."""

_ANY, _NOT_NEGATIVE, _POSITIVE = "finite", "finite and not negative", "finite and above 0"
# Numbers of a URDF by tag and attribute: how many there must be, and of what kind.
_NUMBERS: dict[tuple[str, str], tuple[tuple[int, ...], str]] = {
    **dict.fromkeys([("origin", "xyz"), ("origin", "rpy"), ("axis", "xyz")], ((3,), _ANY)),
    **dict.fromkeys([("inertia", key) for key in ("ixx", "iyy", "izz")], ((1,), _NOT_NEGATIVE)),
    **dict.fromkeys([("inertia", key) for key in ("ixy", "ixz", "iyz")], ((1,), _ANY)),
    **dict.fromkeys([("cylinder", "radius"), ("cylinder", "length"), ("sphere", "radius")], ((1,), _POSITIVE)),
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
    ("box", "size"): ((3,), _POSITIVE),
    ("mesh", "scale"): ((1, 3), _ANY),
    ("color", "rgba"): ((4,), _NOT_NEGATIVE),
}
_ENCODINGS = ("utf-8", "utf-16", "us-ascii", "iso-8859-1")
_ATTRIBUTES = {
    "link": ("name",), "joint": ("name", "type"), "parent": ("link",), "child": ("link",), "mimic": ("joint",),
    "mass": ("value",), "inertia": ("ixx", "iyy", "izz"),
    "box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",), "mesh": ("filename",),
}  # fmt: skip
_CHILDREN = {"joint": ("parent", "child"), "inertial": ("mass", "inertia"),
             "visual": ("geometry",), "collision": ("geometry",)}  # fmt: skip


class Faults(ValueError):
    """All that keeps an arm from loading, one sentence each in `faults`; as an error it says the first."""

    def __init__(self, faults: Iterable[str]) -> None:
        self.faults = list(faults)
        super().__init__(self.faults[0])


def read_urdf(path: Path) -> yourdf.Robot:
    """Reads a URDF file; lengths in m, angles in rad, as written.

    A link called "world", the name MuJoCo keeps for the ground, becomes "world_link".

    Raises:
        ValueError: not there, too large, no XML, a DOCTYPE (so entities never expand), or a tag that lacks what it
            must have or holds a number that is none. `Faults` if that is more than one thing.
    """
    import yourdfpy
    from lxml import etree

    if not path.is_file():
        raise ValueError(f"there is no URDF file {path}")
    data = _read_bytes(path, MAX_URDF)
    _refuse_doctype(data, path, "URDF")
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False, remove_comments=True, remove_pis=True
    )
    try:
        root = etree.fromstring(data, parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise ValueError(f"{path} is not a URDF that can be read: {' '.join(str(error).split())}") from None
    if faults := list(_xml_faults(root, path)):
        raise Faults(faults)
    try:
        text = io.BytesIO(etree.tostring(root))
        robot = yourdfpy.URDF.load(text, build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # yourdfpy lets through whatever float() or its own code raises
        raise ValueError(f"{path} is not a URDF that can be read: {' '.join(str(error).split())}") from None
    _rename_world(robot)
    return robot


def urdf_faults(robot: yourdf.Robot, path: Path) -> list[str]:
    """What is wrong with links, joints and inertias: one sentence each that names the file."""
    faults = list(_tree_faults(robot)) or list(_inertia_faults(robot))
    return [f"{path}: {fault}" for fault in (*faults, *_joint_faults(robot))]


def resolve_meshes(robot: yourdf.Robot, path: Path, folder: Path) -> list[str]:
    """Turns every mesh's file name into the absolute path of a file inside the arm's folder.

    A relative name starts at the URDF; of `package://name/rest`, `rest` starts at the arm's folder, or at its
    subfolder `name`.

    Returns:
        A sentence for each mesh that is missing, lies outside or is of an unknown kind; its name stays.
    """
    faults: dict[str, None] = {}
    for link in robot.links:
        for part in (*link.visuals, *link.collisions):
            mesh = part.geometry.mesh
            if mesh is None:
                continue
            try:
                mesh.filename = str(_mesh_path(mesh.filename, path.parent, folder))
            except ValueError as error:
                faults[f"{path}: link {link.name!r} has the mesh {_shown(mesh.filename)}, which {error}"] = None
    return list(faults)


def read_mesh(path: Path, scale: float | np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [n, 3] in m and triangles [m, 3] of an STL, OBJ or DAE file. Materials and textures stay unread.

    Raises:
        ValueError: not a mesh, nothing in it, numbers that are not finite, or too large.
    """
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    data = _read_bytes(path, MAX_MESH)
    if kind == "dae":
        _refuse_doctype(data, path, "mesh")
    try:
        # From memory and without a resolver: what the file refers to is not opened.
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, skip_materials=True, process=False)
        mesh = scene.to_mesh()
        finite = bool(np.isfinite(mesh.vertices).all())
        mesh.merge_vertices()  # an STL repeats each once a triangle
        if kind == "dae":  # the one of the three that says what a unit is
            unit, _, _ = str(scene.units).rpartition(" * ")  # "meters" or "0.001 * meters"
            mesh.apply_scale(float(unit or 1))
        if scale is not None:
            mesh.apply_scale(scale)
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, int)
    except Exception as error:  # trimesh lets through whatever its readers raise
        raise ValueError(f"{path} is not a mesh that can be read: {' '.join(str(error).split())}") from None
    if not finite:
        raise ValueError(f"{path} has vertices that are not finite numbers")
    if len(vertices) < 4 or not len(faces):
        raise ValueError(f"{path} is not a mesh that can be read: it holds no surface")
    return vertices, faces


def _read_bytes(path: Path, most: int) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from None
    if len(data) > most:
        raise ValueError(f"{path} is larger than {most // 1_000_000} MB, the most that is read")
    return data


def _refuse_doctype(data: bytes, path: Path, noun: str) -> None:
    """Only a DOCTYPE can define entities or name other files. Expat stops at its start, before any of it is read.

    It knows four encodings; in another, a parser that knows more could see a DOCTYPE where expat sees none.
    """

    def refuse(*_: Any) -> None:
        raise ValueError(f"{path} has a DOCTYPE, which can define entities; remove it")

    def look(_version: str, encoding: str | None, _standalone: int) -> None:
        if encoding is not None and encoding.lower() not in _ENCODINGS:
            raise ValueError(f"{path} has the encoding {_shown(encoding)}; {', '.join(_ENCODINGS)} are read")

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler, parser.XmlDeclHandler = refuse, look
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, LookupError) as error:
        raise ValueError(f"{path} is not a {noun} that can be read: {error}") from None


def _xml_faults(root: Any, path: Path) -> Iterator[str]:
    """Tags without what they must have, and numbers that are none. `<gazebo>`, `<transmission>` and such are not
    read."""
    if root.tag != "robot" or not root.get("name"):
        yield f"{path} is not a URDF: its root must be <robot name=...>, not <{root.tag}>"
        return
    for part in root:
        if part.tag not in ("link", "joint", "material"):
            continue
        for element in part.iter():
            where = f"{path}, line {element.sourceline}"
            for key in _ATTRIBUTES.get(element.tag, ()):
                if not element.get(key):
                    yield f"{where}: <{element.tag}> needs {key}=..."
            for tag in _CHILDREN.get(element.tag, ()):
                if element.find(tag) is None:
                    yield f"{where}: <{element.tag}> of {part.tag} {part.get('name')!r} needs <{tag}>"
            if element.tag == "geometry" and (not len(element) or element[0].tag not in SHAPES):
                yield f"{where}: <geometry> of link {part.get('name')!r} needs one of {', '.join(SHAPES)}"
            for key, text in element.attrib.items():
                if (fault := _number_fault(element.tag, key, text)) is not None:
                    yield f"{where}: {fault}"


def _number_fault(tag: str, key: str, text: str) -> str | None:
    if (tag, key) not in _NUMBERS:
        return None
    counts, kind = _NUMBERS[tag, key]
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    good = len(numbers) in counts and all(map(math.isfinite, numbers))
    if kind == _NOT_NEGATIVE:
        good = good and min(numbers) >= 0
    if kind == _POSITIVE:
        good = good and min(numbers) > 0
    if tag == "axis":
        good, kind = good and any(numbers), "finite and not all 0"
    much = " or ".join(map(str, counts))
    return None if good else f"{key}={_shown(text)} of <{tag}> must be {much} number{'s' * (much != '1')}, {kind}"


def _shown(text: str) -> str:
    return repr(text if len(text) <= 80 else text[:77] + "...")


def _rename_world(robot: yourdf.Robot) -> None:
    for link in robot.links:
        link.name = "world_link" if link.name == "world" else link.name
    for joint in robot.joints:
        joint.parent, joint.child = ("world_link" if name == "world" else name for name in (joint.parent, joint.child))


def _tree_faults(robot: yourdf.Robot) -> Iterator[str]:
    """What keeps links and joints from being one tree."""
    links = [link.name for link in robot.links]
    for noun, names in (("link", links), ("joint", [joint.name for joint in robot.joints])):
        for name, count in Counter(names).items():
            if count > 1:
                yield f"{count} {noun}s are called {name!r}; each needs a name of its own"
    for joint in robot.joints:
        for role, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in links:
                yield f"joint {joint.name!r} has the {role} {name!r}, which is not a link of the URDF"
    for name, count in Counter(joint.child for joint in robot.joints).items():
        if count > 1:
            yield f"link {name!r} is the child of {count} joints; a link of a tree has one parent"
    parents = {joint.child: joint.parent for joint in robot.joints}
    roots = [name for name in dict.fromkeys(links) if name not in parents]
    if not links:
        yield "it has no links"
    if len(roots) > 1:
        yield f"the links {', '.join(map(repr, roots))} have no parent; a tree has one root"
    if (looped := _looped(parents)) is not None:
        yield f"link {looped!r} is its own ancestor; links must form a tree"


def _looped(parents: dict[str, str]) -> str | None:
    """A link that one comes back to on the way from child to parent."""
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


def _joint_faults(robot: yourdf.Robot) -> Iterator[str]:
    moving = {joint.name: joint for joint in robot.joints if joint.type in MOVING}
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
            yield f"joint {name!r} mimics {mimic.joint!r}, which mimics a joint itself; let both mimic the same joint"
        if limit is None or None in (limit.lower, limit.upper, limit.velocity, limit.effort):
            yield f"joint {name!r} needs a limit with lower, upper, velocity and effort"
        elif not limit.lower < limit.upper:
            yield f"joint {name!r} has lower limit {limit.lower} not below upper {limit.upper}"
        elif limit.velocity == 0 or limit.effort == 0:
            which = "velocity" if limit.velocity == 0 else "effort"
            yield f"joint {name!r} has the {which} limit 0, so it can't move; give the one of its motor"


def _inertia_faults(robot: yourdf.Robot) -> Iterator[str]:
    """Masses and inertias that no body can have: MuJoCo compiles none of them."""
    masses = {}
    for link in robot.links:
        mass, inertia = (
            (0.0, np.zeros((3, 3))) if link.inertial is None else (link.inertial.mass, link.inertial.inertia)
        )
        masses[link.name] = mass
        moments = np.linalg.eigvalsh(inertia)
        shown = ", ".join(f"{moment:.4g}" for moment in moments)
        if not inertia.any():
            if mass > 0:
                yield f"link {link.name!r} has a mass of {mass:g} kg but zero inertia"
        elif moments[0] <= LEAST:
            yield f"link {link.name!r} has the moments of inertia {shown} kg m2; all three must be above 0"
        elif moments[0] + moments[1] < moments[2] * (1 - 1e-9):
            yield f"link {link.name!r} has the moments of inertia {shown} kg m2; no body has one above the sum of two"
    fixed = [joint for joint in robot.joints if joint.type not in MOVING]
    for joint in robot.joints:
        if joint.type not in MOVING:
            continue
        welded = {joint.child}  # a link without mass is fine where a fixed joint ties it to one with mass
        while more := {j.child for j in fixed if j.parent in welded} - welded:
            welded |= more
        if sum(masses[name] for name in welded) <= LEAST:
            yield f"link {joint.child!r} is moved by joint {joint.name!r} but has no mass"


def _mesh_path(filename: str, start: Path, folder: Path) -> Path:
    """Where a mesh lies; ValueError with the end of a sentence if it must not be read or cannot be."""
    package, _, rest = filename.removeprefix("package://").partition("/")
    if filename.startswith("package://"):
        candidates = [folder / rest, folder / package / rest]
    else:
        candidates = [start / filename.removeprefix("file://")]
    inside = []
    for candidate in candidates:
        try:
            path = candidate.resolve()  # follows links and `..`, so that what is compared is what is opened
            if path.is_relative_to(folder.resolve()):
                inside.append(path)
                if path.is_file():
                    break
        except (OSError, RuntimeError, ValueError):  # a name no file can have, or links in a circle
            continue
    else:
        if len(inside) < len(candidates):
            raise ValueError("leaves the arm's folder; copy it into the folder")
        places = " or ".join(_shown(str(path.relative_to(folder.resolve()))) for path in inside)
        raise ValueError(f"is not found; in the arm's folder it must be {places}")
    if path.suffix.lower() not in MESHES:
        raise ValueError(f"is of a kind that is not read; {', '.join(MESHES)} are")
    return path
