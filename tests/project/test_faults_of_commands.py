"""The commands themselves meet six kinds of faults: no file is half written, and the same command works after that.

`TRIALS=200 make test ARGS="-s -m slow tests/project/test_faults_of_commands.py"` tries so many, of all commands and
faults in turn, and prints how each of them ended. `SEED=1` has other moments. Fewer of them:
`COMMANDS=eval,play FAULTS=memory`.
"""

from __future__ import annotations

import os
import random
from collections import Counter
from pathlib import Path

import pytest

from tests.helpers.command_faults import (
    COMMANDS,
    FAULTS,
    broken,
    clear,
    full,
    grow,
    missing,
    run,
    run_with,
    said_well,
    same,
    unmount,
)

TRIALS, SEED = int(os.environ.get("TRIALS", 14)), int(os.environ.get("SEED", 0))
CHOSEN = os.environ.get("COMMANDS", ",".join(COMMANDS)).split(",")
FACED = os.environ.get("FAULTS", ",".join(FAULTS)).split(",")


def trial(name: str, fault: str, folder: Path, whole: Path, moments: random.Random, usual: float) -> tuple[str, str]:
    """Return how a command ended under a fault, and what was wrong with that or after it."""
    work = folder / "work"
    work.mkdir(parents=True)
    if fault == "full disk":
        size = sum(path.stat().st_size for path in whole.rglob("*") if path.is_file())
        assert full(work, moments, size)
    try:
        met = run_with(fault, name, work, moments, usual)
        wrong = broken(work, name, whole)
        if not said_well(fault, met):
            wrong.append(f"it ended with {met.code}: {met.error[-2000:]}")
        if fault == "full disk":
            grow(work)
        clear(work, name)
        after = run(name, work)
        if after.code:
            wrong.append(f"the next command ended with {after.code}: {after.error[-2000:]}")
        elif not same(work, name, whole):
            wrong.append("the next command led to something else")
        how = "stuck" if met.stuck else "done" if met.code == 0 else "refused" if met.code == 2 else "ended"
        return how, "; ".join(wrong)
    finally:
        unmount(work)


@pytest.mark.slow
def test_commands_meet_faults_at_random_moments(tmp_path: Path) -> None:
    moments = random.Random(SEED)
    count, failed = Counter[tuple[str, str, str]](), list[str]()
    (tmp_path / "probe").mkdir()
    faults = [fault for fault in FACED if not (why := missing(fault, tmp_path / "probe")) or print(f"{fault}: {why}")]
    usual = dict[str, float]()
    for number in range(TRIALS):
        name = CHOSEN[number % len(CHOSEN)]
        fault = faults[number // len(CHOSEN) % len(faults)]
        whole = tmp_path / f"whole {name}"
        if name not in usual:
            for folder in (tmp_path / f"first {name}", whole):  # the first fills caches, which takes longer
                folder.mkdir()
                unbroken = run(name, folder)
                assert unbroken.code == 0, unbroken.error
            usual[name] = unbroken.seconds
            print(f"{name}: {usual[name]:.1f} s", flush=True)
        how, wrong = trial(name, fault, tmp_path / str(number), whole, moments, usual[name])
        count[name, fault, how] += 1
        print(f"{number}: {name}, {fault}: {how}. {wrong}", flush=True)
        if wrong:
            failed.append(f"{name}, {fault}: {wrong}")
    for (name, fault, how), times in sorted(count.items()):
        print(f"| {name} | {fault} | {how} | {times} |")
    assert not failed, "\n".join(failed)


def test_a_scene_whose_disk_is_full_is_written_when_there_is_room(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    if why := missing("full disk", tmp_path / "work"):
        pytest.skip(why)
    try:
        assert full(tmp_path / "work", random.Random(0), 0)
        for ended, name in ((2, "refused"), (0, "written")):
            found = run("export scene", tmp_path / "work")
            assert found.code == ended, (name, found.error)
            if ended:
                assert "No space left on device" in found.error and found.error.count("\n") == 1
                assert not list((tmp_path / "work").iterdir())
                grow(tmp_path / "work")
        assert broken(tmp_path / "work", "export scene", tmp_path) == []
    finally:
        unmount(tmp_path / "work")
