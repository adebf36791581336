"""`surgical-marl eval`: the same answer twice, standard goals, several runs, comparisons and files."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from surgical_marl.cli.main import main
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.evaluation import command
from surgical_marl.evaluation.environment import common_settings
from surgical_marl.evaluation.goal_set import (
    describe_goals,
    episode_seed,
    goal_hash,
    is_standard,
    read_goals,
    standard_hashes,
)
from surgical_marl.learning import train
from surgical_marl.plugins.tasks import TASKS, list_tasks
from surgical_marl.runs.folder import write_config
from surgical_marl.runs.settings import NetworkSettings, Settings, own_sections
from surgical_marl.scenes.placing import scenes_for
from tests.helpers.fake_env import FakeEnv

SMALL = Settings(num_envs=8, iterations=1, steps_per_iteration=8, network=NetworkSettings(hidden=(8,)))


PUBLISHED = [
    (start, task, scene)
    for start, tasks in standard_hashes().items()
    for task, scenes in tasks.items()
    for scene in scenes
]
# Tables of paths take minutes to draw where they are not in the cache.
QUICK = [pytest.param(*one, marks=[] if one[:2] == ("home", "reach") else pytest.mark.slow) for one in PUBLISHED]


@pytest.mark.parametrize("start, task, scene", QUICK)
def test_the_standard_goals_are_those_that_were_published(start: str, task: str, scene: str) -> None:
    """If this fails, results of this version no longer compare with older ones: see docs/evaluation.md."""
    how = {"start": start} if start in TASKS.load(task).starts else {"difficulty": start}
    env = BatchedEnv(task, scene, num_envs=200, engine="mjx", device="cpu", goals="held_out", **how)
    env.reset(episode_seed(0, 0))
    about = describe_goals(env, 200)
    goals = read_goals(env, 200)
    assert goal_hash(about, goals) == standard_hashes()[start][task][scene]
    assert is_standard({**about, "goal_set": goal_hash(about, goals)})
    # Rounding noise is no other goal, a hundredth of a millimetre is.
    noisy = [part.astype(float) * (1 + 1e-12) for part in goals]
    assert goal_hash(about, noisy) == goal_hash(about, goals)
    noisy[0][17] += 1e-5
    assert goal_hash(about, noisy) != goal_hash(about, goals)


def test_the_page_is_enough_to_compute_a_hash() -> None:
    """As docs/evaluation.md has it, without the code of the evaluation."""
    env = Env("reach", "bimanual_psm", goals="held_out")
    first = jax.random.PRNGKey(int(np.random.SeedSequence([0, 0]).generate_state(1)[0] >> 1))
    keys = [jax.random.fold_in(jax.random.fold_in(first, i), 0) for i in range(200)]
    goals = np.stack([np.asarray(env.task.start(key).goal.targets, np.float32) for key in keys])
    about = {"task": "reach", "scene": "bimanual_psm", "control": "position", "difficulty": "default"}
    about |= {
        "goals": "held_out",
        "start": "home",
        "episodes": 200,
        "max_steps": 100,
        "control_dt": 0.02,
        "protocol": 2,
    }
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    digest.update(b"(200, 2, 3)" + np.round(goals.astype(np.float64) * 1e6).astype("<i8").tobytes())
    assert digest.hexdigest() == standard_hashes()["home"]["reach"]["bimanual_psm"]


def test_every_task_has_standard_goal_sets_for_its_scenes() -> None:
    assert {one for one in PUBLISHED if one[0] in TASKS.load(one[1]).starts} == {
        (start, task, scene) for task in list_tasks() for start in TASKS.load(task).starts for scene in scenes_for(task)
    }
    levels = {(level, task) for task in list_tasks() for level in own_sections(task, "difficulties")}
    assert {one[:2] for one in PUBLISHED if one[0] not in TASKS.load(one[1]).starts} == levels


def test_a_baseline_twice_gives_the_same_bytes(capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["eval", "random", "--task", "reach", "--scene", "psm", "--episodes", "12", "--seed", "3", "--json"]
    texts = []
    for _ in range(2):
        assert main(argv) == 0
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[1]
    result = json.loads(texts[0])
    assert [result[key] for key in ("policy", "task", "scene", "episodes", "seed")] == ["random", "reach", "psm", 12, 3]
    assert result["agents"].keys() == {"psm_0"} and result["min_distance_mm"] is None
    assert result["median_error_mm"] > 1 and result["path_length_mm"] > 1 and result["smoothness"] < -1


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Three runs of the same training with different seeds, on a fake environment."""

    def make_env(settings: Settings, num_envs: int | None = None) -> Any:
        return FakeEnv({"psm": 2}, {"psm": 3}, num_envs or settings.num_envs, max_steps=6)

    monkeypatch.setattr(train, "make_env", make_env)
    monkeypatch.setattr(command, "make_env", make_env)
    monkeypatch.chdir(tmp_path)
    for seed in range(3):
        train.train(replace(SMALL, seed=seed), out=tmp_path / f"seed{seed}")
    return [f"seed{seed}" for seed in range(3)]


