"""Where arms fail: what is judged, and what the table says of it."""

from __future__ import annotations

import numpy as np
import pytest

import surgical_marl as sm
from docs.studies.command import run
from docs.studies.failures import Found, _places, look, main, table
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.policies.policy import load_policy


def test_a_policy_that_never_moves_fails_and_the_oracle_does_not() -> None:
    env = BatchedEnv("track", "ecm", num_envs=16, start="random", goals="held_out")
    still, followed = (look(env, load_policy(name, env), 32) for name in ("zero", "oracle"))
    assert still.off.shape == followed.off.shape and 17 <= len(still.off) <= 32  # drawn from 1,024 rows
    assert (still.off > 0.005).all() and (followed.off < 0.002).all()


def test_postures_are_told_apart() -> None:
    env, arm = BatchedEnv("track", "star", num_envs=1, engine="mjx", device="cpu"), sm.load_arm("star")
    at_limit, straight = arm.home.copy(), arm.home.copy()
    at_limit[5] = arm.lower[5]
    straight[3] = 0.02  # an elbow nearly straight, with the wrist bent back onto the axis of the shoulder
    straight[5] = 0.02
    q = np.stack([arm.home, at_limit, straight])[None]
    every = np.ones((1, 3, 1), bool)
    assert _places(env, q, every)[:, 0].tolist() == [2, 0, 1]
    assert _places(env, q, ~every)[:, 0].tolist() == [2, 2, 2]  # after the first miss nothing counts


def test_the_table_counts_arms() -> None:
    found = Found(np.array([[0, 2], [2, 1]]), np.array([[0.004, 0.001], [0.05, 0.0]]))
    lines = table(found).splitlines()
    assert lines[2:] == [
        "| at a joint's limit | 25.0% of 4 | 100.0% | 0 |",
        "| near a singularity | 25.0% of 4 | 0.0% | 0 |",
        "| elsewhere | 50.0% of 4 | 50.0% | 1 |",
        "| all | 100.0% of 4 | 50.0% | 1 |",
    ]


def test_goals_without_rows_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("failures", lambda: main(["reach-psm", "--start", "home"])) == 2
    assert "goals of reach from home are no rows: try --start random" in capsys.readouterr().err
