"""Same seed, same numbers: what docs/reliability.md promises of environments, training and evaluation."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.evaluation.evaluate import evaluate
from surgical_marl.learning import train
from surgical_marl.policies.policy import load_policy
from surgical_marl.runs.folder import read_metrics
from surgical_marl.runs.settings import Settings, make_env
from tests.helpers.devices import needs_cuda
from tests.helpers.processes import answer
from tests.helpers.runs import SMALL, same_state
from tests.helpers.surface import first_scene

TRAINING = replace(SMALL, num_envs=16, iterations=2, max_steps=12, engine="fused")
"""On a real scene: episodes end within an iteration, and checkpoints are of the end alone."""
FIRST, LATER = 0.001, 0.1
"""By how much of itself the mean reward of an iteration may differ between two runs on a GPU: in the first one, before
networks have learned, and in any other."""
MANY = Settings(scene="psm", num_envs=4096, iterations=20, engine="fused", device="cuda")


def episodes(task: str, scene: str, engine: str, device: str, seed: int = 0, num_envs: int = 8) -> str:
    """A hash of every bit that steps of random actions return and leave behind, through an episode's end."""
    env = BatchedEnv(task, scene, num_envs=num_envs, engine=engine, device=device, max_steps=30)
    rng, digest = np.random.default_rng(seed), hashlib.sha256()
    env.reset(seed)
    for _ in range(40):
        shapes = {agent: (num_envs, *env.action_space(agent).shape) for agent in env.agents}
        step = env.step({agent: rng.uniform(-1, 1, shape).astype(np.float32) for agent, shape in shapes.items()})
        for part in (step.final_state, step.state, step.truncated, *step.rewards.values()):
            digest.update(np.ascontiguousarray(part).tobytes())
    for name, part in sorted(env.carry().items()):
        digest.update(name.encode() + np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def trained(settings: Settings, out: Path) -> str:
    """Train, evaluate, and return what the evaluation says."""
    train.train(settings, out=out)
    env = make_env(replace(settings, goals="held_out"), num_envs=4)
    return json.dumps(evaluate(env, load_policy(out, env), episodes=4, seed=0))


def test_an_environment_is_bit_equal_in_every_process() -> None:
    call = "reach", "psm", "fused", "cpu"
    assert answer(episodes, *call) == episodes(*call)
    assert episodes(*call, 1) != episodes(*call)


def test_training_and_evaluation_are_bit_equal_in_every_process(tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    first, second = (answer(trained, TRAINING, out) for out in (one, other))
    assert same_state(one, other)
    assert first == second and '"median_error_mm": ' in first


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["fused", "mjx"])
@pytest.mark.parametrize("task", sm.list_tasks())
def test_each_task_is_bit_equal_also_where_it_was_just_compiled(task: str, engine: str, tmp_path: Path) -> None:
    """Once more from the caches of this machine, and once with caches that are empty."""
    call = task, first_scene(task), engine, "cpu"
    assert answer(episodes, *call) == answer(episodes, *call, XDG_CACHE_HOME=tmp_path)
    assert list(tmp_path.glob("surgical-marl/*")), "it used other caches"


@needs_cuda
@pytest.mark.parametrize("task", sm.list_tasks())
def test_on_a_gpu_each_task_is_bit_equal_in_every_process(task: str) -> None:
    call = task, first_scene(task), "fused", "cuda", 0, 1024
    one, other = (answer(episodes, *call) for _ in range(2))
    assert one and one == other


@needs_cuda
def test_on_a_gpu_training_stays_within_bounds(tmp_path: Path) -> None:
    """Sums of gradients are added in an order that varies: two runs of a seed begin alike and end alike."""
    one, other = tmp_path / "one", tmp_path / "other"
    assert all(answer(trained, MANY, out) for out in (one, other))
    rewards = np.array([[row["reward"] for row in read_metrics(run)] for run in (one, other)])
    apart = np.abs(rewards[0] - rewards[1]) / np.abs(rewards).max(0)
    assert apart[0] <= FIRST and apart.max() <= LATER, apart
