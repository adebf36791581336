"""URDFs and meshes that somebody else wrote, some of them on purpose: what is refused, and what becomes of meshes."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl import load_arm
from surgical_marl.robots.mesh import read_mesh
from surgical_marl.robots.spec import COLLISION_GROUP, _bounding_capsule, build_spec
from surgical_marl.robots.urdf import Faults, read_urdf

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1e-2" iyy="1e-2" izz="1e-2" ixy="0" ixz="0" iyz="0"/></inertial>'
SHAPE = '<geometry><mesh filename="part.stl"/></geometry>'
LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
URDF = f"""<?xml version="1.0"?>
<robot name="two">
  <link name="base"><visual>{SHAPE}</visual></link>
  <link name="upper">{INERTIAL}<visual>{SHAPE}</visual><collision name="shell">{SHAPE}</collision></link>
  <link name="lower">{INERTIAL}<visual><origin xyz="0 0 1" rpy="0 0.1 0"/>{SHAPE}</visual>
    <collision name="shell"><geometry><box size="0.1 0.2 0.4"/></geometry></collision></link>
  <joint name="first" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>{LIMIT}</joint>
  <joint name="second" type="prismatic"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 0.5"/><axis xyz="0 0 1"/><limit lower="0" upper="0.2" velocity="1" effort="1"/></joint>
