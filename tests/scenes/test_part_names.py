"""A link, a joint or a shape may have any name: those of the parts that a scene adds to its model stay apart."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from surgical_marl.robots.arm import load_arm
from surgical_marl.robots.spec import build_spec
from surgical_marl.scenes.check import check
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.mjcf import mjcf
from tests.helpers.samples import INERTIAL, LIMIT

LINKS, JOINTS = ["base", "upper", "left", "right"], ["first", "second", "third", "fourth"]
URDF = """<robot name="two"><link name="{base}"/>
<link name="{upper}">{inertial}<collision name="{shape}"><geometry><sphere radius="0.01"/></geometry></collision></link>
<link name="{left}">{inertial}<collision><geometry><sphere radius="0.01"/></geometry></collision></link>
<link name="{right}">{inertial}<collision name="{shape}"><geometry><sphere radius="0.01"/></geometry></collision></link>
<joint name="{first}" type="revolute"><parent link="{base}"/><child link="{upper}"/><axis xyz="0 1 0"/>{limit}</joint>
<joint name="{second}" type="revolute"><parent link="{upper}"/><child link="{left}"/><origin xyz="0 0 0.5"/>{limit}
</joint>
<joint name="{third}" type="revolute"><parent link="{upper}"/><child link="{right}"/><origin xyz="0 0 0.5"/>{limit}
<mimic joint="{second}"/></joint></robot>
"""
YAML = """urdf: two.urdf
tool_tip: {tip}
joints: {{{first}: {{stiffness: 10, damping: 1, speed: 1}}, {second}: {{stiffness: 10, damping: 1, speed: 1}}}}
jaw: {{joint: {jaw}, open: 1, closed: 0, pads: {{{left}: {{size: [1, 1, 1]}}, {right}: {{size: [1, 1, 1]}}}}}}
cables: {cables}
"""
SCENE = """arms: {{two_0: {{arm: ./two, position: [0, 0, 3]}}}}
objects: {{{name}: {{object: needle_sh}}, floor: {{object: pad, position: [0, 0, -0.5]}}}}
randomisation: {{payload: 0.1}}
"""
OURS = ["payload", "cable_0", "world", "world_link", "tool_tip", "pad", "gear", "overview", "field", "left",
        "right", "left_0", "upper_0", "right_0", "upper_0_right_0", "right_0_left_0", "tissue", "two_0", "contact",
        "reward_a"]  # fmt: skip
"""Names of the model's own parts, and of what they are made with."""


def write(folder: Path, links: list[str], joints: list[str], shape: str, jaw: int, name: str) -> Path:
    """Write a scene of one arm with these names and an object."""
    (folder / "two").mkdir(exist_ok=True)
    named = dict(zip(LINKS, links, strict=True)) | dict(zip(JOINTS, joints, strict=True))
    cables = "[]" if jaw else f"[{{joints: {{{joints[0]}: 1, {joints[1]}: 1}}, stiffness: 1, damping: 1, effort: 1}}]"
    (folder / "two/two.urdf").write_text(URDF.format(**named, shape=shape, inertial=INERTIAL, limit=LIMIT))
    text = YAML.format(**named, tip=links[1 + jaw], jaw=joints[1], cables=cables)
    (folder / "two/arm.yaml").write_text(text if jaw else text.replace("jaw: ", "description: x # "))
    (folder / "scene.yaml").write_text(SCENE.format(name=name))
    return folder / "scene.yaml"


@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(["payload", "upper", "left", "right"], ["cable_0", "second", "third", "fourth"], "left_0", 0, "needle")
@example(["world", "upper_0", "left", "left_0"], ["payload", "payload_", "gear", "pad"], "left/pad", 1, "payload")
@example(["world", "world_link", "left", "right"], ["first", "second", "third", "fourth"], "shell", 0, "needle")
@example(["base", "world", "payload", "right"], ["world", "cable_0", "cable_1", "first"], "right_0", 1, "cable_0")
@given(
    links=st.lists(st.sampled_from([*OURS, *LINKS]), min_size=4, max_size=4, unique=True),
    joints=st.lists(st.sampled_from([*OURS, *JOINTS]), min_size=4, max_size=4, unique=True),
    shape=st.sampled_from(["shell", "left/pad", "left/0", *OURS]),
    jaw=st.integers(0, 1),
    name=st.sampled_from(OURS),
)
def test_any_name_is_a_users(
    tmp_path: Path, links: list[str], joints: list[str], shape: str, jaw: int, name: str
) -> None:
    path = write(tmp_path, links, joints, shape, jaw, name)
    if {"world", "world_link"} <= set(links):
        with pytest.raises(ValueError, match=r"2 links are called 'world_link'.*'world', which MuJoCo reserves"):
            load_scene(path)
    elif name in ("world", "tissue", "two_0", "contact", "reward_a"):
        with pytest.raises(ValueError, match=f"{name} is taken"):
            load_scene(path)
    else:
        scene = load_scene(path)
        model = mujoco.MjModel.from_xml_string(mjcf(scene))
        for link in links:
            assert model.body(f"two_0/{'world_link' if link == 'world' else link}").id > 0
        for joint in joints[:3]:
            assert model.joint(f"two_0/{joint}").id == scene.model.joint(f"two_0/{joint}").id
        assert build_spec(load_arm(tmp_path / "two")).compile().nbody == 5


@pytest.mark.parametrize("link", ["left/pad", "/left", "left/contact"])
@pytest.mark.parametrize("joint", ["first", "second/gear"])
def test_a_slash_is_kept_for_parts(tmp_path: Path, link: str, joint: str) -> None:
    write(tmp_path, ["base", "upper", link, "right"], [joint, "second", "third", "fourth"], "shell", 0, "needle")
    findings = check(tmp_path / "two")
    for noun, name in (("link", link), ("joint", joint)):
        words = f"{noun} {name!r} has a slash in its name, as only parts of the model have; call it "
        assert sum(words + repr(name.replace("/", "_")) in finding for finding in findings) == ("/" in name)
    assert len(findings) == 1 + ("/" in joint)
