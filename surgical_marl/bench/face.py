"""Measure the time that the PettingZoo interface adds to a step of the engine below it.

measure_face("reach", "psm", num_envs=1024).share
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from surgical_marl.interfaces.pettingzoo import parallel_env

PAIRS = 100
"""Pairs of measurements, of the engine and of the face."""
SECONDS = 0.02
"""Least duration of a measurement, s: so short that other work on the machine meets both of a pair alike."""


@dataclass(frozen=True)
class Face:
    """Seconds of a step on a CPU."""

    engine_s: float
    """Time of the engine alone, which reads no results, s; median of all pairs, as the other times."""
    added_s: float
    """Time that the interface adds, s."""
    share: float
    """Time that the interface adds, as a share of the engine's."""
    num_envs: int | None
    """None for the environment that is not batched."""


def measure_face(
    task: str, scene: str, num_envs: int | None = None, pairs: int = PAIRS, seconds: float = SECONDS
) -> Face:
    """Time both in turn, with the same actions.

    Raises:
        ValueError: as `parallel_env`.
    """
    env = parallel_env(task, scene, num_envs=num_envs, device="cpu", max_cycles=1_000_000)
    env.reset(seed=0)
    rng, engine = np.random.default_rng(0), env.batch.engine
    batched = {
        agent: rng.uniform(-1, 1, (num_envs or 1, *env.action_space(agent).shape)).astype(np.float32)
        for agent in env.agents
    }
    given = batched if num_envs else {agent: action[0] for agent, action in batched.items()}
    count = 1
    while (took := _seconds(lambda: env.step(given), count)) < seconds:
        count = max(count + 1, round(count * min(8.0, 1.2 * seconds / took)))
    timed = [
        (_seconds(lambda: engine.step(batched), count) / count, _seconds(lambda: env.step(given), count) / count)
        for _ in range(pairs)
    ]
    env.close()
    alone, faced = np.array(timed).T
    engine_s, added_s, share = (float(np.median(found)) for found in (alone, faced - alone, faced / alone - 1))
    return Face(engine_s, added_s, share, num_envs)


def run(task: str, scene: str, num_envs: int | None, as_json: bool) -> str:
    """Run `surgical-marl bench face`; return its sentence, or JSON."""
    found = measure_face(task, scene, num_envs)
    if as_json:
        return json.dumps(asdict(found))
    times = f"the face adds {found.added_s * 1e6:,.0f} us to the engine's {found.engine_s * 1e6:,.0f} us a step"
    return f"{task} on {scene}: {times}, {found.share:.1%}, {num_envs or 1} envs, cpu"


def _seconds(step: Callable[[], object], count: int) -> float:
    start, held = time.perf_counter(), None
    for _ in range(count):
        held = step()  # as a caller holds the last results while the next step is made
    del held
    return time.perf_counter() - start
