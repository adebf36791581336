"""Scene files: which arms and objects stand where.

    scene = load_scene("bimanual_psm")

A scene file names each agent's arm, the pose of its base frame, and the point around which its targets are drawn. Which
geoms can touch is found by `surgical_marl/scenes/contacts.py`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from surgical_marl.content import find, unknown
from surgical_marl.plugins.systems import read_systems
from surgical_marl.robots.arm import Arm, list_tools, load_arm
from surgical_marl.robots.rotation import turned
from surgical_marl.robots.spec import SOLREF
from surgical_marl.scenes.build import build_scene, cached_model, compile_scene, weigh_shapes
from surgical_marl.scenes.contacts import contact_pairs
from surgical_marl.scenes.object_contacts import check_apart
from surgical_marl.scenes.placing import (
    MAX_OBJECTS,
    PlacementEntry,
    add_bars,
    add_objects,
    read_placements,
    soft_systems,
)
from surgical_marl.scenes.scene import AttachmentEntry, Mount, Randomisation, Scene
from surgical_marl.scenes.surroundings import TissueEntry, View, add_surroundings, add_tissue
from surgical_marl.untrusted.markup import check_name
from surgical_marl.untrusted.schema import Place, Vector, angles, check, lengths, number, several
from surgical_marl.untrusted.values import LONGEST
from surgical_marl.yaml_file import read_yaml

MAX_ARMS, MAX_TISSUE, MAX_SYSTEMS = 32, 200, 20
"""Arms, pieces of tissue, and systems or attachments of a scene."""


@dataclass(frozen=True)
class MountEntry:
    """An arm in a scene file; `arm` is its name or its folder."""

    arm: str
    tool: str | None = field(
        default=None, repr=False
    )  # its values are in the arm's content, the key of the model's cache
    """The tool that it holds, one of `tools` in its `arm.yaml`; None for the first."""
    position: Vector = lengths()
    """Origin of the base frame in the world."""
    turn: float = number(0.0, -LONGEST, LONGEST, unit="degrees")
    """About z, before `tilt`."""
    tilt: Vector = angles()
    workspace: Vector = lengths()
    """The point in front of the arm around which targets are drawn, in the base frame."""


@dataclass(frozen=True)
class SceneFile:
    """The content of a scene file."""

    arms: dict[str, MountEntry] = several("arms", MAX_ARMS, least=1)
    description: str = ""
    view: View = field(default_factory=View)
    tissue: dict[str, TissueEntry] = several("pieces of tissue", MAX_TISSUE)
    objects: dict[str, PlacementEntry] = several("objects", MAX_OBJECTS)
    attachments: dict[str, AttachmentEntry] = several("attachments", MAX_SYSTEMS)
    systems: dict[str, Any] = several("systems", MAX_SYSTEMS)
    """Systems of plug-ins, by name: a `type`, and its settings."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    observe: dict[str, tuple[str, ...]] = several("lists of observation terms", MAX_ARMS)


def load_scene(name: str | Path, control: str = "position") -> Scene:
    """Read a scene by a shipped name (`list_scenes()`) or the path of a YAML file.

    Raises:
        ValueError: unknown name or control mode, a file that is not a valid scene, or objects that overlap.
    """
    path = find("scenes", name)
    check_name(path.stem, "a scene's file")
    settings, place = read_yaml(path), Place(file=path)
    about: SceneFile = check(place, settings, SceneFile)
    for agent in about.observe:
        if agent not in about.arms:
            agents = ", ".join(about.arms)
            raise ValueError(f"{place.at(settings, 'observe', agent)} is not an agent of the scene ({agents})")
    load = cache(load_arm)  # two agents may be the same arm
    mounts = {agent: _mount(agent, entry, place.at(settings, "arms", agent), load) for agent, entry in
              about.arms.items()}  # fmt: skip
    where = place.part("objects", settings)
    entries = about.objects, where, settings.get("objects")
    placed = read_placements(*entries, mounts)
    objects, soft = ({n: p for n, p in placed.items() if bool(p.object.soft) == kind} for kind in (False, True))
    systems = soft_systems(placed, *entries, about.randomisation)
    systems |= read_systems(about.systems, place.part("systems", settings), mounts | placed)
    observe = {agent: list(names) for agent, names in about.observe.items()}
    scene = partial(Scene, path.stem, about.description, control, mounts, randomisation=about.randomisation,
                    observe=observe, objects=objects, soft=soft, attachments=about.attachments,
                    systems=systems)  # fmt: skip

    def compute() -> mujoco.MjModel:
        spec = build_scene(path.stem, mounts, control, about.randomisation, pads=bool(objects or systems))
        add_surroundings(spec, mounts, about.view)
        for piece, entry in about.tissue.items():
            add_tissue(spec, f"tissue/{piece}", entry)
        add_objects(spec, objects)
        add_bars(spec, systems)
        bare = scene(model=compile_scene(spec))
        for one, other in contact_pairs(bare):
            spec.add_pair(geomname1=one, geomname2=other, condim=1, solref=SOLREF)
        model = weigh_shapes(compile_scene(spec), bare.home)
        check_apart(scene(model=model))
        return model

    contents = (part for mount in mounts.values() for part in mount.arm.content)
    held = (item.object.content for item in placed.values())
    pictured = repr(systems)
    model = cached_model(compute, repr((path.stem, control, _without_sources(about))), *contents, *held, pictured)
    loaded = scene(model=model)
    _check_attachments(loaded, place.part("attachments", settings), settings.get("attachments"))
    return loaded


def _check_attachments(scene: Scene, place: Place, entries: Any) -> None:
    """Raise ValueError unless each attachment of a scene file is between a free object and a link of an arm."""
    bodies = (scene.model.body(i).name for i in range(scene.model.nbody))
    links = [name for name in bodies if name.partition("/")[0] in scene.mounts]
    for name, entry in scene.attachments.items():
        for noun, value, good in (
            (f"free object of scene {scene.name!r}", entry.body, list(scene.free_objects)),
            (f"link of scene {scene.name!r}", entry.link, links),
        ):
            if value not in good:
                raise ValueError(f"{place.part(name, entries)}: {unknown(noun, value, good)}")


def _without_sources(about: SceneFile) -> SceneFile:
    """Return the content of a scene file without the places of its arms and objects, which may move."""
    arms = {agent: replace(entry, arm="") for agent, entry in about.arms.items()}
    return replace(about, arms=arms, objects={name: replace(own, object="") for name, own in about.objects.items()})


def _mount(agent: str, entry: MountEntry, place: Place, load: Callable[[Path, str | None], Arm]) -> Mount:
    folder = find("arms", entry.arm, str(place), place.folder)
    if entry.tool is not None and entry.tool not in (tools := list_tools(folder)):
        raise ValueError(f"{place}: {unknown(f'tool of arm {folder.name!r}', entry.tool, tools)}")
    arm = load(folder, entry.tool)
    if not re.fullmatch(re.escape(arm.name) + r"_\d+", agent):
        raise ValueError(f"{place}: an agent of arm {arm.name!r} is called {arm.name}_0, {arm.name}_1 and so on")
    rotation = turned(entry.tilt) @ turned((0.0, 0.0, entry.turn))
    return Mount(arm, np.array(entry.position), rotation, np.array(entry.workspace))
