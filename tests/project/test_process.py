"""The process and its host: pipes that close, terminals in other encodings, homes and folders that are not there."""

from __future__ import annotations

import ast
import errno
import io
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import pytest

from surgical_marl import files
from surgical_marl.files import writable
from surgical_marl.learning import train, trainer
from surgical_marl.learning.reporter import Report
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.process import ending_signals, lasting_streams
from tests.helpers import ROOT
from tests.helpers.fake_env import FakeEnv
from tests.helpers.runs import COUNTS, SIZES, SMALL

COMMAND = f"{shlex.quote(sys.executable)} -m surgical_marl"


def shell(line: str, cwd: Path, **env: str) -> subprocess.CompletedProcess[str]:
    own = {**os.environ, "PYTHONPATH": str(ROOT), **env}
    return subprocess.run(["bash", "-c", line], cwd=cwd, env=own, capture_output=True, encoding="utf-8")


@pytest.fixture
def unread() -> Iterator[io.TextIOWrapper]:
    """A pipe that nobody reads any more."""
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w", encoding="utf-8") as stream:
        yield stream


def test_work_outlasts_the_readers_of_its_streams(unread: io.TextIOWrapper) -> None:
    for redirect in (redirect_stdout, redirect_stderr):
        with redirect(unread), lasting_streams():
            print("lost", flush=True)
            print("lost", file=sys.stderr, flush=True)
            sys.stdout.writelines(["lost\n", "lost\n"])


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no device that is always full")
def test_a_result_that_cannot_be_kept_is_an_error_and_progress_is_none() -> None:
    with open("/dev/full", "w", encoding="utf-8") as full, redirect_stderr(full), lasting_streams():
        print("progress", file=sys.stderr, flush=True)
    with open("/dev/full", "w", encoding="utf-8") as full, redirect_stdout(full), lasting_streams():
        with pytest.raises(OSError) as caught:
            print("result", flush=True)
        assert caught.value.errno == errno.ENOSPC


@pytest.mark.parametrize(
    "line, code, said",
    [
        ("{} list tasks | true; exit ${{PIPESTATUS[0]}}", 0, ""),
        ("{} --help | true; exit ${{PIPESTATUS[0]}}", 0, ""),
        ("{} list tasks >&-", 0, ""),
        ("{} list tasks <&- 2>&- >&-", 0, ""),
        ("{} lsit 2>&-", 2, ""),
        ("{} list tasks >/dev/full", 2, "surgical-marl: No space left on device\n"),
        ("D=$(mktemp -d); cd $D; rmdir $D; {} list tasks", 2, "surgical-marl: the working folder does not exist any"),
    ],
)
def test_streams_and_folders_that_are_not_there(line: str, code: int, said: str, tmp_path: Path) -> None:
    done = shell(line.format(COMMAND), tmp_path)
    assert (done.returncode, done.stderr[: len(said)]) == (code, said)
    assert done.stderr.count("\n") == bool(said)


