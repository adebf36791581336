"""Results on disk are keyed by all that they were made from: content, code of this package, and versions."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from surgical_marl import cache
from surgical_marl.envs.env import Env
from surgical_marl.robots.arm import load_arm
from surgical_marl.tasks.base.paths import walks
from surgical_marl.tasks.needle_pick import Task as NeedlePick
from surgical_marl.tasks.reach import Task as Reach

PACKAGE = Path(cache.__file__).parent


def edited(monkeypatch: pytest.MonkeyPatch, file: str) -> None:
    """Let a source file look as if somebody had changed it."""
    read = cache._read.__wrapped__  # type: ignore[attr-defined]

    def changed(path: Path) -> tuple[str, list[str]]:
        digest, imported = read(path)
        return ("edited" if path == PACKAGE / file else digest), imported

    monkeypatch.setattr(cache, "_read", changed)
    monkeypatch.setattr(cache, "code_digest", cache.code_digest.__wrapped__)


@pytest.mark.parametrize(
    ("file", "matters"),
    [
        ("robots/inverse_kinematics.py", True),
        ("scenes/contacts.py", True),
        ("tasks/base/workspace.py", True),
        ("physics/solver/constraint_rows.py", True),
        ("cli/describe.py", False),
        ("learning/trainer.py", False),
    ],
)
def test_a_kernel_is_keyed_by_the_code_that_it_comes_from(
    file: str, matters: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    modules = cache.modules_of(*Env("reach", "psm").classes)
    assert modules is not None
    before = cache.code_digest(modules)
    edited(monkeypatch, file)
    assert (cache.code_digest(modules) != before) == matters


def test_a_module_is_keyed_by_the_cuda_code_beside_it(tmp_path: Path) -> None:
    (tmp_path / "solve.py").write_text("x = 1\n")
    found = []
    for code in (None, "x;", "y;"):
        if code:
            (tmp_path / "kernel.cu").write_text(code)
        cache._cuda_code.cache_clear()
        found.append(cache._read.__wrapped__(tmp_path / "solve.py")[0])  # type: ignore[attr-defined]
    assert len(set(found)) == 3


def held(value: Any) -> Callable[[], Any]:
    """Return a function that looks as if it were of this package, and holds a value."""
    function = lambda: value  # noqa: E731
    function.__module__ = "surgical_marl.scenes.load"
    return function


class Mine(Reach):
    """A task of somebody else."""


class Patched(Reach):
    """A task that looks as if it were of this package, with a function from elsewhere."""

    def reward_terms(self, world: Any) -> Any:
        return {}


Patched.__module__ = "surgical_marl.tasks.reach"


def recursive() -> Callable[[], Any]:
    def again() -> Any:
        return again

    again.__module__ = "surgical_marl.scenes.load"
    return again


@pytest.mark.parametrize(
    ("code", "shipped"),
    [
        (Env, True),
        (Reach, True),
        (NeedlePick, True),
        (Mine, False),
        (Patched, False),
        (dict, True),
        (np.ndarray, False),
        (SimpleNamespace, True),
        (held(None), True),
        (held(np.ones(3)), True),
        (held(load_arm("psm")), True),
        (held(walks), True),
        (held(lambda: 1), False),
        (held(Mine.__new__(Mine)), False),
        (held(held(Mine.__new__(Mine))), False),
        (held(functools.partial(walks, 1)), True),
        (held(functools.partial(print, test_a_kernel_is_keyed_by_the_code_that_it_comes_from)), False),
        (functools.partial(held(1), Mine.__new__(Mine)), False),
        (Mine.__new__(Mine).reward_terms, False),
        (Reach.__new__(Reach).reward_terms, True),
        (recursive(), True),
    ],
)
def test_code_of_somebody_else_is_told_from_that_of_the_package(code: Any, shipped: bool) -> None:
    assert cache.is_shipped(code) == shipped


def test_what_is_kept_is_found_until_content_code_or_versions_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "cache_dir", lambda: tmp_path)
    made: list[float] = []

    def ask(content: str = "", **options: Any) -> float:
        return float(cache.cached("numbers", shipped, content, **options))

    def shipped() -> np.ndarray:
        made.append(0.0)
        return np.array(float(len(made)))

    shipped.__module__ = "surgical_marl.scenes.load"
    assert ask() == ask() == 1
    assert ask("other content") == 2
    assert ask(classes=[Reach]) == ask(classes=[Reach]) == 3
    assert ask(classes=[Mine]) == 4 and ask(classes=[Mine]) == 5  # nothing is kept
    edited(monkeypatch, "scenes/load.py")
    assert ask() == ask() == 6
    monkeypatch.setattr(cache, "_versions", lambda: ("jax 99",))
    assert ask() == 7
    shipped.__module__ = "__main__"
    assert ask() == 8 and ask() == 9


def counted(count: int) -> Callable[[], np.ndarray]:
    compute = lambda: np.arange(count)  # noqa: E731
    compute.__module__ = "surgical_marl.scenes.load"
    return compute


def test_damaged_files_are_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "cache_dir", lambda: tmp_path)
    assert cache.cached("numbers", counted(3), "x").tolist() == [0, 1, 2]
    (file,) = (tmp_path / "numbers").glob("*.npz")
    file.write_bytes(file.read_bytes()[:40])
    assert cache.cached("numbers", counted(4), "x").tolist() == [0, 1, 2, 3]


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(cache, "cache_dir", lambda: tmp_path / "file")
    assert cache.cached("numbers", counted(3), "x").tolist() == [0, 1, 2]
