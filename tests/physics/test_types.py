"""An agent's type is what its arm is, and not what its folder is called."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from surgical_marl import load_scene
from surgical_marl.content import find
from surgical_marl.physics.simulator import Simulator
from tests.helpers.commands import commander

HEAVIER = 3.0


def scene_of_two(folder: Path, **sources: str) -> Path:
    """A scene of two endoscopes that stand apart: agent -> arm."""
    places = ("[-0.3, 0, 0.15]", "[0.3, 0, 0.15]")
    arms = "\n".join(
        f"  {agent}: {{arm: {source}, position: {place}, workspace: [0, 0, -0.12]}}"
        for (agent, source), place in zip(sources.items(), places, strict=True)
    )
    path = folder / "two.yaml"
    path.write_text(f"arms:\n{arms}\n")
    return path


def copy_arm(folder: Path, factor: float = 1.0) -> None:
    """The shipped endoscope arm with all masses and inertias times a factor."""
    shutil.copytree(find("arms", "ecm"), folder)
    urdf = folder / "ecm.urdf"
    heavier = lambda match: f'{match[1]}="{factor * float(match[2]):.9g}"'  # noqa: E731
    text = re.sub(r'\b(ixx|ixy|ixz|iyy|iyz|izz)="([^"]+)"', heavier, urdf.read_text())
    urdf.write_text(re.sub(r'(<mass value)="([^"]+)"', heavier, text))


@pytest.mark.parametrize("control", [pytest.param("torque", marks=pytest.mark.slow), "position"])
def test_arms_of_one_name_move_by_their_own_models(control: str, tmp_path: Path) -> None:
    copy_arm(tmp_path / "a/ecm")
    copy_arm(tmp_path / "b/ecm", HEAVIER)
    scene = load_scene(scene_of_two(tmp_path, ecm_0="a/ecm", ecm_1="b/ecm"), control)
    assert scene.types == {"ecm": ("ecm_0",), "ecm-2": ("ecm_1",)}
    simulator = Simulator(scene, decimation=1)
    action = {agent: np.full(4, 0.5, np.float32) for agent in scene.agents}
    start = commander(simulator)(simulator.home, action)
    physics, *_ = jax.jit(simulator.advance)(start)
    data = mujoco.MjData(scene.model)
    data.qpos[:], data.ctrl[:] = scene.home, start.ctrl
    mujoco.mj_step(scene.model, data)
    assert np.allclose(physics.qvel, data.qvel, rtol=1e-3, atol=1e-6)
    light, heavy = (np.abs(physics.qvel[scene.qpos_index(agent)]) for agent in scene.agents)
    assert (light > 1.5 * heavy)[:2].all()


def test_arms_that_are_alike_are_of_one_type_whatever_they_are_called(tmp_path: Path) -> None:
    copy_arm(tmp_path / "a/ecm")
    assert load_scene(scene_of_two(tmp_path, ecm_0="ecm", ecm_1="a/ecm")).types == {"ecm": ("ecm_0", "ecm_1")}
    assert load_scene("trimanual_psm_ecm").types == {"psm": ("psm_0", "psm_1"), "ecm": ("ecm_0",)}
