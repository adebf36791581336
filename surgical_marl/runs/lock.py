"""The lock of a run folder: one process at a time trains in it. Others may read it meanwhile."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

LOCK = "train.lock"
"""An empty file that stays in the folder. The system's lock on it ends with the process that holds it, however that
ends."""


@contextlib.contextmanager
def owned(run: Path) -> Iterator[None]:
    """Hold the lock of a run folder.

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
                f"{run} is in use: another process trains in it; wait until it ends, or name another folder"
            ) from None
        except (OSError, NotImplementedError):
            pass
        yield
