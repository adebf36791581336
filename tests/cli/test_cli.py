"""The command line: what it prints, how it takes bad input, and what it says where memory is lacking."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from surgical_marl import list_arms, list_scenes, load_scene
from surgical_marl.cli import main as program
from surgical_marl.cli.describe import shared_workspace
from surgical_marl.cli.doctor import Finding, chain_seconds
from surgical_marl.cli.main import main
from tests.helpers import ROOT


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
        ([*TRAIN, "--control", "speed"], ["'speed'", "cartesian, position"]),
        ([*TRAIN, "--num-envs", "0"], ["--num-envs", "0"]),
        ([*TRAIN, "--num-envs", "many"], ["--num-envs", "'many'"]),
        ([*TRAIN, "--iterations", "-5"], ["iterations", "-5"]),
        ([*TRAIN, "--seed", "1.5"], ["seed", "1.5"]),
        ([*TRAIN, "--num-env", "8"], ["'--num-env'"]),
        ([*TRAIN, "extra"], ["'extra'"]),
        ([*TRAIN, "no.such=3"], ["unknown setting"]),
        (["export"], ["episodes", "scene", "policy"]),
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
        (["eval", ".", "--control", "speed"], ["'speed'", "cartesian, position"]),
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
    "argv, wrong",
    [
        (["train", "ppo.learning_rte=1e-3"], "'ppo.learning_rte'; did you mean 'ppo.learning_rate'?"),
        (["train", "reach", "ppo.learning_rte=1e-3"], "ppo.learning_rte"),
        (["train", "reach", "ppo.gamma=2"], "ppo.gamma must be a number from 0 to 1, not 2"),
        (["train", "reach", "--algo", "mapo"], "'mapo', did you mean 'mappo'"),
        (["train", "reach", "--difficulty", "hrad"], "unknown difficulty 'hrad'"),
        (["train", "--scene", "psmm"], "'psmm', did you mean 'psm'"),
        (["train", "reach", "--scne", "psm"], "'--scne'"),
        (["eval", "--task", "reech"], "'reech', did you mean 'reach'"),
        (["eval", "--scen", "psm"], "'--scen'"),
        (["eval", "zero", "--difficulty", "hrad"], "unknown difficulty 'hrad', did you mean 'hard'"),
        (["eval", "zero", "--csv", "table.txt"], "table.txt: name a .csv file"),
        (["eval", "zero", "--figure", "table.jpg"], "table.jpg: name a .png file"),
        (["eval", "zero", "--against", "none.json"], "none.json"),
        (["eval", "zero", "--partner", "psm_0"], "ROLE=POLICY"),
        (["crossplay", "zero", "--figure", "map.jpg"], "map.jpg: name a .png file"),
        (["crossplay", "--scene", "psmm"], "'psmm', did you mean 'psm'"),
        (["report", "--out", "page.htm"], "page.htm: name a .html file"),
        (["play", "reach", "--out", "film.avi"], "film.avi: name a .mp4, .gif or .webp file"),
        (["play", "reach", "--otu", "film.mp4"], "'--otu'"),
        (["play", "reech", "--scene", "psm"], "'reech', did you mean 'reach'"),
        (["play", "reach", "--policy", "orcle"], "'orcle', did you mean 'oracle'"),
        (["view", "--policy", "orcle"], "'orcle', did you mean 'oracle'"),
        (["view", "reach", "--difficulty", "hrad"], "unknown difficulty 'hrad'"),
        (["view", "--prt", "80"], "'--prt'"),
        (["export", "scene", "--out", "."], ". exists already"),
        (["export", "policy", "no_such_run"], "unknown run or policy 'no_such_run'"),
        (["check", "--verbose"], "'--verbose'"),
    ],
)
def test_what_is_wrong_is_named_before_what_is_missing(
    argv: list[str],
    wrong: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(argv) == 2
    err = capsys.readouterr().err
    assert wrong in err and err.count("\n") == 1


@pytest.mark.parametrize(
    "argv, missing",
    [
        (["play"], "play needs TASK and --out FILE; see surgical-marl play --help"),
        (["eval", "--seed", "1"], "eval needs RUN_OR_POLICY"),
        (["replay"], "replay needs FILE.npz"),
        (["check"], "check needs SOURCE"),
        (["report"], "report needs RUN"),
        (["export", "policy"], "export policy needs RUN and --out DIR"),
        (["play", "reach", "--out", "film.mp4"], "play reach needs --scene (bimanual_psm"),
    ],
)
def test_what_is_missing_is_named(argv: list[str], missing: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 2
    assert missing in capsys.readouterr().err


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
    assert out.splitlines()[-1].split(maxsplit=1)[0] == "verdict"


@pytest.mark.parametrize(
    "findings, text, code",
    [
        ([Finding("video", "mp4")], "ready", 0),
        ([Finding("video", "gif", slow="it is a gif"), Finding("jax", "0.9")], "slowly or in part, because it is a", 0),
        ([Finding("video", "gif", slow="it is a gif"), Finding("jax", "missing", broken="jax is missing")],
         "will not work, because jax is missing", 1),
    ],
)  # fmt: skip
def test_the_doctor_ends_with_a_verdict(
    findings: list[Finding],
    text: str,
    code: int,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("surgical_marl.cli.doctor.report", lambda: findings)
    assert main(["doctor"]) == code
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("verdict ") and text in last


def test_the_doctor_tells_of_a_library_that_fails(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> Iterator[Finding]:
        raise RuntimeError("no backend\nfor it")

    monkeypatch.setattr("surgical_marl.cli.doctor._growth", lambda flag: 1.0)
    monkeypatch.setattr("surgical_marl.cli.doctor._jax_devices", fail)
    assert main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert "jax devices      fails: no backend for it\n" in out and "works, no OpenGL needed" in out
    assert out.endswith("verdict          will not work, because jax devices fails: no backend for it\n")


@pytest.mark.parametrize("columns", [40, 80, 200])
@pytest.mark.parametrize("argv", [["list"], ["list", "-v", "scenes"], ["list", "-v", "policies"]])
def test_lists_fit_the_terminal(
    argv: list[str], columns: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert main(argv) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) > columns / 3
    assert all(len(line) <= columns or " " not in line.strip() for line in lines)


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


def test_teams_of_two_difficulties_can_be_given_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["crossplay", "reach-bimanual_psm", "reach-bimanual_psm-crossing"]) == 2
    assert "choose one for all with --difficulty\n" in capsys.readouterr().err


def test_list_v_names_all_and_says_what_they_are(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "500")
    assert main(["list", "-v"]) == 0
    out = capsys.readouterr().out
    for name in (*list_scenes(), *list_arms(), "psm_0", "ecm_0", "reach"):
        assert f"{name} " in out
    clearance, pairs = load_scene("bimanual_psm"), len(load_scene("bimanual_psm").pairs)
    home = {agent: mount.arm.home for agent, mount in clearance.mounts.items()}
    assert f"{pairs} pairs of shapes can touch, {1000 * float(clearance.clearance(home)):.0f} mm apart at home" in out
    assert "% of an arm's workspace shared" in out


def test_the_shared_workspace_is_all_none_or_between(tmp_path: Path) -> None:
    def shared(x: float) -> float:
        path = tmp_path / f"at{x}.yaml"
        path.write_text(f"arms:\n  psm_0: {{arm: psm}}\n  psm_1: {{arm: psm, position: [{x}, 0, 0]}}\n")
        return shared_workspace(load_scene(path))

    assert shared(0.0) > 0.99
    assert shared(5.0) == 0.0
    assert shared(0.0) > shared(0.1) > shared(0.3) > 0.0
    assert np.isnan(shared_workspace(load_scene("psm")))


@pytest.mark.parametrize("name", [name for name in list_scenes() if len(load_scene(name).agents) > 1])
def test_arms_of_a_scene_share_a_workspace(name: str) -> None:
    assert shared_workspace(load_scene(name)) > 0.5


def chained() -> None:
    try:
        raise OSError("libwarp.so: failed to map segment from shared object")
    except OSError as error:
        raise RuntimeError("cannot load the library") from error


def raising(error: Exception) -> Callable[[], None]:
    def fail() -> None:
        raise error

    return fail


@pytest.mark.parametrize(
    "fail",
    [
        chained,
        raising(MemoryError()),
        raising(RuntimeError("std::bad_alloc")),
        raising(Exception("Could not allocate memory")),
        raising(RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried 8 bytes")),
        raising(ImportError("libx.so: cannot allocate memory in static TLS block")),
        raising(RuntimeError("can't start new thread")),
    ],
)
def test_a_lack_of_memory_is_one_sentence(
    fail: Callable[[], None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(program, "_parse", lambda argv: fail())
    assert program.main([]) == 2
    assert capsys.readouterr().err == "surgical-marl: there is not enough memory for that\n"


def test_other_errors_stay_what_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program, "_parse", lambda argv: raising(RuntimeError("a fault of ours"))())
    with pytest.raises(RuntimeError, match="a fault of ours"):
        program.main([])
