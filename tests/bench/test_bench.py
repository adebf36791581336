"""Benchmarks: what they report and when they stop. How fast anything is, no test says."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from mujoco import rollout

from surgical_marl import machine
from surgical_marl.bench import other_simulators, render, report, sim
from surgical_marl.bench.clock import race
from surgical_marl.bench.course import make_course
from surgical_marl.bench.face import measure_face
from surgical_marl.bench.other_simulators import Contender
from surgical_marl.bench.render import measure_rendering
from surgical_marl.bench.report import QUOTED, draw, ratios, sweep_table
from surgical_marl.bench.sim import Point, Speed, measure, sweep
from surgical_marl.bench.workload import Workload
from surgical_marl.cli.main import main
from surgical_marl.runtime import prepare_mjx, prepare_warp
from surgical_marl.scenes.timing import TIMESTEP

CONTRACT = [
    "physics_steps_per_s", "env_steps_per_s", "simulated_s_per_s", "num_envs", "engine", "device", "dt", "decimation",
    "compile_s",
]  # fmt: skip
FUSED = Speed(4e6, 2e6, 5e3, 64, "fused", "cpu", 0.0025, 1, 3.0)
MJX = replace(FUSED, engine="mjx", physics_steps_per_s=2e5, env_steps_per_s=1e5)
MUJOCO = replace(FUSED, engine="mujoco", physics_steps_per_s=1e6, env_steps_per_s=None)


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """One repeat of a step or two."""
    monkeypatch.setattr(sim, "_time", _brief(sim._time))


def _brief(time: Any) -> Any:
    return lambda workload, found, seconds, repeats: time(workload, found, 0.0, 1)


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Engines that take 64 us a step and 1 us an environment, and have room for 64 environments."""

    def prepare(engine: str, workload: Workload, course: Any) -> Contender:
        if workload.count > 64:
            raise MemoryError(f"{engine} has no room for {workload.count} environments")
        tick = lambda count: 1e-6 * (64 + workload.count) * count  # noqa: E731
        return Contender(
            workload.count, "cpu", 1.0, tick, None if engine.startswith("mujoco") else tick, bytes_per_env=100
        )

    monkeypatch.setattr(sim, "prepare", prepare)
    monkeypatch.setattr(machine, "restart_peak", lambda: machine.peak())  # without a search for garbage
    monkeypatch.setattr(sim, "make_course", lambda workload: None)
    yield


