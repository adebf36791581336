"""The soak tells memory that grows from memory that is noisy, and steps faces, in turns or at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from docs.studies import soak
from docs.studies.command import run

HOURS = np.linspace(0.0, 4.0, 200)


def test_a_leak_is_told_from_noise() -> None:
    noise = np.random.default_rng(0).normal(0, 1, len(HOURS))
    for slope, verdict in ((0.0, "flat"), (30.0, "grows"), (-30.0, "falls")):
        found = soak.trend(HOURS, 400 + slope * HOURS + noise)
        assert found is not None and found.low <= slope <= found.high and found.verdict(0.01) == verdict
    found = soak.trend(HOURS, 400 + 100 * noise)
    assert found is not None and found.verdict(0.01) == "not known yet"
    assert soak.trend(HOURS[:10], noise[:10]) is None


def test_what_slows_all_faces_is_no_ones_fault(tmp_path: Path) -> None:
    """On a machine that becomes half as fast, one face becomes slower still; a row that was cut short is left out."""
    rows, total = [",".join(soak.Sample._fields)], dict.fromkeys("abcd", 0.0)
    for number in range(100):
        for face in total:
            slower = number > 50 and face == "d"
            total[face] += 1000 * (1 - 0.005 * number) * (0.5 if slower else 1.0)
            rows.append(f"{face},{number * 20.0},{number * 5.0},{total[face]:.0f},100.0,0.0,4,1")
    (tmp_path / soak.CSV).write_text("\n".join(rows) + "\nd,99")
    found = soak.read(tmp_path / soak.CSV)
    assert {face: len(own) for face, own in found.items()} == dict.fromkeys("abcd", 100)
    lines = soak.table(found, at_once=False).splitlines()[2:]
    assert ["falls" in line for line in lines] == [False, False, False, True]
    assert all("0.00 ± 0.00 | flat |" in line and "| 4 to 4 | 1 to 1 |" in line for line in lines)
    lines = soak.table(found, at_once=True).splitlines()[2:]
    assert ["falls" in line for line in lines] == [True] * 4, "faces that ran at once are not excused by each other"
    (line,) = soak.table({"d": found["d"]}, at_once=False).splitlines()[2:]
    assert "falls" in line, "a face alone is not excused by itself"
    soak.draw(found, tmp_path / soak.FIGURE, at_once=False)
    assert (tmp_path / soak.FIGURE).stat().st_size > 0


def test_memory_of_a_gpu_is_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """nvidia-smi lists processes, one of them on two GPUs; it may say nothing of a process, or of its memory."""
    said = "#!/bin/sh\nprintf '7, 500\\n8, 10\\n7, 20\\n9, [N/A]\\n'\n"
    (tmp_path / "nvidia-smi").write_text(said)
    (tmp_path / "nvidia-smi").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    assert [soak.gpu_memory(process) for process in (7, 8)] == [520.0, 10.0]
    assert np.isnan([soak.gpu_memory(process) for process in (9, 10)]).all()
    rows = [",".join(soak.Sample._fields)]
    for number in range(100):
        rows += [
            f"a,{number}.0,{number}.0,{number},100.0,{500 + number},4,1",
            f"b,{number}.0,1.0,{number},100.0,nan,4,1",
        ]
    (tmp_path / soak.CSV).write_text("\n".join(rows) + "\n")
    grown, unseen = soak.table(soak.read(tmp_path / soak.CSV), at_once=True).splitlines()[2:]
    assert "| +3600.00 ± 0.00 | grows |" in grown and "|  |  | not known |" in unseen


def test_a_soak_is_not_written_over_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / soak.CSV).write_text("")
    assert run("soak", lambda: soak.main(["--out", str(tmp_path)])) == 2
    assert f"{tmp_path} holds soak.csv already" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("how", [[], ["--at-once"]], ids=["turns", "at once"])
def test_faces_are_stepped(tmp_path: Path, capsys: pytest.CaptureFixture[str], how: list[str]) -> None:
    faces = ["train", "batched", "made"]
    assert soak.main(["--minutes", "0.2", "--turn", "2", "--out", str(tmp_path), "--only", *faces, *how]) == 0
    found = soak.read(tmp_path / soak.CSV)
    assert set(found) == set(faces)
    for own in found.values():
        assert len(own) >= 2 and (np.diff(own.steps) >= 0).all() and own.steps[-1] > 0
        assert (own.memory_mb > 50).all() and (own.threads >= 1).all()
    assert capsys.readouterr().out.count("\n") == 5
