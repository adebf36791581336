"""The soak tells memory that grows from memory that is noisy, and faces are stepped in turns and looked at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surgical_marl.studies import soak
from surgical_marl.studies.command import run

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
            rows.append(f"{face},{number * 20.0},{number * 5.0},{total[face]:.0f},100.0,4,1")
    (tmp_path / soak.CSV).write_text("\n".join(rows) + "\nd,99")
    found = soak.read(tmp_path / soak.CSV)
    assert {face: len(own) for face, own in found.items()} == dict.fromkeys("abcd", 100)
    lines = soak.table(found).splitlines()[2:]
    assert ["falls" in line for line in lines] == [False, False, False, True]
    assert all("0.00 ± 0.00 | flat |" in line and "| 4 to 4 | 1 to 1 |" in line for line in lines)
    soak.draw(found, tmp_path / soak.FIGURE)
    assert (tmp_path / soak.FIGURE).stat().st_size > 0


def test_a_soak_is_not_written_over_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / soak.CSV).write_text("")
    assert run("soak", lambda: soak.main(["--out", str(tmp_path)])) == 2
    assert f"{tmp_path} holds soak.csv already" in capsys.readouterr().err


@pytest.mark.slow
def test_faces_take_turns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    faces = ["train", "batched", "made"]
    assert soak.main(["--minutes", "0.2", "--turn", "2", "--out", str(tmp_path), "--only", *faces]) == 0
    found = soak.read(tmp_path / soak.CSV)
    assert list(found) == faces
    for own in found.values():
        assert len(own) >= 2 and (np.diff(own.steps) >= 0).all() and own.steps[-1] > 0
        assert (own.memory_mb > 50).all() and (own.threads >= 1).all()
    assert capsys.readouterr().out.count("\n") == 5
