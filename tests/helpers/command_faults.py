"""Commands that meet a fault at a random moment, and what must hold afterwards.

Six faults: SIGKILL, SIGTERM, no more memory, a full disk, a folder that becomes read-only, a clock that jumps. Three of
them need Linux and a program of the system: see `missing`.
"""

from __future__ import annotations

import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as iio
from PIL import Image

from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import has_begun, read_metrics, read_settings
from tests.helpers.clock import JUMPS, can_jump, jump, own_clock
from tests.helpers.runs import same_state

PROGRAM = [sys.executable, "-m", "surgical_marl"]
_TRAIN = ["train", "reach", "--scene", "psm", "--num-envs", "64", "--iterations", "12", "--device", "cpu"]
COMMANDS: dict[str, tuple[list[str], list[str]]] = {
    "train": ([*_TRAIN, "checkpoint_every=2", "max_steps=20", "--resume", "run"], ["run"]),
    "eval": (["eval", "reach-psm", "--episodes", "10", "--csv", "a.csv", "--figure", "a.png"], ["a.csv", "a.png"]),
    "export scene": (["export", "scene", "psm", "--out", "a.xml"], ["a.xml"]),
    "export policy": (["export", "policy", "reach-psm", "--out", "mine"], ["mine"]),
    "play": (["play", "reach", "--scene", "psm", "--size", "160x120", "--plain", "--out", "a.gif"], ["a.gif"]),
    "report": (["report", "reach-psm", "--out", "a.html"], ["a.html"]),
    "compile": (["eval", "zero", "--task", "reach", "--scene", "psm", "--episodes", "2", "--csv", "a.csv"], ["a.csv"]),
}
"""What is run, and the files or folders that it writes. "compile" has a cache of its own, which is empty at first."""
FAULTS = ("SIGKILL", "SIGTERM", "memory", "full disk", "read-only", "clock")
STUCK = 30.0
"""Seconds beyond three times the usual after which a command is ended. Without memory this happens: OpenBLAS, which
scipy loads, tries to get some for ever."""
ROOM = 64_000_000
"""Bytes by which memory may still grow at most after that fault."""


def missing(fault: str, folder: Path) -> str | None:
    """Return why a fault cannot be made here; None if it can."""
    if fault == "read-only":
        tried = subprocess.run(["chattr", "+i", folder], capture_output=True) if shutil.which("chattr") else None
        _thaw(folder)
        return None if tried is not None and tried.returncode == 0 else "chattr +i is not possible"
    if fault == "clock":
        return None if can_jump() else "there is no C compiler"
    if fault == "full disk":
        return None if _mounted(folder, 1_000_000) and not _unmount(folder) else "no tmpfs can be mounted"
    return None if sys.platform == "linux" else "not Linux"


@dataclass
class Ended:
    """How a command ended."""

    code: int
    error: str
    seconds: float
    stuck: bool = False


def run(name: str, folder: Path) -> Ended:
    """Run a command without a fault."""
    began = time.monotonic()
    done = subprocess.run([*PROGRAM, *COMMANDS[name][0]], cwd=folder, env=_surroundings(name, folder),
                          capture_output=True, text=True)  # fmt: skip
    return Ended(done.returncode, done.stderr, time.monotonic() - began)


def run_with(fault: str, name: str, folder: Path, moments: random.Random, usual: float) -> Ended:
    """Run a command, let it meet a fault at a moment of its `usual` seconds, and undo the fault when it has ended."""
    own, log, began = _surroundings(name, folder), folder.parent / "stderr", time.monotonic()
    if fault == "clock":
        own |= own_clock(folder.parent / "clock")
    with log.open("w") as file:
        process = subprocess.Popen([*PROGRAM, *COMMANDS[name][0]], cwd=folder, env=own, stdout=file, stderr=file)
        try:
            process.wait(moments.uniform(0.1, 1.0) * usual)
        except subprocess.TimeoutExpired:
            _strike(fault, process, folder, moments)
        try:
            process.wait(STUCK + 3 * usual)
        except subprocess.TimeoutExpired:
            if fault != "memory":
                raise
        finally:
            stuck = process.poll() is None
            process.kill()
            _thaw(folder)
    return Ended(process.wait(), log.read_text(), time.monotonic() - began, stuck)