def test_names_are_utf_8_whatever_the_locale(tmp_path: Path) -> None:
    text = (ROOT / "scenes" / "psm.yaml").read_text(encoding="utf-8")
    (tmp_path / "Übung.yaml").write_text(f"{text}\n# Übung: 練習\n", encoding="utf-8")
    done = shell(f"{COMMAND} check ./Übung.yaml", tmp_path, LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(r"./\xdcbung.yaml: nothing wrong found")  # on a terminal that knows ASCII alone
    done = shell(f"{COMMAND} check ./練習.yaml", tmp_path, PYTHONIOENCODING="latin-1")
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and r"'./\u7df4\u7fd2.yaml'" in done.stderr


def test_signals_that_are_ignored_or_handled_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    handlers = {signal.SIGHUP: signal.SIG_IGN, signal.SIGUSR1: print, signal.SIGUSR2: signal.SIG_DFL}
    monkeypatch.setattr(signal, "getsignal", lambda number: handlers.get(number, signal.default_int_handler))
    assert set(ending_signals()) == {signal.SIGINT, signal.SIGTERM, signal.SIGUSR2}


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No cache has been looked at yet."""
    writable.cache_clear()
    monkeypatch.setattr(files, "_temporary", files.functools.cache(files._temporary.__wrapped__))
    yield
    writable.cache_clear()


def test_a_folder_that_can_be_written_is_taken(fresh: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert writable(tmp_path / "cache" / "kind") == tmp_path / "cache" / "kind"
    assert list(tmp_path.rglob("*")) == [tmp_path / "cache", tmp_path / "cache" / "kind"]
    assert not capsys.readouterr().err


def test_caches_that_cannot_be_written_are_temporary_and_it_is_said_once(
    fresh: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    bad = Path("/proc/none/cache/a"), tmp_path / "file" / "cache" / "b", Path("~/.cache/surgical-marl/c")
    for folder in bad:
        instead = writable(folder)
        (instead / "made").write_text("")
        assert instead != folder and instead.name == folder.name
    said = capsys.readouterr().err
    assert said.startswith("surgical-marl: cannot write to the cache /proc/none/cache/a: ") and said.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_full_disk_still_gives_what_is_there(fresh: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "old").write_text("of before")
    monkeypatch.setattr(files, "_ROOM", 2**62)
    instead = writable(tmp_path)
    assert instead != tmp_path and (instead / "old").read_text() == "of before"


def test_another_python_is_refused_in_a_sentence() -> None:
    code = "import sys; sys.version_info = (3, 10, 13, 'final', 0); {}import surgical_marl"
    for argv, last in (("", "ImportError: surgical_marl"), ("sys.argv = ['-m']; ", "surgical-marl: surgical_marl")):
        done = subprocess.run([sys.executable, "-c", code.format(argv)], cwd=ROOT, capture_output=True, text=True)
        assert done.stderr.splitlines()[-1] == f"{last} needs Python 3.11 or newer, and this is Python 3.10.13"
        assert done.returncode == (2 if argv else 1) and (not argv or done.stderr.count("\n") == 1)
    source = (ROOT / "surgical_marl" / "__init__.py").read_text(encoding="utf-8")
    assert "__future__" not in source
    ast.parse(source, feature_version=(3, 7))


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Training runs on a fake environment."""
    make_env = lambda settings: FakeEnv(COUNTS, SIZES, settings.num_envs, max_steps=10)  # noqa: E731
    monkeypatch.setattr(train, "make_env", make_env)


def test_a_terminal_that_closes_sends_hangup_twice_and_terminate_may_follow(
    tmp_path: Path, toy: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = trainer.Trainer.iterate

    def iterate(self: trainer.Trainer) -> Report:
        for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGTERM, signal.SIGUSR1):
            os.kill(os.getpid(), number)
        return original(self)

    monkeypatch.setattr(trainer.Trainer, "iterate", iterate)
    with pytest.raises(SystemExit) as stopped:
        train.train(replace(SMALL, checkpoint_every=50), out=tmp_path / "run")
    assert stopped.value.code == 128 + signal.SIGHUP
    assert read_checkpoint(tmp_path / "run")["iteration"] == 1


def test_nohup_goes_on(tmp_path: Path, toy: None, monkeypatch: pytest.MonkeyPatch) -> None:
    original = trainer.Trainer.iterate

    def iterate(self: trainer.Trainer) -> Report:
        os.kill(os.getpid(), signal.SIGHUP)
        return original(self)

    monkeypatch.setattr(trainer.Trainer, "iterate", iterate)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        run = train.train(SMALL, out=tmp_path / "run")
    finally:
        signal.signal(signal.SIGHUP, before)
    assert read_checkpoint(run)["iteration"] == SMALL.iterations


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_a_pipe_that_is_closed_does_not_end_a_training(
    name: str, tmp_path: Path, toy: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w", encoding="utf-8") as stream:
        monkeypatch.setattr(sys, name, stream)
        run = train.train(SMALL, out=tmp_path / "run")
    assert read_checkpoint(run)["iteration"] == SMALL.iterations