</robot>
"""
YAML = """urdf: two.urdf
tool_tip: lower
joints: {first: {stiffness: 10, damping: 1, speed: 1}, second: {stiffness: 10, damping: 1, speed: 1}}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An arm of two joints with a mesh, in a folder of its own."""
    folder = tmp_path / "two"
    folder.mkdir()
    (folder / "two.urdf").write_text(URDF)
    (folder / "arm.yaml").write_text(YAML)
    trimesh.creation.box((0.1, 0.2, 0.6)).export(folder / "part.stl")
    return folder


def refused(folder: Path) -> str:
    """The one sentence with which loading and building fails, without a trace."""
    before = {path: path.read_bytes() for path in folder.parent.rglob("*") if path.is_file() and not path.is_symlink()}
    with pytest.raises(ValueError) as caught:
        build_spec(load_arm(folder))
    sentence = str(caught.value)
    assert "\n" not in sentence and len(sentence) < 500
    assert {p: p.read_bytes() for p in folder.parent.rglob("*") if p.is_file() and not p.is_symlink()} == before
    return sentence


BOMB = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))


@pytest.mark.parametrize(
    "doctype",
    [
        f'<!DOCTYPE robot [<!ENTITY a0 "ha">{BOMB}]>',
        '<!DOCTYPE robot [<!ENTITY a11 SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE robot [<!ENTITY % a SYSTEM "file:///etc/passwd"> %a;]>',
        '<!DOCTYPE robot SYSTEM "http://localhost:9/robot.dtd">',
        "<!DOCTYPE robot>",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_are_never_expanded(folder: Path, doctype: str, encoding: str) -> None:
    text = URDF.replace('<?xml version="1.0"?>', f'<?xml version="1.0" encoding="{encoding}"?>{doctype}')
    text = text.replace('<link name="base">', '<link name="base"><visual name="&a11;"/>' if "a11" in doctype else
                        '<link name="base">')  # fmt: skip
    (folder / "two.urdf").write_text(text, encoding=encoding)
    sentence = refused(folder)
    assert "has a DOCTYPE" in sentence and "root:" not in sentence


@pytest.mark.parametrize("encoding", ["utf-7", "cp037", "shift_jis", "no-such-encoding"])
def test_no_encoding_hides_a_doctype(folder: Path, encoding: str) -> None:
    hidden = '+ADwAIQ-DOCTYPE robot [+ADwAIQ-ENTITY a0 "ha"+AD4-]+AD4-'
    (folder / "two.urdf").write_text(URDF.replace('"1.0"?>', f'"1.0" encoding="{encoding}"?>{hidden}'))
    assert "encoding" in refused(folder)


def test_an_entity_bomb_in_a_mesh_is_refused(folder: Path) -> None:
    (folder / "part.dae").write_text(f'<!DOCTYPE a [<!ENTITY a0 "ha">{BOMB}]><COLLADA>&a11;</COLLADA>')
    (folder / "two.urdf").write_text(URDF.replace("part.stl", "part.dae"))
    assert "has a DOCTYPE" in refused(folder)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        # numbers
        ('xyz="0 0 0.5"', 'xyz="0 nan 0.5"', "xyz='0 nan 0.5' of <origin> must be 3 numbers, finite"),
        ('xyz="0 0 0.5"', 'xyz="0 0"', "xyz='0 0' of <origin>"),
        ('rpy="0 0.1 0"', 'rpy="0 inf 0"', "rpy='0 inf 0'"),
        ('lower="-1"', 'lower="-1e999"', "lower='-1e999' of <limit>"),
        ('upper="1"', 'upper="one"', "upper='one'"),
        ('ixx="1e-2"', 'ixx="nan"', "ixx='nan' of <inertia>"),
        ('value="1"', 'value="-1"', "value='-1' of <mass> must be 1 number, finite and not negative"),
        ('size="0.1 0.2 0.4"', 'size="0.1 -0.2 0.4"', "size='0.1 -0.2 0.4' of <box>"),
        ('size="0.1 0.2 0.4"', 'size="0.1 0 0.4"', "finite and above 0"),
        ('axis xyz="0 1 0"', 'axis xyz="0 0 0"', "not all 0"),
        ('filename="part.stl"', 'filename="part.stl" scale="1 nan 1"', "scale='1 nan 1' of <mesh>"),
        (LIMIT, LIMIT + '<mimic joint="second" multiplier="nan"/>', "multiplier='nan'"),
        (LIMIT, LIMIT + '<dynamics damping="-1"/>', "damping='-1'"),
        (' ixx="1e-2"', "", "<inertia> needs ixx=..."),
        # joints
        (LIMIT, "", "joint 'first' needs a limit with lower, upper, velocity and effort"),
        (' effort="1"', "", "joint 'first' needs a limit"),
        ('"first" type="revolute"', '"first" type="continuous"', "joint 'first' is continuous, so it has no limits"),
        ('"first" type="revolute"', '"first" type="floating"', "floating; revolute, prismatic and fixed work"),
        (LIMIT, LIMIT + '<mimic joint="third"/>', "mimics 'third', which is not a moving joint"),
        (LIMIT, LIMIT + '<mimic joint="first"/>', "mimics 'first', which mimics a joint itself"),
        (LIMIT, LIMIT + "<mimic/>", "<mimic> needs joint=..."),
        # the tree
        ('<parent link="base"/>', '<parent link="lower"/>', "is its own ancestor"),
        ('<parent link="base"/>', '<parent link="upper"/>', "link 'upper' is its own ancestor"),
        ('<parent link="base"/>', '<parent link="bass"/>', "the parent 'bass', which is not a link"),
        ('<child link="lower"/>', '<child link="upper"/>', "link 'upper' is the child of 2 joints"),
        ('<link name="base">', '<link name="spare"/><link name="base">', "the links 'spare', 'base' have no parent"),
        ('<link name="base">', '<link name="upper"/><link name="base">', "2 links are called 'upper'"),
        ('name="second"', 'name="first"', "2 joints are called 'first'"),
        ('<parent link="base"/>', "", "<joint> of joint 'first' needs <parent>"),
        ("<robot ", "<model ", "not a URDF"),
        # meshes
        ("part.stl", "../part.stl", "'../part.stl', which leaves the arm's folder"),
        ("part.stl", "package://two/../../part.stl", "leaves the arm's folder"),
        ("part.stl", "file:///etc/passwd", "leaves the arm's folder"),
        ("part.stl", "/etc/passwd", "leaves the arm's folder"),
        ("part.stl", "link/part.stl", "leaves the arm's folder"),
        ("part.stl", "link.stl", "leaves the arm's folder"),
        ("part.stl", "http://localhost:9/part.stl", "is not found"),
        ("part.stl", "no.stl", "'no.stl', which is not found"),
        ("part.stl", "package://two/no.stl", "is not found"),
        ("part.stl", "circle.stl", "link 'base' has the mesh 'circle.stl', which"),
        ("part.stl", "a" * 300 + ".stl", "which"),
        ("part.stl", "two.urdf", "is of a kind that is not read; .stl, .obj, .dae are"),
        ("part.stl", "empty.stl", "empty.stl is not a mesh that can be read"),
        ("part.stl", "broken.dae", "broken.dae is not a"),
        ("part.stl", "nan.obj", "nan.obj has vertices that are not finite"),
        ("<mesh filename", "<mash filename", "<geometry> of link 'base' needs one of box, cylinder, sphere, mesh"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_sentence(folder: Path, old: str, new: str, words: str) -> None:
    trimesh.creation.box((1, 1, 1)).export(folder.parent / "part.stl")
    (folder / "link").symlink_to(folder.parent)
    (folder / "link.stl").symlink_to("/etc/passwd")
    (folder / "circle.stl").symlink_to("circle.stl")
    (folder / "empty.stl").write_bytes(b"")
    (folder / "broken.dae").write_text("<COLLADA/>")
    (folder / "nan.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 nan\nf 1 2 3\nf 1 2 4\n")
    assert old in URDF
    (folder / "two.urdf").write_text(URDF.replace(old, new).replace("</robot>", "</model>") if "model" in new
                                     else URDF.replace(old, new))  # fmt: skip
    sentence = refused(folder)
    assert words in sentence and str(folder) in sentence


@pytest.mark.parametrize(
    ("urdf", "words"),
    [
        ("../two.urdf", "leaves the arm's folder"),
        ("/etc/passwd", "leaves the arm's folder"),
        ("link.urdf", "leaves the arm's folder"),
        ("", "no URDF file"),
        ("no.urdf", "no URDF file"),
    ],
)
def test_the_urdf_lies_in_the_folder(folder: Path, urdf: str, words: str) -> None:
    (folder.parent / "two.urdf").write_text(URDF)
    (folder / "link.urdf").symlink_to(folder.parent / "two.urdf")
    (folder / "arm.yaml").write_text(YAML.replace("two.urdf", repr(urdf)))
    assert words in refused(folder)


YAML_BOMB = "\n".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"a0: &a0 ha\n{YAML_BOMB}\ntool_tip: *a11\n", "an alias"),
        ("[" * 2000, "not valid YAML"),
        ("tool_tip: !!python/name:os.system", "not valid YAML"),
        ("tool_tip: !!timestamp 2001-99-99", "not valid YAML"),
    ],
)
def test_a_yaml_bomb_is_refused(folder: Path, text: str, words: str) -> None:
    (folder / "arm.yaml").write_text(text)
    assert words in refused(folder)


def test_a_file_that_is_too_large_is_not_read(folder: Path) -> None:
    with (folder / "two.urdf").open("ab") as file:
        file.truncate(11_000_000)
    assert "larger than 10 MB" in refused(folder)


def test_deep_xml_is_refused(folder: Path) -> None:
    (folder / "two.urdf").write_text('<robot name="two">' + "<link>" * 1000 + "</link>" * 1000 + "</robot>")
    assert "not a URDF that can be read" in refused(folder)


def test_all_that_is_wrong_is_listed(folder: Path) -> None:
    text = (
        URDF.replace(LIMIT, "")
        .replace("part.stl", "no.stl")
        .replace('"second" type="prismatic"', '"second" type="planar"')
    )
    (folder / "two.urdf").write_text(text)
    with pytest.raises(Faults) as caught:
        load_arm(folder)
    text = "\n".join(caught.value.faults)
    assert str(caught.value) == caught.value.faults[0]
    for words in (
        "'first' needs a limit",
        "'second' is planar",
        "link 'base' has the mesh",
        "link 'upper' has the mesh",
    ):
        assert words in text


FIXED = '<joint name="still" type="fixed"><parent link="lower"/><child link="tip"/>{}</joint><link name="tip"/></robot>'


@pytest.mark.parametrize(
    "idle",
    [
        '<axis xyz="0 0 0"/>',
        '<axis xyz="0 0 0"/><limit lower="0" upper="0" velocity="-1" effort="0"/><dynamics damping="nan"/>',
        '<axis xyz=""/><limit/><mimic/><calibration rising="none"/><safety_controller k_velocity="x"/>',
    ],
)
def test_a_fixed_joint_is_read_without_its_axis_and_limits(folder: Path, idle: str) -> None:
    (folder / "two.urdf").write_text(URDF.replace("</robot>", FIXED.format("")))
    known = load_arm(folder).urdf
    (folder / "two.urdf").write_text(URDF.replace("</robot>", FIXED.format(idle)))
    assert load_arm(folder).urdf == known


@pytest.mark.parametrize("kind", ["continuous", "floating", "planar"])
@pytest.mark.parametrize(
    ("urdf", "yaml"),
    [
        (("", ""), ""),
        (('axis xyz="0 0 1"/>', 'axis xyz="0 0 1"/><mimic joint="first"/>'), ""),
        (("", ""), "cables: [{joints: {first: 1, second: 1}, stiffness: 1, damping: 1, effort: 1}]\n"),
        (("", ""), "jaw: {joint: first, open: 1, closed: 0}\n"),
        (('"second" type="prismatic"', '"second" type="fixed"'), ""),
    ],
)
def test_a_joint_of_a_type_that_does_not_work_is_one_fault(
    folder: Path, kind: str, urdf: tuple[str, str], yaml: str
) -> None:
    """With its drive in arm.yaml, as another joint's leader, in a cable, at the jaw, and alone."""
    text = URDF.replace('"first" type="revolute"', f'"first" type="{kind}"').replace(*urdf)
    drives = {"second": "" if "fixed" in text or "mimic" in text else "second: {stiffness: 10, damping: 1, speed: 1}"}
    (folder / "two.urdf").write_text(text)
    named = f"joints: {{first: {{stiffness: 10, damping: 1, speed: 1}}, {drives['second']}}}\n"
    (folder / "arm.yaml").write_text(f"urdf: two.urdf\ntool_tip: lower\n{named}{yaml}")
    with pytest.raises(Faults) as caught:
        load_arm(folder)
    (fault,) = caught.value.faults
    assert f"joint 'first' is {kind}" in fault


