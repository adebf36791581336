"""Files that are written completely or not at all, and folders of caches that can be written."""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

_ROOM = 64_000_000
"""Bytes that a folder for a cache must have room for, which is more than any file in it."""


def write_atomic(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file next to `path`, then put it in place in one step.

    After a power loss the old or the new file is there, and it is complete, because the new file is on disk before it
    gets its name.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        write(temporary)
        _flush(temporary, os.O_RDWR)
        os.replace(temporary, path)
        with contextlib.suppress(OSError):  # not every system can flush a folder
            _flush(path.parent, os.O_RDONLY)
    except OSError as error:
        if error.filename == str(temporary):
            error.filename = str(path)  # name the file that the caller asked for
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8, as `write_atomic` writes a file."""
    write_atomic(path, lambda part: part.write_text(text, encoding="utf-8"))


def write_npz(path: Path, arrays: Mapping[str, np.ndarray], compressed: bool = True) -> None:
    """Write arrays by name as an npz file, as `write_atomic` writes a file."""
    import numpy as np

    def write(part: Path) -> None:
        with part.open("wb") as file:  # a name without .npz would get one
            (np.savez_compressed if compressed else np.savez)(file, **arrays)  # type: ignore[arg-type]

    write_atomic(path, write)


def remove_temporaries(folder: Path) -> None:
    """Remove temporary files that `write_atomic`, or a film, leaves in a folder if its process is killed."""
    for temporary in folder.glob(".*"):
        if is_temporary(temporary.name):
            temporary.unlink(missing_ok=True)


def is_temporary(name: str) -> bool:
    """Return whether a file of this name is one that `remove_temporaries` removes."""
    return re.fullmatch(r"\..+\.\d+\.(tmp|mp4|gif|webp)", name) is not None


@functools.cache
def writable(folder: Path) -> Path:
    """Return the folder of a cache, or a temporary one if it can't be written or its disk is full.

    The temporary folder has links to all that the other one holds, and is removed when this process ends. A line on
    stderr says so for the first such folder.
    """
    try:
        if folder.parts[:1] == ("~",):
            raise FileNotFoundError(errno.ENOENT, "there is no home folder")
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
        if shutil.disk_usage(folder).free < _ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return folder
    except OSError as error:
        if not has_temporary_caches():
            advice = "what is compiled is lost when this program ends, unless XDG_CACHE_HOME names another folder"
            print(f"surgical-marl: cannot write to the cache {folder}: {error.strerror}; {advice}", file=sys.stderr)
    instead = Path(_temporary().name, *folder.parts[-2:])
    instead.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            (instead / path.name).symlink_to(path)
    return instead


def has_temporary_caches() -> bool:
    """Return whether a cache of this process is a temporary folder (see `writable`)."""
    return _temporary.cache_info().currsize > 0


@functools.cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="surgical-marl-")


def _flush(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
