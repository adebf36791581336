"""The JAX examples of docs/examples run as they are, short, and learn."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest

from tests.helpers import ROOT

FOLDER = ROOT / "docs" / "examples"


def run(name: str, pattern: str) -> list[float]:
    """Run an example as a user does, and return the numbers that it prints where the pattern has its group."""
    done = subprocess.run([sys.executable, FOLDER / name, "--quick"], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return [float(number) for number in re.findall(pattern, done.stdout)]


def test_a_trajectory_is_optimised_by_gradient() -> None:
    errors = run("jax_trajectory.py", r"ends ([\d.]+) mm")
    assert errors[0] > 20 and errors[-1] < 2


@pytest.mark.slow
def test_ppo_earns_more_than_at_first() -> None:
    rewards = run("jax_ppo.py", r"reward (-?[\d.]+)")
    assert np.mean(rewards[-3:]) > np.mean(rewards[:3]) + 0.1


@pytest.mark.parametrize("name", ["jax_ppo.py", "jax_trajectory.py"])
def test_an_example_is_short(name: str) -> None:
    assert len((FOLDER / name).read_text().splitlines()) < 150