def test_a_child_that_is_no_link_is_one_fault(folder: Path) -> None:
    """Of the two links that are then without a parent nothing is said."""
    (folder / "two.urdf").write_text(URDF.replace('<child link="upper"/>', '<child link="uper"/>'))
    with pytest.raises(Faults) as caught:
        load_arm(folder)
    assert len(caught.value.faults) == 1 and "the child 'uper', which is not a link" in str(caught.value)


def test_a_link_called_world_is_renamed(folder: Path) -> None:
    (folder / "two.urdf").write_text(URDF.replace('"base"', '"world"'))
    assert read_urdf(folder / "two.urdf").links[0].name == "world_link"
    assert build_spec(load_arm(folder)).compile().nbody == 4
    (folder / "two.urdf").write_text(URDF.replace('"lower"', '"world"'))
    (folder / "arm.yaml").write_text(YAML.replace("tool_tip: lower", "tool_tip: world"))
    assert load_arm(folder).tool_tip == "world_link"


@pytest.mark.parametrize("kind", ["stl", "obj", "dae"])
@pytest.mark.parametrize("name", ["part.{}", "package://two/part.{}", "package://two_description/part.{}"])
def test_meshes_become_what_is_seen_and_a_capsule_around_them(folder: Path, kind: str, name: str) -> None:
    part = trimesh.creation.box((0.1, 0.2, 0.6))
    part.apply_translation((0.3, 0, 0))
    (folder / "two_description").mkdir()
    for place in (folder, folder / "two_description"):
        part.export(place / f"part.{kind}")
    scaled = f'{name.format(kind)}" scale="2 1 -1'  # a negative number mirrors
    (folder / "two.urdf").write_text(URDF.replace("part.stl", scaled))
    arm = load_arm(folder)
    scene = mujoco.MjSpec()
    scene.copy_during_attach = True
    for prefix in ("a/", "b/"):
        scene.attach(build_spec(arm), prefix=prefix, frame=scene.worldbody.add_frame())
    assert scene.compile().nmesh == 6

    model = build_spec(arm).compile()
    kinds = model.geom_type[model.geom_group == COLLISION_GROUP].tolist()
    assert kinds == [int(mujoco.mjtGeom.mjGEOM_CAPSULE)] * 2
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hit = np.zeros(1, np.int32)
    seen = mujoco.mj_ray(
        model, data, [2.0, 0.01, 0.05], [-1.0, 0, 0], np.array([0, 0, 1, 0, 0, 0], np.uint8), 1, -1, hit
    )
    assert seen == pytest.approx(2.0 - (0.6 + 0.1), abs=1e-6)  # the box reaches from x = 0.5 to 0.7
    shell = model.geom("shell")
    assert shell.pos == pytest.approx([0.6, 0, 0], abs=1e-6)
    assert shell.size[:2] == pytest.approx([np.hypot(0.1, 0.1), 0.3], abs=1e-6)
    assert {model.geom(i).name for i in np.flatnonzero(model.geom_group == COLLISION_GROUP)} == {
        "shell", "lower_0_shell"}  # fmt: skip


