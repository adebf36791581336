"""The files of a run folder, and how they are read and written.

A run folder holds `config.yaml`, `checkpoint.pt`, `metrics.csv`, `curve.png`, `tensorboard/` and `train.lock`
(`surgical_marl/runs/lock.py`). What is made of them at the end, `eval.json`, `episodes.npz`, `video.mp4` and
`report.html`, is written elsewhere. If there were several processes, `environments-*.pt` of the other ranks are beside
the checkpoint. If training diverged, there is also `diverged.json`; if environments became NaN, `fault-*.npz`
(`surgical_marl/runs/fault.py`).

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
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast

import torch

from surgical_marl.files import write_atomic
from surgical_marl.runs.settings import Settings, config_text, read_config
from surgical_marl.untrusted.arrays import check_checkpoint
from surgical_marl.untrusted.files import MB, check_file, is_file
from surgical_marl.untrusted.values import listed
from surgical_marl.yaml_file import read_yaml

CONFIG, CHECKPOINT, METRICS, CURVE = "config.yaml", "checkpoint.pt", "metrics.csv", "curve.png"
DIVERGED = "diverged.json"
WEIGHTS = ".safetensors"
"""Suffix of the weight files of a shipped policy."""
MAX_METRICS = 100 * MB
MOST_PARTS = 100_000
"""Values of a checkpoint, each tensor as one."""
"""Bytes of `metrics.csv`, a quarter of a million iterations."""
PACKAGES = ("surgical-marl", "torch", "rsl-rl-lib", "jax", "mujoco", "mujoco-mjx", "numpy")


def claim_folder(out: Path) -> None:
    """Make the folder of a new run. ValueError if it cannot be written or already holds a run."""
    if any((out / name).exists() for name in (CONFIG, CHECKPOINT)):
        raise ValueError(f"{out} already holds a run: choose another folder, or continue it with --resume {out}")
    check_writable(out)


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
    text = config_text(settings, {"versions": versions, "origin": origin})
    write_atomic(run / CONFIG, lambda path: path.write_text(text))


def read_origin(run: Path) -> dict[str, dict[str, str | None]]:
    """Return the `versions` and `origin` that `write_config` noted beside the settings; empty if a run has none."""
    notes = {name: values.get(name) for values in [read_yaml(run / CONFIG)] for name in ("versions", "origin")}
    return {name: dict(found) if isinstance(found, dict) else {} for name, found in notes.items()}


def has_begun(run: Path) -> bool:
    """Return whether a folder holds a run; a run has its settings from the start."""
    return is_file(run / CONFIG)


def read_settings(run: str | Path, overrides: Iterable[str] = ()) -> Settings:
    """Read the settings of a run or of a shipped policy, with `key=value` overrides.

    ValueError if it is not a run folder.
    """
    path = Path(run) / CONFIG
    if not is_file(path):
        raise ValueError(f"{run} is not a run folder: it has no {CONFIG}")
    return read_config(path, overrides)


def write_checkpoint(run: Path, checkpoint: Mapping[str, Any]) -> None:
    """Replace the checkpoint of a run."""
    write_atomic(run / CHECKPOINT, lambda path: _save(dict(checkpoint), path))


def _save(content: dict[str, Any], path: Path) -> None:
    """Let torch write a file. OSError if that fails, for which torch itself has errors of other kinds."""
    with path.open("wb") as file:
        kept = _FirstError(file)
        torch.save(content, cast(BinaryIO, kept))
        if kept.error is not None:
            raise kept.error


class _FirstError:
    """A file that keeps its first error, and takes everything after that without writing it."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        self._try(self._file.write, data)
        return len(data)

    def flush(self) -> None:
        self._try(self._file.flush)

    def _try(self, call: Callable[..., object], *arguments: Any) -> None:
        if self.error is None:
            try:
                call(*arguments)
            except OSError as error:
                self.error = error


def holds_weights(folder: Path) -> bool:
    """Return whether this folder holds a shipped policy."""
    return any(folder.glob(f"[!.]*{WEIGHTS}"))


