"""Task files: the task `my_task.py`, or `my_task.py:Escort` where the file has several.

The name of such a task is the absolute path of its file, so that any process finds it from any folder. A file is code:
it runs only if a person or a program of this machine named it, now or before. A run folder of a stranger can name it
too, and then it does not run.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import sys
import traceback
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

from surgical_marl.runtime import cache_dir
from surgical_marl.untrusted.files import MB, is_file, read_bytes, user_path
from surgical_marl.untrusted.markup import check_name
from surgical_marl.untrusted.values import one_line

_NAME = re.compile(r"(.+\.py)(?::(\w*))?", re.DOTALL)
_FILE = "__task_file__"
"""Attribute of the module of a task file: its path."""
_NAMED: set[Path] = set()
"""Files that were named in this process."""


def is_task_file(task: object) -> bool:
    """Return whether a task is named by a file, `my_task.py` or `my_task.py:Escort`."""
    return isinstance(task, str) and _NAME.fullmatch(task) is not None


def absolute(task: str) -> str:
    """Return the name of a task with the absolute path of its file; other names stay as they are."""
    if not is_task_file(task):
        return task
    path, cls = _parts(task)
    return f"{path}:{cls}" if cls else str(path)


def label(task: str) -> str:
    """Return a task's name for people and in names of files: of a task file its class, or else the file's name."""
    if not is_task_file(task):
        return task
    path, cls = _parts(task)
    return cls or path.stem


def file_of(cls: Any) -> str | None:
    """Return the path of the task file that defines a class; None if no task file does."""
    return getattr(sys.modules.get(getattr(cls, "__module__", "")), _FILE, None)


def allow(task: str) -> None:
    """Let a task file run, because a person or a program has named it: in this process, and on this machine later.

    ValueError if there is no such file.
    """
    path, _ = _parts(task)
    if not is_file(path):
        raise ValueError(f"there is no task file {one_line(path)}")
    _NAMED.add(path)
    with contextlib.suppress(OSError):  # without a cache it is named again in the next process
        _mark(path).parent.mkdir(parents=True, exist_ok=True)
        _mark(path).touch()


def check_allowed(task: str) -> None:
    """Raise a ValueError if a task is a file that nobody has named on this machine."""
    if not is_task_file(task):
        return
    path, _ = _parts(task)
    if not is_file(path):
        raise ValueError(f"there is no task file {one_line(path)}")
    if path not in _NAMED and not is_file(_mark(path)):
        raise ValueError(
            f"the task file {one_line(path)} has not run on this machine, and a run or a recording alone does not let "
            f"it: read it, then name it once, as in `surgical-marl check {one_line(path)}`"
        )


def load_task_file(task: str, base: type) -> type:
    """Return the class of a task file. A file that has changed since it was loaded is loaded anew.

    Args:
        task: such as "my_task.py" or "my_task.py:Escort".
        base: the class that tasks are subclasses of.

    Raises:
        ValueError: there is no such file, nobody has named it on this machine, it cannot be imported, or it has no such
            class, or several of which none is named.
    """
    check_allowed(task)
    path, wanted = _parts(task)
    module = _module(path)
    own = (each for each in vars(module).values() if isinstance(each, type) and each.__module__ == module.__name__)
    found = {each.__name__: each for each in own if issubclass(each, base)}
    if not found:
        raise ValueError(f"{path} has no task: a task is a subclass of surgical_marl.Task or surgical_marl.TipTask")
    if wanted and wanted not in found:
        raise ValueError(f"{path} has no task {wanted!r}: its tasks are {', '.join(found)}")
    if not wanted and len(found) > 1:
        example = f"{path.name}:{next(iter(found))}"
        raise ValueError(f"{path} has the tasks {', '.join(found)}: name one of them, as in {example}")
    return found[wanted or next(iter(found))]


def _parts(task: str) -> tuple[Path, str]:
    """Return the absolute path of a task file, and the name of its class, "" if none is named."""
    match = _NAME.fullmatch(task)
    assert match is not None, task
    return Path(os.path.abspath(user_path(match[1]))), match[2] or ""


def _mark(path: Path) -> Path:
    """Return the file of the cache that says that a task file was named."""
    return cache_dir() / "task_files" / hashlib.sha256(str(path).encode(errors="surrogateescape")).hexdigest()


def _module(path: Path) -> ModuleType:
    """Return the module of a file as it is now. Its name says path and content, as caches go by modules' names."""
    check_name(path.stem, "a task file")
    content = read_bytes(path, MB)
    digest = hashlib.sha256(str(path).encode(errors="surrogateescape") + b"\0" + content).hexdigest()
    name = f"{re.sub('[^0-9A-Za-z_]', '_', path.stem)}_{digest[:16]}"
    if name in sys.modules:
        return sys.modules[name]
    if (folder := str(path.parent)) not in sys.path:
        sys.path.append(folder)  # as for a program: modules beside it can be imported
    spec = spec_from_file_location(name, path)
    module = module_from_spec(spec)  # type: ignore[arg-type]  # a path that ends with .py has a loader
    setattr(module, _FILE, str(path))
    sys.modules[name] = module
    try:
        exec(compile(content, path, "exec"), vars(module))
    except BaseException as error:  # a user's code may raise anything, and may exit
        del sys.modules[name]
        if isinstance(error, KeyboardInterrupt):
            raise
        raise ValueError(f"{_where(path, error)}: {_reason(error)}") from error
    return module


def _where(path: Path, error: BaseException) -> str:
    """Return the file, and the line of it that raised an error, as far as there is one."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f"{path}, line {error.lineno}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f"{path}, line {lines[-1]}" if lines else str(path)


def _reason(error: BaseException) -> str:
    text = error.msg if isinstance(error, SyntaxError) else str(error)
    return " ".join(f"{type(error).__name__}: {text}".split())
