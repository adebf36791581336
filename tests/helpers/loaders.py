"""All that reads files of strangers, each as a call on the bytes of one file, with good files to begin with.

`tests/helpers/fuzzing.py` looks for files that end in another error than one sentence, or take too much. Those that
once did are in `tests/corpus/`, by loader, and `tests/untrusted/test_fuzz.py` reads them again.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
import trimesh
from safetensors.torch import save

from surgical_marl import load_arm
from surgical_marl.content import find
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.evaluation.command import read_result
from surgical_marl.evaluation.evaluate import EPISODES, difference, read_played
from surgical_marl.evaluation.report import format_table
from surgical_marl.learning.train import _read_resumed, make_training
from surgical_marl.policies.policy import load_policy
from surgical_marl.report.page import render
from surgical_marl.report.run import read_run
from surgical_marl.robots.mesh import read_mesh
from surgical_marl.robots.spec import build_spec
from surgical_marl.runs import fault
from surgical_marl.runs.checkpoint import read_environments, write_checkpoint, write_environments
from surgical_marl.runs.folder import CHECKPOINT, CONFIG, METRICS, read_metrics, read_origin, read_settings
from surgical_marl.runs.settings import Settings, load_config, read_config
from surgical_marl.scenes.check import check
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.objects import load_object
from surgical_marl.untrusted.arrays import read_npz
from surgical_marl.view import take
from surgical_marl.yaml_file import parse_yaml
from tests.helpers import ROOT
from tests.helpers.run_folders import evaluate, make_run, played, standard
from tests.helpers.samples import ARM, CABLES, DAE, JAW, OBJ, OBJECT, SCENE, SCENE_OF_TWO, SETTINGS, SPHERES, TINY, URDF

CORPUS = ROOT / "tests" / "corpus"
"""Files that once ended in another error, or took too much: one folder for each loader."""


class Loader(NamedTuple):
    """What reads one kind of file."""

    kinds: tuple[str, ...]
    """How such files are changed (`tests/helpers/mutators.py`)."""
    seeds: tuple[bytes, ...]
    """Good files."""
    read: Callable[[bytes], Any]


@contextlib.contextmanager
def one_sentence() -> Iterator[None]:
    """Take a ValueError of one sentence for an answer, and warnings of other libraries for none."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            yield
        except ValueError as error:
            text = str(error)
            assert len(text) < 2000, "a value is repeated in full"
            assert text.isprintable(), f"no one line that a terminal can show: {text!r}"


def loader(name: str, folder: Path) -> Loader:
    """Return what reads a kind of file. It writes into an empty folder."""
    return _MAKERS[name](folder)


def _at(path: Path, *reads: Callable[[Path], Any]) -> Callable[[bytes], Any]:
    """Return what writes bytes to a path, and reads them in some ways, each of which may refuse them."""

    def read(data: bytes) -> None:
        path.write_bytes(data)
        for each in reads:
            with one_sentence():
                each(path)

    return read


def _rendered(path: Path) -> None:
    """Read a run, and for one file in eight write its report, which takes a second."""
    run = read_run(path.parent)
    if zlib.crc32(path.read_bytes()) % 8 == 0:
        render([run])


def _texts(*texts: str) -> tuple[bytes, ...]:
    return tuple(text.encode() for text in texts)


# --- arms, objects, scenes


def _arm(folder: Path, text: str, urdf: str) -> Path:
    (folder / "two").mkdir(exist_ok=True)
    (folder / "two" / "arm.yaml").write_text(text)
    (folder / "two" / "two.urdf").write_text(urdf)
    trimesh.creation.box((0.1, 0.2, 0.6)).export(folder / "two" / "part.stl")
    return folder / "two"


def _looked_at(path: Path) -> None:
    """Check a file as `surgical-marl check` does: what is wrong is told, one sentence each."""
    for finding in check(path):
        assert finding.isprintable() and len(finding) < 2000, repr(finding)


def _make_yaml(folder: Path) -> Loader:
    def read(data: bytes) -> None:
        with one_sentence():
            parse_yaml(data.decode("utf-8", "replace"))

    shipped = find("scenes", "bimanual_psm_needle").read_text()
    return Loader(("yaml",), _texts(SCENE, OBJECT, shipped, "? [a]\n: 1\n", "{a: 1:30, b: 0x1f, c: 1e5, d: ~}"), read)


def _make_scene(folder: Path) -> Loader:
    _arm(folder, ARM, SPHERES)
    (folder / "ball.yaml").write_text(OBJECT)
    return Loader(("yaml",), _texts(SCENE, SCENE_OF_TWO), _at(folder / "scene.yaml", load_scene, _looked_at))