def _strike(fault: str, process: Any, folder: Path, moments: random.Random) -> None:
    if fault.startswith("SIG"):
        process.send_signal(signal.Signals[fault])
    elif fault == "memory":
        status = Path("/proc", str(process.pid), "status").read_text()
        if found := re.search(r"VmData:\s+(\d+)", status):  # it has not ended meanwhile
            most = 1024 * int(found[1]) + moments.randrange(ROOM)
            resource.prlimit(process.pid, resource.RLIMIT_DATA, (most, most))
    elif fault == "read-only":
        for path in [folder, *(path for path in folder.rglob("*") if path.is_dir())]:
            subprocess.run(["chattr", "+i", path], capture_output=True)
    elif fault == "clock":
        jump(folder.parent / "clock", moments.choice(JUMPS))


def full(folder: Path, moments: random.Random, size: int) -> bool:
    """Mount a small disk on a folder, with room for a part of `size` bytes."""
    return _mounted(folder, max(4096, round(moments.uniform(0.0, 1.1) * size)))


def grow(folder: Path) -> None:
    """Give that disk as much room as is needed."""
    subprocess.run(["mount", "-o", "remount,size=500m", folder], check=True)


def broken(folder: Path, name: str, whole: Path) -> list[str]:
    """Return what is wrong with the files that a command has left: those that are there must be whole."""
    wrong = []
    for made in COMMANDS[name][1]:
        path = folder / made
        for file in [path] if path.is_file() else sorted(path.rglob("*")):
            try:
                _check(file)
            except Exception as error:  # whatever a damaged file raises
                wrong.append(f"{file.relative_to(folder)}: {error}")
        if name == "export policy" and path.exists() and _names(path) != _names(whole / made):
            wrong.append(f"{made} has {_names(path)}")
    return wrong


def same(folder: Path, name: str, whole: Path) -> bool:
    """Return whether a command wrote what it writes without a fault, and left no temporary files of its own there."""
    if name == "train":
        left = [path for path in (folder / "run").rglob(".*")]
        return same_state(folder / "run", whole / "run") and not left
    exact = [made for made in COMMANDS[name][1] if Path(made).suffix in (".csv", ".xml", ".gif")]
    return all((folder / made).read_bytes() == (whole / made).read_bytes() for made in exact) and all(
        _names(folder / made) == _names(whole / made) for made in COMMANDS[name][1]
    )


def said_well(fault: str, ended: Ended) -> bool:
    """Return whether a command ended as it may after a fault: done, ended by it, or refused in one sentence."""
    if fault in ("SIGKILL", "SIGTERM"):
        return ended.code in (0, -signal.Signals[fault], 128 + signal.SIGTERM)
    if fault == "clock":
        return ended.code == 0
    if fault == "memory":  # libraries in C end the process by themselves, with exit codes and words of their own
        return "Traceback" not in ended.error
    return ended.code == 0 or (ended.code == 2 and "Traceback" not in ended.error)


def clear(folder: Path, name: str) -> None:
    """Remove what a command that does not go on has written, as commands don't write over files."""
    for made in COMMANDS[name][1] if name != "train" else ():
        path = folder / made
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)


def unmount(folder: Path) -> None:
    """Take a small disk away, if there is one."""
    if os.path.ismount(folder):
        _unmount(folder)


def _check(file: Path) -> None:
    """Raise some error if a file is not whole."""
    if file.suffix == ".png":
        with Image.open(file) as image:
            image.load()
    elif file.suffix in (".gif", ".mp4", ".webp"):
        assert len(iio.imread(file)) > 0
    elif file.suffix == ".html":
        assert file.read_text().rstrip().endswith("</html>"), "it is cut short"
    elif file.suffix == ".xml":
        assert file.read_text().rstrip().endswith("</mujoco>"), "it is cut short"
    elif file.name == "checkpoint.pt":
        read_checkpoint(file.parent)
    elif file.name == "metrics.csv":
        rows = [row["iteration"] for row in read_metrics(file.parent)]
        assert rows == sorted(set(rows)), "its rows are in disorder"
    elif file.name == "config.yaml":
        assert has_begun(file.parent)
        read_settings(file.parent)
    elif file.suffix == ".csv":
        assert file.read_text().endswith("\n"), "it is cut short"


def _names(path: Path) -> list[str]:
    return sorted(each.name for each in path.iterdir()) if path.is_dir() else [path.name]


def _surroundings(name: str, folder: Path) -> dict[str, str]:
    own = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    return {**own, "XDG_CACHE_HOME": str(folder / "cache")} if name == "compile" else own


def _thaw(folder: Path) -> None:
    if shutil.which("chattr"):
        subprocess.run(["chattr", "-R", "-i", folder], capture_output=True)


def _mounted(folder: Path, size: int) -> bool:
    return subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder],
                          capture_output=True).returncode == 0  # fmt: skip


def _unmount(folder: Path) -> int:
    return subprocess.run(["umount", "-l", folder], capture_output=True).returncode
