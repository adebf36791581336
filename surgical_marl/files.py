"""Files that are written completely or not at all."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable
from pathlib import Path


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


def remove_temporaries(folder: Path) -> None:
    """Remove temporary files that `write_atomic`, or a film, leaves in a folder if its process is killed."""
    for temporary in folder.glob(".*"):
        if is_temporary(temporary.name):
            temporary.unlink(missing_ok=True)


def is_temporary(name: str) -> bool:
    """Return whether a file of this name is one that `remove_temporaries` removes."""
    return re.fullmatch(r"\..+\.\d+\.(tmp|mp4|gif|webp)", name) is not None


def _flush(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
