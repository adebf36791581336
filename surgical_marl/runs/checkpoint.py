"""The checkpoint of a run, from which training goes on: torch writes it, and what a stranger wrote is checked.

Apart from the other files of a run folder, because only this one needs torch, whose import takes a second.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast

import torch

from surgical_marl.files import write_atomic
from surgical_marl.runs.folder import CHECKPOINT, check_trained, has_begun, holds_weights, read_settings
from surgical_marl.runs.identity import check_identity
from surgical_marl.untrusted.arrays import check_checkpoint
from surgical_marl.untrusted.values import listed

MOST_PARTS = 100_000
"""Values of a checkpoint, each tensor as one."""


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


def read_checkpoint(run: str | Path) -> dict[str, Any]:
    """Read the checkpoint of a run, on the CPU. ValueError if there is none, it is damaged, or it is of another run."""
    path = Path(run) / CHECKPOINT
    if not path.is_file() and holds_weights(Path(run)):
        raise ValueError(f"{run} holds an exported policy, which can be evaluated but not resumed")
    check_trained(Path(run))
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
    if has_begun(path.parent):
        check_identity(checkpoint.get("of", {}), read_settings(path.parent), path)
    return checkpoint


def _check_parts(tree: Any) -> None:
    """Raise ValueError if a loaded tree has too many parts, or a tensor has more numbers than the file.

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
    """Return whether a checkpoint has the keys that every reader needs, valid counts, and an identity."""
    counts = [checkpoint.get(name, 0) for name in ("iteration", "env_steps", "processes")]
    good = all(type(count) is int and 0 <= count < 2**62 for count in counts)
    told = isinstance(checkpoint.get("of", {}), dict)
    return good and told and {"iteration", "groups", "algorithm"} <= checkpoint.keys()


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
    """Read a file of `write_environments`, on the CPU; None if it is not there or damaged."""
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
