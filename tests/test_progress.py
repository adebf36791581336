"""Progress bars: lines where nobody watches, a bar in a terminal."""

from __future__ import annotations

import io
import sys
import time

import pytest

from surgical_marl.runs import progress as module
from surgical_marl.runs.progress import preparing, progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def count(what: str) -> None:
    with progress(3, "step", what) as bar:
        for number in range(3):
            bar.set_postfix_str(f"error {number} mm", refresh=False)
            bar.update()


def test_a_file_gets_lines_and_few_of_them(capsys: pytest.CaptureFixture[str]) -> None:
    count("evaluating")
    lines = capsys.readouterr().err.splitlines(keepends=True)
    assert len(lines) == 2 and not any("\r" in line for line in lines)
    assert lines[0].startswith("evaluating: 0 of 3 step") and lines[1].startswith("evaluating: 3 of 3 step")
    assert lines[1].endswith("error 2 mm\n")


def test_a_file_gets_a_line_for_each_state_that_is_old_enough(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "EVERY", 0.0)
    count("")
    assert [line.split(" of ")[0] for line in capsys.readouterr().err.splitlines()] == ["0", "1", "2", "3"]


def test_what_takes_long_is_named_once_and_not_beside_a_bar(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with preparing("tea"):
        pass
    with pytest.raises(ValueError, match="milk"), preparing("tea"):
        raise ValueError("no milk")
    monkeypatch.setattr(module, "PATIENCE", 0.0)
    with preparing("tea"):
        while not (said := capsys.readouterr().err):
            time.sleep(0.01)
    assert said == "surgical-marl: preparing tea\n"
    monkeypatch.setattr(module, "PATIENCE", 60.0)
    with preparing("tea"):
        (timer,) = module._waiting
        count("evaluating")
        assert timer.finished.is_set()
    assert not module._waiting


def test_a_terminal_gets_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", stream := Terminal())
    monkeypatch.setenv("COLUMNS", "100")
    count("evaluating")
    last = stream.getvalue().split("\r")[-1]
    assert last.startswith("evaluating: 100%|") and "error 2 mm" in last
