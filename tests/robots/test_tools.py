"""Instruments to choose from: what a tool changes of an arm, and what stays."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from surgical_marl import load_arm
from surgical_marl.cli.main import main
from surgical_marl.envs.env import Env, alike
from surgical_marl.robots.arm import arm_files, list_tools
from surgical_marl.robots.spec import build_spec
from surgical_marl.scenes.check import check
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.mjcf import mjcf
from surgical_marl.yaml_file import dump_yaml, read_yaml

PSM = load_arm("psm")
PLACES = {"psm_0": [-0.08, 0.0, 0.15], "psm_1": [0.08, 0.0, 0.15]}


def write_scene(folder: Path, **tools: str) -> Path:
    """Two PSMs; `tools` are those of agents."""
    arms = {
        agent: {"arm": "psm", "position": place, "workspace": [0.0, 0.0, -0.11]}
        | ({"tool": tools[agent]} if agent in tools else {})
        for agent, place in PLACES.items()
    }
    (folder / "two.yaml").write_text(dump_yaml({"arms": arms}))
    return folder / "two.yaml"


def test_the_first_tool_is_the_arm_without_a_choice() -> None:
    assert list_tools("psm") == ["large_needle_driver", "cadiere_forceps"] == list(PSM.tools)
    assert PSM.tool == "large_needle_driver" and PSM.content == load_arm("psm", PSM.tool).content
    assert list_tools("ecm") == [] and load_arm("ecm").tool is None
    assert arm_files("psm") == ["arm.yaml", "psm.urdf", "psm_cadiere_forceps.urdf"]


@pytest.mark.parametrize("name", ["psm", "psm_si"])
def test_cadiere_forceps_have_the_published_tip_and_jaw(name: str) -> None:
    """dVRK: wrist, limits and coupling of the needle driver. dvrk_model: tip 15.5 mm past the wrist-yaw axis."""
    arm, forceps = load_arm(name), load_arm(name, "cadiere_forceps")
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (200, 7))
    ours, theirs = forceps.forward_kinematics(q), arm.forward_kinematics(q)
    assert np.abs(ours[:, :3, :3] - theirs[:, :3, :3]).max() < 1e-12
    past = theirs[:, :3, 3] + (0.0155 - 0.0102) * theirs[:, :3, 2]
    assert np.abs(ours[:, :3, 3] - past).max() < 1e-12
    assert forceps.joints == arm.joints and forceps.cables == arm.cables and forceps.jaw != arm.jaw
    assert forceps.jaw and (forceps.jaw.joint, forceps.jaw.open, forceps.jaw.closed) == ("jaw_left", 0.5, 0.02)


@pytest.mark.parametrize(
    ("arm", "start", "end", "width", "thickness"),
    [
        (PSM, 0.00095, 0.0106, 0.0048, 0.0012),
        (load_arm("psm", "cadiere_forceps"), 0.0061, 0.0199, 0.0052, 0.0015),
        (load_arm("psm_si", "cadiere_forceps"), 0.0061, 0.0199, 0.0052, 0.0015),
    ],
)
def test_closed_plates_touch_between_the_fingers(
    arm: Any, start: float, end: float, width: float, thickness: float
) -> None:
    """The forceps' blades as dvrk-ros' mesh has them: 6.1 to 19.9 mm past the wrist-yaw axis, 5.2 by 1.5 mm."""
    model = build_spec(arm, pads=True).compile()
    data = mujoco.MjData(model)
    for joint in ("jaw_left", "jaw_right"):
        data.joint(joint).qpos = arm.jaw.closed
    mujoco.mj_kinematics(model, data)
    axis, axes = data.body("wrist_yaw_link").xpos, data.body("wrist_yaw_link").xmat.reshape(3, 3)
    for side, link in ((-1, "jaw_left_link"), (1, "jaw_right_link")):
        pad = data.geom(f"{link}/pad")
        half = model.geom(f"{link}/pad").size
        middle = axes.T @ (pad.xpos - axis)
        assert np.abs(axes.T @ pad.xmat.reshape(3, 3) - np.eye(3)).max() < 1e-6  # the closed plates are parallel
        assert middle == pytest.approx([side * thickness / 2, 0.0, -(start + end) / 2], abs=1e-8)
        assert 2 * half == pytest.approx([thickness, width, end - start])


def test_a_scene_names_the_tool_of_each_arm(tmp_path: Path) -> None:
    usual = load_scene(write_scene(tmp_path))
    assert usual.types == {"psm": ("psm_0", "psm_1")}
    named = load_scene(write_scene(tmp_path, psm_0="large_needle_driver"))
    assert named.fingerprint == usual.fingerprint and named.types == usual.types
    mixed = load_scene(write_scene(tmp_path, psm_1="cadiere_forceps"))
    assert mixed.types == {"psm": ("psm_0",), "psm-2": ("psm_1",)} and mixed.fingerprint != usual.fingerprint
    assert [mixed.label(agent) for agent in mixed.agents] == ["psm_0", "psm_1 with cadiere_forceps"]
    alone = mujoco.MjModel.from_xml_string(mjcf(mixed))
    for model in (mixed.model, alone):
        fingers = [model.geom(f"{agent}/jaw_left").size for agent in mixed.agents]  # capsules: radius, half the axis
        assert [2 * sum(size[:2]) for size in fingers] == pytest.approx([0.0106, 0.0199])


def test_a_wrong_tool_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(
        ValueError, match=r"unknown tool of arm 'psm' 'cadiere', did you mean 'cadiere_forceps' \(choose"
    ):
        load_arm("psm", "cadiere")
    with pytest.raises(ValueError, match=r"unknown tool of arm 'star' 'x' \(choose from none\)"):
        load_arm("star", "x")
    path = write_scene(tmp_path, psm_1="scalpel")
    with pytest.raises(ValueError, match=r"two\.yaml, line 12: arms\.psm_1: unknown tool of arm 'psm' 'scalpel'"):
        load_scene(path)
    assert main(["train", "reach", "--scene", str(path)]) == 2
    assert "'scalpel'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"jaws": {}}, r"line \d+: tools\.cadiere_forceps: unknown key 'jaws'; the keys are urdf, tool_tip"),
        ({"tools": {}}, r"tools\.cadiere_forceps: unknown key 'tools'"),
        (3, r"tools\.cadiere_forceps must be a mapping of urdf, tool_tip.*, not 3"),
        ({"urdf": "other.urdf"}, r"line \d+: urdf: there is no URDF file 'other.urdf'"),
        ({"tool_tip": "tip"}, r"line \d+: tool_tip 'tip' is not a link of the URDF"),
        ({"tool_tip": None}, r"arm\.yaml lacks tool_tip"),
        ({"joints": {"rol": {"stiffness": 1.0}}}, r"line \d+: joints\.rol lacks damping, speed"),
        ({"jaw": {"open": 2.0}}, r"arm 'psm with cadiere_forceps': the jaw is open at 2 rad, outside the limits"),
    ],
)
def test_a_tool_that_does_not_fit_is_found(tmp_path: Path, changes: Any, words: str) -> None:
    """`check` looks at every tool; the usual one has no fault here."""
    folder = tmp_path / "psm"
    shutil.copytree(PSM.folder, folder)
    content = read_yaml(folder / "arm.yaml")
    content["tools"]["cadiere_forceps"] = changes
    (folder / "arm.yaml").write_text(dump_yaml(content))
    (found,) = [finding for finding in check(folder) if "collision" not in finding]
    assert re.search(words, found), found


def test_agents_that_see_other_instruments_share_no_network(tmp_path: Path) -> None:
    """Of three PSMs the first and the last are alike, but each sees the forceps at another place."""
    path = write_scene(tmp_path, psm_1="cadiere_forceps")
    content = read_yaml(path)
    content["arms"]["psm_2"] = {"arm": "psm", "position": [0.0, 0.1, 0.15], "workspace": [0.0, 0.0, -0.11]}
    path.write_text(dump_yaml(content))
    env = Env("reach", str(path), knowledge="all")
    assert env.scene.types == {"psm": ("psm_0", "psm_2"), "psm-2": ("psm_1",)}
    assert alike(env) == {"psm": ["psm_0"], "psm-seeing-2": ["psm_2"], "psm-2": ["psm_1"]}
