"""Scenes, arms, objects and settings of strangers: what is too large, too deep or no file is one sentence, soon."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import surgical_marl as sm
from surgical_marl.cli.main import main
from surgical_marl.content import find
from surgical_marl.robots.spec import build_spec
from surgical_marl.runs.settings import load_config, read_config
from surgical_marl.scenes.check import check
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.objects import load_object
from surgical_marl.untrusted.values import as_number, shown
from tests.robots.test_urdf import URDF, YAML

LONG = "1" + "0" * 399
ARMS = "arms: {psm_0: {arm: psm}}\n"
OBJECT = """free: true
mass: 0.01
friction: {sliding: 0.5, torsion: 0.001}
stiffness: 1.0e+5
shapes: [{sphere: {radius: 0.01}}]
"""
ENDS = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'


def refused(read: Callable[[], Any]) -> str:
    """The one sentence of the error; other libraries must not have warned before."""
    with warnings.catch_warnings(), pytest.raises(ValueError) as caught:
        warnings.simplefilter("error")
        read()
    sentence = str(caught.value)
    assert "\n" not in sentence and 20 < len(sentence) < 2000
    return sentence


def tissue(**piece: Any) -> str:
    return f"{ARMS}tissue: {{liver: { ({'shape': 'box', 'size': [1, 1, 1], 'colour': [1, 0, 0]} | piece) }}}"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        # numbers
        (f"arms: {{psm_0: {{arm: psm, turn: {LONG}}}}}", "400 characters; write at most 100"),
        (f"{ARMS}randomisation: {{latency: {LONG}}}", "400 characters"),
        (f"{ARMS}randomisation: {{payload: {'1:' * 300}0.5}}", "payload must be a number from 0 to 1"),
        (f"arms: {{psm_0: {{arm: psm, turn: {'9' * 100}}}}}", "from -1,000 to 1,000"),
        ("arms: {psm_0: {arm: psm, position: [1.0e+30, 0, 0]}}", "from -1,000 to 1,000"),
        (f"{ARMS}randomisation: {{payload: 1.0e+300}}", "payload must be a number from 0 to 1,000,000,000 (kg)"),
        (f"{ARMS}randomisation: {{latency: fast}}", "from 0 to 50 (control steps), not 'fast'"),
        (f"{ARMS}randomisation: {{latency: [1]}}", "from 0 to 50 (control steps), not [1]"),
        (f"{ARMS}randomisation: {{latency: null}}", "from 0 to 50 (control steps), not None"),
        (f"{ARMS}randomisation: {{latency: -1}}", "from 0 to 50 (control steps), not -1"),
        (tissue(shape=["box"]), "shape must be one of ellipsoid, box, capsule, not ['box']"),
        (tissue(shape={"box": 1}), "shape must be one of ellipsoid, box, capsule, not {'box': 1}"),
        (tissue(size=[1e300, 1, 1]), "from 1e-06 to 1,000 (m), not 1e+300"),
        (tissue(size=[1e-300, 1, 1]), "tissue.liver.size.0 must be a number from 1e-06 to 1,000 (m), not 1e-300"),
        # names
        (f"arms: {{psm_0: {{arm: {'a' * 5000}}}}}", "unknown arm 'aaa"),
        ("arms: {psm_0: {arm: ~nobody}}", "unknown arm '~nobody'"),
        ('arms: {psm_0: {arm: "psm\\0"}}', "unknown arm 'psm\\x00'"),
        (f"{ARMS}objects: {{one: {{object: {'a' * 5000}}}}}", "unknown object 'aaa"),
        (f"arms: {{{'a' * 201}: {{arm: psm}}}}", "201 characters, more than 200"),
        # sizes and counts
        (f"{ARMS}view: [{'1,' * 1_000_000}]", "is larger than 1 MB"),
        (f"{ARMS}view: [{'[],' * 60_000}]", "more than 50,000 values are not read"),
        (f"{ARMS}view: {'[' * 100_000}", "nested deeper than 32"),
        ("arms:\n" + "".join(f"  psm_{k}: {{arm: psm}}\n" for k in range(33)), "33 arms are too many; at most 32"),
        (f"{ARMS}tissue: {{{', '.join(f't{k}: 1' for k in range(201))}}}", "201 pieces of tissue are too many"),
        (f"{ARMS}objects: {{{', '.join(f't{k}: 1' for k in range(51))}}}", "51 objects are too many"),
        # what YAML can also do
        ("arms: !!int ''", "the tag"),
        ("arms: &a [*a]", "an alias"),
        ("arms: !!timestamp x", "the tag"),
    ],
)  # fmt: skip
def test_scenes(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "own.yaml").write_text(text)
    assert words in refused(lambda: load_scene(tmp_path / "own.yaml"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("mass: 0.01", f"mass: {LONG}", "400 characters"),
        ("mass: 0.01", "mass: 1.0e+308", "mass must be a number from 1e-12 to 1,000,000,000 (kg), not 1e+308"),
        ("mass: 0.01", "mass: 1.0e+9", "must weigh from 1e-12 to 1e+06 kg"),
        ("radius: 0.01", "radius: 1.0e+300", "radius must be a number from 1e-06 to 1,000 (m), not 1e"),
        ("radius: 0.01", "radius: 1.0e-300", "radius must be a number from 1e-06 to 1,000 (m), not 1e"),
        ("sliding: 0.5", "sliding: 1.0e+10", "sliding must be a number from 0 to 1,000,000,000, not 10000000000.0"),
        ("shapes: [", f"shapes: [{'{sphere: {radius: 0.01}}, ' * 400}", "401 shapes are too many"),
        ("shapes: [", f"shapes: [{'{arc: {radius: 1, wire: 0.1, degrees: 90, segments: 360}}, ' * 2}",
         "721 shapes are too many"),
        ("free: true", f"free: {'x' * 5000}", "free must be true or false, not 'xxx"),
    ],
)  # fmt: skip
def test_objects(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in OBJECT
    (tmp_path / "own.yaml").write_text(OBJECT.replace(old, new))
    assert words in refused(lambda: load_object(tmp_path / "own.yaml"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An arm of two joints."""
    folder = tmp_path / "two"
    folder.mkdir()
    (folder / "two.urdf").write_text(URDF.replace('<mesh filename="part.stl"/>', '<sphere radius="0.1"/>'))
    (folder / "arm.yaml").write_text(YAML)
    build_spec(sm.load_arm(folder))
    return folder


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('value="1"', 'value="1e308"', "of <mass> must be 1 number, finite and not negative, from 0 to 1e+09"),
        ('value="1"', f'value="{LONG}"', "of <mass> must be 1 number"),
        ('size="0.1 0.2 0.4"', 'size="1e300 0.2 0.4"', "of <box> must be 3 numbers"),
        ('size="0.1 0.2 0.4"', 'size="1e-300 0.2 0.4"', "from 1e-06 to 1000"),
        ('xyz="0 0 0.5"', 'xyz="0 0 1e30"', "of <origin> must be 3 numbers, finite, from -1000 to 1000"),
        ('xyz="0 1 0"', 'xyz="0 1e-300 0"', "not all 0"),
        ('upper="1"', 'upper="1e300"', "of <limit>"),
        ('<link name="lower">', f'<link name="lower">{ENDS * 199}', "201 collisions; at most 200 links"),
        ("</robot>", '<link name="l"/>' * 20_000 + "</robot>", "20,003 links; at most 200 links"),
        ("</robot>", "<a/>" * 60_000 + "</robot>", "more than 50,000 elements are not read"),
        ('name="upper"', f'name="{"a" * 5000}"', "name' has 5,000 characters"),
        ("<robot", f"<{'a' * 5000}", "not a URDF"),
    ],
)  # fmt: skip
def test_urdfs(folder: Path, old: str, new: str, words: str) -> None:
    text = (folder / "two.urdf").read_text()
    assert old in text
    text = text.replace(old, new)
    (folder / "two.urdf").write_text(text if "<robot" in text else text.replace("</robot>", f"</{'a' * 5000}>"))
    assert words in refused(lambda: sm.load_arm(folder))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("stiffness: 10", f"stiffness: {LONG}", "400 characters"),
        ("stiffness: 10", "stiffness: 1.0e+300", "from 0 to 1,000,000,000, not 1e+300"),
        ("urdf: two.urdf", f"urdf: {'a' * 5000}", "there is no URDF file 'aaa"),
        ("urdf: two.urdf", 'urdf: "a\\0"', "is not a name that a file can have"),
        ("urdf: two.urdf", "urdf: circle.urdf", "is not a name that a file can have"),
        ("tool_tip: lower", "tool_tip: [lower]", "tool_tip must be a text, not ['lower']"),
        ("tool_tip: lower", "tool_tip: lower\njaw: {joint: [first], open: 1, closed: 0}", "joint must be a text"),
        ("tool_tip: lower", "tool_tip: lower\ncamera: {link: {}, fovy: 1, baseline: 0}", "link must be a text"),
    ],
)
def test_arms(folder: Path, old: str, new: str, words: str) -> None:
    (folder / "circle.urdf").symlink_to("circle.urdf")
    (folder / "arm.yaml").write_text(YAML.replace(old, new, 1))
    assert words in refused(lambda: sm.load_arm(folder))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        (f"ppo.gamma={LONG}", "from 0 to 1, not '1000"),
        (f"num_envs={LONG}", "from 1 to 16,777,216, not '1000"),
        (f"num_envs={'1' * 5000}", "from 1 to 16,777,216, not '1111"),
        (f"ppo.gamma={'[' * 1000}{']' * 1000}", "from 0 to 1, not '[[["),
        (f"ppo.gamma={'x' * 3600}", "from 0 to 1, not 'xxx"),
        ("x" * 3600 + "=1", "unknown setting 'xxx"),
        ("x" * 3600, "is not an override"),
        (f"observe={{psm_0: [{'qpos, ' * 101}]}}", "101 names are too many"),
        (f"network.hidden=[{'8,' * 33}]", "network.hidden must have at most 32 layers, not 33"),
        (f"network.hidden=[{'8,' * 5000}]", "5,000 whole numbers are too many"),
        (f"network.hidden=[{'65536,' * 8}]", "weights between its layers; at most 50,000,000"),
        ("network={hidden: [8192], recurrent: lstm}", "weights between its layers"),
    ],
)
def test_settings(override: str, words: str) -> None:
    assert words in refused(lambda: load_config("reach", "psm", [override]))