def _make_object(folder: Path) -> Loader:
    shipped = [path.read_text() for path in sorted(find("scenes", "psm").parent.glob("objects/*.yaml"))]
    return Loader(("yaml",), _texts(OBJECT, *shipped), _at(folder / "own.yaml", load_object, _looked_at))


def _make_arm(folder: Path) -> Loader:
    arm = _arm(folder, ARM, SPHERES)

    def build(_: Path) -> None:
        build_spec(load_arm(arm), pads=True).compile()

    shipped = (find("arms", "psm") / "arm.yaml").read_text()
    return Loader(
        ("yaml",), _texts(ARM + JAW, ARM + CABLES, shipped), _at(arm / "arm.yaml", build, lambda _: _looked_at(arm))
    )


def _make_urdf(folder: Path) -> Loader:
    arm = _arm(folder, ARM, SPHERES)

    def build(_: Path) -> None:
        build_spec(load_arm(arm)).compile()

    return Loader(("xml",), _texts(SPHERES, URDF), _at(arm / "two.urdf", build))


def _make_mesh(kind: str) -> Callable[[Path], Loader]:
    def make(folder: Path) -> Loader:
        box = trimesh.creation.box((0.1, 0.2, 0.6))
        name, way = {"stl": ("stl", "stl"), "ascii": ("stl_ascii", "words"), "obj": ("obj", "words")}.get(
            kind, (kind, "xml")
        )
        made = DAE if kind == "dae" else box.export(file_type=name)
        data = made.encode() if isinstance(made, str) else bytes(made)
        more = _texts(OBJ) if kind == "obj" else ()
        read = functools.partial(read_mesh, scale=(1.0, 2.0, 1.0))
        return Loader((way,), (data, *more), _at(folder / f"part.{name[:3]}", read))

    return make


# --- settings and runs


def _make_config(folder: Path) -> Loader:
    run = evaluate(make_run(folder / "run"))
    reads: list[Callable[[Path], Any]] = [
        read_config,
        lambda path: read_origin(path.parent),
        _rendered,
    ]
    good = (run / CONFIG).read_text()
    return Loader(("yaml",), _texts(good, SETTINGS), _at(run / CONFIG, *reads))


def _make_overrides(folder: Path) -> Loader:
    def read(data: bytes) -> None:
        with one_sentence():
            load_config("reach", "psm", data.decode("utf-8", "replace").split("\n"))

    good = (
        "num_envs=8\nppo.gamma=0.9\nnetwork.hidden=[8, 8]\nobserve={psm_0: [qpos]}\nreward.collision=-1\ncontrol=task"
    )
    return Loader(("words",), _texts(good.replace("=", " = "), good), read)


def _make_metrics(folder: Path) -> Loader:
    from surgical_marl.runs.curve import draw_curve

    run = evaluate(make_run(folder / "run"))
    reads: list[Callable[[Path], Any]] = [
        lambda path: read_metrics(path.parent),
        _rendered,
        lambda path: draw_curve(path.parent, "a") if zlib.crc32(path.read_bytes()) % 8 == 1 else None,
    ]
    return Loader(
        ("csv",), _texts((run / METRICS).read_text(), "iteration,a\r\n1,2.5\r\n2,\r\n"), _at(run / METRICS, *reads)
    )


def _make_result(folder: Path) -> Loader:
    run = evaluate(make_run(folder / "run"))

    def against(path: Path) -> None:
        older, now = read_result(path), {"policy": "now", **standard()}
        format_table(now, {"older": older, "difference": difference(now, older, "older")})

    good = json.loads((run / "eval.json").read_text())
    several = {"runs": [good], "aggregate": good}
    reads: list[Callable[[Path], Any]] = [against, _rendered]
    return Loader(("json",), _texts(json.dumps(good), json.dumps(several)), _at(run / "eval.json", *reads))


def _make_episodes(folder: Path) -> Loader:
    run = evaluate(make_run(folder / "run"), played(("psm_0",), stages=("grasped",)))
    reads: list[Callable[[Path], Any]] = [read_played, _rendered]
    return Loader(("npz", "zip"), ((run / EPISODES).read_bytes(),), _at(run / EPISODES, *reads))


def _make_npz(folder: Path) -> Loader:
    file = io.BytesIO()
    np.savez_compressed(file, about=np.array("{}"), error=np.zeros((2, 1)), c=np.arange(3), d=np.array(True))
    return Loader(("npz", "zip"), (file.getvalue(),), _at(folder / "some.npz", read_npz))


# --- policies and checkpoints


@functools.cache
def _env() -> BatchedEnv:
    env = BatchedEnv("reach", "psm", num_envs=1, engine="fused", device="cpu")
    env.reset(seed=0)
    return env


def _small() -> Settings:
    """The settings of a run whose files are small."""
    with tempfile.TemporaryDirectory() as name:
        return read_settings(_tiny_run(Path(name)))


@functools.cache
def _training() -> Any:
    return make_training(_small())