def test_one_engine_as_json_has_the_keys_of_the_contract(brief: None, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["bench", "sim", "--scene", "ecm", "--num-envs", "8", "--device", "cpu", "--json"]
    assert main([*argv, "--engine", "fused", "--decimation", "2"]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert list(found) == CONTRACT
    assert (found["engine"], found["device"], found["num_envs"], found["decimation"]) == ("fused", "cpu", 8, 2)
    assert found["dt"] == TIMESTEP
    assert found["simulated_s_per_s"] == pytest.approx(2 * TIMESTEP * found["env_steps_per_s"])
    assert "timed" in err
    assert main([*argv, "--engine", "mujoco"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found) == CONTRACT
    assert found["env_steps_per_s"] is None
    assert found["simulated_s_per_s"] == pytest.approx(TIMESTEP * found["physics_steps_per_s"])


def test_all_engines_stand_beside_what_is_quoted(made_up: None, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["bench", "sim", "--num-envs", "64", "--device", "cpu"]
    assert main([*argv, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [list(speed) for speed in found["engines"]] == [CONTRACT] * 3
    assert [speed["engine"] for speed in found["engines"]] == ["fused", "mjx", "mujoco"]
    assert found["ratios"]["physics"] == {"mjx": pytest.approx(1), "mujoco": pytest.approx(1)}
    assert main(argv) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(any(line.startswith(name) and line.endswith("quoted") for line in lines) for name in QUOTED)
    measured = [line for line in lines if line.startswith(("fused engine", "MJX engine", "C MuJoCo"))]
    assert len(measured) == 5 and not any("quoted" in line for line in measured)
    assert "500,000" in measured[0]


def test_some_engines_stand_beside_each_other(made_up: None, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["bench", "sim", "--num-envs", "64", "--device", "cpu", "--json", "--engine"]
    assert main([*argv, "fused,mujoco,fused"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [speed["engine"] for speed in found["engines"]] == ["fused", "mujoco"]
    assert list(found["ratios"]["physics"]) == ["mujoco"]
    assert main([*argv, "mujoco,all"]) == 0
    assert len(json.loads(capsys.readouterr().out)["engines"]) == 3
    assert main([*argv, "all,mujoco_warp"]) == 0
    assert len(json.loads(capsys.readouterr().out)["engines"]) == 4, "on a CPU MuJoCo Warp runs where it is named"


def test_on_a_gpu_mujoco_warp_stands_beside_c_mujoco(
    made_up: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("surgical_marl.bench.workload.has_cuda", lambda: True)
    assert main(["bench", "sim", "--num-envs", "64", "--device", "cuda"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for rival in ("C MuJoCo", "MuJoCo Warp"):
        assert sum(line.startswith(rival) for line in lines) == 1
        assert any(line.startswith(f"physics steps, fused engine over {rival}: ") for line in lines)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "motion", "count", "near", "share"),
    [("ecm", "random", 3, 1e-5, 1.0), ("psm_needle", "grasp", 16, 0.01, 0.9)],
)
def test_mujoco_warp_steps_as_c_mujoco_does(scene: str, motion: Any, count: int, near: float, share: float) -> None:
    """A lap of a course, on a CPU: joints, and where objects are.

    Single precision turns needles that slide in a jaw by some mrad in a lap, and one of 16 by 15 mrad. So the bound is
    asked of nine tenths of them, half of it of three quarters, and twice as much of all.
    """
    workload = Workload(scene=scene, motion=motion, num_envs=count, device="cpu")
    course = make_course(workload)
    prepare_mjx()
    model, states = other_simulators._exported(workload, course)
    controls = other_simulators._controls(course)[:count]
    contacts, rows = other_simulators._most(model, states[:count], controls)
    _, _, data, short = other_simulators._warp_lap(prepare_warp(), workload, course, model, states, contacts, rows)
    found, _ = rollout.rollout(model, mujoco.MjData(model), states[:count], controls)
    assert not short
    apart = np.abs(data.qpos.numpy() - found[:, -1, 1 : 1 + model.nq]).max(1)
    assert apart.max() < 2 * near and np.quantile(apart, share) < near and np.quantile(apart, 0.75) < near / 2
    *_, short = other_simulators._warp_lap(prepare_warp(), workload, course, model, states, 0, -6)
    assert short, "one row is not enough, and it did not say so"


@pytest.mark.usefixtures("made_up")
def test_an_engine_without_room_is_left_out() -> None:
    with pytest.raises(ValueError, match="no room for 65"):
        measure(Workload(num_envs=65), ("fused",))


def test_ratios() -> None:
    found = ratios({"fused": FUSED, "mjx": MJX, "mujoco": MUJOCO})
    assert found == {"physics": {"mjx": 20.0, "mujoco": 4.0}, "env": {"mjx": 20.0}}
    assert ratios({"mjx": MJX, "mujoco": MUJOCO}) == {"physics": {}, "env": {}}


def test_the_best_repeat_counts() -> None:
    times = {"a": iter([9.0, 1.0, 3.0, 2.0, 4.0]), "b": iter([9.0, 1.0, 7.0, 8.0, 6.0])}
    clocks = {key: (lambda count, key=key: count * next(times[key])) for key in times}
    assert race(clocks, seconds=1.0, repeats=3) == {"a": 2.0, "b": 6.0}


@pytest.mark.parametrize(
    "engine, limits, counts, why",
    [
        ("fused", {}, [1, 4, 16, 64], "no room for 256"),
        ("fused", {"free": 0.0}, [1], "no memory for 4"),
        ("fused", {"longest": 3e-4}, [1, 4, 16], "would take more than"),
        ("mujoco", {"most": 16}, [1, 4, 16], "no faster"),
    ],
)
def test_a_sweep_stops_and_says_why(
    engine: str,
    limits: dict[str, float],
    counts: list[int],
    why: str,
    made_up: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(machine, "free", lambda: limits.get("free", np.inf))
    monkeypatch.setattr(machine, "peak", iter(range(100)).__next__)  # a byte more each time it is looked at
    monkeypatch.setattr(sim, "LONGEST", limits.get("longest", 10.0))
    monkeypatch.setattr(sim, "MOST_ROLLED", limits.get("most", 4096))
    points = list(sweep(Workload(device="cpu"), (engine,)))
    assert [point.speed.num_envs for point in points] == counts
    assert why in capsys.readouterr().err.splitlines()[-1]


def test_a_sweep_as_table_json_and_picture(made_up: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sweep.png"
    assert main(["bench", "sim", "--sweep", "--device", "cpu", "--json", "--out", str(out)]) == 0
    points = json.loads(capsys.readouterr().out)["points"]
    assert len(points) == 12
    assert list(points[0]) == [*CONTRACT, "bytes_per_env"]
    assert out.read_bytes().startswith(b"\x89PNG")
    assert main(["bench", "sim", "--sweep", "--device", "cpu", "--json", "--num-envs", "20"]) == 0
    assert [point["num_envs"] for point in json.loads(capsys.readouterr().out)["points"][:3]] == [1, 4, 16]
    assert "4,000,000" in sweep_table([Point(FUSED, 567), Point(MUJOCO, None)])


def test_a_sweep_that_is_stopped_leaves_its_picture(
    made_up: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: Any) -> Iterator[Point]:
        yield Point(FUSED, 567)
        yield Point(FUSED, 567)
        raise KeyboardInterrupt

    monkeypatch.setattr(report, "sweep", stopped)
    with pytest.raises(KeyboardInterrupt):
        report.run(Workload(device="cpu"), ("fused",), sweeping=True, out=tmp_path / "sweep.png")
    assert (tmp_path / "sweep.png").read_bytes().startswith(b"\x89PNG")


def test_a_picture_of_one_point(tmp_path: Path) -> None:
    draw([Point(MUJOCO, None)], "title", tmp_path / "one.png")
    assert (tmp_path / "one.png").exists()


def test_a_scene_without_objects_has_nothing_to_grasp(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "sim", "--scene", "ecm", "--motion", "grasp", "--num-envs", "1", "--device", "cpu"]) == 2
    assert "scene 'ecm' has nothing to grasp" in capsys.readouterr().err


def test_rendering_as_json_and_as_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(render.clock, "race", lambda clocks, *_: {key: clock(1) for key, clock in clocks.items()})
    argv = ["bench", "render", "--scene", "ecm", "--num-envs", "2", "--device", "cpu"]
    assert main([*argv, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found) == ["frames_per_s", "num_envs", "device", "width", "height", "channels", "stereo"]
    assert found.pop("frames_per_s") > 0
    assert found == {"num_envs": 2, "device": "cpu", "width": 64, "height": 64, "channels": ["rgb"], "stereo": False}
    assert main(argv) == 0
    assert "pictures/s of 64 x 64 pixels of rgb, 2 envs, cpu" in capsys.readouterr().out
    one, two = (measure_rendering("ecm", 1, "cpu", size=8, stereo=stereo) for stereo in (False, True))
    assert (one.stereo, two.stereo, two.width) == (False, True, 8)


def test_pictures_for_people_as_json_and_as_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(render.clock, "race", lambda clocks, *_: {key: clock(1) for key, clock in clocks.items()})
    argv = ["bench", "render", "--of", "scene", "--scene", "psm"]
    assert main([*argv, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found) == ["ms_per_picture", "width", "height", "shapes"]
    assert found["ms_per_picture"] > 0 and (found["width"], found["height"]) == (480, 360) and found["shapes"] > 30
    assert main(argv) == 0
    assert "of one core a picture, 480 x 360 pixels" in capsys.readouterr().out


def test_what_the_face_adds_as_json_and_as_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(measure_face, "__defaults__", (None, 2, 0.0))
    assert main(["bench", "face", "--num-envs", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found) == ["engine_s", "added_s", "share", "num_envs"] and found["num_envs"] == 2
    assert main(["bench", "face", "--scene", "bimanual_psm"]) == 0
    assert "reach on bimanual_psm: the face adds " in capsys.readouterr().out


@pytest.mark.parametrize(
    "argv, words",
    [
        ([], ["sim"]),
        (["sin"], ["'sin'", "sim"]),
        (["sim", "--engine", "fuzed"], ["'fuzed'", "did you mean 'fused'", "mjx", "mujoco", "all"]),
        (["sim", "--engine", "fused,"], ["''", "mjx", "mujoco", "all"]),
        (["sim", "--scene", "psmm"], ["'psmm'", "did you mean 'psm'", "bimanual_psm"]),
        (["sim", "--task", "reech"], ["'reech'", "did you mean 'reach'"]),
        (["sim", "--num-envs", "0"], ["--num-envs", "'0'"]),
        (["sim", "--motion", "wild"], ["'wild'", "random, rough, grasp, policy"]),
        (["sim", "--scene", "psm_needle", "--motion", "policy"], ["'reach-psm_needle'", "reach-psm"]),
        (["sim", "--scene", "psm", "--control", "velocity", "--motion", "policy"], ["reach-psm", "'velocity'"]),
        (["sim", "--decimation", "0"], ["--decimation", "'0'"]),
        (["sim", "--device", "gpu"], ["'gpu'", "auto, cpu, cuda"]),
        (["sim", "--engine", "mujoco", "--device", "cuda"], ["'mujoco'", "'cuda'", "CPU"]),
        (["sim", "--out", "a.png"], ["a.png", "--sweep"]),
        (["sim", "--sweep", "--out", "a.pdf"], ["a.pdf", ".png"]),
        (["sim", "--sweep", "--out", "none/a.png"], ["none/a.png", "folder"]),
        (["render", "--scene", "psm"], ["'psm'", "no endoscope"]),
        (["render", "--of", "room"], ["'room'", "endoscope", "scene"]),
        (["render", "--of", "scene", "--device", "cpu"], ["--device"]),
        (["render", "--scene", "ecm", "--sweep"], ["'--sweep'", "bench render"]),
        (["view", "--task", "reech"], ["'reech'", "did you mean 'reach'"]),
        (["view", "--num-envs", "4"], ["'--num-envs'", "bench view"]),
    ],
)
def test_bad_input(argv: list[str], words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *argv]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.startswith("surgical-marl: ") and err.count("\n") == 1
    for word in words:
        assert word in err


def test_no_cuda_is_bad_input(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgical_marl.bench.workload.has_cuda", lambda: False)
    assert main(["bench", "sim", "--device", "cuda"]) == 2
    assert "device 'cuda' is not there" in capsys.readouterr().err


@pytest.mark.parametrize(
    "wrong",
    [{"num_envs": 0}, {"num_envs": True}, {"decimation": 0}, {"device": "tpu"}, {"task": ""}, {"motion": "wild"}],
)
def test_a_workload_that_is_none(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Workload(**wrong)
    with pytest.raises(ValueError, match="unknown engine 'bullet'"):
        measure(Workload(scene="ecm"), ("bullet",))


def test_a_speed_is_the_contract() -> None:
    assert list(asdict(FUSED)) == CONTRACT
