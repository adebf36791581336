"""Training as a whole: it learns, it resumes bit for bit, and it refuses what it cannot do."""

from __future__ import annotations

import json
import math
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from surgical_marl.evaluation.evaluate import evaluate
from surgical_marl.files import write_atomic
from surgical_marl.learning import train, trainer
from surgical_marl.learning.algorithm import Algorithm
from surgical_marl.learning.episodes import Episodes
from surgical_marl.learning.reporter import Report
from surgical_marl.plugins.algorithms import ALGORITHMS, list_algorithms
from surgical_marl.policies.policy import load_policy, random_policy, zero_policy
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import CONFIG, read_metrics, read_settings, write_metrics
from surgical_marl.runs.settings import NetworkSettings, PPOSettings, Settings
from tests.helpers.fake_env import FakeEnv
from tests.helpers.runs import ALL, COUNTS, OPTIONS, SIZES, SMALL, untrained_policy


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Training runs on fake environments, which this list collects."""
    made: list[Any] = []

    def make_env(settings: Settings, num_envs: int | None = None) -> Any:
        made.append(FakeEnv(COUNTS, SIZES, settings.num_envs, max_steps=10))
        return made[-1]

    monkeypatch.setattr(train, "make_env", make_env)
    return made


def weights(run: Path) -> dict[str, torch.Tensor]:
    return read_checkpoint(run)["algorithm"]["actor_state_dict"]


def without_time(rows: list[dict[str, float]]) -> str:
    return str([{k: v for k, v in row.items() if not k.startswith(("seconds", "steps_per_s"))} for row in rows])


def test_an_iterations_time_is_split(tmp_path: Path, fakes: list[Any]) -> None:
    train.train(replace(SMALL, iterations=2), out=tmp_path / "run")
    for row in read_metrics(tmp_path / "run"):
        assert row["seconds_rollout"] > 0
        assert row["seconds_update"] > 0
        assert row["seconds_rollout"] + row["seconds_update"] <= row["seconds"]


@pytest.mark.parametrize("algo", list_algorithms())
def test_the_toy_is_learned(algo: Any, tmp_path: Path, fakes: list[Any]) -> None:
    ppo = PPOSettings(learning_rate=3e-3, gamma=0.9, mini_batches=2)
    settings = replace(
        SMALL,
        algo=algo,
        num_envs=256,
        iterations=25,
        steps_per_iteration=16,
        ppo=ppo,
        network=NetworkSettings(hidden=(32, 32)),
    )
    run = train.train(settings, out=tmp_path / "run")
    env: Any = FakeEnv(COUNTS, SIZES, num_envs=100, max_steps=10)
    trained = evaluate(env, load_policy(run, env), episodes=100, seed=7)["mean_error_mm"]
    nothing = evaluate(env, zero_policy(env), episodes=100, seed=7)["mean_error_mm"]
    fresh = untrained_policy(env, settings, ALGORITHMS.load(algo).grouping)
    untrained = evaluate(env, fresh, episodes=100, seed=7)["mean_error_mm"]
    assert trained < nothing / 3
    assert untrained > nothing / 2
    rows = read_metrics(run)
    assert rows[-1]["tip_error_mm"] < rows[0]["tip_error_mm"] / 2
    assert rows[-1]["success_rate"] > rows[0]["success_rate"]


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("counts", [{"psm": 1}, COUNTS])
@pytest.mark.parametrize("algo", list_algorithms())
def test_options_go_together(
    algo: Any, counts: dict[str, int], precision: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "make_env", lambda settings: FakeEnv(counts, SIZES, settings.num_envs, max_steps=5))
    settings = replace(SMALL, algo=algo, precision=precision, **ALL, iterations=2)
    run = train.train(settings, out=tmp_path / "run")
    assert read_settings(run) == settings
    last = read_metrics(run)[-1]
    assert last["cost_rate"] >= 0 and last["lagrange_multiplier"] >= 0 and math.isfinite(last["value_loss"])
    env: Any = FakeEnv(counts, SIZES, num_envs=4, max_steps=5)
    assert evaluate(env, load_policy(run, env), episodes=4, seed=0)["mean_error_mm"] > 0


@pytest.mark.parametrize("options", [*OPTIONS, ALL])
def test_resume_is_bit_for_bit(options: dict[str, Any], tmp_path: Path, fakes: list[Any]) -> None:
    settings = replace(SMALL, **options)
    whole = train.train(settings, out=tmp_path / "whole")
    half = train.train(replace(settings, iterations=2), out=tmp_path / "half")
    same = train.train(settings, out=half, resume=half)
    copy = train.train(replace(settings, iterations=2), out=tmp_path / "other")
    moved = train.train(settings, out=tmp_path / "moved", resume=copy)
    first = read_checkpoint(whole)
    for run in (same, moved):
        again = read_checkpoint(run)
        for part in ("actor_state_dict", "critic_state_dict", "options_state_dict"):
            for name, value in first["algorithm"][part].items():
                assert torch.equal(again["algorithm"][part][name], value), name
        moments = first["algorithm"]["optimizer_state_dict"]["state"]
        for index, moment in again["algorithm"]["optimizer_state_dict"]["state"].items():
            assert torch.equal(moment["exp_avg_sq"], moments[index]["exp_avg_sq"])
        for name, memory in first["env"]["memory"].items():
            assert torch.equal(again["env"]["memory"][name], memory)
            assert memory.any() == (settings.network.recurrent != "none")
        assert torch.equal(again["random"], first["random"])
        assert torch.equal(again["env"]["observations"]["state"], first["env"]["observations"]["state"])
        assert [row["iteration"] for row in read_metrics(run)] == [1, 2, 3, 4]
        assert without_time(read_metrics(run)) == without_time(read_metrics(whole))


def test_the_state_holds_running_episodes(fakes: list[Any]) -> None:
    first, second = (trainer.Trainer(SMALL, train.make_env(SMALL)) for _ in range(2))
    first.iterate()
    first.episodes.collided[::2] = True
    second.set_state(first.state())
    assert second.iteration == 1
    assert torch.equal(second.episodes.collided, first.episodes.collided)
    assert (second.env.env.steps == first.env.env.steps).all()


def test_a_seed_decides_the_run(tmp_path: Path, fakes: list[Any]) -> None:
    runs = [train.train(replace(SMALL, seed=s), out=tmp_path / str(i)) for i, s in enumerate((0, 0, 1))]
    name = next(name for name in weights(runs[0]) if name.endswith("mlp.0.weight"))
    first, again, other = (weights(run)[name] for run in runs)
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_resume_drops_rows_beyond_the_checkpoint(tmp_path: Path, fakes: list[Any]) -> None:
    run = train.train(replace(SMALL, iterations=2), out=tmp_path / "run")
    with (run / "metrics.csv").open("a") as file:
        file.write((run / "metrics.csv").read_text().splitlines()[-1].replace("2,", "3,", 1) + "\n")
    train.train(replace(SMALL, iterations=3), out=run, resume=run)
    assert [row["iteration"] for row in read_metrics(run)] == [1, 2, 3]
    (run / "metrics.csv").write_bytes(b"garbage\x00\xff,,,\n1,2\n")
    train.train(replace(SMALL, iterations=4), out=run, resume=run)
    assert [row["iteration"] for row in read_metrics(run)] == [4]


def test_a_run_folder_recreates_the_run(tmp_path: Path, fakes: list[Any]) -> None:
    settings = replace(SMALL, team_reward=True, max_steps=10)
    run = train.train(settings, out=tmp_path / "a" / "run")
    assert read_settings(run) == settings
    assert read_settings(run, ["iterations=9"]) == replace(settings, iterations=9)
    assert "torch: " in (run / "config.yaml").read_text()
    assert (run / "curve.png").read_bytes()[:4] == b"\x89PNG"
    assert list((run / "tensorboard").iterdir())
    assert not list(run.glob(".*"))
    row = read_metrics(run)[-1]
    assert row["env_steps"] == 4 * 8 * 32 and row["episodes"] > 0


def test_episodes_are_counted_once_each(tmp_path: Path, fakes: list[Any]) -> None:
    episodes = Episodes(["a", "b"], ["reward_near"], 2, 3, "cpu")
    flags = torch.tensor

    def infos(error: float, collision: list[bool]) -> dict[str, dict[str, torch.Tensor]]:
        tip = torch.full((3,), error)
        hit, clear = flags(collision), flags([False] * 3)
        return {
            "a": {
                "tip_error": tip,
                "success": flags([True, True, False]),
                "collision": hit,
                "reward_near": flags([2.0, 4.0, 6.0]),
            },
            "b": {"tip_error": 3 * tip, "success": flags([True, False, False]), "collision": clear},
        }

    none, reward = flags([False] * 3), flags([1.0, 2.0, 3.0])
    episodes.add(reward, none, infos(float("nan"), [True, False, False]), flags([False] * 3))
    episodes.add(reward, flags([True, True, False]), infos(0.25, [False, False, True]), flags([False] * 3))
    episodes.add(reward, flags([True, False, False]), infos(0.5, [False, False, False]), flags([False, True, True]))
    # Ended: environment 0 (mean error 0.5, both succeed, collided before), 1 (0.5, half of them),
    # and 0 again (1.0, both, no collision). Two agents share a term of mean 4 that one of them has.
    assert episodes.take().tolist() == [3.0, 2.0, 2.5, 1.0, 6.0, 6.0]
    assert episodes.collided.tolist() == [False, False, True]
    assert episodes.take().tolist() == [0.0] * 6


@pytest.mark.parametrize("algo", ["mappo", "joint"])
def test_reward_terms_add_up_to_the_reward(algo: Any, tmp_path: Path, fakes: list[Any]) -> None:
    for row in read_metrics(train.train(replace(SMALL, algo=algo), out=tmp_path / "run")):
        assert row["reward_late"] < 0
        assert row["reward_distance"] + row["reward_late"] == pytest.approx(row["reward"], rel=1e-5)


def test_metrics_of_an_older_version_lack_columns(tmp_path: Path) -> None:
    write_metrics(tmp_path, ["a", "b"], [{"a": 1.0, "old": 5.0}, {"b": 2.0, "a": 3.0}])
    assert (tmp_path / "metrics.csv").read_text().split() == ["a,b", "1,", "3,2"]


def test_nan_stops_and_keeps_the_last_checkpoint(
    tmp_path: Path, fakes: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    original = trainer.Trainer.iterate

    def iterate(self: trainer.Trainer) -> Report:
        fakes[0].poison = self.iteration == 3
        return original(self)

    monkeypatch.setattr(trainer.Trainer, "iterate", iterate)
    with pytest.raises(FloatingPointError, match="iteration 4"):
        train.train(replace(SMALL, iterations=9), out=tmp_path / "run")
    checkpoint = read_checkpoint(tmp_path / "run")
    assert checkpoint["iteration"] == 2
    assert all(torch.isfinite(value).all() for value in weights(tmp_path / "run").values())
    assert len(read_metrics(tmp_path / "run")) == 3
    found = json.loads((tmp_path / "run" / "diverged.json").read_text())
    assert found["iteration"] == 4 and found["last_checkpoint"] == 2 and found["learning_rate"] > 0
    assert found["not_finite"]["observations"] == ["psm[0]", "state[0]"]
    assert {"actions", "values", "gradients", "weights"} <= found["not_finite"].keys()
    assert found["not_finite"]["gradients"] == ["actor in mini-batch 1", "critic in mini-batch 1"]
    monkeypatch.undo()
    monkeypatch.setattr(train, "make_env", lambda settings: FakeEnv(COUNTS, SIZES, settings.num_envs, max_steps=10))
    train.train(SMALL, out=tmp_path / "run", resume=tmp_path / "run")
    assert not (tmp_path / "run" / "diverged.json").exists()


def test_a_nan_reward_names_its_term(tmp_path: Path, fakes: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    original = FakeEnv._info

    def info(self: FakeEnv, agent: str) -> dict[str, torch.Tensor]:
        found = original(self, agent)
        return found | {"reward_distance": found["reward_distance"].clone().fill_(math.inf)}

    monkeypatch.setattr(FakeEnv, "_info", info)
    with pytest.raises(FloatingPointError, match=r"rewards became NaN or infinite in iteration 1 \(reward_distance\)"):
        train.train(SMALL, out=tmp_path / "run")


def test_a_nan_loss_stops(tmp_path: Path, fakes: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Algorithm, "conclude", lambda self: self.losses.fill_(math.nan))
    with pytest.raises(FloatingPointError, match="learning_rate"):
        train.train(SMALL, out=tmp_path / "run")
    assert read_checkpoint(tmp_path / "run")["iteration"] == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2])
def test_a_signal_ends_the_iteration_and_saves(
    number: int,
    tmp_path: Path,
    fakes: list[Any],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    original = trainer.Trainer.iterate

    def iterate(self: trainer.Trainer) -> Report:
        if self.iteration == 2:
            os.kill(os.getpid(), number)
        return original(self)

    monkeypatch.setattr(trainer.Trainer, "iterate", iterate)
    before = signal.getsignal(number)
    with pytest.raises((KeyboardInterrupt, SystemExit)) as stopped:
        train.train(replace(SMALL, checkpoint_every=50), out=tmp_path / "run")
    assert stopped.type is (KeyboardInterrupt if number == signal.SIGINT else SystemExit)
    assert number == signal.SIGINT or stopped.value.code == 128 + number
    assert signal.getsignal(number) is before
    assert read_checkpoint(tmp_path / "run")["iteration"] == 3
    told = capsys.readouterr().err
    assert f"--resume {tmp_path / 'run'}`" in told and f"report {tmp_path / 'run'}`" in told


def test_a_refused_run_leaves_no_folder(tmp_path: Path, fakes: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise ValueError("there is no room")

    monkeypatch.setattr(train, "check_room", refuse)
    (tmp_path / "mine").mkdir()
    for out in (tmp_path / "runs" / "first", tmp_path / "mine" / "runs" / "first"):
        with pytest.raises(ValueError, match="no room"):
            train.train(SMALL, out=out)
    assert [path.name for path in tmp_path.rglob("*")] == ["mine"]


def test_folders_that_cannot_be_used(tmp_path: Path, fakes: list[Any]) -> None:
    run = train.train(replace(SMALL, iterations=1), out=tmp_path / "run")
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    cases: list[tuple[Settings, dict[str, Any], str]] = [
        (SMALL, {"out": run}, "already holds a run"),
        (SMALL, {"out": tmp_path / "file" / "run"}, "cannot write"),
        (SMALL, {"out": tmp_path / "new", "resume": tmp_path / "empty"}, "not a run folder"),
        (replace(SMALL, iterations=1), {"out": tmp_path / "new", "resume": run}, "already has 1 iteration:"),
        (replace(SMALL, num_envs=8), {"out": run, "resume": run}, "num_envs 32"),
        (replace(SMALL, **OPTIONS[1]), {"out": run, "resume": run}, "normalise_values False"),
        (replace(SMALL, **OPTIONS[2]), {"out": run, "resume": run}, "constraint.cost 'none'"),
        (replace(SMALL, **OPTIONS[3]), {"out": run, "resume": run}, "network.recurrent 'none'"),
        (replace(SMALL, scene="ecm"), {"out": run, "resume": run}, "'psm'"),
    ]
    for settings, arguments, message in cases:
        with pytest.raises(ValueError, match=message):
            train.train(settings, **arguments)
    assert not (tmp_path / "new").exists()
    whole = (run / CONFIG).read_text()
    for text, message in (
        (b"", "config.yaml has no task"),
        (whole.replace("scene: psm\n", "").encode(), "config.yaml has no scene"),
        (b"\xdf\xff", "config.yaml cannot be read: it is no text in UTF-8"),
    ):
        (run / CONFIG).write_bytes(text)
        with pytest.raises(ValueError, match=message):
            read_settings(run)


def test_a_run_that_cannot_start_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown reward term 'speed'"):
        train.train(replace(SMALL, reward={"speed": 1.0}), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_writing_is_atomic(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")

    def fail(temporary: Path) -> None:
        temporary.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_atomic(path, fail)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with pytest.raises(FileNotFoundError) as error:
        write_atomic(tmp_path / "no" / "file", lambda temporary: temporary.write_text(""))
    assert error.value.filename == str(tmp_path / "no" / "file")


def test_policies_act_alike_on_numpy_and_tensors(tmp_path: Path, fakes: list[Any]) -> None:
    run = train.train(replace(SMALL, iterations=1), out=tmp_path / "run")
    env: Any = FakeEnv(COUNTS, SIZES, num_envs=4)
    observations, *_ = env.reset(0)
    arrays = {agent: value.numpy() for agent, value in observations.items()}
    policy = load_policy(run, env)
    actions = policy(observations)
    for agent, action in policy(arrays).items():
        assert action.shape == (4, env.sizes[agent]) and abs(action).max() <= 1
        torch.testing.assert_close(torch.from_numpy(action), actions[agent])
    alone = policy({agent: value[1] for agent, value in arrays.items()})
    torch.testing.assert_close(torch.from_numpy(alone["psm_1"]), actions["psm_1"][1])
    far = {agent: 1e6 * value for agent, value in observations.items()}
    assert all(action.abs().max() <= 1 for action in policy(far).values())
    assert not any(action.any() for action in zero_policy(env)(arrays).values())
    noise = random_policy(env, seed=3)(arrays)["psm_0"]
    assert noise.shape == (4, 3) and abs(noise).max() <= 1 and noise.std() > 0.3


def test_policies_that_cannot_be_loaded(tmp_path: Path, fakes: list[Any]) -> None:
    run = train.train(replace(SMALL, iterations=1), out=tmp_path / "run")
    other: Any = FakeEnv({"psm": 1}, SIZES)
    with pytest.raises(ValueError, match=r"2 psm of 8 observations.*1 psm of 6 observations"):
        load_policy(run, other)
    env: Any = FakeEnv(COUNTS, SIZES)
    for name in ("nothing", str(tmp_path)):
        with pytest.raises(ValueError, match="not a run folder"):
            load_policy(name, env)
    data = (run / "checkpoint.pt").read_bytes()
    for damaged in (b"", b"junk", data[: len(data) // 2]):
        (run / "checkpoint.pt").write_bytes(damaged)
        with pytest.raises(ValueError, match="damaged"):
            load_policy(run, env)
