"""policies/train_all.py: what there is to do, in which order, and what happens when a part fails or is stopped."""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from surgical_marl.plugins.tasks import list_tasks
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import CHECKPOINT, CONFIG, read_metrics
from surgical_marl.scenes.placing import scenes_for
from tests.helpers import ROOT


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "policies"))
    import train_all

    return train_all


def test_every_task_and_scene_has_a_policy_and_those_that_ship_are_left_alone(script: Any, tmp_path: Path) -> None:
    assert script.PLACES["needle_pick-psm_needle"]
    assert script.PLACES["match_image-ecm"] == ("match_image", "ecm", "default")
    levels = [name for name in script.PLACES if name.endswith(("-crossing", "-hard"))]
    usual = sum(len(scenes_for(task)) for task in list_tasks())
    assert len(script.PLACES) == usual + len(levels) and "reach-bimanual_psm-crossing" in levels
    own = ("reach", "bimanual_psm", "crossing")
    assert script.PLACES["reach-bimanual_psm-crossing"] == own and script._fits(*own)
    assert script.PLACES["peg_transfer-bimanual_psm_pegs-hard"] == ("peg_transfer", "bimanual_psm_pegs", "hard")
    assert not script._fits("reach", "psm", "crossing") and script._fits("reach", "psm", "default")
    known = {path.parent.name for path in (ROOT / "policies").glob("*/config.yaml")}
    assert known <= script.PLACES.keys()
    arguments = argparse.Namespace(out=tmp_path, runs=tmp_path / "runs", seeds=[0, 3])
    first, second, last = script._jobs("track-psm", arguments, ["num_envs=64"])
    asked = ["seed=0", "start=random", "num_envs=64"]
    assert first.arguments == ("track", "psm", tmp_path / "runs" / "track-psm" / "seed0", asked)
    assert second.what == "seed3" and not second.needs
    (crossing, *_) = script._jobs("reach-bimanual_psm-crossing", arguments, [])
    assert crossing.arguments[3] == ["seed=0", "difficulty=crossing"]
    assert (last.what, last.needs, len(last.arguments[0])) == ("export", 2, 2)
    (tmp_path / "track-psm").mkdir()
    assert script._jobs("track-psm", arguments, []) == []


def test_an_export_waits_for_its_seeds_and_a_failure_for_nobody(
    script: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = tmp_path / "good", tmp_path / "no" / "bad"

    def jobs(policy: str, folder: Path) -> list[Any]:
        return [
            script.Job(policy, "seed0", os.mkdir, (folder,), tmp_path / "logs" / "0.log"),
            script.Job(policy, "export", os.mkdir, (folder / "out",), tmp_path / "logs" / "out.log", 1),
        ]

    failed = script.run([*jobs("bad", bad), *jobs("good", good)], 2)
    assert (good / "out").is_dir() and not bad.exists()
    assert [(job.policy, job.what) for job in failed] == [("bad", "seed0"), ("bad", "export")]
    said = capsys.readouterr().out
    assert "bad seed0: FAILED, see" in said and "good export: done" in said
    assert "FileNotFoundError" in (tmp_path / "logs" / "0.log").read_text()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_who_stops_it_stops_what_it_started(number: int, tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; import train_all\n"
        "if __name__ == '__main__':\n"
        "    train_all.signal.signal(train_all.signal.SIGTERM, lambda *_: sys.exit(143))\n"
        "    train_all.run([train_all.Job('p', 'w', time.sleep, (600,), Path('log'))], 1)"
    )
    (tmp_path / "main.py").write_text(code)
    path = os.pathsep.join([str(ROOT), str(ROOT / "policies"), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen([sys.executable, "main.py"], cwd=tmp_path, env={**os.environ, "PYTHONPATH": path})
    children = _wait_for(lambda: _children(process.pid) if (tmp_path / "log").exists() else [])
    time.sleep(0.5)
    process.send_signal(number)
    process.wait(30)
    assert _wait_for(lambda: not any(_alive(child) for child in children))


def test_a_run_that_was_stopped_goes_on_from_wherever_it_was(script: Any, tmp_path: Path) -> None:
    small = ["num_envs=4", "steps_per_iteration=4", "iterations=2", "device=cpu"]
    run, unbroken = tmp_path / "run", tmp_path / "unbroken"
    script.train("reach", "psm", unbroken, small)
    run.mkdir()
    shutil.copy(unbroken / CONFIG, run)  # stopped before its first checkpoint
    script.train("reach", "psm", run, [*small, "iterations=1"])
    shutil.copy(run / CHECKPOINT, tmp_path)
    for _ in range(2):  # after the first it is done
        script.train("reach", "psm", run, small)
    assert read_checkpoint(run)["iteration"] == 2
    for other, words in (("iterations=1", "already has 2 iterations"), ("num_envs=8", "has num_envs 4")):
        with pytest.raises(ValueError, match=words):  # it is not what was asked for
            script.train("reach", "psm", run, [*small, other])
    shutil.copy(tmp_path / CHECKPOINT, run)  # stopped when the last metrics were written, and the last checkpoint not
    script.train("reach", "psm", run, small)
    assert read_checkpoint(run)["iteration"] == 2
    assert [row["reward"] for row in read_metrics(run)] == [row["reward"] for row in read_metrics(unbroken)]


def test_a_name_that_is_no_policy() -> None:
    command = [sys.executable, "policies/train_all.py", "--only", "reach-psmm"]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 2 and "did you mean 'reach-psm'" in done.stderr


def test_the_table_replaces_the_old_one(script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgical_marl.evaluation.card.table", lambda: "new")
    (tmp_path / "README.md").write_text("before\n<!-- table -->\nold\n<!-- end of table -->\nafter\n")
    script.write_table(tmp_path / "README.md")
    assert (tmp_path / "README.md").read_text() == "before\n<!-- table -->\nnew\n<!-- end of table -->\nafter\n"


def _children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def _alive(pid: int) -> bool:
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def _wait_for(get: Any, seconds: float = 30.0) -> Any:
    until = time.monotonic() + seconds
    while not (found := get()) and time.monotonic() < until:
        time.sleep(0.1)
    return found
