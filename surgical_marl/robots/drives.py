"""How the joints of an arm are driven, read from `arm.yaml`: each by its own drive, some also by a shared cable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgical_marl.untrusted.values import LARGEST, as_number, check_count, listed, shown
from surgical_marl.yaml_file import build, check_keys


@dataclass(frozen=True)
class Drive:
    """How one joint is driven. SI units: N m/rad, N m s/rad, kg m2, rad/s, rad (or N/m, N s/m, kg, m/s, m)."""

    stiffness: float
    damping: float
    speed: float
    armature: float = 0.0
    home: float = 0.0
    margin: float = 0.0
    """How far the joint limits lie inside those of the URDF. A light joint that is struck goes a little past its
    limit."""


@dataclass(frozen=True)
class Cable:
    """A cable that couples several joints.

    The length of the cable is the sum of coefficient times position of its joints. Its own drive acts on this length,
    in addition to the drives of the joints. Units are those of a `Drive`, per unit of that length.
    """

    joints: dict[str, float]
    """Coefficient of each joint."""
    stiffness: float
    damping: float
    effort: float
    armature: float = 0.0


def read_drives(drives: Any, joints: list[str], where: Path, keep: Callable[..., Any]) -> dict[str, Drive]:
    """Return the drive of each of `joints`.

    `keep` calls each reader and collects what is wrong. Only a `drives` that is not a mapping raises ValueError at
    once.
    """
    if not isinstance(drives, dict):
        raise ValueError(f"{where}: joints must be a mapping from joint name to drive")
    keep(check_keys, drives, tuple(joints), f"{where}, joints")
    return {name: keep(_drive, drives.get(name, {}), f"{where}, joint {name!r}") for name in joints}


def _drive(mapping: Any, where: str) -> Drive:
    drive: Drive = build(Drive, mapping, where)
    _check_signs(drive, "speed", where)
    return drive


def _check_signs(drive: Drive | Cable, positive: str, where: str) -> None:
    for key in ("stiffness", "damping", "armature", "margin"):
        if getattr(drive, key, 0) < 0:
            raise ValueError(f"{where}: {key} must be 0 or more, not {getattr(drive, key):g}")
    if not getattr(drive, positive) > 0:
        raise ValueError(f"{where}: {positive} must be above 0, not {getattr(drive, positive):g}")


def read_cables(cables: Any, joints: list[str], where: Path, keep: Callable[..., Any]) -> tuple[Cable, ...]:
    """Return the cables, which may couple only `joints`.

    `keep` calls each reader and collects what is wrong. Only a `cables` that is not a list raises ValueError at once.
    """
    if not isinstance(cables, list):
        raise ValueError(f"{where}: cables must be a list, not {shown(cables)}")
    check_count(len(cables), len(joints) ** 2, "cables", where)
    return tuple(keep(_cable, cable, joints, f"{where}, cable {number}") for number, cable in enumerate(cables))


def _cable(mapping: Any, joints: list[str], where: str) -> Cable:
    cable: Cable = build(Cable, mapping, where)
    if not isinstance(cable.joints, dict) or len(cable.joints) < 2:
        raise ValueError(f"{where}: joints must map two joints or more to coefficients, not {shown(cable.joints)}")
    for name, value in cable.joints.items():
        if name not in joints:  # a jaw is under position control in every mode, so no cable may drive it
            raise ValueError(f"{where}: joint {shown(name)} is not one of {listed(joints)}")
        if not 0 < abs(as_number(value)) <= LARGEST:
            raise ValueError(
                f"{where}: the coefficient of {name!r} must be a finite number but 0, not {shown(value)}, and at most "
                f"{LARGEST:g} in size"
            )
    _check_signs(cable, "effort", where)
    return cable
