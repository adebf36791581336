"""Arrays that take a while to compute, kept on disk, keyed by everything that they were computed from.

That is data, code and the versions of the libraries that the code calls. Code of this package is found by following
imports from the module that computes: no list of modules is kept by hand. Code of somebody else can depend on anything,
such as a global or `sys.argv`, so what it computes is not kept.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import re
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from surgical_marl.files import writable, write_npz
from surgical_marl.runtime import cache_dir

PACKAGE = __name__.partition(".")[0]
_ROOT = Path(__file__).parent
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]*(\([^)]*\)|[^\n#]*)|import[ \t]+([\w., \t]+))", re.M
)


def cached(
    kind: str, compute: Callable[[], np.ndarray], *content: str | bytes, classes: Iterable[type] = ()
) -> np.ndarray:
    """Return what `compute` returns, from disk if it was computed before from the same content, code and libraries.

    Args: see `cached_arrays`.
    """
    return cached_arrays(kind, lambda: {"array": compute()}, *content, classes=classes)["array"]


def cached_arrays(
    kind: str,
    compute: Callable[[], dict[str, np.ndarray]],
    *content: str | bytes,
    classes: Iterable[type] = (),
) -> dict[str, np.ndarray]:
    """Return what `compute` returns, arrays by name, as `cached` does with one.

    Args:
        kind: folder within the cache.
        compute: the work. Its arrays appear on disk completely or not at all. If the cache fails, that is no error.
            Where it runs code that is not of this package, its result is not kept.
        content: data that the result depends on.
        classes: classes whose code `compute` runs, besides the functions and objects that it holds.
    """
    modules = modules_of(compute, *classes)
    if modules is None:
        return compute()
    digest = hashlib.sha256(kind.encode())
    for part in (*content, code_digest(modules), *_versions()):
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little") + data)
    path = writable(cache_dir() / kind) / f"{digest.hexdigest()[:32]}.npz"
    if (arrays := _load(path)) is not None:
        return arrays
    with locked(path):
        if (arrays := _load(path)) is not None:  # another process has made the file meanwhile
            return arrays
        arrays = compute()
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_npz(path, arrays, compressed=False)
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


def is_shipped(*code: Any) -> bool:
    """Return whether code is of this package alone; the arguments are those of `modules_of`."""
    return modules_of(*code) is not None


def modules_of(*code: Any) -> frozenset[str] | None:
    """Return the modules in which code is defined, or None if some of it is not of this package.

    Args:
        code: classes, with all that they inherit, and functions and methods, with the objects that they hold.
    """
    waiting, seen, modules = [*code], list[Any](), set[str]()
    while waiting:
        one = waiting.pop()
        if any(one is other for other in seen):
            continue
        seen.append(one)
        if inspect.isclass(one):
            if not all(map(_is_shipped_class, one.__mro__)):
                return None
            modules |= {base.__module__ for base in one.__mro__}
        elif inspect.isfunction(one):
            if _package(one) != PACKAGE:
                return None
            modules.add(one.__module__)
            waiting += (*inspect.getclosurevars(one).nonlocals.values(), *(one.__defaults__ or ()))
        elif inspect.ismethod(one):
            waiting += one.__func__, one.__self__
        elif isinstance(one, functools.partial):
            waiting += one.func, *one.args, *one.keywords.values()
        elif any(_package(base) == PACKAGE for base in type(one).__mro__):  # anything else is data
            waiting.append(type(one))
    return frozenset(modules)


def _is_shipped_class(one: type) -> bool:
    """Return whether a class is of this package or of Python, and no function was put into it from outside."""
    functions = (own for own in vars(one).values() if inspect.isfunction(own))
    ours = {PACKAGE, f"namedtuple_{one.__name__}", *sys.stdlib_module_names}
    return _package(one) in ours and all(_package(own) in ours for own in functions)


def _package(code: Any) -> str:
    return str(code.__module__).partition(".")[0]


@functools.cache
def code_digest(modules: frozenset[str]) -> str:
    """Return a hash of the source of modules of this package and of all that they import, directly or not, of it.

    CUDA code belongs to all modules in its folder.

    Args:
        modules: names, as in "surgical_marl.tasks.reach".
    """
    waiting, seen = sorted(modules), dict[str, str]()
    while waiting:
        name = waiting.pop()
        if name not in seen and (path := _file(name)):
            seen[name], imported = _read(path)
            waiting += imported
    return hashlib.sha256(repr(sorted(seen.items())).encode()).hexdigest()


@functools.cache
def _read(path: Path) -> tuple[str, list[str]]:
    """Return the hash of a source file with the CUDA code beside it, and the names that it may import.

    These are of modules, and of objects in modules.
    """
    source, digest = path.read_bytes(), hashlib.sha256()
    for part in (source, *_cuda_code(path.parent)):
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest(), list(_imported(source.decode(errors="replace")))


@functools.cache
def _cuda_code(folder: Path) -> list[bytes]:
    return [file.read_bytes() for file in sorted(folder.glob("*.cu"))]


def _imported(text: str) -> Iterator[str]:
    for package, names, modules in _IMPORT.findall(text):
        for name in re.findall(r"[\w.]+", modules):
            yield name
        if package:
            yield package
            for name in re.findall(r"\w+", names):
                yield f"{package}.{name}"


def _file(module: str) -> Path | None:
    """Return the source file of a module of this package; None if there is no such module."""
    top, *inner = module.split(".")
    if top != PACKAGE:
        return None
    path = _ROOT.joinpath(*inner)
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


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
