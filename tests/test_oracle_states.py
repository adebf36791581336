"""Starts along the oracle's episodes: states that fit their observations, and environments that go on from them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from surgical_marl.learning.oracle_states import EPISODES, OracleStates
from surgical_marl.learning.trainer import Trainer
from surgical_marl.runs.environment import make_env
from surgical_marl.runs.settings import NetworkSettings, OracleStatesSettings, Settings

SETTINGS = Settings(
    task="reach", scene="psm", num_envs=64, iterations=4, steps_per_iteration=4, device="cpu",
    oracle_states=OracleStatesSettings(rate=12.5, until=0.5), network=NetworkSettings(hidden=(8,)),
)  # fmt: skip


@pytest.fixture(scope="module")
def trainer() -> Trainer:
    return Trainer(SETTINGS, make_env(SETTINGS))


def test_states_are_what_is_observed_in_them(trainer: Trainer) -> None:
    states = OracleStates(SETTINGS, trainer.env.layout, "cpu")
    carry, seen = states.draw(32)
    trainer.env.place(torch.arange(32), carry)
    steps = trainer.env.env.steps[:32]
    terms = trainer.env.env.observation_terms("psm_0")
    qpos = trainer.env.env.qpos[:32, :7]  # without the second finger
    np.testing.assert_array_equal(seen["psm"][:, 0, terms["qpos"]].numpy(), qpos)
    assert len(np.unique(steps)) > 8
    assert len(np.unique(carry[".goal.targets"].numpy().round(6), axis=0)) > 8, f"of {EPISODES} episodes"
    solved = seen["psm"][:, 0, terms["to_target"]].norm(dim=-1) < 0.002
    assert 0 < solved.float().mean() < 1


def test_a_share_of_the_environments_goes_on_and_fades(trainer: Trainer) -> None:
    def moved() -> float:
        trainer.episodes.moved.zero_()
        trainer._place()
        return float(trainer.episodes.moved.float().mean())

    keys = trainer.env.env.engine.read(".key", "numpy")
    shares = []
    for trainer.iteration in range(4):
        shares.append(moved())
    assert shares == [0.5, 0.25, 0.0, 0.0]
    np.testing.assert_array_equal(trainer.env.env.engine.read(".key", "numpy"), keys)


def test_an_episode_that_was_moved_is_not_counted(trainer: Trainer) -> None:
    trainer.iteration = 0
    trainer._place()
    moved = trainer.episodes.moved.clone()
    trainer.env.episode_length_buf = torch.full((64,), trainer.env.max_episode_length - 1)
    trainer.episodes.take()
    trainer._rollout()
    assert trainer.episodes.take()[0] == (~moved).sum()
    assert not trainer.episodes.moved.any()


def test_training_with_them_goes_on_bit_for_bit(trainer: Trainer) -> None:
    trainer.iteration = 0
    kept = trainer.state()
    ends = []
    for _ in range(2):
        again = Trainer(SETTINGS, make_env(SETTINGS))
        again.set_state(kept)
        again.iterate()
        ends.append(torch.cat([weight.detach().ravel() for weight in again.algorithm.parameters()]))
    assert torch.equal(*ends)


def test_another_control_is_refused(trainer: Trainer) -> None:
    with pytest.raises(ValueError, match=r"oracle_states.rate must be 0 with control 'torque'"):
        OracleStates(replace(SETTINGS, control="torque"), trainer.env.layout, "cpu")


def test_pictures_are_refused() -> None:
    seeing: Any = SimpleNamespace(pictures={"ecm": {"image": None}})
    with pytest.raises(ValueError, match=r"oracle_states.rate must be 0 where agents observe pictures"):
        OracleStates(SETTINGS, seeing, "cpu")
