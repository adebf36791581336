"""The bodies of a MuJoCo model as meshes for a browser: GLB files with materials."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from surgical_marl.view.drawn import Extra
from surgical_marl.view.shading import GAMMA, Material, visual_rgba
from surgical_marl.view.tracer import PLANE
from surgical_marl.vision.rays import BOX, CYLINDER, ELLIPSOID

_VISIBLE = 2
"""The last group of visual geoms."""
_METAL = 0.4
"""Metalness of steel here, from 0 to 1. A full metal only mirrors the room, and would be black without one. A room,
as the environment maps of viser are, makes a browser without a GPU seven times as slow."""
_CREASE = 0.6
"""Angle of two faces in rad from which on their edge is sharp."""
_GROUND = (12.0, 12.0, 0.01)
"""Sides of the plate that stands for a plane, m."""

_Geom: Any = mujoco.mjtGeom


def body_glb(model: mujoco.MjModel, body: int, looks: Sequence[Material]) -> bytes | None:
    """Return the visual geoms of a body as a GLB file in the body's frame; None if it has none that can be drawn.

    Args:
        model: of the scene.
        body: its number.
        looks: what each geom of the model is made of.
    """
    scene = trimesh.Scene()
    colours = visual_rgba(model)
    for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_group <= _VISIBLE)).tolist():
        mesh = geom_mesh(model, geom)
        if mesh is not None and colours[geom, 3] > 0:
            mesh.visual = TextureVisuals(material=_material(looks[geom], float(colours[geom, 3])))
            scene.add_geometry(mesh)
    if not scene.geometry:
        return None
    return bytes(scene.export(file_type="glb", include_normals=True))


def stage_glb(stage: Sequence[Extra]) -> bytes:
    """Return the shapes that stand around a scene as a GLB file in the world; a plane is a wide plate there."""
    scene = trimesh.Scene()
    for extra in stage:
        size, pose = np.array(extra.size), np.eye(4)
        pose[:3, :3], pose[:3, 3] = extra.axes, extra.place
        mesh = trimesh.creation.box(_GROUND) if extra.kind == PLANE else _MADE[_KINDS[extra.kind]](size)
        mesh.apply_transform(pose)
        mesh = trimesh.graph.smooth_shade(mesh, angle=_CREASE)
        mesh.visual = TextureVisuals(material=_material(extra.material, 1.0))
        scene.add_geometry(mesh)
    return bytes(scene.export(file_type="glb", include_normals=True))


def geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """Return a geom's surface in its body's frame; None for a plane or a height field."""
    kind = _Geom(int(model.geom_type[geom]))
    if kind == _Geom.mjGEOM_MESH:
        mesh = _mesh(model, int(model.geom_dataid[geom]))
    elif kind in _MADE:
        mesh = _MADE[kind](model.geom_size[geom])
    else:
        return None
    pose = np.eye(4)
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = turn.reshape(3, 3), model.geom_pos[geom]
    mesh.apply_transform(pose)
    return trimesh.graph.smooth_shade(mesh, angle=_CREASE)


def _ellipsoid(size: np.ndarray) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    mesh.apply_scale(size)
    return mesh


_MADE: dict[Any, Callable[[np.ndarray], trimesh.Trimesh]] = {
    _Geom.mjGEOM_SPHERE: lambda size: trimesh.creation.icosphere(subdivisions=3, radius=size[0]),
    _Geom.mjGEOM_CAPSULE: lambda size: trimesh.creation.capsule(2 * size[1], size[0], count=[20, 16]),
    _Geom.mjGEOM_ELLIPSOID: _ellipsoid,
    _Geom.mjGEOM_CYLINDER: lambda size: trimesh.creation.cylinder(size[0], 2 * size[1], sections=40),
    _Geom.mjGEOM_BOX: lambda size: trimesh.creation.box(2 * size),
}


_KINDS = {int(BOX): _Geom.mjGEOM_BOX, int(CYLINDER): _Geom.mjGEOM_CYLINDER, int(ELLIPSOID): _Geom.mjGEOM_ELLIPSOID}


def _mesh(model: mujoco.MjModel, index: int) -> trimesh.Trimesh:
    first, count = model.mesh_vertadr[index], model.mesh_vertnum[index]
    begin, faces = model.mesh_faceadr[index], model.mesh_facenum[index]
    return trimesh.Trimesh(
        model.mesh_vert[first : first + count], model.mesh_face[begin : begin + faces], process=False
    )


def _material(look: Material, alpha: float) -> PBRMaterial:
    """Return a material as a browser knows it; patterns are left out."""
    _, blur, metal = look.gloss
    return PBRMaterial(
        baseColorFactor=(255 * np.array([*look.colour ** (1 / GAMMA), alpha])).round().astype(np.uint8),
        metallicFactor=_METAL * metal,
        roughnessFactor=min(0.15 + blur, 1.0),
        alphaMode="BLEND" if alpha < 1 else "OPAQUE",
    )
