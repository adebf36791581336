"""A batch that does not fit into memory is bad input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from surgical_marl.cli.main import main
from surgical_marl.learning import memory, train
from surgical_marl.learning.memory import check_room, in_memory, rollout_bytes
from surgical_marl.learning.trainer import Trainer
from surgical_marl.runs.settings import ConstraintSettings, Settings
from tests.helpers.fake_env import FakeEnv

SETTINGS = Settings(num_envs=16, steps_per_iteration=4)


@pytest.fixture(params=[("mappo", "none"), ("ippo", "none"), ("joint", "none"), ("mappo", "collision")])
def training(request: pytest.FixtureRequest) -> Trainer:
    env: Any = FakeEnv({"psm": 2, "ecm": 1}, {"psm": 3, "ecm": 2}, 16)
    algo, cost = request.param
    return Trainer(replace(SETTINGS, algo=algo, constraint=ConstraintSettings(cost=cost)), env)


def test_what_a_rollout_takes_is_what_is_stored(training: Trainer) -> None:
    training.rollout()
    storage = training.algorithm.storage
    stored = [part for part in vars(storage).values() if isinstance(part, torch.Tensor)]
    stored += [*storage.observations.values(), *storage.distribution_params]
    taken = sum(part.numel() * part.element_size() for part in stored)
    assert rollout_bytes(training.settings, training.env.env) * 16 == taken


def test_no_room_for_a_rollout(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    env: Any = FakeEnv({"psm": 1}, {"psm": 3}, 16)
    each = rollout_bytes(SETTINGS, env)
    monkeypatch.setattr(memory, "free_memory", lambda device: 10 * each)
    with pytest.raises(ValueError, match=rf"num_envs 16 .* {each} bytes.* at most 10 fit"):
        check_room(SETTINGS, env)
    monkeypatch.setattr(train, "make_env", lambda settings: env)
    with pytest.raises(ValueError, match="num_envs 16"):
        train.train(SETTINGS, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    monkeypatch.setattr(memory, "free_memory", lambda device: None)
    check_room(SETTINGS, env)


def test_memory_is_known_here() -> None:
    free = memory.free_memory("cpu")
    assert free is None or 1e6 < free < 1e15


def test_used_up_memory_is_one_sentence() -> None:
    with pytest.raises(ValueError, match="num_envs 16 does not fit into memory: try num_envs=8"), in_memory(16):
        torch.empty(2**50)
    with pytest.raises(ValueError, match="num_envs 16"), in_memory(16):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB")
    with pytest.raises(ValueError, match="steps_per_iteration"), in_memory(1):
        np.empty(2**55)
    with pytest.raises(RuntimeError, match="something else"), in_memory(16):
        raise RuntimeError("something else")


def test_the_command_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["--scene", "ecm", "--num-envs", "8192", "--device", "cpu", "steps_per_iteration=100000"]
    for command in (["bench", "train"], ["bench", "solve"]):
        assert main([*command, *argv]) == 2
        out, err = capsys.readouterr()
        assert not out and "num_envs 8192 does not fit into memory" in err.splitlines()[-1]
