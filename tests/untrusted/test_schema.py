"""Each field of each file: a value of another type is one sentence that names the file, the line and the key."""

from __future__ import annotations

import re
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, is_dataclass
from pathlib import Path
from typing import Any, Union, get_args, get_origin

import pytest

import surgical_marl as sm
from surgical_marl.cli.main import main
from surgical_marl.content import list_configs
from surgical_marl.plugins.tasks import scene_of
from surgical_marl.robots.arm import ArmFile
from surgical_marl.runs.settings import load_config, read_config
from surgical_marl.scenes.load import SceneFile
from surgical_marl.scenes.objects import ObjectFile
from surgical_marl.scenes.thread_file import ThreadFile
from surgical_marl.scenes.tissue_file import TissueFile
from surgical_marl.untrusted.schema import Faults, Place, check, fields_of
from surgical_marl.yaml_file import dump_yaml, parse_yaml, read_as

OTHERS = {"text": "qpos", "number": 5, "fraction": 0.5, "list": [[]], "mapping": {"a b": 1}, "bool": True, "null": None}
LOOK = "colour: [1, 0, 0], material: steel"
SAMPLES = {
    ArmFile: """
urdf: a.urdf
tool_tip: tip
description: an arm
remote_center: shaft
camera: {link: eye, fovy: 60, baseline: 0.006}
joints:
  yaw: {stiffness: 1, damping: 1, speed: 1, armature: 0, home: 0, margin: 0}
cables:
  - {joints: {yaw: 1, pitch: -1}, stiffness: 1, damping: 1, effort: 1, armature: 0}
tip_speed: {translation: 1, rotation: 1}
jaw:
  joint: grip
  open: 1
  closed: 0
  pads: {finger: {size: [1, 1, 1], position: [0, 0, 0], tilt: [0, 0, 0]}}
tools: {driver: {}, forceps: {tool_tip: other}}
""",
    SceneFile: """
description: a scene
arms:
  psm_0: {arm: psm, position: [0, 0, 0], turn: 0, tilt: [0, 0, 0], workspace: [0, 0, 0], tool: driver}
view: {position: [1, 0, 0], target: [0, 0, 0]}
tissue:
  liver: {shape: box, size: [1, 1, 1], colour: [1, 0, 0], position: [0, 0, 0], tilt: [0, 0, 0]}
objects:
  pad: {object: pad, position: [0, 0, 0], tilt: [0, 0, 0], colour: [1, 0, 0],
        tied: {first: world, last: pad}}
attachments:
  weld: {body: pad, link: psm_0/tip, active: true}
systems:
  beads: {type: bead_string}
randomisation:
  {offset_angle: 0, offset_slide: 0, backlash_angle: 0, backlash_slide: 0, noise_angle: 0, noise_slide: 0, stiffness: 0,
   damping: 0, friction: 0, payload: 0, latency: 0, object_shift: 0, object_turn: 0, object_size: 0, object_mass: 0,
   object_friction: 0, thread_stiffness: 0, thread_friction: 0, tissue_stiffness: 0, tissue_friction: 0}
observe: {psm_0: [qpos]}
""",
    ObjectFile: f"""
description: an object
free: false
mass: null
density: null
friction: {{sliding: 1, torsion: 0}}
stiffness: 1
colour: [1, 0, 0]
material: steel
shapes:
  - sphere: {{radius: 1, position: [0, 0, 0], {LOOK}}}
  - capsule: {{radius: 1, from: [0, 0, 0], to: [0, 0, 1], {LOOK}}}
  - box: {{size: [1, 1, 1], position: [0, 0, 0], tilt: [0, 0, 0], {LOOK}}}
  - plane: {{position: [0, 0, 0], tilt: [0, 0, 0], {LOOK}}}
  - arc: {{radius: 1, wire: 0.1, degrees: 90, segments: 2, position: [0, 0, 0], tilt: [0, 0, 0], {LOOK}}}
sites:
  tip: {{position: [0, 0, 0], tilt: [0, 0, 0]}}
""",
    ThreadFile: """
kind: thread
description: a thread
length: 0.1
diameter: 0.0002
material: null
young: 1.0e+9
density: 1000
nodes: 40
friction: {sliding: 1, torsion: 0}
stiffness: 1000
drag: 1
strength: 1
coil: {radius: 0.01, pitch: 0.001}
colour: [1, 0, 0]
""",
    TissueFile: """
kind: tissue
description: a sheet with a hole
size: [0.03, 0.02, 0.005]
cells: [3, 2, 1]
grid: ["###", "#.#"]
young: 30000
poisson: 0.4
density: 1000
damping: 0.002
fixed: [left]
springs: {right: 1.0e+6}
friction: {sliding: 1, torsion: 0}
stiffness: 5000
tears: 2
channels: {most: 1, puncture: 1, cutting: 1, friction: 1, thread_friction: 1, stiffness: 1000, spacing: 0.001}
colour: [1, 0, 0]
""",
}