def test_numbers_of_the_interfaces() -> None:
    for option in ({"max_steps": 10**400}, {"reward": {"collision": -(10**400)}}, {"decimation": [[]] * 10**6}):
        refused(lambda option=option: sm.parallel_env("reach", scene="psm", **option))


@pytest.mark.parametrize("name", ["a" * 5000, "~nobody", "a\0b", "", "/dev/zero", "/dev/full/a"])
def test_names_that_no_file_can_have(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    for kind in ("arms", "scenes", "objects", "policies"):
        refused(lambda kind=kind: find(kind, name))
    refused(lambda: check(name))
    for command in (["check"], ["eval"], ["report"], ["train", "reach", "--scene"], ["play", "reach", "--scene"]):
        assert main([*command, name]) == 2
        out, err = capsys.readouterr()
        assert not out and err.startswith("surgical-marl: ") and err.count("\n") == 1
        assert len(re.sub(r"choose from [^)]*", "", err)) < 500


SPECIAL = """
import os, resource, sys
from pathlib import Path
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.objects import load_object
from surgical_marl import load_arm
from surgical_marl.runs.settings import read_config
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
read = {"arm": load_arm, "scene": load_scene, "object": load_object, "config": read_config}
for path in map(Path, sys.argv[1:]):
    try:
        read[path.stem](path)
    except ValueError as error:
        print(error)
"""


def test_pipes_and_devices_are_not_read(folder: Path, tmp_path: Path) -> None:
    """In a process of its own, which would wait for ever, or take all memory."""
    paths = []
    for kind in ("fifo", "zero"):
        own = tmp_path / kind
        for name in ("arm", "urdf"):
            (own / name / "arm").mkdir(parents=True)
        paths += [own / "arm" / "arm", own / "urdf" / "arm"]
        (own / "urdf" / "arm" / "arm.yaml").write_text(YAML)
        for name in ("scene", "object", "config"):
            (own / name).mkdir()
            paths.append(own / name / f"{name}.yaml")
        specials = [own / "arm/arm/arm.yaml", own / "urdf/arm/two.urdf", *paths[-3:]]
        for path in specials:
            os.mkfifo(path) if kind == "fifo" else path.symlink_to("/dev/zero")
    command = [sys.executable, "-c", SPECIAL, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert not done.stderr and len(lines := done.stdout.splitlines()) == len(paths)
    good = "a pipe or a device", "unknown ", "there is no URDF file", "leaves the arm's folder"
    assert all(any(words in line for words in good) for line in lines), lines


def test_values_in_errors_are_short() -> None:
    deep: Any = 1
    for _ in range(100_000):
        deep = [deep]
    for value in (deep, "x" * 10**7, 10**9_000, -(10**400), [1] * 10**6, {k: [k] * 99 for k in range(9_999)}, {1}):
        assert len(shown(value)) <= 200
    for value in ("a", 1, -1.5, None, [1, "b"], {"b": 1, "a": [None]}, (1,), 10**30, True):
        assert shown(value) == repr(value)
    assert shown(-(10**400)) == "-10000... (a whole number of 401 digits)"


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
        max_leaves=8,
    )
)
def test_any_value_is_shown_shortly_and_read_as_a_number(value: Any) -> None:
    assert len(shown(value)) <= 200
    assert isinstance(as_number(value, words=True), float)


def test_a_setting_may_be_written_as_before(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("task: reach\nscene: psm\nppo: {gamma: 9e-1, learning_rate: 1e-3}\ndifficulty: 2001-01-01\n")
    settings = read_config(path)
    assert (settings.ppo.gamma, settings.ppo.learning_rate, settings.difficulty) == (0.9, 1e-3, "2001-01-01")