def _tiny_run(folder: Path) -> Path:
    (folder / "run").mkdir()
    (folder / "run" / CONFIG).write_text(TINY)
    return folder / "run"


def _make_weights(folder: Path) -> Loader:
    run = _tiny_run(folder)
    actor = {f"{name}": value for name, value in _training().algorithm.actor.models["psm"].state_dict().items()}
    widths = _training().state()["groups"]["psm"]
    about = dict(zip(("agents", "observation", "action"), map(str, widths), strict=True))
    good = save({name: value.contiguous() for name, value in actor.items()}, metadata=about)
    path = run / "psm.safetensors"
    path.write_bytes(good)
    load_policy(run, _env())
    return Loader(("weights",), (good,), _at(path, lambda _: load_policy(run, _env())))


def _make_checkpoint(folder: Path) -> Loader:
    run = _tiny_run(folder)
    write_checkpoint(run, _training().state())
    load_policy(run, _env())
    seeds = ((run / CHECKPOINT).read_bytes(),)

    def resume(_: Path) -> None:
        if (state := _read_resumed(_small(), run, True)) is not None:
            _training().set_state(state)

    return Loader(("checkpoint", "zip"), seeds, _at(run / CHECKPOINT, lambda _: load_policy(run, _env()), resume))


def _make_environments(folder: Path) -> Loader:
    write_environments(folder, 1, 1, 2, {"env": {"a": torch.zeros(2)}, "random": torch.get_rng_state()[:10]})
    path = next(folder.glob("environments-*.pt"))
    return Loader(
        ("checkpoint", "zip"), (path.read_bytes(),), _at(path, lambda path: read_environments(path.parent, 1, 1, 2))
    )


# --- recordings


def _same_env(settings: Settings, num_envs: int | None = None, arrays: str = "torch") -> Any:
    """Return an environment that is there already; others would have to be compiled."""
    assert num_envs is not None and 1 <= num_envs <= 4, "as many environments as a file asks for"
    good = Settings(task="reach", scene="psm").of_environment()
    if settings.of_environment() != good or num_envs != 1:
        raise ValueError("it is of another environment")
    return _Open(_env())


class _Open:
    """An environment that stays open."""

    def __init__(self, env: Any) -> None:
        self._env = env

    def __getattr__(self, name: str) -> Any:
        return (lambda: None) if name == "close" else getattr(self._env, name)


def _make_take(folder: Path) -> Loader:
    env, settings = _env(), Settings(task="reach", scene="psm", engine="fused", device="cpu")
    env.reset(seed=0)
    made = take.Take(env, settings, 0, {"psm_0": "oracle"})
    actions = {agent: np.zeros((1, *space.shape), np.float32) for agent, space in env.action_spaces.items()}
    for _ in range(3):
        made.add(actions, env.step(actions))
    path = made.write(folder / "take.npz")
    good = path.read_bytes()

    def read(path: Path) -> take.Replayed:
        with patch.object(take, "make_env", _same_env):
            return take.replay(path)

    assert read(path).differs_at is None
    return Loader(("npz", "zip"), (good,), _at(path, read))


def _make_fault(folder: Path) -> Loader:
    env, settings, path = _env(), Settings(task="reach", scene="psm", engine="fused", device="cpu"), folder / "f.npz"
    env.reset(seed=0)
    start = {name: np.array(value) for name, value in env.carry().items()}
    start[".physics.arms.qvel"][:] = np.nan
    actions = {agent: np.zeros((3, 1, *space.shape), np.float32) for agent, space in env.action_spaces.items()}
    fault.write_fault(path, env, settings, start, actions, seed=0, index=0, place="state")

    def read(path: Path) -> None:
        if (found := fault.read_fault(path)) is not None:
            with patch.object(fault, "make_env", _same_env):
                told = fault.reproduce(path, *found)
            assert told.told.isprintable() and len(told.told) < 2000

    read(path)
    return Loader(("npz", "zip"), (path.read_bytes(),), _at(path, read))


_MAKERS: dict[str, Callable[[Path], Loader]] = {
    "yaml": _make_yaml,
    "scene": _make_scene,
    "object": _make_object,
    "arm": _make_arm,
    "urdf": _make_urdf,
    "stl": _make_mesh("stl"),
    "ascii": _make_mesh("ascii"),
    "obj": _make_mesh("obj"),
    "dae": _make_mesh("dae"),
    "config": _make_config,
    "overrides": _make_overrides,
    "metrics": _make_metrics,
    "result": _make_result,
    "episodes": _make_episodes,
    "npz": _make_npz,
    "weights": _make_weights,
    "checkpoint": _make_checkpoint,
    "environments": _make_environments,
    "take": _make_take,
    "fault": _make_fault,
}
LOADERS = tuple(_MAKERS)
