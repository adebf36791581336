"""Skips leave out work that would change nothing: without them the same comes out."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.physics import skip
from surgical_marl.physics.skip import SKIPS, VARIABLE

ENVS, STEPS = 8, 12
STATE = ".physics.arms.qpos", ".physics.rigid_bodies.bodies.position", ".physics.rigid_bodies.bodies.quaternion"


def test_without_it_the_work_is_done_always(monkeypatch: pytest.MonkeyPatch) -> None:
    def choose() -> Any:
        return skip.cond("sleeping", jnp.bool_(False), lambda x: x + 1, lambda x: x, 1)

    assert choose() == 1
    monkeypatch.setenv(VARIABLE, "-far_pairs, -sleeping")
    assert skip.switched_off() == {"far_pairs", "sleeping"} and choose() == 2


@pytest.mark.parametrize("value", ["sleeping", "-sleep", "-sleeping,all"])
def test_a_bad_name_is_one_sentence(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    monkeypatch.setenv(VARIABLE, value)
    with pytest.raises(ValueError, match=r"unknown name in SURGICAL_MARL_SKIP .*choose from -arms_apart"):
        skip.switched_off()


def test_environments_with_other_skips_are_other_environments(monkeypatch: pytest.MonkeyPatch) -> None:
    """So what is compiled for the one is not taken for the other."""
    from surgical_marl.envs.env import Env

    usual = Env("reach", "psm").content
    monkeypatch.setenv(VARIABLE, "-sleeping")
    assert Env("reach", "psm").content != usual


def play(monkeypatch: pytest.MonkeyPatch, names: str) -> dict[str, np.ndarray]:
    """Return the state after some steps in which two arms close on a needle and move."""
    monkeypatch.setenv(VARIABLE, names)
    env = BatchedEnv("needle_handover", "bimanual_psm_needle", num_envs=ENVS, engine="fused", device="cpu")
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(STEPS):
        env.step({agent: rng.uniform(-1, 1, (ENVS, 7)).astype(np.float32) for agent in env.agents})
    found = {name: env.engine.read(name, "numpy") for name in STATE}
    env.close()
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["all", *SKIPS])
def test_without_a_skip_the_same_comes_out(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    usual = play(monkeypatch, "")
    other = play(monkeypatch, ",".join(f"-{each}" for each in SKIPS) if name == "all" else f"-{name}")
    for part, values in usual.items():
        # arms in contact take their damping in the solve, arms apart after it: see docs/physics.md
        most = 2e-3 if name in ("all", "arms_apart") and part.endswith("qpos") else 1e-4
        np.testing.assert_allclose(other[part], values, atol=most, err_msg=part)
