"""Policies, checkpoints, results, episodes and meshes of strangers: data, of limited size, within their folder."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pickle
import shutil
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from surgical_marl.content import find
from surgical_marl.evaluation.command import read_result
from surgical_marl.evaluation.evaluate import read_played
from surgical_marl.policies.actor import _read
from surgical_marl.policies.weights import read_weights
from surgical_marl.report.run import read_run
from surgical_marl.robots.mesh import read_mesh
from surgical_marl.runs.checkpoint import read_checkpoint, read_environments, write_environments
from surgical_marl.runs.folder import read_metrics
from surgical_marl.untrusted.arrays import read_npz
from surgical_marl.view.take import read_take

CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
FACES = "f 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"


def refused(read: Callable[[], Any]) -> str:
    with pytest.raises(ValueError) as caught:
        read()
    sentence = str(caught.value)
    assert "\n" not in sentence and 20 < len(sentence) < 600
    return sentence


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """A copy of a policy that ships."""
    return Path(shutil.copytree(find("policies", "reach-psm"), tmp_path / "reach-psm"))


def header(length: int, about: bytes = b"{}") -> bytes:
    return struct.pack("<Q", length) + about


@pytest.mark.parametrize(
    "data",
    [
        b"",
        header(2**40),
        header(2**64 - 1),
        header(4, b"[{]}"),
        header(100_000, b"[" * 100_000),
        header(2, b"[]"),
        header(2),
        header(len(many := json.dumps({str(k): 0 for k in range(10_001)}).encode()), many),
        pickle.dumps({}),
    ],
)
def test_weights(policy: Path, data: bytes) -> None:
    (policy / "psm.safetensors").write_bytes(data)
    assert "psm.safetensors is damaged, or not the weights" in refused(lambda: read_weights(policy))


def test_weights_stay_in_their_folder(policy: Path) -> None:
    weights, elsewhere = policy / "psm.safetensors", policy.parent / "elsewhere.safetensors"
    weights.rename(elsewhere)
    weights.symlink_to(elsewhere)
    assert "link out of its folder" in refused(lambda: read_weights(policy))
    weights.unlink()
    elsewhere.rename(policy / "kept")
    weights.symlink_to("kept")
    read_weights(policy)
    weights.unlink()
    os.mkfifo(weights)
    assert "a pipe or a device" in refused(lambda: read_weights(policy))


def compressed(source: Path) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new:
        for info in old.infolist():
            new.writestr(info.filename, old.read(info))
    return packed.getvalue()


def test_checkpoints(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    good = {"iteration": 1, "groups": {"psm": [1, 2, 3]}, "algorithm": {"actor_state_dict": {"a": torch.zeros(2)}}}
    torch.save(good, path)
    assert _read(tmp_path)[0] == {"psm": [1, 2, 3]}
    path.write_bytes(compressed(path))
    assert "damaged" in refused(lambda: read_checkpoint(tmp_path))
    torch.save(good, path, _use_new_zipfile_serialization=False)
    assert "damaged" in refused(lambda: read_checkpoint(tmp_path))
    bad: list[dict[str, Any]] = [
        {"groups": [1]}, {"groups": {"psm": 1}}, {"groups": {"psm": ["a"]}}, {"groups": {"psm": [1]}},
        {"algorithm": {}}, {"algorithm": 1}, {"algorithm": {"actor_state_dict": {"a": 1}}},
    ]  # fmt: skip
    for change in bad:
        torch.save({**good, **change}, path)
        assert "is damaged" in refused(lambda: _read(tmp_path))
    path.unlink()
    os.mkfifo(path)
    assert "has no checkpoint.pt" in refused(lambda: read_checkpoint(tmp_path))


def bombs() -> Iterator[Any]:
    """Yield parts of a small checkpoint that would take 40 GB, hours, or more calls in each other than Python makes."""
    yield torch.zeros(1).expand(100_000, 100_000)
    yield torch.zeros(100_000, 100_000, device="meta")
    yield torch.sparse_coo_tensor(size=(100_000, 100_000), check_invariants=True)
    doubled: list[Any] = [1.0]
    for _ in range(40):
        doubled = [doubled, doubled]
    yield doubled
    deep: list[Any] = []
    for _ in range(5_000):
        deep = [deep]
    yield deep
    circle: list[Any] = []
    circle.append(circle)
    yield circle


@pytest.mark.parametrize("number", range(6))
def test_a_small_checkpoint_that_stands_for_a_large_one(number: int, tmp_path: Path) -> None:
    bomb = list(bombs())[number]
    good = {"iteration": 1, "groups": {"psm": [1, 2, 3]}, "algorithm": {"actor_state_dict": {"a": torch.zeros(2)}}}
    with more_calls():
        torch.save({**good, "algorithm": {"a": bomb}}, tmp_path / "checkpoint.pt")
        write_environments(tmp_path, 1, 1, 2, {"a": bomb})
    assert (tmp_path / "checkpoint.pt").stat().st_size < 200_000
    assert "is damaged" in refused(lambda: read_checkpoint(tmp_path))
    found = read_environments(tmp_path, 1, 1, 2)
    assert found is None or isinstance(found["a"], list)  # how deep it is matters to nobody there


@contextlib.contextmanager
def more_calls() -> Iterator[None]:
    """Let Python make enough calls in each other to write what it can't read."""
    usual = sys.getrecursionlimit()
    sys.setrecursionlimit(50_000)
    try:
        yield
    finally:
        sys.setrecursionlimit(usual)


