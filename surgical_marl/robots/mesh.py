"""Mesh files of an arm: their paths, and the vertices and triangles in them."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np

from surgical_marl.robots.description import Link, Robot, Shape, Vector
from surgical_marl.robots.safe_xml import parse_xml, write_xml
from surgical_marl.untrusted.files import read_bytes
from surgical_marl.untrusted.values import shown

KINDS = (".stl", ".obj", ".dae")
MAX_MESH = 50_000_000
"""Bytes; more is a mistake or an attack."""


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

    return replace(robot, links=tuple(map(whole, robot.links))), list(faults)


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
    data = read_bytes(path, MAX_MESH)
    if kind == "dae":
        data = write_xml(parse_xml(data, path, "mesh").root)
    try:
        # From memory and without a resolver, so that files that the mesh refers to are not opened.
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, skip_materials=True, process=False)
        mesh = scene.to_mesh()
        finite = bool(np.isfinite(mesh.vertices).all())
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
    if len(vertices) < 4 or not len(faces):
        raise ValueError(f"{path} is not a mesh that can be read: it holds no surface")
    return vertices, faces


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
