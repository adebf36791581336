"""Arrays that take a while to compute, kept on disk by what they were computed from."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterable

import numpy as np

from surgical_marl.runtime import cache_dir


def cached(kind: str, sources: Iterable[bytes], compute: Callable[[], np.ndarray]) -> np.ndarray:
    """What `compute` returns, from disk if these `sources` (code, files, numbers) were computed before.

    Each array appears whole or not at all; a cache that can't be read or written is no error.
    """
    digest = hashlib.sha256()
    for source in sources:
        digest.update(len(source).to_bytes(8, "little") + source)
    path = cache_dir() / kind / f"{digest.hexdigest()[:32]}.npy"
    with contextlib.suppress(OSError, ValueError, EOFError):  # not there yet, or damaged
        array: np.ndarray = np.load(path)
        return array
    array = compute()
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            np.save(file, array)
        os.replace(file.name, path)
    return array
