"""Arrays that take a while to compute, kept on disk, keyed by everything that they were computed from.

What an array was computed from is data, code and the versions of the libraries that the code calls. The code is found
by following imports from the module that computes: no list of modules is kept by hand.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import os
import re
import sys
import tempfile
import uuid
import zlib
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from surgical_marl.runtime import cache_dir

THIS_PROCESS = uuid.uuid4().hex
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]*(\([^)]*\)|[^\n#]*)|import[ \t]+([\w., \t]+))", re.M
)


def cached(
    kind: str, compute: Callable[[], np.ndarray], *content: str | bytes, roots: Iterable[str] = ()
) -> np.ndarray:
    """Return what `compute` returns, from disk if it was computed before from the same content, code and libraries.

    Args: see `cached_arrays`.
    """
    return cached_arrays(kind, lambda: {"array": compute()}, *content, roots=(compute.__module__, *roots))["array"]


def cached_arrays(
    kind: str, compute: Callable[[], dict[str, np.ndarray]], *content: str | bytes, roots: Iterable[str] = ()
) -> dict[str, np.ndarray]:
    """Return what `compute` returns, arrays by name, as `cached` does with one.

    Args:
        kind: folder within the cache.
        compute: the work. Its arrays appear on disk completely or not at all. If the cache fails, that is no error.
        content: data that the result depends on.
        roots: modules whose code `compute` runs, besides the module that it is defined in and all that they import.
    """
    digest = hashlib.sha256(kind.encode())
    for part in (*content, code_digest(frozenset((compute.__module__, *roots))), *_versions()):
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little") + data)
    path = cache_dir() / kind / f"{digest.hexdigest()[:32]}.npz"
    if (arrays := _load(path)) is not None:
        return arrays
    with locked(path):
        if (arrays := _load(path)) is not None:  # another process has made the file meanwhile
            return arrays
        arrays = compute()
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]  # the one option is no array's name
            os.replace(file.name, path)
    return arrays


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock that belongs to a path of the cache, so that only one of several processes does the work.

    The lock of a process that dies is released. Where the system can't make a lock, nothing is locked.
    """
    from filelock import FileLock

    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError, NotImplementedError):
            path.parent.mkdir(parents=True, exist_ok=True)
            held.enter_context(FileLock(path.with_name(f".{path.name}.lock")))
        yield


def _load(path: Path) -> dict[str, np.ndarray] | None:
    """Return the arrays in a file of the cache; None if the file is not there, or is damaged."""
    try:
        with path.open("rb") as file, np.load(file) as found:
            return dict(found)
    except (OSError, ValueError, EOFError, KeyError, BadZipFile, zlib.error):
        return None


@functools.cache
def code_digest(roots: frozenset[str]) -> str:
    """Return a hash of the source of modules and of all that they import, directly or not, of their own packages.

    A program that runs as `__main__` is a module too, and the files beside it belong to it. Code without a file, such
    as a notebook's cells, counts as different in each process, so its results are never found again.

    Args:
        roots: names of modules, as in "surgical_marl.tasks.reach".
    """
    packages = {root.partition(".")[0] for root in roots} | {__name__.partition(".")[0]}
    waiting, seen = sorted(roots), dict[str, str]()
    while waiting:
        name = waiting.pop()
        if name in seen or not (name.partition(".")[0] in packages or _beside_main(name, roots)):
            continue
        if path := _file(name):
            seen[name], imported = _read(path)
            waiting += imported
        elif name in roots:
            seen[name] = THIS_PROCESS
    return hashlib.sha256(repr(sorted(seen.items())).encode()).hexdigest()


def _beside_main(module: str, roots: frozenset[str]) -> bool:
    """Return whether a module lies beside the program that runs, if the program is one of the roots."""
    main = _file("__main__") if "__main__" in roots else None
    return main is not None and any((main.parent / f"{module.partition('.')[0]}{end}").exists() for end in ("", ".py"))


@functools.cache
def _read(path: Path) -> tuple[str, list[str]]:
    """Return the hash of a source file, and the names that it may import: of modules, and of objects in modules."""
    text = path.read_text()
    return hashlib.sha256(text.encode()).hexdigest(), list(_imported(text))


def _imported(text: str) -> Iterator[str]:
    for package, names, modules in _IMPORT.findall(text):
        for name in re.findall(r"[\w.]+", modules):
            yield name
        if package:
            yield package
            for name in re.findall(r"\w+", names):
                yield f"{package}.{name}"


def _file(module: str) -> Path | None:
    """Return the source file of a module or package; None if it has no such file, or if there is no such module."""
    if module == "__main__":
        file = getattr(sys.modules["__main__"], "__file__", None)
        return Path(file) if file and Path(file).is_file() else None
    top, *inner = module.split(".")
    for folder in _folders(top):
        path = Path(folder, *inner)
        for file in (path.with_suffix(".py"), path / "__init__.py"):
            if file.is_file():
                return file
    return None


@functools.cache
def _folders(package: str) -> tuple[str, ...]:
    """Return the folder of a package's modules.

    For a module that is no package, return its file's path without the suffix.
    """
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        return ()
    return tuple(spec.submodule_search_locations or [str(Path(spec.origin).with_suffix(""))])


@functools.cache
def _versions() -> tuple[str, ...]:
    """Return name and version of each library that this package needs: other versions may give other numbers."""
    found = []
    with contextlib.suppress(PackageNotFoundError):
        needed = (text for text in requires("surgical-marl") or () if "extra ==" not in text)
        for name in sorted({re.match(r"[\w.-]+", text)[0] for text in needed}):  # type: ignore[index]
            with contextlib.suppress(PackageNotFoundError):
                found.append(f"{name} {version(name)}")
    return tuple(found)
