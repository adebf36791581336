"""The files of a run folder, and how they are read and written, but for its checkpoint (`runs/checkpoint.py`).

A run folder holds `config.yaml`, `checkpoint.pt`, `metrics.csv`, `curve.png`, `tensorboard/` and `train.lock`,
and a user's own scene in `content/` (`surgical_marl/runs/content.py`). What is made of
them at the end, `eval.json`, `episodes.npz`, `video.mp4` and `report.html`, is written elsewhere. If there were several
processes, `environments-*.pt` of the other ranks are beside the checkpoint. If training diverged, there is also
`diverged.json`; if environments became NaN, `fault-*.npz` (`surgical_marl/runs/fault.py`).

A shipped policy has safetensors instead of the checkpoint (`surgical_marl/evaluation/export.py`). Every write is
atomic, except that `metrics.csv` grows by rows.
"""

from __future__ import annotations

import contextlib
import csv
import importlib.metadata
import json
import math
import os
import platform
import subprocess
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from surgical_marl.content import find, list_policies
from surgical_marl.files import is_temporary, write_atomic, write_text
from surgical_marl.runs.content import stored_scene
from surgical_marl.runs.settings import Settings, config_text, read_config
from surgical_marl.untrusted.files import MB, check_file, is_file, user_path
from surgical_marl.untrusted.values import listed, shown
from surgical_marl.yaml_file import read_yaml

LOCK = "train.lock"
"""An empty file that stays in the folder. The system's lock on it ends with the process that holds it, however that
ends."""


CONFIG, CHECKPOINT, METRICS, CURVE = "config.yaml", "checkpoint.pt", "metrics.csv", "curve.png"
DIVERGED = "diverged.json"
WEIGHTS = ".safetensors"
"""Suffix of the weight files of a shipped policy."""
MAX_METRICS = 100 * MB
"""Bytes of `metrics.csv`, a quarter of a million iterations."""
PACKAGES = ("surgical-marl", "torch", "rsl-rl-lib", "jax", "mujoco", "mujoco-mjx", "numpy")


def find_run(run: str | Path) -> Path:
    """Find the folder of a policy that ships, by its name, or of a run, by its path.

    ValueError if there is none.
    """
    if str(run) in list_policies():
        return find("policies", str(run))
    if is_file(folder := user_path(run) / CONFIG):
        return folder.parent
    shipped = ", ".join(list_policies()) or "none yet"
    raise ValueError(
        f"{shown(str(run))} is not a run folder, nor zero, random, oracle or a policy that ships ({shipped})"
    )


def claim_folder(out: Path) -> None:
    """Make the folder of a new run. ValueError if it cannot be written, or already holds a run or something else."""
    if any((out / name).exists() for name in (CONFIG, CHECKPOINT)):
        raise ValueError(f"{out} already holds a run: choose another folder, or continue it with --resume {out}")
    check_own(out, LOCK)
    check_writable(out)


def check_own(out: Path, *ours: str) -> None:
    """Raise ValueError if a folder holds more than temporary files, and files of these names, with `*` for any text."""
    try:
        names = [path.name for path in out.iterdir()]
    except OSError:  # there is no such folder yet, or `check_writable` says what is wrong
        return
    strange = [name for name in names if not is_temporary(name) and not any(fnmatch(name, own) for own in ours)]
    if strange:
        raise ValueError(f"{out} is not empty, it holds {listed(sorted(strange), 3)}: name a new or an empty folder")


