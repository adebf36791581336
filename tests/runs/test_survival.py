"""Runs that are killed: `--resume` goes on as if nothing had been, and no run is lost or corrupt."""

from __future__ import annotations

import os
import pickle
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from surgical_marl.cli.main import main
from surgical_marl.files import write_atomic
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import read_metrics
from tests.helpers.processes import end, start
from tests.helpers.runs import LONG, MOMENTS, SMALL, run, run_or_resume, run_until, same_state

KILLED = -signal.SIGKILL


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An unbroken run."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert end([start(run, SMALL, out)]) == [0]
    return out


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_at_a_moment(moment: str, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert end([start(run_until, SMALL, out, moment)]) == [KILLED]
    assert end([start(run_or_resume, SMALL, out)]) == [0]
    assert same_state(out, whole)
    assert not list(out.glob(".*")), "what was half written is gone"


def test_killed_at_random_moments(tmp_path: Path) -> None:
    moments = random.Random(0)
    broken, unbroken = tmp_path / "broken", tmp_path / "unbroken"
    for _ in range(10):
        process = start(run_or_resume, LONG, broken)
        time.sleep(moments.uniform(0.0, 0.6))
        process.kill()
        assert end([process]) == [KILLED]
    reached = read_checkpoint(broken)["iteration"] if (broken / "checkpoint.pt").exists() else 0
    last = replace(LONG, iterations=reached + 5)
    assert end([start(run_or_resume, last, broken)]) == end([start(run, last, unbroken)]) == [0]
    assert same_state(broken, unbroken)


def test_a_row_that_was_cut_short_is_dropped(tmp_path: Path) -> None:
    whole = "iteration,reward\r\n1,0.5\r\n2,0.25\r\n"
    for rest in ("", "3", "3,0.1", "3,0.125\r", "3,0.\0\0\r\n4,1\r\n"):
        (tmp_path / "metrics.csv").write_bytes((whole + rest).encode())
        assert read_metrics(tmp_path) == [{"iteration": 1, "reward": 0.5}, {"iteration": 2, "reward": 0.25}]


def test_a_file_is_on_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done, original = [], os.replace
    monkeypatch.setattr(os, "fsync", lambda descriptor: done.append(os.readlink(f"/proc/self/fd/{descriptor}")))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append("replace"), original(a, b)))
    write_atomic(tmp_path / "file", lambda path: path.write_text("new"))
    temporary, replaced, folder = done
    assert Path(temporary).name.startswith(".file.") and replaced == "replace" and folder == str(tmp_path)


class Trap:
    """What a pickle can do to whoever loads it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (Path.touch, (self.path,))


def test_checkpoints_that_cannot_be_resumed(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    checkpoint, good = tmp_path / "run" / "checkpoint.pt", (whole / "checkpoint.pt").read_bytes()
    checkpoint.parent.mkdir()
    config = (whole / "config.yaml").read_text()
    state = read_checkpoint(whole)
    trap, caught = pickle.dumps(Trap(tmp_path / "sprung"), 2), tmp_path / "sprung"
    other = {**state, "of": {**state["of"], "scene": "ecm"}}

    def refused(words: list[str], *flags: str) -> None:
        assert main(["train", "--resume", "run", "--iterations", "9", *flags]) == 2
        out, err = capsys.readouterr()
        assert not out and err.startswith("surgical-marl: ") and "Traceback" not in err
        assert all(word in err for word in words), err

    (checkpoint.parent / "config.yaml").write_text(config)
    for data in (good[: len(good) // 2], b"", trap, b"junk"):
        checkpoint.write_bytes(data)
        refused(["run/checkpoint.pt is damaged, or not a checkpoint"])
    assert not caught.exists()
    torch.save({"iteration": Trap(caught), "groups": {}, "algorithm": {}}, checkpoint)
    refused(["damaged"])
    assert not caught.exists(), "a checkpoint is data: nothing in it is run"
    torch.save(other, checkpoint)
    refused(["run/checkpoint.pt is of scene 'ecm'", "'psm'"])
    torch.save({**state, "iteration": 10}, checkpoint)
    refused(["already has 10 iterations", "more than 9"])
    torch.save({name: value for name, value in state.items() if name != "of"}, checkpoint)
    refused(["networks in the checkpoint"])  # those of fake arms
    checkpoint.write_bytes(good)
    if not torch.cuda.is_available():
        refused(["'cuda' is not there"], "--device", "cuda")
    assert (checkpoint.parent / "config.yaml").read_text() == config


@pytest.mark.slow
def test_the_command_killed_at_random_moments(tmp_path: Path) -> None:
    """As a scheduler would do it: always the same command."""
    moments = random.Random(1)

    def command(out: Path, iterations: int) -> list[str]:
        sizes = ["--num-envs", "32", "steps_per_iteration=4", "checkpoint_every=2", "network.hidden=[32]"]
        what = ["reach", "--scene", "psm", "--device", "cpu", "--iterations", str(iterations)]
        return [sys.executable, "-m", "surgical_marl", "train", *what, *sizes, "--out", str(out), "--resume", str(out)]

    broken, unbroken = tmp_path / "broken", tmp_path / "unbroken"
    for _ in range(20):
        process = subprocess.Popen(command(broken, 1_000_000), stderr=subprocess.DEVNULL)
        time.sleep(moments.uniform(0.0, 12.0))
        process.kill()
        assert process.wait() == KILLED
    last = read_checkpoint(broken)["iteration"] + 3
    for out in (broken, unbroken):
        subprocess.run(command(out, last), check=True, stdout=subprocess.DEVNULL)
    assert same_state(broken, unbroken)
    assert (broken / "eval.json").read_text() == (unbroken / "eval.json").read_text()