def good_types(kind: Any) -> set[str]:
    """Names of `OTHERS` whose type a field takes."""
    if kind is Any:
        return set(OTHERS)
    if get_origin(kind) in (Union, types.UnionType):
        return {"null", *good_types(get_args(kind)[0])}
    if is_dataclass(kind):
        fields = [item for item, _ in fields_of(kind).values()]
        needs = any(item.default is item.default_factory is MISSING for item in fields)
        return {"mapping"} if needs else {"mapping", "null"}
    if get_origin(kind) in (dict, Mapping):
        return {"mapping", "null"}
    if get_origin(kind) in (tuple, Sequence):
        return {"list"}
    plain: dict[Any, set[str]] = {str: {"text"}, bool: {"bool"}, int: {"number"}, float: {"number", "fraction"}}
    return plain.get(kind, set())  # none is one of a few words


def places(kind: Any, value: Any, *keys: str | int) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """All keys of a document that lead to a value with a type of its own, and that type."""
    if get_origin(kind) in (Union, types.UnionType):
        kind = get_args(kind)[0]
    if is_dataclass(kind):
        for key, (_, hint) in fields_of(kind).items():
            if key in value:  # each shape has one of its kinds
                yield (*keys, key), hint
                yield from places(hint, value[key], *keys, key)
    elif isinstance(value, (dict, list)) and kind is not Any:
        inner = get_args(kind)[1] if isinstance(value, dict) else get_args(kind)[0]
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            if inner is not float or isinstance(value, dict):  # a vector is one value
                yield (*keys, key), inner
                yield from places(inner, part, *keys, key)


def named(kind: type, value: Any) -> set[tuple[Any, str]]:
    """The dataclasses that a document has fields of, with those fields."""
    found = set()
    for keys, hint in [((), kind), *places(kind, value)]:
        whole = value
        for key in keys:
            whole = whole[key]
        inner = get_args(hint)[0] if get_origin(hint) in (Union, types.UnionType) else hint
        if is_dataclass(inner) and whole is not None:
            found |= {(inner, key) for key in whole}
    return found


@pytest.mark.parametrize("kind", list(SAMPLES))
def test_the_samples_have_all_fields(kind: type) -> None:
    found = named(kind, parse_yaml(SAMPLES[kind]))
    assert found == {(part, key) for part in {part for part, _ in found} for key in fields_of(part)}


@pytest.mark.parametrize("kind", list(SAMPLES))
def test_a_value_of_another_type_is_one_sentence(kind: type, tmp_path: Path) -> None:
    path, tried = tmp_path / "own.yaml", 0
    sample = parse_yaml(SAMPLES[kind])
    assert check(Place(), sample, kind) is not None
    for keys, hint in places(kind, sample):
        for name in OTHERS.keys() - good_types(hint):
            tree = parse_yaml(SAMPLES[kind])
            whole = tree
            for key in keys[:-1]:
                whole = whole[key]
            whole[keys[-1]] = OTHERS[name]
            path.write_text(dump_yaml(tree))
            with pytest.raises(ValueError) as caught:
                read_as(kind, path)
            sentence, key = str(caught.value), ".".join(map(str, keys))
            said = re.fullmatch(rf"{re.escape(str(path))}, line (\d+): {re.escape(key)} must .*", sentence)
            assert said, (name, sentence)
            line = path.read_text().splitlines()[int(said[1]) - 1]
            assert f"{keys[-1]}:" in line or isinstance(keys[-1], int), (sentence, line)
            tried += 1
    assert tried > 80