def check_writable(out: Path) -> None:
    """Make the folder if it is missing. ValueError if it cannot be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise ValueError(f"cannot write to the output folder {out}: {error.strerror}") from None


def write_config(run: Path, settings: Settings) -> None:
    """Write the settings, and the origin of the run: versions of packages, device, commit, time of this start."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    from surgical_marl.machine import machine  # imports JAX

    names = machine()
    origin = {
        "device": names["cpu"] if settings.device == "cpu" else names["gpu"] or names["cpu"],
        "commit": _commit(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }
    scene = stored_scene(settings.scene, run)
    write_text(run / CONFIG, config_text(settings, {"scene": scene, "versions": versions, "origin": origin}))


def read_origin(run: Path) -> dict[str, dict[str, str | None]]:
    """Return the `versions` and `origin` that `write_config` noted beside the settings; empty if a run has none."""
    notes = {name: values.get(name) for values in [read_yaml(run / CONFIG)] for name in ("versions", "origin")}
    return {name: dict(found) if isinstance(found, dict) else {} for name, found in notes.items()}


def has_begun(run: Path) -> bool:
    """Return whether a folder holds a run; a run has its settings from the start."""
    return is_file(run / CONFIG)


def read_settings(run: str | Path, overrides: Iterable[str] = ()) -> Settings:
    """Read the settings of a run or of a shipped policy, with `key=value` overrides.

    ValueError if it is not a run folder, or lacks its copy of a scene.
    """
    path = Path(run) / CONFIG
    if not is_file(path):
        raise ValueError(f"{run} is not a run folder: it has no {CONFIG}")
    return read_config(path, overrides)


def holds_weights(folder: Path) -> bool:
    """Return whether this folder holds a shipped policy."""
    return any(folder.glob(f"[!.]*{WEIGHTS}"))


def check_trained(run: Path) -> None:
    """Raise ValueError if a folder holds no networks: a run before its first checkpoint, or no run."""
    if not (run / CHECKPOINT).is_file() and not holds_weights(run):
        raise ValueError(
            f"{run} has no {CHECKPOINT} yet: a run has one after its first iterations, and `surgical-marl train "
            f"--resume {run}` goes on with it"
        )


def write_divergence(run: Path, divergence: Mapping[str, Any]) -> None:
    """Write `diverged.json`."""
    write_text(run / DIVERGED, json.dumps(divergence, indent=2) + "\n")


def format_row(row: Mapping[str, float]) -> list[str]:
    """Return the cells of a row of metrics. A rate over no episodes (NaN) is an empty cell."""
    return ["" if math.isnan(value) else format(value, ".9g") for value in row.values()]


def read_metrics(run: Path) -> list[dict[str, float]]:
    """Read the rows of `metrics.csv`. An empty cell is NaN.

    If there is no file, there are no rows. A row that was cut short is left out, and so are the rows after it.

    ValueError if the file is too large.
    """
    if not is_file(run / METRICS):
        return []
    check_file(run / METRICS, MAX_METRICS)
    rows: list[dict[str, float]] = []
    with (
        (run / METRICS).open(newline="", encoding="utf-8", errors="replace") as file,
        contextlib.suppress(ValueError, csv.Error),
    ):
        for row in csv.DictReader(line for line in file if line.endswith("\n")):
            if None in row:  # cells without a column
                break
            rows.append({key: float(cell or "nan") for key, cell in row.items()})
    return rows


def write_metrics(run: Path, columns: Iterable[str], rows: Iterable[Mapping[str, float]]) -> None:
    """Replace `metrics.csv`. A column that a row lacks is empty there."""

    def write(path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(names := list(columns))
            writer.writerows(format_row({name: row.get(name, math.nan) for name in names}) for row in rows)

    write_atomic(run / METRICS, write)


def _commit() -> str | None:
    """Return the commit of the code that runs, or None if it is unknown.

    It is `GIT_COMMIT` where that is set, as for a copy without git, and else the commit of the checkout.
    """
    root = Path(__file__).parents[2]
    if told := os.environ.get("GIT_COMMIT"):
        return told
    if not (root / ".git").exists():  # an installed package may lie inside another project's repository
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, encoding="utf-8", check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


@contextlib.contextmanager
def owned(run: Path, doing: str = "trains in it") -> Iterator[None]:
    """Hold the lock of a run folder, or of another one in which a process is `doing` something.

    Where there is no folder yet, or the system can't lock files in it, nothing is locked.

    Raises:
        ValueError: another process holds it.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(run / LOCK)
    with contextlib.ExitStack() as held:
        try:
            lock.acquire(timeout=0)
            held.callback(lock.release)
        except Timeout:
            raise ValueError(
                f"{run} is in use: another process {doing}; wait until it ends, or name another folder"
            ) from None
        except (OSError, NotImplementedError):
            pass
        yield
