"""Arms and scenes from the cache: what a warm start imports, and that nothing stale comes out."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from surgical_marl import list_arms, load_arm, load_scene
from surgical_marl.robots.description import from_json, to_json
from surgical_marl.scenes.scene import Scene

HEAVY = {"jax", "lxml", "scipy", "torch", "trimesh", "yourdfpy"}
WARM = "import sys, surgical_marl; surgical_marl.load_scene('bimanual_psm'); print(*sys.modules)"


def imported(cache: Path) -> set[str]:
    """The modules that a process imports which loads a scene."""
    env = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    done = subprocess.run([sys.executable, "-c", WARM], env=env, capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_a_warm_start_of_a_scene_imports_no_parser(tmp_path: Path) -> None:
    assert imported(tmp_path) & HEAVY >= {"yourdfpy", "trimesh", "lxml"}
    assert not imported(tmp_path) & HEAVY


@pytest.mark.parametrize("name", list_arms())
def test_a_description_survives_the_cache(name: str) -> None:
    robot = load_arm(name).urdf
    assert from_json(to_json(robot)) == robot


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene of one's own with an arm of one's own that has a mesh."""
    folder = tmp_path / "psm"
    shutil.copytree(load_arm("psm").folder, folder)
    edit(folder / "psm.urdf", "<visual>", '<visual><geometry><mesh filename="part.stl"/></geometry></visual><visual>')
    trimesh.creation.box((0.01, 0.02, 0.03)).export(folder / "part.stl")
    (tmp_path / "mine.yaml").write_text("arms: {psm_0: {arm: psm, position: [0, 0, 0.1]}}")
    return tmp_path / "mine.yaml"


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def mesh_size(scene: Scene) -> float:
    return float(np.ptp(scene.model.mesh_vert, axis=0).max())


def test_a_change_of_any_file_changes_the_model(scene: Path) -> None:
    first = load_scene(scene)
    assert mesh_size(load_scene(scene)) == mesh_size(first) == pytest.approx(0.03)

    trimesh.creation.box((0.01, 0.02, 0.06)).export(scene.parent / "psm" / "part.stl")
    assert mesh_size(load_scene(scene)) == pytest.approx(0.06)

    edit(scene.parent / "psm" / "arm.yaml", "stiffness: ", "stiffness: 1")
    assert load_scene(scene).model.actuator_gainprm[0, 0] > first.model.actuator_gainprm[0, 0]

    edit(scene.parent / "psm" / "psm.urdf", 'effort="', 'effort="1')
    assert load_scene(scene).model.jnt_actfrcrange[0, 1] > first.model.jnt_actfrcrange[0, 1]

    edit(scene, "0.1", "0.2")
    moved = load_scene(scene)
    assert moved.model.body("psm_0/remote_center").pos[2] == pytest.approx(0.2)
    assert load_scene(scene, "torque").model.actuator_gainprm[0, 0] == 1


def test_an_arm_is_the_same_wherever_its_folder_lies(scene: Path, tmp_path: Path) -> None:
    shutil.copytree(scene.parent / "psm", tmp_path / "elsewhere" / "psm")
    assert load_arm(tmp_path / "elsewhere" / "psm").content == load_arm(scene.parent / "psm").content
