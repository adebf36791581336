"""The content of a run: a copy of the user's own scene, arms and objects, so that the folder can be moved and sent.

    RUN/content/mine.yaml               the scene; `scene: content/mine.yaml` in the run's config
    RUN/content/<agent>/<arm>/          an arm of its own: arm.yaml, the URDF and the meshes
    RUN/content/<object>/<file>.yaml    an object of its own

What a scene names by its name (`surgical_marl/content.py`) is not copied, and neither is a scene that is named so.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from surgical_marl.content import own_path
from surgical_marl.files import write_atomic
from surgical_marl.untrusted.files import MB, check_file, read_bytes
from surgical_marl.untrusted.schema import as_mapping
from surgical_marl.yaml_file import MAX_YAML, dump_yaml, read_yaml

CONTENT = "content"
MOST = 500 * MB
"""Bytes that are copied."""


class _Part(NamedTuple):
    """An arm or an object of the user's own in a scene."""

    said: dict[str, Any]
    """The scene's settings of it."""
    key: str
    """Names its place in them: "arm" or "object"."""
    user: str
    """The agent, or the object's name in the scene."""
    path: Path
    """Path of the arm's folder, or of the object's file."""


def copy_content(scene: str, folder: Path) -> str:
    """Copy a user's own scene, with its own arms and objects, into a folder; return the path of the copy.

    A scene that ships is not copied, and its name is returned. A copy that is there already stays as it is.

    Raises:
        ValueError: the scene cannot be copied, it is too large, or the folder holds another scene of that name.
        OSError: a file cannot be written.
    """
    source = own_path("scenes", scene)
    if source is None:
        return scene
    target = folder.resolve() / CONTENT / source.name
    if not target.exists():
        _copy(source, target)
    if scene_label(str(target)) != scene_label(str(source)):
        raise ValueError(
            f"{target} differs from {source}, in the scene or in an arm or object of it: name another folder"
        )
    return str(target)


def scene_label(scene: str) -> str:
    """Return a scene's name, and of a user's own also the hash of its content: equal labels are equal scenes.

    The hash is of the scene's settings, and of the files of its own arms and objects, wherever they are.
    """
    path = own_path("scenes", scene)
    if path is None:
        return scene
    settings = read_yaml(path)
    for part in _parts(path, settings):
        digest = hashlib.sha256()
        for name, file, most in _files(part):
            digest.update(f"{name}\n{hashlib.sha256(read_bytes(file, most)).hexdigest()}\n".encode())
        part.said[part.key] = digest.hexdigest()
    text = json.dumps(settings, default=str)
    return f"{path.stem} (content {hashlib.sha256(text.encode()).hexdigest()[:12]})"


def stored_scene(scene: str, folder: Path) -> str:
    """Return how the files of a folder name a scene: relative to the folder if it is a copy there."""
    path, home = Path(scene), folder.resolve()
    return path.relative_to(home).as_posix() if path.is_relative_to(home / CONTENT) else scene


def found_scene(scene: str, folder: Path) -> str:
    """Return the scene that the files of a folder name, as `stored_scene` does.

    Raises:
        ValueError: the folder lacks its copy, or something of it lies outside, links resolved.
    """
    if not scene.startswith(f"{CONTENT}/"):
        return scene
    home, path = folder.resolve() / CONTENT, folder.resolve() / scene
    check_file(path, MAX_YAML, within=home)
    for part in _parts(path, read_yaml(path)):
        if not part.path.is_relative_to(home):
            raise ValueError(f"{path} cannot be read: its {part.key} {part.path} is not in {home}; copy it there")
    return str(path.resolve())


def _copy(source: Path, target: Path) -> None:
    """Copy a scene: the file of the scene comes last, so that it stands for a whole copy."""
    from surgical_marl.scenes.load import load_scene

    load_scene(source)  # errors are about the user's file
    settings = read_yaml(source)
    parts = _parts(source, settings)
    files = {target.parent / part.user / name: (file, most) for part in parts for name, file, most in _files(part)}
    if (total := sum(check_file(*each) for each in files.values())) > MOST:
        raise ValueError(
            f"{source} names arms and objects of {total / MB:,.0f} MB, which a run copies into its folder; "
            f"at most {MOST / MB:g} MB are copied"
        )
    for path, each in files.items():
        _write(path, read_bytes(*each))
    for part in parts:
        part.said[part.key] = f"{part.user}/{part.path.name}"
        if part.key == "arm":
            _check_arm(part.path, target.parent / part.user / part.path.name)
    text = dump_yaml(settings).encode() if parts else read_bytes(source, MAX_YAML)
    _write(target, text)


def _check_arm(source: Path, copied: Path) -> None:
    """Raise ValueError if the copy of an arm lacks something: a URDF may name a mesh by a link."""
    from surgical_marl.robots.arm import arm_files

    try:
        arm_files(copied)
    except ValueError as error:
        raise ValueError(f"{source} cannot be copied, replace links in it by files: {error}") from None


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, lambda temporary: temporary.write_bytes(data))


def _parts(path: Path, settings: dict[str, Any]) -> list[_Part]:
    """Return the arms and objects of the user's own that the settings of a scene file name."""
    found = []
    for kind, key in (("arms", "arm"), ("objects", "object")):
        for user, said in as_mapping(f"{path}: {kind}", settings.get(kind) or {}, kind).items():
            own = own_path(kind, str(said[key]), path.parent) if isinstance(said, dict) and key in said else None
            if own is not None:
                found.append(_Part(said, key, str(user), own))
    return found


def _files(part: _Part) -> Iterator[tuple[str, Path, int]]:
    """Yield the files of an arm or an object: the name within the copy, the path, and the most bytes of it."""
    folder, name = part.path.parent, part.path.name
    if part.key == "object":
        yield name, part.path, MAX_YAML
        return
    from surgical_marl.robots.arm import arm_files  # only now: settings are read before anything else is
    from surgical_marl.robots.mesh import MAX_MESH

    for file in arm_files(part.path):
        yield f"{name}/{file}", folder / name / file, MAX_MESH