def run(*argv: str) -> list[str]:
    return ["eval", *argv, "--episodes", "20"]


def test_several_runs(runs: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(run(*runs, "--json", "--csv", "table.csv", "--figure", "figure.png")) == 0
    found = json.loads(capsys.readouterr().out)
    assert [result["policy"] for result in found["runs"]] == runs
    assert len({result["goal_set"] for result in [*found["runs"], found["aggregate"]]}) == 1
    means = [result["mean_error_mm"] for result in found["runs"]]
    assert len(set(means)) == 3 and found["aggregate"]["mean_error_mm"] == pytest.approx(np.mean(means))
    low, high = found["aggregate"]["intervals"]["mean_error_mm"]
    assert low < np.mean(means) < high
    assert Path("figure.png").read_bytes().startswith(b"\x89PNG")
    with Path("table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["policy"], row["agent"]) for row in rows] == [
        (policy, agent) for policy in (*runs, "aggregate") for agent in ("all", "psm_0", "psm_1")
    ]
    assert float(rows[4]["mean_error_mm"]) == found["runs"][1]["agents"]["psm_0"]["mean_error_mm"]
    assert [float(rows[-3][f"mean_error_mm_{end}"]) for end in ("low", "high")] == [low, high]
    assert rows[1]["team_success_2mm"] == ""
    assert main(run(*runs)) == 0
    table = capsys.readouterr().out
    assert all(name in table.splitlines()[1] for name in ("all", "95 % interval", *runs))
    assert f"{found['aggregate']['median_error_mm']:.2f}" in table


def test_one_run_gives_the_interval_over_episodes(runs: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(run(*runs, "--json")) == 0
    several = json.loads(capsys.readouterr().out)
    assert main(run(runs[1], "--json")) == 0
    assert json.loads(capsys.readouterr().out) == several["runs"][1]


def test_comparing(runs: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(run(runs[0], "--json")) == 0
    text = capsys.readouterr().out
    Path("old.json").write_text(text)
    old = json.loads(text)
    assert main(run(runs[1], "--json", "--against", "old.json")) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["against"]["result"] == "old.json"
    assert found["against"]["difference"]["mean_error_mm"] == found["mean_error_mm"] - old["mean_error_mm"]
    assert main(run(*runs, "--against", "old.json")) == 0
    assert capsys.readouterr().out.splitlines()[1].split()[-2:] == ["old.json", "difference"]

    Path("other.json").write_text(json.dumps({**old, "goal_set": "0" * 64}))
    Path("half.json").write_text(text[:100])
    Path("none.json").write_text(json.dumps({"median_error_mm": 1.0}))
    for name, words in (("other.json", "000000000000 .* only results on the same goals compare"),
                        ("half.json", "is not a result"), ("none.json", "is not a result")):  # fmt: skip
        assert main(run(runs[1], "--against", name, "--csv", "new.csv")) == 2
        out, err = capsys.readouterr()
        assert not out and re.search(f"surgical-marl: {name} .*{words}", err)
    assert not Path("new.csv").exists()


def test_runs_that_do_not_go_together(runs: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    Path("torque").mkdir()
    write_config(Path("torque"), replace(SMALL, control="torque"))
    for argv, sentence in (
        ((runs[0], "torque"), "torque has control 'torque' and seed0 has 'position': they can't be compared"),
        ((runs[0], runs[0]), "'seed0' is named twice"),
        ((runs[0], "--scene", "psm"), "seed0 is of scene 'bimanual_psm', not 'psm': leave --scene out"),
        ((runs[0], "--control", "torque"), "seed0 is of control 'position', not 'torque': leave --control out"),
    ):
        assert main(run(*argv)) == 2
        out, err = capsys.readouterr()
        assert not out and err == f"surgical-marl: {sentence}\n"
    assert main(run(runs[0], "--task", "reach", "--scene", "bimanual_psm")) == 0
    asked = {"difficulty": "hard", "start": "random", "goals": "held_out"}
    found = common_settings([runs[0]], asked)
    assert {key: getattr(found, key) for key in asked} == asked, "other than it was trained for"


def test_a_file_that_cannot_be_written(
    runs: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device", "table.csv")

    monkeypatch.setattr(command, "write_csv", fail)
    assert main(run(runs[0], "--csv", "table.csv")) == 2
    assert "cannot write table.csv: No space left on device" in capsys.readouterr().err
