"""A lack of memory is one sentence, whichever library meets it, and no other error is taken for it."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from surgical_marl.cli import main as program


def chained() -> None:
    try:
        raise OSError("libwarp.so: failed to map segment from shared object")
    except OSError as error:
        raise RuntimeError("cannot load the library") from error


def raising(error: Exception) -> Callable[[], None]:
    def fail() -> None:
        raise error

    return fail


@pytest.mark.parametrize(
    "fail",
    [
        chained,
        raising(MemoryError()),
        raising(RuntimeError("std::bad_alloc")),
        raising(Exception("Could not allocate memory")),
        raising(RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried 8 bytes")),
        raising(ImportError("libx.so: cannot allocate memory in static TLS block")),
        raising(RuntimeError("can't start new thread")),
    ],
)
def test_a_lack_of_memory_is_one_sentence(
    fail: Callable[[], None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(program, "_parse", lambda argv: fail())
    assert program.main([]) == 2
    assert capsys.readouterr().err == "surgical-marl: there is not enough memory for that\n"


def test_other_errors_stay_what_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program, "_parse", lambda argv: raising(RuntimeError("a fault of ours"))())
    with pytest.raises(RuntimeError, match="a fault of ours"):
        program.main([])
