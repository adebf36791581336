"""Materials of geoms of a model: colours in linear light, gloss and patterns; colours of agents and goals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgical_marl.scenes.objects import Placement
from surgical_marl.view.lighting import PLAIN, TISSUE
from surgical_marl.vision.skin import Skin

Colour = tuple[float, float, float]
"""Red, green and blue as files give them, from 0 to 1."""

AGENTS: tuple[Colour, ...] = (
    (0.10, 0.66, 0.42),
    (0.97, 0.58, 0.08),
    (0.36, 0.42, 0.95),
    (0.90, 0.30, 0.62),
    (0.20, 0.70, 0.90),
)
"""Colours of the agents of a scene, in turn."""
TEAM: Colour = (0.99, 0.85, 0.15)
"""Colour of a goal that is no single agent's."""
GOAL_RADIUS = 0.004
"""Radius of a goal's ball in m, large enough to see a tip touch it."""
_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)


def goal_colour(number: int, goals: int, agents: int) -> Colour:
    """Return the colour of a goal: that of its agent, or `TEAM` if several agents have only one."""
    return TEAM if goals == 1 < agents else AGENTS[number % len(AGENTS)]


def visual_rgba(model: mujoco.MjModel) -> NDArray[np.float32]:
    """Return the colours of all geoms, [ngeom, 4]; a geom's own rgba overrides its material's, as in MuJoCo."""
    rgba: NDArray[np.float32] = model.geom_rgba.copy()
    painted = (model.geom_matid >= 0) & (rgba == _DEFAULT_RGBA).all(axis=1)
    rgba[painted] = model.mat_rgba[model.geom_matid[painted]]
    return rgba


Array = NDArray[np.float64]

GAMMA = 2.2  # colours are mixed in linear light; files give them as sRGB

STEEL = (0.75, 0.20, 1.0)
"""Gloss: reflectance straight on, blur of the reflection, share of a metal; each from 0 to 1."""
PAINT = (0.10, 0.45, 0.45)
PLASTIC = (0.045, 0.30, 0.0)
RUBBER = (0.04, 0.55, 0.0)
WET = (0.07, 0.20, 0.0)
CLOTH = (0.0, 1.0, 0.0)
LOOKS = {
    "steel": (STEEL, PLAIN),
    "paint": (PAINT, PLAIN),
    "plastic": (PLASTIC, PLAIN),
    "rubber": (RUBBER, PLAIN),
    "cloth": (CLOTH, PLAIN),
    "tissue": (WET, TISSUE),
}
"""Gloss and pattern of each of `scenes.shapes.MATERIALS`."""

_BROAD = 0.03  # half side of a box, m
_STILL = 1
"""Group of geoms that only stand in the scene."""


class Material(NamedTuple):
    """Material of a surface."""

    colour: Array
    """Linear light, [3]."""
    gloss: tuple[float, float, float]
    pattern: int
    """A pattern of `view/lighting.py`."""


def material(rgb: Array, fleshy: bool = False, broad: bool = False) -> Material:
    """Return the material that a colour stands for.

    Greys are white plastic, bare steel, painted metal or black rubber, from light to dark. Colours are plastic, or
    tissue where it is `fleshy`. No `broad` plate is bare steel.
    """
    colour = np.asarray(rgb, float) ** GAMMA
    light, saturation = rgb.max(), np.ptp(rgb) / max(float(rgb.max()), 1e-6)
    if fleshy and saturation > 0.2:
        return Material(colour, WET, int(TISSUE))
    if saturation > 0.3:
        return Material(colour, PLASTIC, int(PLAIN))
    if light > 0.87 or (light > 0.55 and broad):
        return Material(colour, CLOTH if fleshy else PLASTIC, int(PLAIN))
    return Material(colour, STEEL if light > 0.55 else PAINT if light > 0.3 else RUBBER, int(PLAIN))


def flesh(skin: Skin) -> Material:
    """Return the material of tissue."""
    return material(skin.colour, fleshy=True)


def materials(
    model: mujoco.MjModel, paint: Mapping[int, Material | Sequence[float]] = MappingProxyType({})
) -> list[Material]:
    """Return the material of each geom of a model: from `paint`, or else the one that its colour suggests.

    Tissue is what stands in the scene as tissue or as the operating field, and fixed objects in the colour of skin.
    """
    rgba = visual_rgba(model)[:, :3].astype(float)
    found = []
    for geom, rgb in enumerate(rgba):
        name = model.geom(geom).name
        still = model.geom_group[geom] == _STILL and model.body_mocapid[model.geom_bodyid[geom]] < 0
        flesh = name == "field" or name.startswith("tissue/") or (still and _is_skin(rgb))
        broad = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX and model.geom_size[geom].max() > _BROAD
        made = material(rgb, bool(flesh), bool(broad))
        ground = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE
        found.append(made._replace(gloss=CLOTH) if ground else made)
    for geom, look in paint.items():
        found[geom] = look if isinstance(look, Material) else material(np.asarray(look))
    return found


def named(model: mujoco.MjModel, objects: Mapping[str, Placement]) -> dict[int, Material]:
    """Return geom -> material, for the shapes of objects whose files name a material."""
    found = {}
    for name, place in objects.items():
        for number, shape in enumerate(place.object.shapes):
            if shape.material:
                gloss, pattern = LOOKS[shape.material]
                colour = np.array(shape.colour) ** GAMMA
                found[model.geom(f"{name}/{number}").id] = Material(colour, gloss, int(pattern))
    return found


def _is_skin(rgb: Array) -> bool:
    red, green, blue = rgb
    return bool(red > green > blue * 0.95 and 0.25 < np.ptp(rgb) / red < 0.65)
