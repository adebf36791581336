"""The search of docs/tuning.md: where it starts, and what it leaves out."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from docs.studies import tuning
from surgical_marl import machine
from surgical_marl.runs.settings import Settings, load_config


@pytest.mark.parametrize(
    ("task", "scene", "where", "imitates"),
    [
        ("reach", "psm", "cpu", False),
        ("needle_pick", "psm_needle", "cuda", True),
        ("needle_handover", "bimanual_psm_needle", "cuda", True),
    ],
)
def test_shipped_settings_are_a_point_of_the_space(task: str, scene: str, where: str, imitates: bool) -> None:
    settings = load_config(task, scene, [f"device={where}"])
    assert (settings.imitation.steps > 0) == imitates
    for name, knob in tuning.knobs(where, imitates).items():
        point = knob.point(tuning._setting(settings, knob.setting))
        assert knob.range._contains(point), name
        value = tuning._setting(settings, knob.setting)
        assert knob.value(point) == pytest.approx(value, abs=1e-5), name


def test_what_is_fixed_is_not_searched() -> None:
    found = tuning.knobs("cuda", fixed=["num_envs=64", "network.hidden=[8]"])
    assert "log2_num_envs" not in found and len(found) == len(tuning.knobs("cuda")) - 1


def test_slower_trials_are_pruned_and_the_best_is_confirmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A training takes 1 s for each epoch, and is given up after its limit."""

    def solve(settings: Settings, goal: Any, give_up: Any) -> Any:
        give_up(0.0, 0.0)
        solved = not give_up(0.0, float(settings.ppo.epochs))
        return SimpleNamespace(solved=solved, learning_s=float(settings.ppo.epochs), exam=SimpleNamespace(success=0.5))

    monkeypatch.setattr(tuning, "solve", solve)
    monkeypatch.setattr(machine, "restart_peak", lambda: 0.0)  # it collects all garbage, 27 times
    folders = ["--out", str(tmp_path / "out"), "--results", str(tmp_path / "results")]
    argv = ["--device", "cpu", "--trials", "12", "--limit", "6", "--confirm", "2", *folders]
    assert tuning.main(argv) == 0
    found = json.loads((tmp_path / "results" / "reach-psm-mappo-cpu.json").read_text())
    shipped = load_config("reach", "psm", ["device=cpu"]).ppo
    assert found["seconds"]["shipped"] == [shipped.epochs] * 2
    assert found["seconds"]["best"] == [found["best"]["ppo.epochs"]] * 2
    assert found["best"]["ppo.epochs"] <= shipped.epochs
    lines = (tmp_path / "results" / "reach-psm-mappo-cpu.csv").read_text().splitlines()
    assert len(lines) == 13 and lines[1].startswith(f"0,complete,{float(shipped.epochs)},,{shipped.learning_rate},")
    assert all("complete" in line or ",pruned," in line for line in lines[1:])
    assert tuning.main(argv) == 0, "nothing is left to do but to confirm"
    assert len((tmp_path / "results" / "reach-psm-mappo-cpu.csv").read_text().splitlines()) == 13


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--scene", "nope"], "unknown scene 'nope'"),
        (["--task", "nope"], "unknown task 'nope' (choose from camera_assist,"),
        (["--success", "2"], "2"),
        (["num_env=3"], "did you mean 'num_envs'"),
        (["--seeds", "0"], "argument --seeds: must be a whole number of 1 or more, not '0'"),
        (["--trials", "2.5"], "argument --trials: must be a whole number of 1 or more, not '2.5'"),
        (["--limit", "-1"], "argument --limit: must be a number above 0, not '-1'"),
    ],
)
def test_bad_input_starts_no_search(
    argv: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises((ValueError, SystemExit)) as error:
        tuning.main([*argv, "--device", "cpu", "--out", str(tmp_path / "out")])
    assert words in (str(error.value) if error.type is ValueError else capsys.readouterr().err)
    assert not list(tmp_path.rglob("*.csv")) + list(tmp_path.rglob("*.log"))
