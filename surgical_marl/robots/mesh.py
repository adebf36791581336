"""Mesh files of an arm: their paths, and the vertices and triangles in them."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from surgical_marl.robots.description import Link, Robot, Shape, Vector
from surgical_marl.robots.safe_xml import parse_xml, write_xml
from surgical_marl.untrusted.files import MB, check_file, read_bytes
from surgical_marl.untrusted.values import LARGEST, LONGEST, check_count, shown

KINDS = (".stl", ".obj", ".dae")
MAX_MESH = 25 * MB
"""Bytes of a file."""
MAX_TEXT = 10 * MB
"""Bytes of an OBJ or DAE file. To read one takes up to eighty times as much memory."""
MAX_ALL, TEXT_COST = 60 * MB, 3
"""Bytes of the meshes of all shapes of an arm, each of an OBJ or DAE file counted three times: some seconds to read."""
MAX_BLOCKS = 500
"""Groups, objects and materials of an OBJ file, solids of an STL file in text, and geometries of a scene in a DAE file:
each becomes a mesh of its own at first."""


def resolve_meshes(robot: Robot, path: Path, folder: Path) -> tuple[Robot, list[str]]:
    """Find the files of all meshes.

    A relative name is relative to the URDF. The `rest` of `package://name/rest` is relative to the arm's folder, or to
    its subfolder `name`.

    Args:
        robot: with meshes named as in the URDF.
        path: of the URDF.
        folder: of the arm.

    Returns:
        The robot with the paths of meshes relative to the arm's folder, and a sentence for each mesh that is missing,
        lies outside or is of an unknown kind. The name of such a mesh is not changed.
    """
    faults: dict[str, None] = {}

    def resolved(link: str, shape: Shape) -> Shape:
        if shape.mesh is None:
            return shape
        try:
            return replace(shape, mesh=_mesh_path(shape.mesh, path.parent, folder))
        except ValueError as error:
            faults[f"{path}: link {link!r} has the mesh {shown(shape.mesh)}, which {error}"] = None
            return shape

    def whole(link: Link) -> Link:
        visuals, collisions = (tuple(resolved(link.name, s) for s in of) for of in (link.visuals, link.collisions))
        return replace(link, visuals=visuals, collisions=collisions)

    found = replace(robot, links=tuple(map(whole, robot.links)))
    return found, list(faults) or _size_faults(found, path, folder)


def _size_faults(robot: Robot, path: Path, folder: Path) -> list[str]:
    """Return a sentence if all meshes together are too large."""
    shapes = (shape for link in robot.links for shape in (*link.visuals, *link.collisions))
    sizes: dict[str, int] = {}
    total = 0
    for shape in shapes:
        if shape.mesh is not None:
            if shape.mesh not in sizes:
                try:
                    sizes[shape.mesh] = _cost(folder / shape.mesh)
                except ValueError as error:
                    return [str(error)]
            total += sizes[shape.mesh]
    if total <= MAX_ALL:
        return []
    return [f"{path} has meshes of {total / MB:,.0f} MB (OBJ and DAE count {TEXT_COST} times); at most "
            f"{MAX_ALL / MB:g} MB are read"]  # fmt: skip


def _cost(file: Path) -> int:
    text = file.suffix.lower() != ".stl"
    return check_file(file, MAX_TEXT if text else MAX_MESH) * (TEXT_COST if text else 1)


def mesh_files(robot: Robot) -> list[str]:
    """Return the names of all mesh files, each once, sorted."""
    shapes = (shape for link in robot.links for shape in (*link.visuals, *link.collisions))
    return sorted({shape.mesh for shape in shapes if shape.mesh is not None})


def read_mesh(path: Path, scale: Vector | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [n, 3] in m and triangles [m, 3] of an STL, OBJ or DAE file. Materials and textures are not read.

    Raises:
        ValueError: not a mesh, nothing in it, numbers that are not finite, or too large.
    """
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    data = read_bytes(path, MAX_MESH if kind == "stl" else MAX_TEXT)
    if kind == "dae":
        root = parse_xml(data, path, "mesh").root
        try:
            shown_parts = _geometries(root)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path} is not a mesh that can be read: {error}") from None
        check_count(shown_parts, MAX_BLOCKS, "geometries", path)
        data = write_xml(root)
    else:
        words = rb"solid" if kind == "stl" else rb"(?:g|o|usemtl|usemap)"
        blocks = len(re.findall(rb"^[ \t]*" + words + rb"\b", data, re.M | re.I)) if _is_text(data, kind) else 0
        check_count(blocks, MAX_BLOCKS, "groups", path)
    try:
        # From memory and without a resolver, so that files that the mesh refers to are not opened.
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, skip_materials=True, process=False)
        mesh = scene.to_mesh()
        finite = bool(np.isfinite(mesh.vertices).all())
        if finite and np.abs(mesh.vertices).max(initial=0) <= LARGEST:
            mesh.merge_vertices()  # an STL repeats a vertex for each of its triangles
        if kind == "dae":  # only this format of the three declares a unit
            unit, _, _ = str(scene.units).rpartition(" * ")  # "meters" or "0.001 * meters"
            mesh.apply_scale(float(unit or 1))
        if scale is not None:
            mesh.apply_scale(scale)
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, int)
    except Exception as error:  # trimesh passes on any exception of its readers
        raise ValueError(f"{path} is not a mesh that can be read: {' '.join(str(error).split())}") from None
    if not finite:
        raise ValueError(f"{path} has vertices that are not finite numbers")
    if vertices.size and not np.abs(vertices).max() <= LONGEST:
        raise ValueError(
            f"{path} has vertices up to {np.abs(vertices).max():g} m away, more than {LONGEST:g} m: give it a scale"
        )
    if len(vertices) < 4 or not len(faces):
        raise ValueError(f"{path} is not a mesh that can be read: it holds no surface")
    return vertices, faces


