"""What the MJX engine compiles, and when."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import jax
import numpy as np
import pytest

from surgical_marl.engines.compilation import DONE, told
from surgical_marl.engines.mjx import MjxEngine
from surgical_marl.envs.env import Env


@contextmanager
def watch() -> Iterator[list[str]]:
    """What JAX traces and compiles meanwhile."""
    found: list[str] = []
    watching = True

    def note(event: str, seconds: float, **_: object) -> None:
        if watching and event.startswith("/jax/core/compile/"):
            found.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    yield found
    watching = False


def play(engine: MjxEngine) -> np.ndarray:
    engine.reset(3)
    engine.step({"ecm_0": np.full((engine.num_envs, 4), 0.5, np.float32)})
    engine.begin(engine.read(".key", "numpy"), np.ones(engine.num_envs, np.int32))
    return engine.outcome("numpy")["observations"]["ecm_0"]


def test_a_second_engine_for_such_environments_compiles_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    said: list[tuple[str, str]] = []
    listener = lambda title, stage: said.append((title, stage))  # noqa: E731
    with watch() as first, told(listener):
        one = play(MjxEngine(Env("reach", "ecm"), 64, "cpu"))
    title = "reach on ecm (mjx, cpu)"
    assert first and said == [(title, what) for name in ("reset", "step") for what in
                              (f"tracing and compiling the {name}", DONE)]  # fmt: skip
    assert not capfd.readouterr().err  # nobody asked
    with watch() as second, told(listener):
        other = play(MjxEngine(Env("reach", "ecm", max_steps=50, reward={"distance": -3.0}), 64, "cpu"))
    assert not second and len(said) == 4 and not capfd.readouterr().err
    np.testing.assert_array_equal(one, other)


def test_weights_and_time_limits_stay_those_of_each_engine() -> None:
    still = {"ecm_0": np.zeros((1, 4), np.float32)}
    engines = [MjxEngine(Env("reach", "ecm", max_steps=n, reward={"distance": -n}), 1, "cpu") for n in (1, 2)]
    for engine in engines:
        engine.reset(0)
        engine.step(still)
    short, long = (engine.outcome("numpy") for engine in engines)
    assert short["truncated"] and not long["truncated"]
    one, two = (outcome["infos"]["ecm_0"]["reward_distance"] for outcome in (short, long))
    np.testing.assert_allclose(2 * one, two, rtol=1e-6)
