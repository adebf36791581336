"""Results on disk are keyed by all that they were made from: content, code and versions."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from surgical_marl import cache
from surgical_marl.envs.env import Env

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
        ("physics/solver.py", True),
        ("cli/describe.py", False),
        ("learning/trainer.py", False),
    ],
)
def test_a_kernel_is_keyed_by_the_code_that_it_comes_from(
    file: str, matters: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    roots = frozenset(Env("reach", "psm").roots)
    before = cache.code_digest(roots)
    edited(monkeypatch, file)
    assert (cache.code_digest(roots) != before) == matters


def test_an_edited_module_is_computed_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "cache_dir", lambda: tmp_path / "cache")
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "stranger").mkdir()
    (tmp_path / "stranger/__init__.py").write_text("")
    (tmp_path / "stranger/helper.py").write_text("VALUE = 1\n")
    (tmp_path / "stranger/task.py").write_text("def draw():\n    from stranger.helper import VALUE\n    return VALUE\n")
    made: list[float] = []

    def ask(content: str = "") -> float:
        def compute() -> np.ndarray:
            made.append(0.0)
            return np.array(float(len(made)))

        for remembered in (cache.code_digest, cache._read, cache._folders):
            remembered.cache_clear()
        return float(cache.cached("numbers", compute, content, roots=["stranger.task"]))

    assert ask() == ask() == 1
    assert ask("other content") == 2
    (tmp_path / "stranger/helper.py").write_text("VALUE = 2\n")
    assert ask() == 3
    monkeypatch.setattr(cache, "_versions", lambda: ("jax 99",))
    assert ask() == 4


def test_damaged_files_are_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "cache_dir", lambda: tmp_path)
    assert cache.cached("numbers", lambda: np.arange(3), "x").tolist() == [0, 1, 2]
    (file,) = (tmp_path / "numbers").glob("*.npz")
    file.write_bytes(file.read_bytes()[:40])
    assert cache.cached("numbers", lambda: np.arange(4), "x").tolist() == [0, 1, 2, 3]


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(cache, "cache_dir", lambda: tmp_path / "file")
    assert cache.cached("numbers", lambda: np.arange(3), "x").tolist() == [0, 1, 2]


PROGRAM = """
import sys
from surgical_marl import cache
import numpy as np
from beside import VALUE

def compute():
    print("made", VALUE)
    return np.array(float(VALUE))

cache.cached("numbers", compute)
"""


def test_a_program_is_code_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a script makes is found again until the script, or a file beside it, changes."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", str(PACKAGE.parent))
    (tmp_path / "program.py").write_text(PROGRAM)

    def run(*how: str, value: int) -> str:
        (tmp_path / "beside.py").write_text(f"VALUE = {value}\n")
        done = subprocess.run([sys.executable, *how], cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout

    assert [run("program.py", value=value) for value in (1, 1, 2, 2)] == ["made 1\n", "", "made 2\n", ""]
    (tmp_path / "program.py").write_text(PROGRAM.replace("made", "anew"))
    assert run("program.py", value=2) == "anew 2\n"
    assert [run("-c", PROGRAM, value=2) for _ in range(2)] == ["made 2\n"] * 2  # without a file nothing is kept
