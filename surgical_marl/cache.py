"""Arrays that take a while to compute, kept on disk by what they were computed from."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from surgical_marl.runtime import cache_dir

_GEOMETRY = ("arm", "contacts", "describe", "geometry", "inverse_kinematics", "paths", "scene", "spline", "workspace")


def cached(
    kind: str,
    settings: str,
    fingerprint: bytes,
    compute: Callable[[], np.ndarray],
    code: tuple[str, ...] = _GEOMETRY,
) -> np.ndarray:
    """What `compute` returns, from disk if it was computed before for these settings, this scene and this version.

    Args:
        kind: the folder within the cache.
        settings: all that the result depends on besides the scene.
        fingerprint: the scene's.
        compute: the work. Its array appears on disk whole or not at all; a cache that fails is no error.
        code: the modules of this package that it comes from, or patterns of them: if one changes, it is computed anew.
    """
    digest = hashlib.sha256("\0".join([kind, settings, _digest(code)]).encode() + fingerprint)
    path = cache_dir() / kind / f"{digest.hexdigest()[:32]}.npz"
    with contextlib.suppress(OSError, ValueError, EOFError, KeyError, BadZipFile, zlib.error):  # not there, or damaged
        array: np.ndarray = np.load(path)["array"]
        return array
    array = compute()
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            np.savez(file, array=array)
        os.replace(file.name, path)
    return array


@functools.cache
def _digest(code: tuple[str, ...]) -> str:
    files = (file for name in code for file in sorted(Path(__file__).parent.glob(f"{name}.py")))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