def test_all_faults_of_a_file_are_listed(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text("free: 1\nfriction: {sliding: x}\nshapes: [{ball: {}}]\n")
    with pytest.raises(Faults) as caught:
        sm.load_object(tmp_path / "own.yaml")
    own = f"{tmp_path / 'own.yaml'}"
    assert caught.value.faults == [
        f"{own} lacks stiffness",
        f"{own}, line 1: free must be true or false, not 1",
        f"{own}, line 2: friction lacks torsion",
        f"{own}, line 2: friction.sliding must be a number from 0 to 1,000,000,000, not 'x'",
        f"{own}, line 3: shapes.0: unknown key 'ball'; the keys are capsule, sphere, box, plane, arc",
    ]


@pytest.mark.parametrize("value", [{"arms": {}}, b"psm", 3, ["psm"], True])
def test_a_name_that_is_none_is_one_sentence(value: Any) -> None:
    for load in (sm.load_scene, sm.load_arm, sm.load_object, lambda bad: sm.parallel_env("reach", scene=bad)):
        with pytest.raises(ValueError, match=r"^the (scene|arm|object) must be a name or a path, not ") as caught:
            load(value)
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="the scene must be a name or a path"):
        load_config("reach", value)


def test_no_scene_is_the_tasks_own() -> None:
    for task in ("reach", "match_image"):
        env = sm.parallel_env(task, scene=None)
        assert env.batch.scene.name == scene_of(task)
        env.close()


@pytest.mark.parametrize("text", ["Dear reader,\nthis is: no: scene\n", "a text", "- 1\n- 2\n", "a: 1\na: 2\n"])
def test_check_of_a_file_that_is_no_mapping_is_bad_input(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.txt").write_text(text)
    assert main(["check", str(tmp_path / "notes.txt")]) == 2
    out, err = capsys.readouterr()
    assert not out and err.startswith(f"surgical-marl: {tmp_path / 'notes.txt'}") and err.count("\n") == 1
    assert "YAML" in err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("num_envs: 1e3", "line 3: num_envs must be a whole number from 1 to 16,777,216, not 1000.0"),
        ("ppo: {gamma: high}", "line 3: ppo.gamma must be a number from 0 to 1, not 'high'"),
        ("ppo:\n  gama: 1", "line 3: ppo: unknown setting 'ppo.gama'; did you mean 'ppo.gamma'?"),
        ("network: {hidden: [8, 8.5]}", "line 3: network.hidden.1 must be a whole number from 1 to 65,536, not 8.5"),
        (
            "reward: {collision: '-1'}",
            "line 3: reward.collision must be a number from -1,000,000 to 1,000,000, not '-1'",
        ),
        ("seed: 1\nseed: 2", "line 4 is not valid YAML: the key 'seed' is given twice, first in line 3"),
    ],
)
def test_settings_of_a_file_are_named_with_their_line(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(f"task: reach\nscene: psm\n{text}\n")
    with pytest.raises(ValueError) as caught:
        read_config(path)
    assert str(caught.value) == f"{path}, {words}"


@pytest.mark.parametrize("section", ["{}", "cuda: {{{}}}", "starts: {{random: {{cuda: {{{}}}}}}}",
                                     "scenes: {{psm: {{difficulties: {{hard: {{{}}}}}}}}}"])  # fmt: skip
def test_sections_that_are_not_used_are_checked_too(
    section: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("surgical_marl.runs.settings.find", lambda *_: tmp_path / "reach.yaml")
    (tmp_path / "reach.yaml").write_text(section.format("num_envs: few"))
    with pytest.raises(ValueError, match=r"reach.yaml, line 1: \S*num_envs must be a whole number .* not 'few'"):
        load_config("reach", "psm")


def test_settings_that_ship_are_of_their_types() -> None:
    for task in list_configs():
        assert load_config(task, scene_of(task)).task == task
