"""Archives of arrays that strangers may have written: npz files, torch's checkpoints, safetensors."""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np

from surgical_marl.untrusted.files import MB, check_file
from surgical_marl.untrusted.values import check_count, one_line

MAX_NPZ = 500 * MB
"""Bytes of all arrays of an npz file, unpacked."""
MAX_WEIGHTS = 500 * MB
"""Bytes of a file of weights."""
MAX_HEADER = MB
"""Largest header of a file, which describes its arrays, in bytes."""
MAX_MEMBERS = 10_000


def read_npz(path: Path, most: int = MAX_NPZ) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file by name.

    Raises:
        ValueError: it can't be read, is damaged, holds objects, or is larger than `most` bytes when unpacked.
    """
    check_file(path, most)
    try:
        with zipfile.ZipFile(path) as archive:
            _check_members(archive, most, path)
            return {info.filename.removesuffix(".npy"): _read_array(archive, info) for info in archive.infolist()}
    except Exception as error:  # zipfile, zlib and numpy have many types of errors for damaged data
        raise ValueError(f"{path} is no npz file that can be read: {one_line(' '.join(str(error).split()))}") from None


def check_checkpoint(path: Path) -> None:
    """Raise ValueError if a file is not an archive as torch writes it: a zip file whose parts are not compressed.

    Such a file takes as much memory as its size says. Older formats of torch, and pickles, say themselves how much
    memory they take.
    """
    check_file(path, 2**62)
    try:
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()
            _check_members(archive, path.stat().st_size, path)
    except (OSError, zipfile.BadZipFile, NotImplementedError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no archive of torch: {error}") from None
    if any(info.compress_type != zipfile.ZIP_STORED for info in infos):
        raise ValueError(f"{path} is no archive of torch: its parts are compressed")


def read_header(path: Path) -> tuple[dict[str, Any], int]:
    """Return the header of a file of safetensors, and where the bytes of its tensors begin.

    ValueError if the file is too large, or says too much about them.
    """
    size = check_file(path, MAX_WEIGHTS)
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if not 2 <= length <= min(MAX_HEADER, size - 8):
            raise ValueError(f"{path} has a header of {length:,} bytes, and not of 2 to {min(MAX_HEADER, size - 8):,}")
        try:
            header = json.loads(file.read(length))
        except (ValueError, RecursionError):
            raise ValueError(f"{path} has a header that is not JSON") from None
    if not isinstance(header, dict):
        raise ValueError(f"{path} has a header that is no mapping")
    check_count(len(header), MAX_MEMBERS, "tensors", path)
    return header, 8 + length


def _check_members(archive: zipfile.ZipFile, most: int, path: Path) -> None:
    infos = archive.infolist()
    check_count(len(infos), MAX_MEMBERS, "parts", path)
    if (total := sum(info.file_size for info in infos)) > most:
        raise ValueError(f"its parts have {total:,} bytes, more than {most:,}")
    if len({info.filename for info in infos}) < len(infos):
        raise ValueError("two of its parts have the same name")


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """Return one array; its size is compared with the file's before there is room made for it."""
    with archive.open(info) as file:
        version = np.lib.format.read_magic(file)
        shape, _, dtype = _read_header(file, version)
        if dtype.hasobject or math.prod(shape) * dtype.itemsize > info.file_size:
            raise ValueError(f"{info.filename} holds objects, or less than it says")
    with archive.open(info) as file:
        return np.lib.format.read_array(file, allow_pickle=False, max_header_size=10_000)


def _read_header(file: IO[bytes], version: tuple[int, int]) -> Any:
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"arrays of version {version} are not read")
    return readers[version](file, max_header_size=10_000)
