"""The bodies of a MuJoCo model as meshes for a browser: GLB files with materials."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from surgical_marl.view.colours import visual_rgba

_VISIBLE = 2
"""The last group of visual geoms."""
_CREASE = 0.6
"""Angle of two faces in rad from which on their edge is sharp."""

_Geom: Any = mujoco.mjtGeom


def body_glb(model: mujoco.MjModel, body: int) -> bytes | None:
    """Return the visual geoms of a body as a GLB file in the body's frame; None if it has none that can be drawn."""
    scene = trimesh.Scene()
    colours = visual_rgba(model)
    for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_group <= _VISIBLE)):
        mesh = geom_mesh(model, int(geom))
        if mesh is not None and colours[geom, 3] > 0:
            mesh.visual = TextureVisuals(material=_material(colours[geom]))
            scene.add_geometry(mesh)
    if not scene.geometry:
        return None
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


def _mesh(model: mujoco.MjModel, index: int) -> trimesh.Trimesh:
    first, count = model.mesh_vertadr[index], model.mesh_vertnum[index]
    begin, faces = model.mesh_faceadr[index], model.mesh_facenum[index]
    return trimesh.Trimesh(
        model.mesh_vert[first : first + count], model.mesh_face[begin : begin + faces], process=False
    )


def _material(rgba: np.ndarray) -> PBRMaterial:
    """Return steel for greys, and plastic or tissue for colours."""
    saturation = float(np.ptp(rgba[:3]) / max(rgba[:3].max(), 1e-6))
    steel = float(np.clip(1 - 4 * saturation, 0.0, 1.0) * (0.3 < rgba[:3].mean() < 0.8))
    return PBRMaterial(
        baseColorFactor=(255 * np.asarray(rgba)).astype(np.uint8),
        metallicFactor=0.35 * steel,
        roughnessFactor=0.65 - 0.3 * steel,
        alphaMode="BLEND" if rgba[3] < 1 else "OPAQUE",
    )
