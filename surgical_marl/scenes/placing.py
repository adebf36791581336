"""Places objects in a scene: read from its file, and built into its model."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mujoco

from surgical_marl.content import find, list_scenes
from surgical_marl.robots.rotation import quaternion, turned
from surgical_marl.scenes.objects import Placement, add_shape, load_object
from surgical_marl.scenes.surroundings import STILL
from surgical_marl.untrusted.files import is_file
from surgical_marl.untrusted.values import check_count, shown
from surgical_marl.yaml_file import check_keys, read_mapping, read_vector, read_yaml

MAX_OBJECTS = 50
"""Objects of a scene."""

TAKEN = re.compile(r"world|tissue|contact|target|(?:reward|cost|stage)(?:_\w*)?")
"""Names that parts of a model, observations or infos have or begin with: `contact_force`, `reward_reach`."""


def scenes_without_objects() -> list[str]:
    """Return the names of the scenes in which arms have nothing to touch but each other."""
    return [name for name in list_scenes() if not read_yaml(find("scenes", name)).get("objects")]


def read_placements(settings: Any, agents: Iterable[str], path: Path) -> dict[str, Placement]:
    """Return the objects of a scene file by their names in the scene.

    Raises:
        ValueError: a name that is also an agent's, an unknown object or key, or a bad number.
    """
    found = {}
    given = read_mapping(settings, f"{path}, objects")
    check_count(len(given), MAX_OBJECTS, "objects", path)
    for name, place in given.items():
        where = f"{path}, object {shown(name)}"
        if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z_]\w*", name):
            raise ValueError(f"{where}: a name in a scene is of letters, digits and underscores")
        if name in agents or TAKEN.fullmatch(name):
            raise ValueError(f"{where}: {name} is taken; give the object another name")
        found[name] = _read_placement(place, where, path.parent)
    return found


def _read_placement(settings: Any, where: str, folder: Path) -> Placement:
    if not isinstance(settings, dict) or "object" not in settings:
        raise ValueError(f"{where}: must be a mapping that names its object")
    check_keys(settings, ("object", "position", "tilt", "colour"), where)
    source = str(settings["object"])
    local = folder / source  # a user's own object may be named relative to the scene file
    item = load_object(local if is_file(local) else find("objects", source, where), settings.get("colour"))
    position, tilt = (read_vector(settings.get(key, [0, 0, 0]), f"{where}, {key}") for key in ("position", "tilt"))
    return Placement(item, position, turned(tilt))


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
