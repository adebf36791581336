"""Random files: each loader reads them, or says in one sentence why not. What was found is kept as examples.

`FUZZ=2000 make test ARGS="tests/untrusted/test_fuzz.py"` tries that many of each instead of a few.
"""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from safetensors.torch import save

from surgical_marl import load_arm
from surgical_marl.evaluation.command import read_result
from surgical_marl.evaluation.evaluate import read_played
from surgical_marl.policies.actor import _read
from surgical_marl.report.run import read_run
from surgical_marl.robots.mesh import read_mesh
from surgical_marl.robots.spec import build_spec
from surgical_marl.runs.settings import load_config, read_config
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.objects import load_object
from surgical_marl.untrusted.arrays import read_npz
from surgical_marl.untrusted.values import as_number, shown
from surgical_marl.yaml_file import parse_yaml
from tests.helpers.loaders import one_sentence
from tests.helpers.samples import SCENE, SETTINGS
from tests.robots.test_urdf import URDF, YAML
from tests.untrusted.test_untrusted import OBJECT

COUNT = int(os.environ.get("FUZZ", 15))
fuzz = settings(max_examples=COUNT, deadline=None, derandomize=COUNT <= 15, suppress_health_check=list(HealthCheck))

SIMPLE = URDF.replace('<mesh filename="part.stl"/>', '<sphere radius="0.05"/>')
edges = st.sampled_from(
    [0, -1, 10**400, -(10**400), 10**4000, 1e300, -1e300, 1e-300, float("nan"), float("inf"), True, None, "", "1e5",
     "~x", "a" * 300, "\0", "\n", "..", "/dev/zero", "psm", [], {}, [[]], [1, 2, 3], {"a": 1}]
)  # fmt: skip
values = st.recursive(
    edges | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


def text_of(value: Any) -> str:
    with contextlib.suppress(ValueError):  # a number that Python does not write out
        return str(yaml.safe_dump(value, width=10**9))
    return "1" * 5001


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where there is a value in nested lists and mappings."""
    found = [path]
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        found += places(inner, (*path, key))
    return found


def with_value(whole: Any, path: tuple[Any, ...], value: Any) -> Any:
    if not path:
        return value
    copy = dict(whole) if isinstance(whole, dict) else list(whole)
    copy[path[0]] = with_value(whole[path[0]], path[1:], value)
    return copy


def changed(text: str) -> st.SearchStrategy[str]:
    """A YAML text with another value in one place."""
    whole = yaml.safe_load(text)
    return st.builds(
        lambda path, value: text_of(with_value(whole, path, value)), st.sampled_from(places(whole)), values
    )


def damaged(data: bytes) -> st.SearchStrategy[bytes]:
    """A file that ends early, with other bytes in some places."""
    spot = st.tuples(st.integers(0, len(data) - 1), st.binary(min_size=1, max_size=8))

    def damage(end: int, spots: list[tuple[int, bytes]]) -> bytes:
        copy = bytearray(data)
        for start, new in spots:
            copy[start : start + len(new)] = new
        return bytes(copy[:end])

    return st.builds(damage, st.integers(0, len(data)) | st.just(len(data)), st.lists(spot, max_size=4))


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """An arm, an object and a scene of them."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "two").mkdir()
        write_arm(folder, YAML, SIMPLE)
        (folder / "ball.yaml").write_text(OBJECT)
        (folder / "scene.yaml").write_text(SCENE)
        load_scene(folder / "scene.yaml")
        yield folder


def write_arm(folder: Path, text: str, urdf: str) -> None:
    (folder / "two" / "arm.yaml").write_text(text, errors="replace")
    (folder / "two" / "two.urdf").write_text(urdf, errors="replace")


@fuzz
@example("1:1:1:1:1:1:1:1.5")
@example("!!int ''")
@example("!!timestamp x")
@example("? [a]\n: 1")
@example("0001-01-01T00:00:00+99:99")
@example("{<<: 3}")
@example("'\\ud800'")
@given(st.text(max_size=200) | changed(SCENE))
def test_yaml(text: str) -> None:
    with one_sentence():
        parse_yaml(text)


@fuzz
@given(changed(SCENE))
def test_scenes(folder: Path, text: str) -> None:
    write_arm(folder, YAML, SIMPLE)
    (folder / "scene.yaml").write_text(text)
    with one_sentence():
        load_scene(folder / "scene.yaml")


@fuzz
@given(changed(OBJECT))
def test_objects(folder: Path, text: str) -> None:
    (folder / "own.yaml").write_text(text)
    with one_sentence():
        load_object(folder / "own.yaml")


JAW = """jaw: {joint: first, open: 1, closed: 0, pads: {upper: {size: [1, 1, 1]}}}
camera: {link: lower, fovy: 60, baseline: 0.1}"""
CABLES = "cables: [{joints: {first: 1, second: 2}, stiffness: 1, damping: 1, effort: 1}]"


@fuzz
@given(changed(f"{YAML}{CABLES}\n") | changed(f"{YAML}{JAW}\n"))
def test_arms(folder: Path, text: str) -> None:
    write_arm(folder, text, SIMPLE)
    with one_sentence():
        build_spec(load_arm(folder / "two"), pads=True).compile()


ATTRIBUTES = [part for part in SIMPLE.split('"')[1::2] if part not in ("1.0", "two")]


@fuzz
@given(
    st.sampled_from(sorted(set(ATTRIBUTES))),
    st.text(max_size=10) | values.map(shown) | st.sampled_from(["1e300", "0 0 1e-300", "0 0 0", "-1", "world", "base"]),
    st.integers(1, 3),
)
@example("first", "\x7f", 1)
def test_urdfs(folder: Path, old: str, new: str, count: int) -> None:
    new = new.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    write_arm(folder, YAML, SIMPLE.replace(f'"{old}"', f'"{new}"', count))
    with one_sentence():
        build_spec(load_arm(folder / "two")).compile()


@fuzz
@given(damaged(SIMPLE.encode()))
def test_damaged_urdfs(folder: Path, data: bytes) -> None:
    write_arm(folder, YAML, "")
    (folder / "two" / "two.urdf").write_bytes(data)
    with one_sentence():
        build_spec(load_arm(folder / "two")).compile()


@fuzz
@given(changed(SETTINGS))
def test_configs(folder: Path, text: str) -> None:
    (folder / "config.yaml").write_text(text)
    for read in (read_config, lambda path: read_run(path.parent)):
        with one_sentence():
            read(folder / "config.yaml")


@fuzz
@given(
    st.sampled_from(["num_envs", "ppo.gamma", "ppo", "network.hidden", "observe", "max_steps", "a", "ppo.a"]),
    values.map(text_of) | st.text(max_size=50),
)
def test_overrides(key: str, text: str) -> None:
    with one_sentence():
        load_config("reach", "psm", [f"{key}={text}"])


def npz() -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, about=np.array("{}"), error=np.zeros((2, 1)))
    return file.getvalue()


