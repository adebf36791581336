"""Scene files: which arms and objects stand where.

    scene = load_scene("bimanual_psm")

A scene file names each agent's arm, the pose of its base frame, and the point around which its targets are drawn. Which
geoms can touch is found by `surgical_marl/scenes/contacts.py`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import mujoco

from surgical_marl.content import find
from surgical_marl.robots.arm import Arm, load_arm
from surgical_marl.robots.rotation import turned
from surgical_marl.robots.spec import SOLREF
from surgical_marl.scenes.build import build_scene, cached_model, compile_scene, weigh_shapes
from surgical_marl.scenes.contacts import contact_pairs
from surgical_marl.scenes.object_contacts import check_apart
from surgical_marl.scenes.placing import add_objects, read_placements
from surgical_marl.scenes.randomisation import read_randomisation
from surgical_marl.scenes.scene import Mount, Scene
from surgical_marl.scenes.surroundings import add_surroundings, add_tissue
from surgical_marl.untrusted.files import is_file
from surgical_marl.untrusted.markup import check_name
from surgical_marl.untrusted.values import check_count, shown
from surgical_marl.yaml_file import check_keys, read_mapping, read_vector, read_yaml

MAX_ARMS, MAX_TISSUE = 32, 200
"""Arms and pieces of tissue of a scene."""


def load_scene(name: str | Path, control: str = "position") -> Scene:
    """Read a scene by a shipped name (`list_scenes()`) or the path of a YAML file.

    Raises:
        ValueError: unknown name or control mode, a file that is not a valid scene, or objects that overlap.
    """
    path = find("scenes", name)
    check_name(path.stem, "a scene's file")
    settings = read_yaml(path)
    check_keys(settings, ("description", "arms", "view", "tissue", "objects", "randomisation", "observe"), path)
    arms = settings.get("arms")
    if not isinstance(arms, dict) or not arms:
        raise ValueError(f"{path}: arms must map agent names such as psm_0 to arms")
    check_count(len(arms), MAX_ARMS, "arms", path)
    tissue = read_mapping(settings.get("tissue"), f"{path}, tissue")
    check_count(len(tissue), MAX_TISSUE, "pieces of tissue", path)
    if (wrong := next((piece for piece in tissue if not isinstance(piece, str)), None)) is not None:
        raise ValueError(f"{path}, tissue {shown(wrong)}: a name is a text; write it in quotes")
    load = cache(load_arm)  # two agents may be the same arm
    mounts = {agent: _read_mount(agent, mount, path, load) for agent, mount in arms.items()}
    objects = read_placements(settings.get("objects"), mounts, path)
    randomisation = read_randomisation(settings.get("randomisation"), path)
    description = str(settings.get("description", ""))
    observe = read_mapping(settings.get("observe"), f"{path}, observe")
    scene = partial(Scene, path.stem, description, control, mounts, randomisation=randomisation, observe=observe,
                    objects=objects)  # fmt: skip

    def compute() -> mujoco.MjModel:
        spec = build_scene(path.stem, mounts, control, randomisation, pads=bool(objects))
        add_surroundings(spec, mounts, settings.get("view"), path)
        for piece, what in tissue.items():
            add_tissue(spec, f"tissue/{piece}", what, f"{path}, tissue {shown(piece)}")
        add_objects(spec, objects)
        bare = scene(model=compile_scene(spec))
        for one, other in contact_pairs(bare):
            spec.add_pair(geomname1=one, geomname2=other, condim=1, solref=SOLREF)
        model = weigh_shapes(compile_scene(spec), bare.home)
        check_apart(scene(model=model))
        return model

    about = repr((path.stem, control, settings))
    contents = (part for mount in mounts.values() for part in mount.arm.content)
    held = (place.object.content for place in objects.values())
    return scene(model=cached_model(compute, about, *contents, *held))


def _read_mount(agent: str, settings: Any, path: Path, load: Callable[[str | Path], Arm]) -> Mount:
    where = f"{path}, agent {shown(agent)}"
    if not isinstance(settings, dict) or "arm" not in settings:
        raise ValueError(f"{where}: must be a mapping that names its arm")
    check_keys(settings, ("arm", "position", "turn", "tilt", "workspace"), where)
    source = str(settings["arm"])
    local = path.parent / source  # a user's own arm may be named relative to the scene file
    arm = load(local if is_file(local / "arm.yaml") else find("arms", source, where))
    if not re.fullmatch(re.escape(arm.name) + r"_\d+", str(agent)):
        raise ValueError(f"{where}: an agent of arm {arm.name!r} is called {arm.name}_0, {arm.name}_1 and so on")
    vectors = {key: read_vector(settings.get(key, [0.0, 0.0, 0.0]), f"{where}, {key}") for key in
               ("position", "tilt", "workspace")}  # fmt: skip
    turn = read_vector([0.0, 0.0, settings.get("turn", 0.0)], f"{where}, turn")
    rotation = turned(vectors["tilt"]) @ turned(turn)
    return Mount(arm, vectors["position"], rotation, vectors["workspace"])
