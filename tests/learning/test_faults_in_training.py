"""A training goes on beside an environment that becomes NaN, keeps what reproduces it, and stops if many do."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from docs.studies.numbers import fuzz
from surgical_marl.cli.main import main
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.learning import train, trainer
from surgical_marl.learning.algorithm import Algorithm
from surgical_marl.learning.faults import MOST, SHARE, too_many
from surgical_marl.learning.reporter import Report
from surgical_marl.runs.checkpoint import read_checkpoint, write_checkpoint
from surgical_marl.runs.fault import read_fault
from surgical_marl.runs.folder import read_metrics
from surgical_marl.runs.settings import NetworkSettings, PPOSettings, Settings

SMALL = Settings(
    "reach", "psm", engine="fused", device="cpu", num_envs=16, steps_per_iteration=4, iterations=3, checkpoint_every=1,
    network=NetworkSettings(hidden=(8,)), ppo=PPOSettings(epochs=1, mini_batches=2),
)  # fmt: skip
FAST = np.float32(3e38)
"""A finite speed, that one step makes infinite, rad/s."""


def hurt(monkeypatch: pytest.MonkeyPatch, chosen: slice, iteration: int) -> None:
    """Let joints of some environments be that fast before an iteration."""
    original = trainer.Trainer.iterate

    def iterate(self: trainer.Trainer) -> Report:
        if self.iteration == iteration - 1:
            carry = self.env.env.carry()
            carry[".physics.arms.qvel"][chosen] = FAST
            self.env.env.set_carry(carry)
        return original(self)

    monkeypatch.setattr(trainer.Trainer, "iterate", iterate)


def test_training_goes_on_and_the_fault_can_be_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hurt(monkeypatch, slice(5, 6), 2)
    run = train.train(SMALL, out=tmp_path / "run")
    assert [row["faults"] for row in read_metrics(run)] == [0, 1, 0]
    assert all(math.isfinite(row["reward"]) and row["episodes"] >= 0 for row in read_metrics(run))
    said = capsys.readouterr().err
    assert "became NaN or infinite in iteration 2, environment 5, seed 0" in said and "fault-2.npz" in said
    found = read_fault(run / "fault-2.npz")
    assert found is not None and found[0]["place"].startswith("state physics.arms.qpos[")
    assert (found[1]["start.physics.arms.qvel"] == FAST).all(), "it begins where all was finite"
    assert main(["replay", str(run / "fault-2.npz")]) == 0
    told = capsys.readouterr().out
    assert "seed 0, environment 5" in told and "not finite after step 1 of 1, on cpu" in told
    assert "observation qpos[0] of psm_0" in told and "reward distance of psm_0" in told
    assert [path.name for path in run.glob("fault-*")] == ["fault-2.npz"]


def test_training_stops_if_many_are_at_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not too_many(MOST, 1) and too_many(MOST + 1, 1)
    assert not too_many(SHARE * 1e9, 10**9) and too_many(SHARE * 1e9 + 1, 10**9)
    hurt(monkeypatch, slice(0, MOST + 1), 2)
    with pytest.raises(FloatingPointError, match=rf"environments became NaN .* iteration 2 \({MOST + 1} of 64 steps"):
        train.train(SMALL, out=tmp_path / "run")
    assert read_checkpoint(tmp_path / "run")["iteration"] == 1
    assert (tmp_path / "run" / "fault-2.npz").is_file()


def test_a_gradient_at_fault_stops_in_its_mini_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original, calls = Algorithm.loss, list[int]()

    def loss(self: Algorithm, batch: Any) -> Any:
        calls.append(1)
        found, measured = original(self, batch)
        return found * (math.inf if len(calls) == 4 else 1.0), measured

    monkeypatch.setattr(Algorithm, "loss", loss)
    with pytest.raises(FloatingPointError, match=r"gradients .* iteration 2 \(actor in mini-batch 2, critic in mini-"):
        train.train(SMALL, out=tmp_path / "run")
    assert read_checkpoint(tmp_path / "run")["iteration"] == 1


def test_a_checkpoint_at_fault_is_neither_written_nor_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = train.train(SMALL, out=tmp_path / "run")
    state = read_checkpoint(run)
    state["algorithm"]["optimizer_state_dict"]["state"][0]["exp_avg"].reshape(-1)[0] = math.nan
    write_checkpoint(run, state)
    with pytest.raises(ValueError, match=r"holds numbers that are not finite \(optimizer_state_dict.state.0.exp_avg\)"):
        read_checkpoint(run)
    save = Algorithm.save
    monkeypatch.setattr(Algorithm, "save", lambda self: {**save(self), "extra": torch.tensor([1.0, math.inf])})
    with pytest.raises(FloatingPointError, match=r"checkpoint became NaN or infinite in iteration 0 \(extra\)"):
        train.train(SMALL, out=tmp_path / "other")


def test_a_fault_that_is_not_whole_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    about = {"layout": 1, "kind": "fault", "environment": {"task": "reach", "scene": "psm"}, "engine": "fused",
             "device": "cpu", "seed": 0, "index": 0, "place": "here", "versions": {}}  # fmt: skip
    for change, arrays in (
        ({"layout": 9}, {}),
        ({"environment": {"task": "reach", "scene": "none"}}, {}),
        ({"environment": {"speed": 3}}, {}),
        ({"place": 3}, {}),
        ({}, {}),
        ({}, {"actions/psm_0": np.zeros((2, 1, 7))}),
        ({}, {"actions/psm_0": np.array(["a"])}),
    ):
        np.savez(tmp_path / "fault.npz", about=np.array(json.dumps(about | change)), **arrays)
        assert main(["replay", str(tmp_path / "fault.npz")]) == 2
        told, err = capsys.readouterr()
        assert not told and err.startswith("surgical-marl: ") and err.count("\n") == 1 and len(err) < 500


def test_extreme_actions_lead_to_no_fault(tmp_path: Path) -> None:
    """The study's loop with few steps; docs/reliability.md has its figures of many."""
    found = fuzz(Settings("reach", "psm", engine="fused"), 3000, seed=1, out=tmp_path, count=64)
    assert found.steps >= 3000 and (found.faults, found.tunnels, found.overflows, found.unfelt) == (0, 0, 0, 0)


def test_the_study_finds_a_fault_and_keeps_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = BatchedEnv.reset

    def reset(self: BatchedEnv, *given: Any, **named: Any) -> Any:
        found = original(self, *given, **named)
        carry = self.carry()
        carry[".physics.arms.qvel"][3] = FAST
        self.set_carry(carry)
        return found

    monkeypatch.setattr(BatchedEnv, "reset", reset)
    found = fuzz(Settings("reach", "psm", engine="fused"), 64, seed=1, out=tmp_path, count=64)
    assert found.faults == 1 and main(["replay", str(tmp_path / "fault-psm-1-3.npz")]) == 0
