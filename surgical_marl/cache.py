"""Arrays that take a while to compute, kept on disk by what they were computed from."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from surgical_marl.runtime import cache_dir


def cached(kind: str, settings: str, fingerprint: bytes, compute: Callable[[], np.ndarray]) -> np.ndarray:
    """What `compute` returns, from disk if it was computed before for these settings, this scene and this version.

    Args:
        kind: the folder within the cache.
        settings: all that the result depends on besides the scene.
        fingerprint: the scene's.
        compute: the work. Its array appears on disk whole or not at all; a cache that fails is no error.
    """
    digest = hashlib.sha256("\0".join([kind, settings, _code()]).encode() + fingerprint)
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


@functools.cache
def _code() -> str:
    """A digest of the code that such arrays come from: when it changes, they are computed anew."""
    names = ("arm", "contacts", "describe", "geometry", "inverse_kinematics", "scene", "workspace")
    files = (Path(__file__).with_name(f"{name}.py") for name in names)
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
