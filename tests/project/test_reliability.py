"""Full disks, folders that cannot be written, and two processes on one run: one sentence, and nothing is lost."""

from __future__ import annotations

import contextlib
import errno
import multiprocessing
import os
import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from filelock import FileLock

from surgical_marl.cli.main import main
from surgical_marl.files import remove_temporaries
from surgical_marl.learning import train
from surgical_marl.runs import checkpoint
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import LOCK, owned, read_metrics
from tests.helpers.processes import end, start, start_together
from tests.helpers.runs import LONG, SMALL, run, run_or_resume, same_state

FEW = replace(SMALL, num_envs=8, iterations=2, checkpoint_every=1)


def limited(settings: Any, out: Path, most: int, said: Any = None) -> None:
    """As `run_or_resume` where no file may be larger than `most` bytes, as on a disk that is full; for a process."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    try:
        run_or_resume(settings, out)
    except ValueError as error:
        said.put(str(error))


def held(out: Path, ready: Any) -> None:
    """Hold the lock until the process is killed."""
    with owned(out):
        ready.put(True)
        time.sleep(600)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An unbroken run."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert end([start(run, SMALL, out)]) == [0]
    return out


@pytest.mark.parametrize("most", [0, 100, 5_000])
def test_a_full_disk_is_one_sentence_and_the_run_goes_on_when_there_is_room(
    most: int, whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """0: not even the settings; 100: some metrics and events of tensorboard; 5,000: all but the checkpoint."""
    out, said = tmp_path / "run", multiprocessing.get_context("forkserver").SimpleQueue()
    assert end([start(run, replace(SMALL, iterations=1), out)]) == [0]
    first = (out / "checkpoint.pt").read_bytes()
    assert end([start(limited, SMALL, out, most, said)]) == [0]
    assert (sentence := said.get()).startswith("cannot write ") and sentence.endswith("goes on from there")
    assert "File too large" in sentence and "\n" not in sentence
    assert "Traceback" not in capfd.readouterr().err
    assert (out / "checkpoint.pt").read_bytes() == first
    assert not list(out.glob(".*"))
    assert end([start(run_or_resume, SMALL, out)]) == [0]
    assert same_state(out, whole)


class Full:
    """A file on a disk with room for some bytes."""

    def __init__(self, room: int) -> None:
        self.room = room

    def write(self, data: Any) -> int:
        self.room -= len(data)
        if self.room < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return len(data)

    def flush(self) -> None:
        pass


@pytest.mark.parametrize("room", [0, 1, 500, 1500, 4000])
def test_torch_says_that_a_disk_is_full(room: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """By itself it raises "unexpected pos" and other errors, after which the disk's error is lost."""

    @contextlib.contextmanager
    def opened(path: Path, mode: str) -> Iterator[Full]:
        yield Full(room)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", opened)
        with pytest.raises(OSError, match="No space left"):
            checkpoint._save({"weights": torch.zeros(1000)}, tmp_path / "file")


def test_a_second_process_is_refused_while_one_trains(tmp_path: Path) -> None:
    out = tmp_path / "run"
    first = start(run, LONG, out)
    while not (out / "checkpoint.pt").is_file():
        assert first.is_alive()
        time.sleep(0.01)
    for resume in (out, None):
        with pytest.raises(ValueError, match=r"is in use: another process trains in it|already holds a run"):
            train.train(LONG, out=out, resume=resume)
    assert read_checkpoint(out) and read_metrics(out) is not None, "it can be read meanwhile"
    first.kill()
    first.join()
    reached = read_checkpoint(out)["iteration"]
    assert end([start(run_or_resume, replace(LONG, iterations=reached + 1), out)]) == [0], (
        "a lock ends with its process"
    )


def test_the_lock_of_a_folder_ends_with_its_process_however_it_ends(tmp_path: Path) -> None:
    ready = multiprocessing.get_context("forkserver").SimpleQueue()
    process = start(held, tmp_path, ready)
    assert ready.get()
    with pytest.raises(ValueError, match="is in use"), owned(tmp_path):
        pass
    process.kill()
    process.join()
    with owned(tmp_path), pytest.raises(ValueError, match="is in use"), owned(tmp_path):
        pass
    with owned(tmp_path):
        assert (tmp_path / LOCK).stat().st_size == 0


def test_where_nothing_can_be_locked_training_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: FileLock, timeout: float) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    with owned(tmp_path / "not there"):
        pass
    monkeypatch.setattr(FileLock, "acquire", fail)
    with owned(tmp_path):
        pass


def test_the_processes_of_one_run_are_one_owner(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert end(start_together(2, run, FEW, out)) == [0, 0]
    assert end(start_together(2, run_or_resume, replace(FEW, iterations=3), out)) == [0, 0]
    assert read_checkpoint(out)["iteration"] == 3


def test_a_new_run_that_is_refused_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(settings: Any) -> None:
        raise ValueError("no")

    monkeypatch.setattr(train, "make_training", refuse)
    with pytest.raises(ValueError, match="no"):
        train.train(FEW, out=tmp_path / "run")
    assert not list(tmp_path.iterdir())


def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    kept = [".hidden.mp4", "video.12.mp4", ".video.x.mp4", ".tmp"]
    for name in [*kept, ".checkpoint.pt.12.tmp", ".video.12.mp4", ".video.12.gif", ".a.b.7.webp"]:
        (tmp_path / name).write_bytes(b"")
    remove_temporaries(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(kept)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(ValueError, match="cannot write to the output folder"):
        train.train(FEW, out=tmp_path / "run")


def test_an_output_that_cannot_be_written_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    for out in ("/proc/none/psm.xml", "/dev/null/psm.xml", "a" * 5000, "a\0b"):
        assert main(["export", "scene", "psm", "--out", out]) == 2
        told, err = capsys.readouterr()
        assert not told and err.startswith("surgical-marl: ") and err.count("\n") == 1 and len(err) < 400
