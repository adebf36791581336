"""What `surgical-marl check` finds, and the page docs/your_own_arm.md as it stands."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
from pettingzoo import ParallelEnv

import surgical_marl as sm
from surgical_marl.cli.main import main
from surgical_marl.robots.arm_findings import number_findings
from surgical_marl.scenes.check import check
from surgical_marl.scenes.mjcf import mjcf
from surgical_marl.view.render import Renderer, View
from tests.helpers import ROOT

PAGE = (ROOT / "docs" / "your_own_arm.md").read_text()
BLOCKS = [(kind, text) for kind, text in re.findall(r"```(\w+)\n(.*?)```", PAGE, re.DOTALL)]
XML, (YAML, TOOLS, SCENE) = dict(BLOCKS)["xml"], [text for kind, text in BLOCKS if kind == "yaml"]
MESHES, ENV = [text for kind, text in BLOCKS if kind == "python"]


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The page's files in an empty folder, which is the working folder."""
    monkeypatch.chdir(tmp_path)
    exec(MESHES, {})
    (tmp_path / "lab_arm" / "urdf" / "lab_arm.urdf").write_text(XML)
    (tmp_path / "lab_arm" / "arm.yaml").write_text(YAML)
    (tmp_path / "beside_psm.yaml").write_text(SCENE)
    return tmp_path


def replace(path: Path, *pairs: tuple[str, str]) -> None:
    text = path.read_text()
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    path.write_text(text)


