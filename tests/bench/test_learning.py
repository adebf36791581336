"""Benchmarks of learning: what they report, and when they evaluate. How fast anything is, no test says."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from itertools import count
from types import SimpleNamespace
from typing import Any

import pytest

from surgical_marl import machine
from surgical_marl.bench import course, solve
from surgical_marl.bench import learning as train
from surgical_marl.bench.learning import STARTING
from surgical_marl.bench.solve import EvaluationSchedule, Exam, Goal
from surgical_marl.cli.main import main
from surgical_marl.learning import train as learning_train
from surgical_marl.learning.imitation import Imitation
from surgical_marl.learning.trainer import Trainer
from surgical_marl.runs.settings import ImitationSettings, NetworkSettings, PPOSettings, Settings
from tests.helpers.fake_env import FakeEnv

CONTRACT = [
    "physics_steps_per_s", "env_steps_per_s", "simulated_s_per_s", "num_envs", "engine", "device", "dt", "decimation",
    "compile_s", "train_env_steps_per_s",
]  # fmt: skip
SMALL = ["steps_per_iteration=4", "ppo.epochs=1", "ppo.mini_batches=1", "network.hidden=[8]"]
SETTINGS = Settings(
    num_envs=32, steps_per_iteration=8, network=NetworkSettings(hidden=(8,)), ppo=PPOSettings(epochs=1, mini_batches=1)
)
ANY = Goal(0.0, 1.0)


def exam(success: float, collisions: float = 0.0) -> Exam:
    return Exam("success_2mm", success, 0.0, collisions, 1.0, "hash", True)


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trainings and evaluations run on fake environments."""

    def make_env(settings: Settings, num_envs: int | None = None) -> Any:
        env = FakeEnv({"psm": 2}, {"psm": 3}, num_envs or settings.num_envs, max_steps=10)
        env.engine = SimpleNamespace(name="fake")  # type: ignore[attr-defined]
        return env

    monkeypatch.setattr(solve, "make_env", make_env)
    monkeypatch.setattr(learning_train, "make_env", make_env)


