"""The study of docs/study.md: arms that are taken from their policy, and tables from what runs left."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from docs.studies import study, study_cells, study_report, study_runs
from surgical_marl.learning import train
from surgical_marl.policies.acting import forget
from surgical_marl.runs import settings as settings_module
from surgical_marl.runs.folder import write_config, write_metrics
from surgical_marl.runs.settings import Settings, load_config

ROOT = Path(__file__).parents[3]
MEASURES = ("error", "held", "squared", "distance", "center", "path", "time", "smoothness", "action_change")


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two seeds of two algorithms: seed 0 succeeds with both arms in half of the episodes, seed 1 always; whoever is
    frozen fails."""
    settings = load_config("reach", "bimanual_psm", ["num_envs=8", "iterations=10"])
    for algo in ("mappo", "joint"):
        for seed in range(2):
            run = tmp_path / f"reach-bimanual_psm-{algo}-seed{seed}"
            run.mkdir()
            write_config(run, replace(settings, algo=algo))
            rows = [
                {"env_steps": 100.0 * i, "seconds": 1.0 + seed, "success_rate": i / 10, "collision_rate": 0.0}
                for i in range(1, 11)
            ]
            write_metrics(run, rows[0], rows)
            good = np.full((4, 2), 0.001)
            good[: 2 - 2 * seed] = 0.1
            found: dict[str, Any] = {f"untouched/{name}": good for name in MEASURES}
            found["untouched/success"] = good < 0.002
            found["untouched/collided"] = np.zeros((4, 2), bool)
            for index, arm in enumerate(("psm_0", "psm_1")):
                for what, itself in (("frozen", 0.1), ("oracle", 0.0)):
                    held = good.copy()
                    held[:, index] = itself
                    found |= {f"{what} {arm}/held": held, f"{what} {arm}/collided": held > 0.05}
            about = {"goal_set": "hash", "episodes": 4, "agents": ["psm_0", "psm_1"], "cpu": "a CPU", "gpu": None}
            np.savez_compressed(run / study.PLAYED, about=json.dumps(about), **found)
    return tmp_path


def test_tables_and_files(runs: Path) -> None:
    page = runs / "study.md"
    page.write_text(f"before\n{study_report.BEGIN}\nold\n{study_report.END}\nafter\n")
    argv = ["--only", "report", "--out", str(runs), "--results", str(runs), "--cells"]
    assert study.main([*argv, "reach-bimanual_psm-mappo", "reach-bimanual_psm-joint"]) == 0
    first, second = json.loads((runs / "study.json").read_text())
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    assert f"10 iterations; trained on {first['trained_on']}, played on a CPU." in text
    assert "| `bimanual_psm` | `algo=mappo` | 75.0% (" in text
    assert "other arms, one frozen | collisions |" in text and "| `bimanual_psm` | `algo=joint` | 75.0% (" in text
    assert re.search(r"`algo=joint` \| 75\.0% \([^|]*\| 100\.0% \|", text), "others beside a frozen arm, and collisions"
    assert (first["algo"], second["algo"], first["seeds"]) == ("mappo", "joint", [0, 1])
    assert [each["success_2mm"] for each in first["by_seed"]] == [0.5, 1.0]
    assert first["seconds"][0] == 15.0 and first["samples"] == 1000.0
    assert first["broken"]["frozen"]["itself"][0] == 0.0 and first["broken"]["oracle"]["itself"][0] == 1.0
    assert first["broken"]["frozen"]["collisions"][0] == 1.0
    assert 790 <= first["curves"]["samples"]["reached"] <= 820
    # of both seeds together at the same second: the slower one ends after 20 s, the faster one after 10
    assert first["curves"]["seconds"]["x"][-1] == 10.0
    assert len((runs / "study.csv").read_text().splitlines()) == 5
    assert first["arms"]["psm_1"][0] == 0.75
    # a second report of one cell keeps the row of the other one
    assert study.main([*argv, "reach-bimanual_psm-mappo"]) == 0
    assert [row["cell"] for row in json.loads((runs / "study.json").read_text())] == [first["cell"], second["cell"]]
    assert (runs / "study.png").read_bytes().startswith(b"\x89PNG")