def _is_text(data: bytes, kind: str) -> bool:
    """Return whether a file is not an STL in binary, whose size follows from its number of triangles."""
    return kind != "stl" or len(data) != 84 + 50 * int.from_bytes(data[80:84], "little")


def _geometries(root: Element) -> int:
    """Return how many geometries the scenes of a COLLADA document show, where nodes may stand for other nodes.

    ValueError if a node stands for itself.
    """
    nodes = {f"#{node.get('id')}": node for node in root.iter() if _tag(node) == "node"}
    known: dict[str, int] = {}
    under_way: set[str] = set()

    def count(element: Element) -> int:
        total = 0
        for part in element:
            if _tag(part) in ("instance_geometry", "instance_controller"):
                total += 1
            elif _tag(part) == "instance_node":
                total += named(part.get("url", ""))
            else:
                total += count(part)
        return total

    def named(url: str) -> int:
        if url in under_way:
            raise ValueError(f"the node {shown(url)} stands for itself")
        if url not in known and url in nodes:
            under_way.add(url)
            known[url] = count(nodes[url])
            under_way.discard(url)
        return known.get(url, 0)

    return sum(count(scene) for scene in root.iter() if _tag(scene) == "visual_scene")


def _tag(element: Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _mesh_path(filename: str, start: Path, folder: Path) -> str:
    """Return the path of a mesh in the arm's folder.

    Raise ValueError, with the end of a sentence, if it must not or can't be read.
    """
    package, _, rest = filename.removeprefix("package://").partition("/")
    if filename.startswith("package://"):
        candidates = [folder / rest, folder / package / rest]
    else:
        candidates = [start / filename.removeprefix("file://")]
    home, inside = folder.resolve(), []
    for candidate in candidates:
        try:
            path = candidate.resolve()  # resolves links and `..`: the path that is compared is opened
            if path.is_relative_to(home):
                inside.append(path)
                if path.is_file():
                    break
        except (OSError, RuntimeError, ValueError):  # an impossible file name, or a cycle of links
            continue
    else:
        if len(inside) < len(candidates):
            raise ValueError("leaves the arm's folder; copy it into the folder")
        places = " or ".join(shown(str(path.relative_to(home))) for path in inside)
        raise ValueError(f"is not found; in the arm's folder it must be {places}")
    if path.suffix.lower() not in KINDS:
        raise ValueError(f"is of a kind that is not read; {', '.join(KINDS)} are")
    return path.relative_to(home).as_posix()
