"""Progress bars: lines where nobody watches, a bar in a terminal."""

from __future__ import annotations

import io
import logging
import os
import re
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest

from surgical_marl.engines.compilation import compiling, told
from surgical_marl.runs import progress as module
from surgical_marl.runs.progress import Compilations, preparing, progress


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
    assert lines[0].startswith("evaluating: 0 of 3 steps,") and lines[1].startswith("evaluating: 3 of 3 steps,")
    assert lines[1].endswith("error 2 mm\n")


def test_one_is_not_counted_as_many(capsys: pytest.CaptureFixture[str]) -> None:
    progress(1, "frame").close()
    assert capsys.readouterr().err.startswith("0 of 1 frame,")


FIGURES = "error 0.24 mm, success 100%, collision 0%, 1,234,567 steps/s"


@pytest.mark.parametrize(
    ("columns", "shown"),
    [
        (160, rf"100%\|█+\| 160/160 \[00:0\d<00:00, {FIGURES}\]"),
        (90, rf"160/160 \[00:0\d<00:00, {FIGURES}\]"),
        (80, r"160/160 \[00:0\d<00:00, error 0.24 mm, success 100%, collision 0%\]"),
        (60, r"160/160 \[00:0\d<00:00, error 0.24 mm, success 100%\]"),
        (30, r"160/160 \[00:0\d<00:00\]"),
        (8, "100%"),
    ],
)
def test_a_narrow_terminal_gets_whole_figures_instead_of_a_bar(
    monkeypatch: pytest.MonkeyPatch, columns: int, shown: str
) -> None:
    lines = drawn(monkeypatch, columns, "", FIGURES)
    assert re.fullmatch(shown, lines[-1])
    assert all(len(line) <= columns for line in lines)


def test_a_bar_in_a_terminal_of_80_columns_has_room_for_what_evaluation_and_films_say(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lines = drawn(monkeypatch, 80, "evaluating reach-bimanual_psm", "error 0.24 mm, success 100%, collision 0%")
    assert lines[0] == "evaluating reach-bimanual_psm"  # above, because both don't fit into a line
    assert re.fullmatch(r"160/160 \[.*, error 0.24 mm, success 100%, collision 0%\]", lines[-1])
    assert re.fullmatch(r"filming: 100%\|█+\| 160/160 \[.*\]", drawn(monkeypatch, 80, "filming", "")[-1])


def drawn(monkeypatch: pytest.MonkeyPatch, columns: int, what: str, figures: str) -> list[str]:
    """Return all states of a bar in a terminal of so many columns, after what stands above it."""
    with terminal(monkeypatch, columns) as text, progress(160, "it", what) as bar:
        bar.set_postfix_str(figures, refresh=False)
        bar.update(160)
    return [line.rstrip(" ") for line in re.split(r"[\r\n]+", text[0]) if line.strip()]


@contextmanager
def terminal(monkeypatch: pytest.MonkeyPatch, columns: int) -> Iterator[list[str]]:
    """Let stderr be a terminal of so many columns; yield a list that gets what was written to it."""
    reader, writer = os.openpty()
    termios.tcsetwinsize(writer, (24, columns))
    found: list[str] = []
    with monkeypatch.context() as patched, open(writer, "w", encoding="utf-8") as stream:
        patched.setattr(sys, "stderr", stream)
        yield found
    text = b""
    with suppress(OSError):  # where Linux says that the other end is closed
        while part := os.read(reader, 4096):
            text += part
    os.close(reader)
    found.append(text.decode())


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


def test_a_terminal_gets_one_line_on_a_compilation_that_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", stream := Terminal())
    monkeypatch.setattr(module, "TICK", 0.01)
    monkeypatch.setenv("COLUMNS", "100")
    with told(Compilations()), compiling("reach on psm (fused, cpu)") as stage:
        stage("tracing the step")
        while stream.getvalue().count("tracing") < 3:  # it counts seconds within a stage, too
            time.sleep(0.01)
        stage("compiling the C code")
    shown = stream.getvalue().split("\r\x1b[K")
    line = r"surgical-marl: compiling, \d+ s, {}: reach on psm \(fused, cpu\)"
    assert re.fullmatch(line.format("tracing the step"), shown[1])
    assert re.fullmatch(line.format("compiling the C code"), shown[-2])
    assert re.fullmatch(r"surgical-marl: compiled reach on psm \(fused, cpu\) in \d+ s; .*cache\n", shown[-1])
    assert "\n" not in "".join(shown[:-1])
    size = len(stream.getvalue())
    time.sleep(0.05)
    assert len(stream.getvalue()) == size  # nothing ticks on


def test_a_narrow_terminal_gets_no_second_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Narrow is the terminal on stderr, whatever stdout and the environment say."""
    monkeypatch.setenv("COLUMNS", "200")
    title = "reach on " + 100 * "x"
    with (
        terminal(monkeypatch, 40) as text,
        pytest.raises(RuntimeError),
        told(Compilations()),
        compiling(title) as stage,
    ):
        stage("tracing the step")
        raise RuntimeError
    *lines, last = text[0].split("\r\x1b[K")
    assert lines[1].endswith("...") and all(len(line) < 40 for line in lines)
    assert last == ""  # nothing is left of what failed


def test_a_file_gets_lines_on_a_compilation(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def compile_all() -> list[str]:
        with told(Compilations()), compiling("reach on psm (fused, cpu)") as stage:
            for name in ("tracing the step", "scheduling the step", "compiling the C code"):
                stage(name)
        text = capsys.readouterr().err
        assert "\r" not in text and "\x1b" not in text
        return text.splitlines()

    monkeypatch.setattr(module, "PAUSE", 1000.0)
    start, end = compile_all()  # stages that follow soon are not worth a line
    assert start.startswith("surgical-marl: compiling reach on psm (fused, cpu): tracing the step; a second start")
    assert end.startswith("surgical-marl: compiled reach on psm (fused, cpu) in ")
    monkeypatch.setattr(module, "PAUSE", 0.0)
    _, *stages, _ = compile_all()
    assert stages == [f"surgical-marl: compiling reach on psm (fused, cpu): {name}" for name in
                      ("scheduling the step", "compiling the C code")]  # fmt: skip


def test_what_is_kept_on_disk_and_what_nobody_asked_for_is_not_told(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    with told(Compilations()), compiling("tea"):
        pass
    assert not capsys.readouterr().err and not caplog.records
    with compiling("tea") as stage:
        stage("boiling")
    assert not capsys.readouterr().err
    with caplog.at_level(logging.INFO, "surgical_marl"), compiling("tea") as stage:
        stage("boiling")
    assert caplog.messages == ["compiling tea: boiling", "compiling tea: done"]
    assert not capsys.readouterr().err


def test_a_compilation_is_told_in_place_of_what_is_prepared(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with preparing("tea"), told(Compilations()), compiling("a kettle") as stage:
        (timer,) = module._waiting
        stage("boiling")
        assert timer.finished.is_set()


def test_a_terminal_gets_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", stream := Terminal())
    monkeypatch.setenv("COLUMNS", "100")
    count("evaluating")
    last = stream.getvalue().split("\r")[-1]
    assert last.startswith("evaluating: 100%|") and "error 2 mm" in last