def test_nothing_to_report(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no run that was played"):
        study.main(["--only", "report", "--out", str(tmp_path), "--results", str(tmp_path)])


def test_what_is_played_are_goals_that_training_never_drew(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def make_env(settings: Settings, num_envs: int) -> None:
        raise ValueError(f"{num_envs} episodes of {settings.goals} goals")

    monkeypatch.setattr(settings_module, "make_env", make_env)
    job = study_runs.Job("reach-bimanual_psm-mappo", 0)
    (runs / str(job) / study_runs.PLAYED).unlink()
    with pytest.raises(ValueError, match="200 episodes of held_out goals"):
        study_runs.play(job, runs)


def test_an_arm_is_taken_over() -> None:
    env = SimpleNamespace(steps=torch.tensor([0, 4, 5, 9]))
    policy = lambda observations: {name: torch.ones(4, 2) for name in ("a", "b")}  # noqa: E731
    instead = lambda observations: {name: -torch.ones(4, 2) for name in ("a", "b")}  # noqa: E731
    forgotten: list[Any] = []
    policy.reset = forgotten.append  # type: ignore[attr-defined]
    acting = study_runs.taken_over(policy, env, "b", instead, start=5)
    forget(acting, "ended")
    assert forgotten == ["ended"]
    actions = acting({})
    assert actions["a"].tolist() == [[1, 1]] * 4
    assert actions["b"].tolist() == [[1, 1]] * 2 + [[-1, -1]] * 2


def test_what_is_wrong_with_one_run_stops_no_other(tmp_path: Path) -> None:
    job = study_runs.Job("reach-bimanual_psm-mappo", 0)
    assert study_runs.work("train", job, tmp_path, ["num_env=3"]) == (
        job,
        "unknown setting 'num_env'; did you mean 'num_envs'?",
    )


@pytest.mark.parametrize(
    ("script", "argv", "words"),
    [
        ("study", ["--only", "report"], "study: out holds no run that was played: nothing to report"),
        ("study", ["--cells", "one-4"], "study: unknown cell 'one-4', did you mean"),
        ("study", ["--seeds", "0"], "argument --seeds: must be a whole number of 1 or more, not '0'"),
        ("tuning", ["--scene", "nope"], "tuning: unknown scene 'nope'"),
    ],
)
def test_bad_input_ends_in_one_sentence(script: str, argv: list[str], words: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", f"docs.studies.{script}", *argv, "--out", "out"]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 2 and words in done.stderr and "Traceback" not in done.stderr


def test_sizes_and_devices_are_told_by_scene_or_settings() -> None:
    where = {
        "steps_per_iteration": 32,
        "iterations": 9,
        "seeds": [0],
        "task": "reach",
        "trained_on": "a GPU",
        "gpu": None,
        "cpu": "a CPU",
    }
    of = (("a", 8, "mappo"), ("b", 8, "mappo"), ("a", 8, "joint"), ("c", 16, "mappo"))
    found = [{**where, "scene": s, "num_envs": n, "cell": f"handover-{algo}"} for s, n, algo in of]
    both = "8 environments, 32 steps an iteration, 9 iterations on `a` and `b`"
    assert study_report.about(found[:3]) == (
        f"`reach`, 1 seeds each, {both.removesuffix(' on `a` and `b`')}; trained on a GPU, played on a CPU."
    )
    assert f"{both}; 16 environments, 32 steps an iteration, 9 iterations on `c`; trained" in study_report.about(found)
    found[2] |= {"trained_on": "another", "gpu": "another"}
    told = "trained on a GPU, played on a CPU with `algo=mappo` and on `b`; trained on another, played on another with"
    assert study_report.about(found[:3]).endswith(f"{told} `algo=joint`.")  # scene `a` does not tell them apart


@pytest.mark.parametrize("cell", study_cells.CELLS.values(), ids=list(study_cells.CELLS))
def test_every_cell_has_settings_that_are_accepted(cell: study_cells.Cell) -> None:
    settings = load_config(cell.task, cell.scene, cell.settings)
    assert cell.question in study_cells.QUESTIONS and settings.scene == cell.scene


def test_a_cell_is_trained_with_its_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(train, "finish", lambda settings, run: asked.append((settings, run)))
    study_runs.learn(study_runs.Job("one-4-ippo", 3), tmp_path, ["iterations=7"])
    ((settings, run),) = asked
    assert (settings.knowledge, settings.messages, settings.algo, settings.team_reward) == ("one", 4, "ippo", True)
    assert (settings.seed, settings.iterations, run) == (3, 7, tmp_path / "one-4-ippo-seed3")
