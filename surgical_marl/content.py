"""Find the swappable content: arms, scenes, objects, configs and policies, by name or by path.

Shipped content is at the top of the repository. An installed package adds its own content in folders of the same names,
and registers itself with an entry point: `my_package = "my_package"` in the group `surgical_marl.content`.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib.util
import os
from collections.abc import Sequence
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from surgical_marl.untrusted.files import is_file, is_folder, user_path
from surgical_marl.untrusted.values import listed, shown

KINDS = ("arms", "scenes", "objects", "configs", "policies")
BASELINES = ("zero", "random", "oracle")
"""Policies that need no learning. They have no task and scene of their own."""
PARTNERS = ("frozen", "random", "delayed", "oracle")
"""Partners that every team can be given: one who keeps still, one who moves at random, one who does what the team's own
policy does, but starts late, and the oracle."""

_PACKAGE = Path(__file__).resolve().parent
_NOUNS = {"arms": "arm", "scenes": "scene", "objects": "object", "configs": "config", "policies": "run or policy"}
_FOLDER = {"objects": "scenes/objects"}
_MARKER = {"arms": "arm.yaml", "policies": "config.yaml"}
_SUFFIX = {"scenes": ".yaml", "objects": ".yaml", "configs": ".yaml"}


def content_dir(kind: str) -> Path:
    """Return the folder of one kind of content: inside the package in a wheel, beside it in a checkout."""
    if kind not in KINDS:
        raise unknown("kind of content", kind, KINDS)
    folder = _FOLDER.get(kind, kind)
    shipped = _PACKAGE / "content" / folder
    return shipped if shipped.is_dir() else _PACKAGE.parent / folder


def list_arms() -> list[str]:
    """Return the names of all arms, shipped and of installed packages."""
    return _names("arms")


def list_scenes() -> list[str]:
    """Return the names of all scenes, shipped and of installed packages."""
    return _names("scenes")


def list_objects() -> list[str]:
    """Return the names of all objects, shipped and of installed packages."""
    return _names("objects")


def list_configs() -> list[str]:
    """Return the names of the tasks that have training settings, shipped or in installed packages."""
    return _names("configs")


def list_policies() -> list[str]:
    """Return the names of all trained policies, shipped and of installed packages."""
    return _names("policies")


def find(kind: str, name_or_path: str | os.PathLike[str], where: str = "", folder: Path | None = None) -> Path:
    """Return the file or folder of content by its name, or of a user's own by its path.

    Args:
        kind: one of the folders of content, such as "arms".
        name_or_path: what to find.
        where: the place in a file that names it, for the error.
        folder: of the file that names it, where a relative path begins; None for the working folder.

    Raises:
        ValueError: nothing has that name or is at that path, or two packages have something of that name.
    """
    places, text = _places(kind), as_name(_NOUNS[kind], name_or_path)
    if (own := own_path(kind, text, folder)) is not None:
        return own
    if text in places:
        if len(places[text]) > 1:
            where = " and ".join(str(path) for path in places[text])
            raise ValueError(f"the {_NOUNS[kind]} {text!r} is in {where}: name the one that is meant by its path")
        return places[text][0]
    error = unknown(_NOUNS[kind], text, list(places))
    raise ValueError(f"{where}: {error}") if where else error


def as_name(noun: str, value: Any) -> str:
    """Return a name or a path as a text; ValueError for a value that is neither, such as a mapping."""
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(text, str):
        raise ValueError(f"the {noun} must be a name or a path, not {shown(value)}")
    return text


def own_path(kind: str, text: str, folder: Path | None = None) -> Path | None:
    """Return the absolute path of a user's own content, links resolved; None if it is content by its name, or none.

    The arguments are those of `find`. Beside a file that names it, own content goes before content of the same name.
    """
    path = (folder or Path()) / user_path(text)
    there = bool(text) and (is_file(path) if kind in _SUFFIX else is_folder(path))
    if not there or (text in _places(kind) and (folder is None or not is_file(path / _MARKER.get(kind, "")))):
        return None
    return path.resolve()


def absolute(kind: str, text: str) -> str:
    """Return a path of content as an absolute one, so that it is the same from any working folder; names stay."""
    return str(own_path(kind, text) or text)


def unknown(noun: str, value: object, good: Sequence[str]) -> ValueError:
    """Return the error for a name that does not exist: it names the value, the nearest good one and all good ones."""
    text = value if isinstance(value, str) else shown(value)
    near = difflib.get_close_matches(text[:100], good, n=1)
    missing = ", and no such file" if text.endswith(".yaml") else ", and no such folder" if "/" in text else ""
    hint = f", did you mean {near[0]!r}" if near else missing
    return ValueError(f"unknown {noun} {shown(text)}{hint} (choose from {listed(good) or 'none'})")


def _names(kind: str) -> list[str]:
    return list(_places(kind))


def _places(kind: str) -> dict[str, list[Path]]:
    """Return the files or folders of a kind of content by name, shipped and of installed packages."""
    found: dict[str, list[Path]] = {}
    for folder in (content_dir(kind), *(root / _FOLDER.get(kind, kind) for root in _plugin_roots())):
        for path in folder.glob(f"[!._]*{_SUFFIX.get(kind, '')}"):
            if kind in _SUFFIX or (path / _MARKER[kind]).exists():
                found.setdefault(path.stem if kind in _SUFFIX else path.name, []).append(path)
    return dict(sorted(found.items()))


@cache
def _plugin_roots() -> tuple[Path, ...]:
    """Return the folders of packages that register in the entry-point group `surgical_marl.content`."""
    roots = []
    for point in entry_points(group="surgical_marl.content"):
        with contextlib.suppress(ImportError, ValueError):  # a broken package must not affect the others
            spec = importlib.util.find_spec(point.value)
            roots += [Path(folder) for folder in (spec and spec.submodule_search_locations) or ()]
    return tuple(roots)