def test_the_page_makes_a_urdf_and_a_few_lines_an_agent_beside_a_psm(
    own: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len(YAML.splitlines()) <= 20
    for line in re.findall(r"surgical-marl check .*", PAGE):
        command, _, said = line.partition("#")
        assert main(command.split()[1:]) == 0
        assert capsys.readouterr().out == said.strip() + "\n"
    names: dict[str, object] = {}
    exec(ENV, names)
    env, observations = names["env"], names["observations"]
    assert isinstance(env, ParallelEnv) and isinstance(observations, dict)
    assert set(env.agents) == {"psm_0", "lab_arm_0"}
    infos = names["infos"]
    assert isinstance(infos, dict)
    for agent in env.agents:  # each is given a goal of its own, near where it starts
        assert infos[agent]["tip_error"] < 0.25
    for _ in range(2):
        for agent in env.agents:
            assert env.observation_space(agent).contains(observations[agent])
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        observations, _, terminations, truncations, _ = env.step(actions)
        assert not any(terminations.values()) and not any(truncations.values())
    assert env.action_space("lab_arm_0").shape == (6,)
    assert all(np.isfinite(observation).all() for observation in observations.values())


def test_the_page_gives_the_arm_a_choice_of_tools(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (own / "lab_arm" / "arm.yaml").write_text(YAML + TOOLS)
    replace(own / "beside_psm.yaml", ("arm: lab_arm,", "arm: lab_arm, tool: bare,"))
    assert main(["check", "lab_arm"]) == main(["check", "beside_psm.yaml"]) == 0
    assert "4 collision shapes, 2 tools)" in capsys.readouterr().out
    arm, usual = sm.load_scene(own / "beside_psm.yaml").mounts["lab_arm_0"].arm, sm.load_arm("lab_arm")
    assert (arm.tool, usual.tool, arm.tool_tip, usual.tool_tip) == ("bare", "straight", "flange", "tool0")
    assert arm.joints[-1].drive.armature == 0.0005 and arm.joints[-1].drive.stiffness == 4.0


def test_a_scene_with_meshes_opens_in_plain_mujoco(own: Path) -> None:
    """Exported, with the meshes in the file itself: every vertex where it was."""
    scene, corners = sm.load_scene(own / "beside_psm.yaml"), []
    (own / "scene.xml").write_text(mjcf(scene))
    shutil.rmtree(own / "lab_arm")
    for model in (scene.model, mujoco.MjModel.from_xml_path(str(own / "scene.xml"))):
        data = mujoco.MjData(model)
        data.qpos[:] = scene.home
        mujoco.mj_kinematics(model, data)
        found = []
        for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH):
            start, count = (part[model.geom_dataid[geom]] for part in (model.mesh_vertadr, model.mesh_vertnum))
            vertices = model.mesh_vert[start : start + count]
            found.append(vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
        corners.append(found)
    assert len(corners[0]) == 2
    for before, after in zip(*corners, strict=True):
        np.testing.assert_allclose(after, before, atol=1e-6)  # vertices are float32


def test_a_mesh_is_seen(own: Path) -> None:
    replace(own / "lab_arm/urdf/lab_arm.urdf", ("0.9 0.5 0.1 1", "0 0 1 1"))
    scene = sm.load_scene(own / "beside_psm.yaml")
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    mujoco.mj_forward(scene.model, data)
    view = View(lookat=(-0.42, 0, 0.22), distance=0.4, elevation=0)
    image = Renderer(scene.model, 40, 30).render(data, camera=view).astype(int)
    blue = image[..., 2] > 1.5 * image[..., 0] + 20
    assert 0.05 < blue.mean() < 0.9


@pytest.mark.parametrize("name", dict.fromkeys([*sm.list_arms(), *sm.list_scenes()]))
def test_nothing_is_wrong_with_what_ships(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert check(name) == []
    assert main(["check", name]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{name}: nothing wrong found (") and out.count("\n") == 1


LIMIT_1 = '<limit lower="-2.9" upper="2.9" velocity="2" effort="20"/>'
LIMIT_2 = '<limit lower="-2" upper="2" velocity="2" effort="20"/>'
MIMIC = '<mimic joint="joint_5" multiplier="{}" offset="{}"/>'
SHOULDER = '<inertia ixx="2e-3" iyy="2e-3" izz="2e-3" ixy="0" ixz="0" iyz="0"/>'


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("arm.yaml", "tool_tip: tool0", "tool_tip: tip", "tool_tip 'tip' is not a link"),
        ("arm.yaml", "tool_tip: tool0", "", "arm.yaml lacks tool_tip"),
        ("arm.yaml", "stiffness: 80", "stiffness: 800000", "unstable at the physics step of 2.5 ms, joint 'joint_"),
        ("arm.yaml", "stiffness: 80", "stiffness: 1.0e+9", "unstable"),
        ("arm.yaml", "stiffness: 80", "stiffness: -1", "stiffness must be a number from 0 to 1,000,000,000, not -1"),
        ("arm.yaml", "home: 0.6", "home: 2.6", "home at 2.6 rad, outside its limits [-2, 2] rad"),
        ("arm.yaml", "speed: 2.0", "speed: 0", "speed must be a number from 1e-12 to 1,000,000,000, not 0"),
        ("arm.yaml", "tool_tip:", "remote_center: forearm\ntool_tip:", "misses the origin of the base frame by up to"),
        ("arm.yaml", "tool_tip:", "jaw: {joint: joint_6, open: 3, closed: 0}\ntool_tip:", "the jaw is open at 3 rad"),
        ("urdf/lab_arm.urdf", LIMIT_1, "", "joint 'joint_1' needs a limit"),
        ("urdf/lab_arm.urdf", '"joint_1" type="revolute"', '"joint_1" type="continuous"', "has no limits"),
        ("urdf/lab_arm.urdf", 'velocity="2" effort="10"', 'velocity="2" effort="0"', "effort limit 0"),
        ("urdf/lab_arm.urdf", 'velocity="2" effort="10"', 'velocity="0" effort="1"', "velocity limit 0"),
        (
            "urdf/lab_arm.urdf",
            SHOULDER,
            SHOULDER.replace("2e-3", "0"),
            "'shoulder' has a mass of 1 kg but zero inertia",
        ),
        ("urdf/lab_arm.urdf", SHOULDER, SHOULDER.replace("2e-3", "5e-3", 1), "no body has one above the sum of two"),
        ("urdf/lab_arm.urdf", SHOULDER, SHOULDER.replace('ixy="0"', 'ixy="9"'), "all three must be above 0"),
        (
            "urdf/lab_arm.urdf",
            f'<inertial><mass value="1.0"/>{SHOULDER}</inertial>',
            "",
            "moved by joint 'joint_1' but",
        ),
        ("urdf/lab_arm.urdf", LIMIT_2, LIMIT_2 + '<mimic joint="joint_9"/>', "mimics 'joint_9', which is not a moving"),
        ("urdf/lab_arm.urdf", "meshes/base.stl", "meshes/bass.stl", "bass.stl', which is not found"),
        ("arm.yaml", "speed: 2.0", "speed: 60", "the speed 60 rad/s in arm.yaml, above its velocity limit of 3 rad/s"),
        (
            "urdf/lab_arm.urdf",
            LIMIT_1,
            '<limit lower="-170" upper="170" velocity="180" effort="20"/>',
            'which look like degrees: a URDF\'s are in rad; write lower="-2.967" upper="2.967" velocity="3.142"',
        ),
        ("urdf/lab_arm.urdf", LIMIT_1, LIMIT_1.replace('velocity="2"', 'velocity="90"'), 'write velocity="1.571"'),
        (
            "urdf/lab_arm.urdf",
            f'"joint_1" type="revolute"><parent link="base_link"/><child link="shoulder"/>\n'
            f'    <origin xyz="0 0 0.12"/><axis xyz="0 0 1"/>{LIMIT_1}',
            '"joint_1" type="prismatic"><parent link="base_link"/><child link="shoulder"/>'
            '<origin xyz="0 0 0.12"/><axis xyz="0 0 1"/><limit lower="0" upper="240" velocity="200" effort="20"/>',
            'which look like mm: a URDF\'s are in m; write lower="0" upper="0.24" velocity="0.2"',
        ),
        (
            "urdf/lab_arm.urdf",
            '<origin xyz="0 0 0.12"/><axis xyz="0 0 1"/>',
            '<origin xyz="0 0 0.12"/><axis xyz="0 0 -2"/>',
            'the axis 0 0 -2 of length 2, which is read as one of length 1; write xyz="0 0 -1"',
        ),
        ("urdf/lab_arm.urdf", LIMIT_2, LIMIT_2 + MIMIC.format(1, 0), "joint_2 mimics 'joint_5' and has no drive"),
        (
            "arm.yaml",
            "  joint_1:",
            "  flange_to_tool0: {stiffness: 80, damping: 6, speed: 1.0}\n  joint_1:",
            "flange_to_tool0 is fixed and has no drive",
        ),
        ("urdf/lab_arm.urdf", SHOULDER, SHOULDER.replace("2e-3", "2e3"), "a radius of gyration of 44.7 m"),
        ("urdf/lab_arm.urdf", "<collision>", "<sensor>", "has no <collision>"),
    ],
)
def test_what_is_wrong_is_one_sentence(own: Path, file: str, old: str, new: str, words: str) -> None:
    pairs = [(old, new)] + [("</collision>", "</sensor>")] * (new == "<sensor>")
    replace(own / "lab_arm" / file, *pairs)
    before = sorted(own.rglob("*"))
    findings = check(own / "lab_arm")
    assert any(words in finding for finding in findings), findings
    assert not any("\n" in finding for finding in findings)
    assert findings == check(own / "lab_arm" / "arm.yaml")
    assert sorted(own.rglob("*")) == before, "a check must leave nothing behind"


@pytest.mark.parametrize(
    ("lower", "upper", "multiplier", "offset", "margin", "kept"),
    [
        (-2, 2, 1, 0, 0, None),
        (-2.9, 2.9, -1, 0.5, 0, None),
        (-2, 2, 1, 0, 0.1, None),
        (-1.99, 1.99, 1, 0, 0, None),
        (-2, 0.08, 1, 0, 0, ("48 %", -2, 2)),
        (0, 2, -1, 0, 0, ("50 %", -2, 2)),
        (-2, 2, 2, 0, 0, ("50 %", -4, 4)),
        (-2, 2, 1, 1, 0.1, ("26 %", -1, 3)),
        (3, 4, 1, 0, 0, ("100 %", -2, 2)),
        (-1, 1, 0, 0.1, 0, None),
    ],
)
def test_limits_that_hold_back_a_leader_are_named(
    own: Path, lower: float, upper: float, multiplier: float, offset: float, margin: float,
    kept: tuple[str, float, float] | None,
) -> None:  # fmt: skip
    old = '<limit lower="-2.9" upper="2.9" velocity="3" effort="3"/></joint>\n  <joint name="flange_to_tool0"'
    new = f'<limit lower="{lower}" upper="{upper}" velocity="3" effort="3"/>{MIMIC.format(multiplier, offset)}'
    replace(own / "lab_arm/urdf/lab_arm.urdf", (old, new + '</joint>\n  <joint name="flange_to_tool0"'))
    replace(own / "lab_arm/arm.yaml", ("  joint_6: {stiffness: 4, damping: 0.2, speed: 2.0, armature: 0.001}\n", ""),
            ("home: 0.6", f"home: 0.0, margin: {margin}"))  # fmt: skip
    findings = [finding for finding in number_findings(sm.load_arm(own / "lab_arm")) if "joint_6" in finding]
    if multiplier == 0:
        assert "mimics 'joint_5' with multiplier 0, so it stays at 0.1 rad; make it fixed" in findings.pop()
    assert len(findings) == (kept is not None), findings
    if kept is not None:
        share, least, most = kept
        assert f"keep both from {share} of that" in findings[0]
        assert f'write lower="{least:g}" upper="{most:g}", or give' in findings[0]


def test_a_home_that_collides_with_itself_is_named(own: Path) -> None:
    replace(own / "lab_arm" / "arm.yaml", ("home: 1.6", "home: 2.5"), ("home: 0.6", "home: 2.0"))
    findings = check(own / "lab_arm")
    assert any("'upper_arm_0' and 'flange_0' overlap by" in finding for finding in findings), findings


def test_several_things_are_found_at_once(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    replace(own / "lab_arm/arm.yaml", ("tool_tip: tool0", "tool_tip: tip"), ("  joint_4:", "  joint_44:"))
    replace(own / "lab_arm/urdf/lab_arm.urdf", (LIMIT_1, ""), (SHOULDER, SHOULDER.replace("2e-3", "0")),
            ("base.stl", "bass.stl"))  # fmt: skip
    wanted = (
        "'joint_1' needs a limit",
        "'shoulder' has a mass",
        "bass.stl",
        "'joint_44'",
        "joints lacks joint_4",
        "'tip'",
    )
    for source in ("lab_arm", "beside_psm.yaml"):
        assert main(["check", source]) == 1
        out, err = capsys.readouterr()
        assert not err and len(out.splitlines()) == len(wanted)
        for words in wanted:
            assert sum(words in line for line in out.splitlines()) >= 1, words


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("workspace: [0.33, 0.0, 0.12]", "workspace: [0.0, 0.0, 2.0]", "mm out of its reach"),
        ("position: [-0.45, 0.0, 0.0]", "position: [-0.33, 0.0, 0.0]", "psm_0 and lab_arm_0 overlap at home"),
        ("arm: lab_arm,", "arm: lab_army,", "unknown arm 'lab_army'"),
        ("arms:", "tissue: 3\narms:", "line 2: tissue must be a mapping of names to pieces of tissue, not 3"),
        (
            "arms:",
            "observe: qpos\narms:",
            "observe must be a mapping of names to lists of observation terms, not 'qpos'",
        ),
        ("arms:", "observe: {psm_7: [qpos]}\narms:", "observe.psm_7 is not an agent of the scene (psm_0, lab_arm_0)"),
    ],
)
def test_what_is_wrong_with_a_scene_is_one_sentence(own: Path, old: str, new: str, words: str) -> None:
    replace(own / "beside_psm.yaml", (old, new))
    (finding,) = check(own / "beside_psm.yaml")
    assert words in finding and "\n" not in finding


def test_a_folder_with_the_name_of_a_shipped_arm_is_the_folder(own: Path) -> None:
    shutil.copytree(own / "lab_arm", own / "psm")
    replace(own / "psm" / "arm.yaml", ("tool_tip: tool0", "tool_tip: tip"))
    assert "'tip'" in check("./psm")[0]
    assert check("psm") == []


@pytest.mark.parametrize("source", ["psmm", "", "no/such/folder", "none.yaml"])
def test_an_unknown_name_is_bad_input(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["check", source]) == 2
    out, err = capsys.readouterr()
    assert not out and "unknown arm, scene or object" in err and err.count("\n") == 1