def test_training_as_json_has_the_keys_of_the_contract_and_the_split(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(train, "measure", partial(train.measure, seconds=0.0, repeats=1))
    argv = ["bench", "train", "--scene", "ecm", "--num-envs", "8", "--device", "cpu", *SMALL]
    assert main([*argv, "--engine", "fused", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found) == [*CONTRACT, "rollout_s", "update_s", "rest_s"]
    assert (found["engine"], found["device"], found["num_envs"], found["decimation"]) == ("fused", "cpu", 8, 8)
    iteration = found["rollout_s"] + found["update_s"] + found["rest_s"]
    assert found["train_env_steps_per_s"] == pytest.approx(8 * 4 / iteration)


def test_nothing_comes_before_learning_that_changes_no_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    """No imitation, and no course of `bench sim`, which take minutes with objects."""

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError

    monkeypatch.setattr(Imitation, "run", refuse)
    monkeypatch.setattr(course, "make_course", refuse)
    settings = replace(SETTINGS, imitation=ImitationSettings(steps=100, batch_size=8), oracle_episodes=8)
    speed = train.measure(settings, seconds=0.0, repeats=1)
    assert speed.physics_steps_per_s == speed.decimation * (speed.env_steps_per_s or 0)
    assert speed.simulated_s_per_s == pytest.approx(speed.dt * speed.physics_steps_per_s)


def test_training_stands_beside_what_is_quoted() -> None:
    speed = train.Speed(2e6, 2e5, 4e3, 64, "fused", "cpu", 0.0025, 8, 3.0, 5e4, 0.03, 0.01, 0.0)
    lines = train.table(SETTINGS, speed).splitlines()
    assert all(any(line.startswith(name) and line.endswith("quoted") for line in lines) for name in train.QUOTED)
    assert any("147,059" in line for line in lines) and any("50,000" in line for line in lines)
    assert "rollout 0.03 s (75%)" in "\n".join(lines) and "25.0% of the simulator's speed" in "\n".join(lines)


def test_solved_as_json(fakes: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["bench", "solve", "--device", "cpu", "--num-envs", "32", "--success", "0", "--collisions", "1", *SMALL]
    assert main([*argv, "--seed", "3", "--algo", "ippo", "--json"]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert found["solved"] and (found["seed"], found["algo"], found["goal"]["success"]) == (3, "ippo", 0.0)
    parts = ("imports_s", "compile_s", "rollout_s", "update_s", "evaluation_s", "rest_s")
    assert sum(found[part] for part in parts) == pytest.approx(found["seconds"])
    assert found["env_steps"] == 32 * 4 * found["iterations"]
    assert found["evaluations"] == 1 and "within 2 mm" in err
    assert found["best_success"] == found["success_2mm"] and found["control_frame"] == "base"


def test_given_up(fakes: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["bench", "solve", "--device", "cpu", "--num-envs", "32", "--limit", "0.001", *SMALL]
    assert main(argv) == 1
    assert "given up after" in capsys.readouterr().out
    found = solve.solve(SETTINGS, Goal(), lambda seconds, learning: learning > 0)
    assert not found.solved and (found.iterations, found.evaluations) == (1, 1)
    assert found.learning_s <= found.seconds


def test_the_policy_is_examined_as_it_is(fakes: None) -> None:
    """An evaluation between two iterations changes nothing for the training."""
    other = solve.make_env(SETTINGS, solve.STANDARD_EPISODES)

    def losses(examined: bool) -> list[float]:
        training, found = Trainer(SETTINGS, solve.make_env(SETTINGS)), []
        for row, _ in zip(train.rows(training), range(3), strict=False):
            found.append(row["value_loss"])
            if examined:
                solve.examine(training, other)
        return found

    assert losses(examined=True) == losses(examined=False)


def test_starting_is_what_the_first_iterations_take_more() -> None:
    assert solve.starting([5.0, 3.0, 1.0, 1.0, 2.0]) == 4.0 + 2.0
    assert solve.starting([5.0] * STARTING) == 0.0
    assert solve.starting([0.5, 0.5, 1.0]) == 0.0


def test_a_stopwatch_times_each_rollout_and_update(fakes: None, monkeypatch: pytest.MonkeyPatch) -> None:
    training = Trainer(SETTINGS, solve.make_env(SETTINGS))
    watch = train.Stopwatch(training)
    ticks = count()
    monkeypatch.setattr("time.perf_counter", lambda: float(next(ticks)))
    for _ in range(3):
        training.rollout()
        training.update()
    assert watch.seconds("rollout") == watch.seconds("update") == [1.0] * 3


def test_evaluations_are_worth_their_time() -> None:
    schedule = EvaluationSchedule(Goal(0.9, 0.01))
    assert not schedule.due(math.nan, 10.0), "no episode ended"
    assert not schedule.due(0.2, 10.0) and schedule.due(0.3, 10.0), "a quarter of the goal"
    schedule.add(0.4, exam(0.8), learning=100.0, took=1.0)
    # (0.4, 0.8) and (1, 1): 0.9 is expected at 0.7
    assert not schedule.due(0.69, 119.0) and schedule.due(0.69, 121.0), "a twentieth of the time"
    assert not schedule.due(0.71, 102.5) and schedule.due(0.71, 103.5), "a third of the time"
    schedule.add(0.7, exam(0.95, collisions=0.02), learning=200.0, took=1.0)
    assert schedule.due(0.7, 206.0), "only collisions are too many"


def test_a_goal_is_success_without_collisions() -> None:
    assert exam(0.95).passes(Goal()) and not exam(0.949).passes(Goal())
    assert not exam(1.0, collisions=0.01).passes(Goal())


def test_tasks_without_targets_of_tips_are_judged_by_their_own_success(fakes: None) -> None:
    env = solve.make_env(SETTINGS, solve.STANDARD_EPISODES)
    found = {}
    for task in ("reach", "needle_pick"):
        training = Trainer(SETTINGS, solve.make_env(SETTINGS))
        training.settings = replace(SETTINGS, task=task)
        found[task] = solve.examine(training, env)
    assert found["reach"].judged_by == "success_2mm" and found["needle_pick"].judged_by == "success_rate"
    judged = replace(found["needle_pick"], success_2mm=0.0, success_rate=1.0)
    assert judged.passes(ANY) and judged.success == 1.0 and judged.what == "successful"
    assert not replace(judged, judged_by="success_2mm").passes(Goal(0.5, 1.0))


def test_a_process_has_an_age() -> None:
    assert 0 < machine.age() < 1e7


@pytest.mark.parametrize(
    "argv, words",
    [
        (["train", "--engine", "fuzed"], ["'fuzed'", "did you mean 'fused'", "auto", "mjx"]),
        (["train", "--scene", "psmm"], ["'psmm'", "did you mean 'psm'"]),
        (["train", "--task", "reech"], ["'reech'", "did you mean 'reach'"]),
        (["train", "--algo", "ppo"], ["'ppo'", "mappo", "ippo", "joint"]),
        (["train", "ppo.epoch=3"], ["'ppo.epoch'", "did you mean 'ppo.epochs'"]),
        (["train", "ppo.epochs=0"], ["ppo.epochs", "from 1 to"]),
        (["train", "--success", "0.9"], ["--success", "bench train --help"]),
        (["train", "--sweep"], ["--sweep"]),
        (["sim", "num_envs=3"], ["num_envs=3", "bench sim --help"]),
        (["solve", "--success", "95"], ["success", "from 0 to 1", "95"]),
        (["solve", "--collisions", "x"], ["--collisions", "'x'"]),
        (["solve", "--limit", "0"], ["--limit", "above 0", "0"]),
        (["solve", "--limit", "nan"], ["--limit", "nan"]),
        (["solve", "iterations=3"], ["iterations=3", "--limit"]),
    ],
)
def test_bad_input(argv: list[str], words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *argv]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.startswith("surgical-marl: ") and err.count("\n") == 1
    for word in words:
        assert word in err


@pytest.mark.parametrize("kind", ["train", "solve"])
def test_no_cuda_is_bad_input(kind: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgical_marl.bench.workload.has_cuda", lambda: False)
    assert main(["bench", kind, "--device", "cuda"]) == 2
    assert "device 'cuda' is not there" in capsys.readouterr().err
