"""The jaw of an arm: which joint moves it, and the plates of its fingers that hold objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from surgical_marl.robots.description import Matrix, Vector
from surgical_marl.robots.rotation import turned
from surgical_marl.robots.urdf import link_name
from surgical_marl.yaml_file import build, check_keys, read_mapping, read_vector


@dataclass(frozen=True)
class Pad:
    """A plate of a finger, by which a jaw holds objects."""

    link: str
    size: Vector
    """Sides, m, [3]."""
    position: Vector
    """Middle in the link's frame, m, [3]."""
    rotation: Matrix
    """Axes in the link's frame, [3, 3]."""


@dataclass(frozen=True)
class Jaw:
    """A jaw. One command, open or closed, moves `joint` and the joints that mimic it."""

    joint: str
    open: float
    closed: float
    pads: tuple[Pad, ...] = ()
    """The plates of the fingers; without them the jaw holds nothing."""


def read_jaw(settings: Any, where: Path) -> Jaw:
    """Return the jaw of an `arm.yaml`.

    Raises:
        ValueError: a key or a number is wrong or missing.
    """
    jaw: Jaw = build(Jaw, settings, where)
    pads = read_mapping(settings.get("pads"), f"{where}, jaw, pads")
    found = tuple(_pad(link_name(link), pad, f"{where}, jaw pad of {link!r}") for link, pad in pads.items())
    return replace(jaw, pads=found)


def _pad(link: str, settings: Any, where: str) -> Pad:
    settings = read_mapping(settings, where)
    check_keys(settings, ("size", "position", "tilt"), where)
    size = read_vector(settings.get("size"), f"{where}, size")
    if not (size > 0).all():
        raise ValueError(f"{where}: size {size.tolist()} must be above 0")
    position, tilt = (read_vector(settings.get(key, [0, 0, 0]), f"{where}, {key}") for key in ("position", "tilt"))
    rotation = tuple(tuple(row) for row in turned(tilt).tolist())
    return Pad(link, tuple(size.tolist()), tuple(position.tolist()), rotation)
