"""Places objects in a scene: read from its file, and built into its model."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from surgical_marl.content import find, list_scenes
from surgical_marl.plugins.systems import soft_kind
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.robots.rotation import quaternion, turned
from surgical_marl.scenes.objects import Placement, add_shape, load_object
from surgical_marl.scenes.poses import along
from surgical_marl.scenes.scene import Randomisation
from surgical_marl.scenes.surroundings import STILL
from surgical_marl.untrusted.schema import Place, Vector, angles, lengths, rgb
from surgical_marl.yaml_file import read_yaml

MAX_OBJECTS = 50
"""Objects of a scene."""

TAKEN = re.compile(r"world|tissue|contact|target|(?:reward|cost|stage)(?:_\w*)?")
"""Names that parts of a model, observations or infos have or begin with: `contact_force`, `reward_reach`."""


EXACT = Randomisation()
"""Nothing is randomised."""


@dataclass(frozen=True)
class Tied:
    """Fastenings of the two ends of a thread: "world", or a free object that has a site `tail`."""

    first: str | None = None
    last: str | None = None


@dataclass(frozen=True)
class PlacementEntry:
    """An object in a scene file; `object` is its name or its file."""

    object: str
    position: Vector = lengths()
    tilt: Vector = angles()
    colour: Vector | None = rgb()
    tied: Tied | None = None
    """Of a thread: what its ends are fastened to."""


def scenes_without_objects() -> list[str]:
    """Return the names of the scenes in which arms have nothing to touch but each other."""
    return [name for name in list_scenes() if not read_yaml(find("scenes", name)).get("objects")]


def scenes_for(task: str) -> list[str]:
    """Return the names of the shipped scenes that a task is meant for."""
    scenes = TASKS.load(task).scenes
    return scenes_without_objects() if scenes is None else list(scenes)


def read_placements(
    entries: Mapping[str, PlacementEntry], place: Place, settings: Any, taken: Iterable[str]
) -> dict[str, Placement]:
    """Return the objects of a scene by their names in it.

    Args:
        entries: the objects of the scene file, by name.
        place: of `settings` in the file.
        settings: the mapping that `entries` were read from.
        taken: names of the scene's agents.

    Raises:
        ValueError: a name that is also an agent's or can't be one, or an object that is unknown or has a fault.
    """
    found = {}
    for name, entry in entries.items():
        where = place.at(settings, name)
        if not re.fullmatch(r"[A-Za-z_]\w*", name):
            raise ValueError(f"{where}: a name in a scene is of letters, digits and underscores")
        if name in taken or TAKEN.fullmatch(name):
            raise ValueError(f"{where}: {name} is taken; give the object another name")
        source = find("objects", entry.object, str(where), where.folder)
        found[name] = Placement(load_object(source, entry.colour), np.array(entry.position), turned(entry.tilt))
        if entry.tied and not found[name].object.soft:
            raise ValueError(f"{where}.tied: only the ends of a thread are tied, and {entry.object} is none")
    return found


def soft_systems(
    placements: Mapping[str, Placement], entries: Mapping[str, PlacementEntry], place: Place, settings: Any,
    ranges: Randomisation = EXACT,
) -> dict[str, Any]:  # fmt: skip
    """Return the systems that move those of some objects that are no rigid bodies, by name.

    Args:
        placements: objects of the scene by name.
        entries: of the scene file.
        place: of `settings` in the file.
        settings: the mapping that `entries` were read from.
        ranges: of domain randomisation.

    Raises:
        ValueError: one is fastened to nothing that there is.
    """

    def placed(name: str, item: Placement) -> Any:
        kind = item.object.soft.kind
        system = soft_kind(kind).placed(item, entries[name], rigid, place.at(settings, name))
        own = (getattr(ranges, f"{kind}_{value}") for value in system.ranges._fields)
        return replace(system, ranges=system.ranges._make(own))

    rigid = {name: item for name, item in placements.items() if not item.object.soft}
    return {name: placed(name, item) for name, item in placements.items() if item.object.soft}


def add_bars(spec: mujoco.MjSpec, systems: Mapping[str, Any]) -> None:
    """Add the capsules of systems, which only pictures show: a mocap body `<system>/<number>` for each."""
    for name, bars in ((name, system.bars) for name, system in systems.items() if system.bars):
        start, end = (bars.start[bars.ends[:, side]].mean(1) for side in (0, 1))
        middle, turn = along(start, end)
        half = np.linalg.norm(end - start, axis=1) / 2
        for number, (place, facing) in enumerate(zip(middle, turn, strict=True)):
            body = spec.worldbody.add_body(name=f"{name}/{number}", pos=place, quat=facing, mocap=True)
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[bars.radius, half[number], 0.0], mass=0,
                          rgba=[*bars.colour, 1], **STILL)  # fmt: skip


def add_objects(spec: mujoco.MjSpec, objects: dict[str, Placement]) -> None:
    """Add a body for each object, with geoms `<name>/<number>` and sites `<name>/<site>`.

    A free object is a mocap body: it moves, but has no degrees of freedom in `qpos`, which stays that of the arms.
    """
    for name, place in objects.items():
        body = spec.worldbody.add_body(
            name=name, pos=place.position, quat=quaternion(place.rotation), mocap=place.object.free
        )
        for number, shape in enumerate(place.object.shapes):
            add_shape(body, shape, name=f"{name}/{number}", mass=0, rgba=[*shape.colour, 1], **STILL)
        for site, (position, rotation) in place.object.sites.items():
            body.add_site(name=f"{name}/{site}", pos=position, quat=quaternion(rotation), size=[0.001] * 3, group=4)