def npz(**members: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return packed.getvalue()


def npy(shape: str, data: bytes = b"", descr: str = "<f8", version: bytes = b"\1\0") -> bytes:
    about = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}}}".encode()
    return b"\x93NUMPY" + version + struct.pack("<H", len(about)) + about + data


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"PK\3\4",
        npz(a=b""),
        npz(a=npy("(1099511627776,)")),
        npz(a=npy("(-1,)", b"\0" * 8)),
        npz(a=npy("(1,)", b"\0" * 8, "|O")),
        npz(a=npy("(" * 5000 + ")" * 5000)),
        npz(a=npy("(1,)", b"\0" * 8, version=b"\7\0")),
        npz(a=npy("(2,)", b"\0" * 8)),
    ],
)  # fmt: skip
def test_arrays(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "file.npz").write_bytes(data)
    refused(lambda: read_npz(tmp_path / "file.npz"))
    assert "is damaged" in refused(lambda: read_played(tmp_path / "file.npz"))
    assert "is not a take" in refused(lambda: read_take(tmp_path / "file.npz"))


def test_an_archive_is_limited_by_what_it_unpacks_to(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "zeros.npz", a=np.zeros(1_000_000))
    assert (tmp_path / "zeros.npz").stat().st_size < 20_000
    assert read_npz(tmp_path / "zeros.npz")["a"].shape == (1_000_000,)
    assert "more than 1,000,000" in refused(lambda: read_npz(tmp_path / "zeros.npz", most=1_000_000))


@pytest.mark.parametrize("text", ["", "[" * 100_000, "1" * 5000, "[]", "{}", '{"aggregate": 3}', "\0", "nan"])
def test_results(tmp_path: Path, text: str) -> None:
    (tmp_path / "eval.json").write_text(text)
    assert "is not a result" in refused(lambda: read_result(tmp_path / "eval.json"))


@pytest.mark.parametrize(
    "text", ["a" * 200_000 + "\n1\n", "a,b\n1\n", '"a\n1\n', "a\n\0\n", "a,a\n1,x\n", "iteration\n1e999\n"]
)
def test_metrics_are_rows_of_numbers_or_nothing(tmp_path: Path, text: str) -> None:
    (tmp_path / "metrics.csv").write_text(text)
    (tmp_path / "config.yaml").write_text("task: reach\nscene: psm\niterations: 3\n")
    assert all(isinstance(value, float) for row in read_metrics(tmp_path) for value in row.values())
    read_run(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.obj", CORNERS + FACES + "g a\nusemtl b\n" * 300, "600 groups are too many"),
        ("a.stl", ("solid a\n" + FACET + "endsolid a\n") * 600, "600 groups are too many"),
        ("a.obj", CORNERS + "f 1 2 3\n" * 1_250_000, "is larger than 10 MB"),
        ("a.obj", CORNERS.replace("v 1", "v 1e300") + FACES, "more than 1000 m"),
        ("a.obj", CORNERS.replace("v 1", "v 1e400") + FACES, "not finite"),
        ("a.obj", CORNERS + "f 1 2 99\n", "not a mesh"),
        ("a.stl", "solid", "not a mesh"),
        ("a.dae", "<a/>" * 60_000, "not a mesh"),
        ("a.dae", "<a>" + "<b/>" * 60_000 + "</a>", "more than 50,000 elements"),
    ],
)
def test_meshes(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    assert words in refused(lambda: read_mesh(tmp_path / name))


@pytest.mark.parametrize(("depth", "wide"), [(30, 2), (12, 4), (5000, 1)])
def test_nodes_of_a_mesh_that_stand_for_others(tmp_path: Path, depth: int, wide: int) -> None:
    """Thirty nodes, each twice the next one, are a billion meshes."""
    inner = [f'<instance_node url="#n{k + 1}"/>' * wide for k in range(depth)]
    nodes = "".join(f'<node id="n{k}">{text}</node>' for k, text in enumerate(inner))
    last = f'<node id="n{depth}"><instance_geometry url="#g"/></node>'
    scene = '<visual_scene id="s"><node><instance_node url="#n0"/></node></visual_scene>'
    (tmp_path / "a.dae").write_text(f"<COLLADA><library_nodes>{nodes}{last}</library_nodes>{scene}</COLLADA>")
    assert "not a mesh" in (found := refused(lambda: read_mesh(tmp_path / "a.dae"))) or "are too many" in found
    (tmp_path / "a.dae").write_text(f"<COLLADA><node id='n0'><instance_node url='#n0'/></node>{scene}</COLLADA>")
    assert "stands for itself" in refused(lambda: read_mesh(tmp_path / "a.dae"))
