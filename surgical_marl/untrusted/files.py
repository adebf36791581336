"""Files that strangers may have written: regular files of limited size, without links out of their folder."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import Any

MB = 1_000_000
MAX_JSON = 20 * MB


def user_path(text: str | os.PathLike[str]) -> Path:
    """Return a path that somebody named, with `~` replaced where there is such a user."""
    path = Path(text)
    try:
        return path.expanduser()
    except RuntimeError:
        return path


def is_file(path: str | os.PathLike[str]) -> bool:
    """Return whether there is a regular file at a path, which may be one that no file can have."""
    return _is(path, stat.S_ISREG)


def is_folder(path: str | os.PathLike[str]) -> bool:
    """Return whether there is a folder at a path, which may be one that no folder can have."""
    return _is(path, stat.S_ISDIR)


def check_file(path: Path, most: int, within: Path | None = None) -> int:
    """Return the size of a file in bytes.

    Args:
        path: of the file.
        most: the largest size that is read.
        within: a folder that the file must lie in, links resolved.

    Raises:
        ValueError: there is no such file, it is a device, a pipe or a folder, it is too large, or lies elsewhere.
    """
    try:
        found = os.stat(path)
        inside = within is None or path.resolve().is_relative_to(within.resolve())
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    return _checked(path, found, most, inside)


def read_bytes(path: Path, most: int, within: Path | None = None) -> bytes:
    """Return the content of a file; the arguments and the error are those of `check_file`."""
    check_file(path, most, within)
    try:
        # Without waiting: a pipe may have taken the file's place.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with open(descriptor, "rb") as file:
            _checked(path, os.fstat(descriptor), most, True)
            data = file.read(most + 1)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from None
    if len(data) > most:  # it grows
        raise ValueError(_too_large(path, most))
    return data


def read_text(path: Path, most: int, within: Path | None = None) -> str:
    """Return the text of a file in UTF-8; the arguments and the error are those of `check_file`."""
    try:
        return read_bytes(path, most, within).decode()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} cannot be read: it is no text in UTF-8, see byte {error.start}") from None


def read_json(path: Path, most: int = MAX_JSON) -> Any:
    """Return the content of a file in JSON; ValueError if it can't be read or holds something else."""
    text = read_text(path, most)
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError(f"{path} is not JSON that is read: it is nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"{path} is not JSON: {error}") from None


def _is(path: str | os.PathLike[str], kind: Any) -> bool:
    try:
        return bool(kind(os.stat(path).st_mode))
    except (OSError, ValueError):
        return False


def _checked(path: Path, found: os.stat_result, most: int, inside: bool) -> int:
    if not inside:
        raise ValueError(f"{path} cannot be read: it is a link out of its folder; copy the file into it")
    if not stat.S_ISREG(found.st_mode):
        raise ValueError(f"{path} cannot be read: it is a folder, a pipe or a device, and not a file")
    if found.st_size > most:
        raise ValueError(_too_large(path, most))
    return found.st_size


def _too_large(path: Path, most: int) -> str:
    return f"{path} is larger than {most / MB:g} MB, the most that is read"