def read_checkpoint(run: str | Path) -> dict[str, Any]:
    """Read the checkpoint of a run, on the CPU. ValueError if there is none or it is damaged."""
    path = Path(run) / CHECKPOINT
    if not path.is_file() and holds_weights(Path(run)):
        raise ValueError(f"{run} holds an exported policy, which can be evaluated but not resumed")
    if not path.is_file():
        raise ValueError(f"{run} is not a run folder: it has no {CHECKPOINT}")
    try:
        check_checkpoint(path)
        with warnings.catch_warnings(action="ignore"):  # torch's error for a file of another format
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        _check_parts(checkpoint)
        bad = not_finite(checkpoint["algorithm"])
    except Exception:  # torch.load raises many types of errors for a damaged file
        checkpoint, bad = None, []
    if not isinstance(checkpoint, dict) or not _is_whole(checkpoint):
        raise ValueError(f"{path} is damaged, or not a checkpoint of this program: restore it from a copy")
    if bad:
        raise ValueError(f"{path} holds numbers that are not finite ({listed(bad, 3)}): restore it from a copy")
    return checkpoint


def _check_parts(tree: Any) -> None:
    """Raise ValueError if what was loaded has too many parts, or a tensor has more numbers than the file.

    A tensor may repeat one number along an axis, and a list may hold another one many times: a file of a kilobyte could
    take any amount of memory or time.
    """
    waiting = [tree]
    for _ in range(MOST_PARTS):
        if not waiting:
            return
        part = waiting.pop()
        if isinstance(part, Mapping):
            waiting += part.values()
        elif isinstance(part, (list, tuple, set)):
            waiting += part
        elif isinstance(part, torch.Tensor):
            needed = part.numel() * part.element_size()
            if part.is_meta or needed > part.untyped_storage().nbytes():
                raise ValueError("a tensor has more numbers than the file")
    raise ValueError(f"more than {MOST_PARTS} parts")


def _is_whole(checkpoint: dict[str, Any]) -> bool:
    """Return whether a checkpoint has what every reader needs, counts that are some, and says what it is of."""
    counts = [checkpoint.get(name, 0) for name in ("iteration", "env_steps", "processes")]
    good = all(type(count) is int and 0 <= count < 2**62 for count in counts)
    of = checkpoint.get("of", {})
    known = isinstance(of, dict) and of.keys() <= {"task", "scene", "algo"}
    return good and known and {"iteration", "groups", "algorithm"} <= checkpoint.keys()


def not_finite(tree: Any, name: str = "") -> list[str]:
    """Return the names of tensors in dicts and lists in which a number is NaN or infinite."""
    if isinstance(tree, torch.Tensor):
        return [] if not tree.is_floating_point() or bool(tree.isfinite().all()) else [name]
    if not isinstance(tree, (Mapping, list, tuple)):
        return []
    parts = tree.items() if isinstance(tree, Mapping) else enumerate(tree)
    return [bad for key, part in parts for bad in not_finite(part, f"{name}.{key}" if name else str(key))]


def write_environments(run: Path, iteration: int, rank: int, processes: int, state: Mapping[str, Any]) -> None:
    """Write the part of an iteration's checkpoint that belongs to one further process."""
    write_atomic(_environments(run, iteration, rank, processes), lambda path: _save(dict(state), path))


def read_environments(run: Path, iteration: int, rank: int, processes: int) -> dict[str, Any] | None:
    """Read what `write_environments` wrote, on the CPU; None if it is not there or damaged."""
    path = _environments(run, iteration, rank, processes)
    try:
        check_checkpoint(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
        _check_parts(state)
    except Exception:  # as in `read_checkpoint`
        return None
    return state if isinstance(state, dict) else None


def remove_environments(run: Path, iteration: int, processes: int) -> None:
    """Remove files that don't belong to the checkpoint of this iteration and this number of processes."""
    kept = {_environments(run, iteration, rank, processes) for rank in range(1, processes)}
    for path in set(run.glob("environments-*.pt")) - kept:
        path.unlink(missing_ok=True)


def _environments(run: Path, iteration: int, rank: int, processes: int) -> Path:
    return run / f"environments-{iteration}-{rank}-of-{processes}.pt"


def write_divergence(run: Path, divergence: Mapping[str, Any]) -> None:
    """Write `diverged.json`."""
    write_atomic(run / DIVERGED, lambda path: path.write_text(json.dumps(divergence, indent=2) + "\n"))


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
    with (run / METRICS).open(newline="", errors="replace") as file, contextlib.suppress(ValueError, csv.Error):
        for row in csv.DictReader(line for line in file if line.endswith("\n")):
            if None in row:  # cells without a column
                break
            rows.append({key: float(cell or "nan") for key, cell in row.items()})
    return rows


def write_metrics(run: Path, columns: Iterable[str], rows: Iterable[Mapping[str, float]]) -> None:
    """Replace `metrics.csv`. A column that a row lacks is empty there."""

    def write(path: Path) -> None:
        with path.open("w", newline="") as file:
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
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
