"""Programs that are ended at random moments, and full disks: the next command works, and nothing is half done.

`TRIALS=200 make test ARGS="-m slow tests/project/test_faults.py"` tries that many of each instead of a few.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import has_begun, read_metrics, read_settings
from tests.helpers.processes import end, start
from tests.helpers.runs import LONG, run, run_or_resume, same_state
from tests.project.test_reliability import limited

TRIALS = int(os.environ.get("TRIALS", 20))
COMMAND = [sys.executable, "-m", "surgical_marl"]

pytestmark = pytest.mark.slow


def check_whole(out: Path) -> int:
    """Read all of a run folder as it is left; return its iteration."""
    if not has_begun(out):
        return 0
    read_settings(out)
    rows = [row["iteration"] for row in read_metrics(out)]
    assert rows == sorted(set(rows))
    return int(read_checkpoint(out)["iteration"]) if (out / "checkpoint.pt").exists() else 0


class Nowhere:
    """Takes sentences that nobody reads."""

    def put(self, sentence: str) -> None:
        assert "\n" not in sentence


def test_training_is_ended_and_its_disk_is_full_at_random_moments(tmp_path: Path) -> None:
    moments, happened = random.Random(TRIALS), Counter[str]()
    broken, unbroken, reached = tmp_path / "broken", tmp_path / "unbroken", 0
    for _ in range(TRIALS):
        fault = moments.choice(["SIGKILL", "SIGTERM", "full disk"])
        if fault == "full disk":
            assert end([start(limited, LONG, broken, moments.randrange(9_000), Nowhere())]) == [0]
        else:
            process = start(run_or_resume, LONG, broken)
            time.sleep(moments.uniform(0.0, 0.6))
            os.kill(process.pid or 0, signal.Signals[fault])
            assert end([process])[0] in (-signal.Signals[fault], 128 + signal.SIGTERM)
        happened[fault] += 1
        before, reached = reached, check_whole(broken)
        assert reached >= before, "nothing is lost that was saved"
    last = replace(LONG, iterations=reached + 5)
    assert end([start(run_or_resume, last, broken)]) == end([start(run, last, unbroken)]) == [0]
    assert same_state(broken, unbroken)
    assert not list(broken.glob(".*"))
    print(f"{dict(happened)} in {reached} iterations")


COMMANDS = {
    "eval": (["eval", "reach-psm", "--episodes", "20", "--csv", "a.csv", "--figure", "a.png"], ["a.csv", "a.png"]),
    "export scene": (["export", "scene", "bimanual_psm", "--out", "a.xml"], ["a.xml"]),
    "report": (["report", "reach-psm", "--out", "a.html"], ["a.html"]),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_commands_that_are_ended_leave_whole_files_or_none(name: str, tmp_path: Path) -> None:
    """And the same command works after that, with the same files."""
    command, files = COMMANDS[name]
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    for folder in (whole, broken):
        folder.mkdir()
    began = time.monotonic()
    subprocess.run([*COMMAND, *command], cwd=whole, check=True, capture_output=True)
    usual, moments = time.monotonic() - began, random.Random(TRIALS)
    for _ in range(TRIALS):
        process = subprocess.Popen(
            [*COMMAND, *command], cwd=broken, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(moments.uniform(0.5, 1.1) * usual)
        process.send_signal(moments.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT]))
        process.wait(60)
        for file in files:
            path = broken / file
            assert not path.exists() or path.stat().st_size >= 0.9 * (whole / file).stat().st_size
            path.unlink(missing_ok=True)
    subprocess.run([*COMMAND, *command], cwd=broken, check=True, capture_output=True)
    assert {path.name for path in broken.iterdir() if not path.name.startswith(".")} == set(files)


def test_the_export_of_a_policy_that_is_ended_leaves_no_folder(tmp_path: Path) -> None:
    moments, out = random.Random(TRIALS), tmp_path / "mine"
    command = [*COMMAND, "export", "policy", "reach-psm", "--out", str(out)]
    began = time.monotonic()
    subprocess.run(command, check=True, capture_output=True)
    usual, names = time.monotonic() - began, sorted(path.name for path in out.iterdir())
    out.rename(tmp_path / "whole")
    for _ in range(max(1, TRIALS // 5)):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(moments.uniform(0.2, 1.0) * usual)
        process.kill()
        process.wait(60)
        if out.exists():
            assert sorted(path.name for path in out.iterdir()) == names
            out.rename(tmp_path / f"done-{time.monotonic_ns()}")
    subprocess.run(command, check=True, capture_output=True)
    assert sorted(path.name for path in out.iterdir()) == names
