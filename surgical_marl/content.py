"""Where the swappable content lives: arms, scenes, configs and policies, by name or by path."""

from __future__ import annotations

import difflib
import os
from collections.abc import Sequence
from pathlib import Path

KINDS = ("arms", "scenes", "configs", "policies")
BASELINES = ("zero", "random", "oracle")
"""Policies that need no learning, and so have no task and scene of their own."""

_PACKAGE = Path(__file__).resolve().parent
_NOUNS = {"arms": "arm", "scenes": "scene", "configs": "config", "policies": "run or policy"}
_MARKER = {"arms": "arm.yaml", "policies": "config.yaml"}
_SUFFIX = {"scenes": ".yaml", "configs": ".yaml"}


def content_dir(kind: str) -> Path:
    """The folder of one kind of content: inside the package in a wheel, beside it in a checkout."""
    if kind not in KINDS:
        raise unknown("kind of content", kind, KINDS)
    shipped = _PACKAGE / "content" / kind
    return shipped if shipped.is_dir() else _PACKAGE.parent / kind


def list_arms() -> list[str]:
    """Names of the arms that ship."""
    return _names("arms")


def list_scenes() -> list[str]:
    """Names of the scenes that ship."""
    return _names("scenes")


def list_policies() -> list[str]:
    """Names of the trained policies that ship."""
    return _names("policies")


def find(kind: str, name_or_path: str | os.PathLike[str]) -> Path:
    """The file or folder of shipped content by its name, or of a user's own by its path."""
    folder, suffix = content_dir(kind), _SUFFIX.get(kind, "")
    names, text = _names(kind), os.fspath(name_or_path)
    if text in names:
        return folder / f"{text}{suffix}"
    path = Path(text).expanduser()
    if text and (path.is_file() if suffix else path.is_dir()):
        return path.resolve()
    raise unknown(_NOUNS[kind], text, names)


def unknown(noun: str, value: object, good: Sequence[str]) -> ValueError:
    """The error for a name that does not exist: the value, the nearest good one, all good ones."""
    near = difflib.get_close_matches(str(value), good, n=1)
    hint = f", did you mean {near[0]!r}" if near else ""
    return ValueError(f"unknown {noun} {str(value)!r}{hint} (choose from {', '.join(good) or 'none'})")


def _names(kind: str) -> list[str]:
    folder, suffix = content_dir(kind), _SUFFIX.get(kind)
    if not folder.is_dir():
        return []
    if suffix:
        return sorted(file.stem for file in folder.glob(f"[!._]*{suffix}"))
    marker = _MARKER.get(kind, "")
    return sorted(sub.name for sub in folder.glob("[!._]*") if sub.is_dir() and (sub / marker).exists())
