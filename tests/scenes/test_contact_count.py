"""Scenes with more contacts of objects than there are slots: `check` says so, and the physics counts what it leaves
out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.cli.main import main
from surgical_marl.physics.contact.detection import SLOTS
from surgical_marl.scenes.check import check
from surgical_marl.scenes.contact_count import crowd
from tests.helpers.falling import Falling

BALL = {
    "free": True,
    "mass": 0.001,
    "friction": {"sliding": 0.5, "torsion": 0.001},
    "stiffness": 1e5,
    "shapes": [{"sphere": {"radius": 0.002}}],
}


def balls(folder: Path, count: int, height: float = 0.002) -> dict[str, dict[str, Any]]:
    """Write a ball's file; return where a scene has a pad and a row of balls over it."""
    (folder / "ball.yaml").write_text(yaml.safe_dump(BALL))
    places = [[0.006 * (i - (count - 1) / 2), 0.0, height] for i in range(count)]
    return {"pad": {"object": "pad", "tilt": [0, 0, 90]}} | {
        f"ball_{i}": {"object": "ball.yaml", "position": place} for i, place in enumerate(places)
    }


def scene(folder: Path, objects: dict[str, dict[str, Any]]) -> Path:
    """One PSM over objects."""
    arms = {"psm_0": {"arm": "psm", "position": [0.0, 0.0, 0.15], "workspace": [0.0, 0.0, -0.11]}}
    (folder / "balls.yaml").write_text(yaml.safe_dump({"arms": arms, "objects": objects}, sort_keys=False))
    return folder / "balls.yaml"


def test_a_scene_that_may_need_more_contacts_than_slots_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A jaw and as many balls as have room, and one more."""
    most = SLOTS - 4
    assert check(scene(tmp_path, balls(tmp_path, most))) == []
    path = scene(tmp_path, balls(tmp_path, most + 1))
    (finding,) = check(path)
    assert finding.startswith("scene 'balls': its objects may need 17 contacts at one time, 13 where they come to rest")
    assert "\n" not in finding and "contact_overflow" in finding
    assert main(["check", str(path)]) == 1
    assert capsys.readouterr().out == finding + "\n"


def test_contacts_are_counted_where_objects_come_to_rest(tmp_path: Path) -> None:
    """Balls that fall on a pad, and a block on another one."""
    assert crowd(sm.load_scene(scene(tmp_path, balls(tmp_path, 3, height=0.022)))) == (3, 4)
    objects = balls(tmp_path, 0)
    for name, z in (("low", 0.0075), ("high", 0.0225)):
        objects[name] = {"object": "block", "position": [0, 0, z]}
    assert crowd(sm.load_scene(scene(tmp_path, objects))).resting == 2


def test_contacts_without_a_slot_are_counted(tmp_path: Path) -> None:
    falling = Falling(tmp_path, balls(tmp_path, SLOTS + 3))
    objects = jax.tree.map(lambda x: x[0], falling.begin(1))
    slots = jax.jit(falling.step.slots)(falling._arms.with_systems(rigid_bodies=objects))
    assert slots.total == SLOTS + 3 and slots.found == SLOTS
    assert len(np.unique(slots.number)) == SLOTS
