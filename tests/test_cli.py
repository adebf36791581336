"""The command line: what it prints, and how it takes bad input."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from surgical_marl.cli.doctor import chain_seconds
from surgical_marl.cli.main import main

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    "argv, expected",
    [
        (["list", "tasks"], ["reach"]),
        (["list", "scenes"], ["bimanual_psm", "psm"]),
        (["list", "arms"], ["psm"]),
        (["list"], ["tasks", "scenes", "arms", "policies", "reach", "bimanual_psm"]),
    ],
)
def test_list(argv: list[str], expected: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 0
    out, err = capsys.readouterr()
    assert not err
    for name in expected:
        assert name in out.replace(",", " ").split()


TRAIN = ["train", "reach", "--scene", "psm"]


@pytest.mark.parametrize(
    "argv, words",
    [
        ([], ["name a command", "surgical-marl list", "surgical-marl --help"]),
        (["trian"], ["'trian'", "train", "eval", "list", "doctor"]),
        (["list", "sceens"], ["'sceens'", "did you mean 'scenes'"]),
        (["list", "--all"], ["'--all'"]),
        (["list", "a=b"], ["'a=b'"]),
        (["train"], ["TASK", "reach", "--scene", "bimanual_psm"]),
        (["train", "reach"], ["--scene", "bimanual_psm"]),
        (["train", "num_envs=4"], ["TASK", "--scene"]),
        (["train", "needle_pick", "num_envs=0"], ["num_envs", "not 0"]),  # its scene goes without saying
        (["train", "reech", "--scene", "psm"], ["'reech'", "did you mean 'reach'"]),
        (["train", "reach", "--scene", "psmm"], ["'psmm'", "did you mean 'psm'", "bimanual_psm"]),
        (["train", "reach", "--scene", "./none.yaml"], ["'./none.yaml'"]),
        ([*TRAIN, "--algo", "mapo"], ["'mapo'", "did you mean 'mappo'"]),
        ([*TRAIN, "--engine", "mxj"], ["'mxj'", "did you mean 'mjx'"]),
        ([*TRAIN, "--device", "gpu"], ["'gpu'", "auto, cpu, cuda"]),
        ([*TRAIN, "--control", "speed"], ["'speed'", "position, velocity, torque"]),
        ([*TRAIN, "--num-envs", "0"], ["--num-envs", "0"]),
        ([*TRAIN, "--num-envs", "many"], ["--num-envs", "'many'"]),
        ([*TRAIN, "--iterations", "-5"], ["iterations", "-5"]),
        ([*TRAIN, "--seed", "1.5"], ["seed", "1.5"]),
        ([*TRAIN, "--num-env", "8"], ["'--num-env'"]),
        ([*TRAIN, "extra"], ["'extra'"]),
        ([*TRAIN, "no.such=3"], ["unknown setting"]),
        (["export"], ["scene", "policy"]),
        (["export", "scene"], ["NAME_OR_PATH"]),
        (["export", "policy"], ["RUN", "--out"]),
        (["export", "policy", "no_such_run", "--out", "new"], ["unknown run or policy 'no_such_run'"]),
        (["export", "policy", ".", "--out", "new"], ["config.yaml"]),
        (["export", "policy", ".", "--outt", "new"], ["--out"]),
        (["export", "arm", "psm"], ["'arm'", "scene"]),
        (["export", "scene", "psmm"], ["'psmm'", "did you mean 'psm'", "bimanual_psm"]),
        (["export", "scene", "psm", "--format", "urdf"], ["'urdf'", "mjcf"]),
        (["export", "scene", "psm", "--control", "speed"], ["'speed'", "position, velocity, torque"]),
        (["export", "scene", "psm", "--out", "no/such/psm.xml"], ["cannot write no/such/psm.xml"]),
        (["eval"], ["RUN_OR_POLICY"]),
        (["eval", "no_such_run"], ["'no_such_run'"]),
        (["eval", "runs/none"], ["'runs/none', and no such folder"]),
        (["eval", "."], ["config.yaml"]),
        (["eval", ".", "--episodes", "0"], ["--episodes", "'0'"]),
        (["eval", ".", "--episodes", "1000001"], ["--episodes", "from 1 to 1000000", "'1000001'"]),
        (["eval", ".", "--seed", "-1"], ["--seed"]),
        (["train", "reach", "--scene", "psm", "--out", "new", "--resume", "nowhere"], ["nowhere is not a run folder"]),
        (["eval", "zer"], ["'zer'", "did you mean 'zero'", "oracle"]),
        (["eval", "zero"], ["--task (", "reach", "--scene (bimanual_psm"]),
        (["eval", "zero", "--task", "reach"], ["--scene"]),
        (["eval", "zero", "--task", "reech", "--scene", "psm"], ["'reech'", "did you mean 'reach'"]),
        (["eval", "zero", "--task", "reach", "--scene", "psmm"], ["'psmm'", "did you mean 'psm'"]),
        (["eval", "zero", "random", "--task", "reach", "--scene", "psm"], ["'zero'", "alone"]),
        (["eval", ".", "--control", "speed"], ["'speed'", "position, velocity, torque"]),
        (["eval", ".", "--csv", "table.txt"], ["table.txt", ".csv"]),
        (["eval", ".", "--figure", "no/such/figure.png"], ["no/such/figure.png", ".png"]),
        (["eval", ".", "--against", "old.json"], ["old.json"]),
    ],
)
def test_bad_input_is_one_sentence_and_code_2(
    argv: list[str],
    words: list[str],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(argv) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.startswith("surgical-marl: ") and err.count("\n") == 1
    for word in words:
        assert word in err
    assert not list(tmp_path.iterdir()), "bad input must leave nothing behind"


@pytest.mark.parametrize(
    "growth, verdict",
    [(3.5, "has the serial-chain fault"), (1.1, "does not have"), (None, "not measured")],
)
def test_doctor_looks_at_everything(
    growth: float | None,
    verdict: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("surgical_marl.cli.doctor._growth", lambda flag: growth)
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    caches = "compile cache", "suite's cache", "Warp's kernels", "clear caches     rm -r /"
    for word in ("Python", "mujoco", "jax devices", "torch devices", *caches, verdict):
        assert word in out
    assert "works, no OpenGL needed" in out


def test_the_probe_of_the_doctor_measures() -> None:
    assert chain_seconds(2) > 0


def test_interrupting_is_code_130(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("surgical_marl.cli.doctor.report", interrupt)
    assert main(["doctor"]) == 130
    assert capsys.readouterr().err == "surgical-marl: interrupted\n"


def test_a_reader_that_leaves_is_no_error() -> None:
    command = [sys.executable, "-m", "surgical_marl.cli.main", "list"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout and process.stderr
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0