def test_a_dae_says_what_its_unit_is(folder: Path) -> None:
    path = folder / "part.dae"
    trimesh.creation.box((100, 200, 600)).export(path)
    text = re.sub(r"<unit[^>]*/>", "", path.read_text())
    assert "<asset>" in text
    path.write_text(text.replace("<asset>", '<asset><unit name="millimeter" meter="0.001"/>'))
    vertices, _ = read_mesh(path)
    assert np.ptp(vertices, axis=0) == pytest.approx([0.1, 0.2, 0.6])


@pytest.mark.parametrize("up", ["X_UP", "Y_UP", "Z_UP"])
def test_no_axis_of_a_dae_is_turned_up(folder: Path, up: str) -> None:
    """RViz and MoveIt leave `up_axis` out too, so that a robot's meshes are drawn for that."""
    path = folder / "part.dae"
    trimesh.creation.box((0.1, 0.2, 0.6)).export(path)
    text = re.sub(r"<up_axis>.*?</up_axis>", "", path.read_text())
    path.write_text(text.replace("</asset>", f"<up_axis>{up}</up_axis></asset>"))
    assert up in path.read_text()
    assert np.ptp(read_mesh(path)[0], axis=0) == pytest.approx([0.1, 0.2, 0.6])


def test_a_flat_mesh_can_be_seen(folder: Path) -> None:
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]])
    flat.export(folder / "part.stl")
    assert build_spec(load_arm(folder)).compile().nmesh == 3


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 3), min_size=4, max_size=30))
def test_the_bounding_capsule_holds_all_points(numbers: list[tuple[float, float, float]]) -> None:
    points = np.array(numbers)
    shape, place = _bounding_capsule(points)
    radius, half, _ = shape["size"]
    local = (points - place[:3, 3]) @ place[:3, :3]
    local[:, 2] -= np.clip(local[:, 2], -half, half)
    assert np.linalg.norm(local, axis=1).max() <= radius + 1e-9
    assert np.linalg.det(place[:3, :3]) == pytest.approx(1)
    sides = np.ptp(points, axis=0)
    assert sides @ np.abs(place[:3, 2]) == pytest.approx(sides.max())