def checkpoint() -> bytes:
    file = io.BytesIO()
    state = {"actor_state_dict": {"a": torch.zeros(2)}}
    torch.save({"iteration": 1, "groups": {"psm": [1, 2, 3]}, "algorithm": state}, file)
    return file.getvalue()


def mesh(kind: str) -> bytes:
    made = trimesh.creation.box((0.1, 0.2, 0.6)).export(file_type=kind)
    return made.encode() if isinstance(made, str) else bytes(made)


WEIGHTS = save({"a": torch.zeros(2)}, metadata={"agents": "1", "observation": "2", "action": "3"})
FILES: dict[str, tuple[bytes, Callable[[Path], Any]]] = {
    "psm.safetensors": (WEIGHTS, lambda path: _read(path.parent)),
    "checkpoint.pt": (checkpoint(), lambda path: _read(path.parent)),
    "some.npz": (npz(), read_npz),
    "episodes.npz": (npz(), read_played),
    "eval.json": (b'{"episodes": 1, "agents": {}, "intervals": {"a": [1, 2]}}', read_result),
    "metrics.csv": (b"iteration,a\r\n1,2.5\r\n2,\r\n", lambda path: read_run(path.parent)),
    "part.stl": (mesh("stl"), read_mesh),
    "ascii.stl": (mesh("stl_ascii"), read_mesh),
    "part.obj": (mesh("obj"), read_mesh),
}


@pytest.mark.parametrize("name", FILES)
def test_damaged_files(name: str, tmp_path: Path) -> None:
    data, read = FILES[name]
    (tmp_path / "config.yaml").write_text(SETTINGS)

    @fuzz
    @given(damaged(data))
    def check(bad: bytes) -> None:
        (tmp_path / name).write_bytes(bad)
        with one_sentence():
            read(tmp_path / name)

    check()


@fuzz
@given(values)
def test_values(value: Any) -> None:
    assert len(shown(value)) <= 200
    assert isinstance(as_number(value, words=True), float)
