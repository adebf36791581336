"""Environments in worker processes: spawned and forked, also where the parent has stepped and drawn before."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import subprocess
import sys
from typing import Any

import cloudpickle
import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv

STEPS = 3


def rollout(env: Any, seed: int | None = 0) -> list[np.ndarray]:
    """States over a few steps of actions drawn from a seed; from where the environment stands without one."""
    rng = np.random.default_rng(3)
    if seed is not None:
        env.reset(seed=seed)
    seen = [env.state()]
    for _ in range(STEPS):
        env.step({agent: rng.uniform(-1, 1, env.action_space(agent).shape) for agent in env.agents})
        seen.append(env.state())
    return seen


def fork_after_step(task: str, scene: str) -> list[Any]:
    """Step, fork, and let children do what the parent did: with a new environment, and with the parent's."""
    env = sm.parallel_env(task, scene=scene, engine="fused")
    expected = rollout(env)
    return [expected, in_worker("fork", fresh, task, scene), in_worker("fork", rollout, env)]


def fresh(task: str, scene: str) -> list[np.ndarray]:
    return rollout(sm.parallel_env(task, scene=scene, engine="fused"))


def call(pipe: Any, function: Any, *arguments: Any) -> None:
    pipe.send(function(*arguments))


def in_worker(method: str, function: Any, *arguments: Any) -> Any:
    """What a function returns in a new process; None if a forked one takes more than half a minute."""
    context = multiprocessing.get_context(method)
    ours, theirs = context.Pipe()
    worker = context.Process(target=call, args=(theirs, function, *arguments))
    worker.start()
    theirs.close()  # so that a worker that ends without an answer is noticed
    found = ours.recv() if ours.poll(30 if method == "fork" else 120) else None
    worker.kill()
    worker.join()
    return found


@pytest.mark.parametrize(("task", "scene"), [("reach", "psm"), ("match_image", "ecm")])
def test_a_process_that_has_stepped_can_fork_workers(task: str, scene: str) -> None:
    fresh(task, scene)  # compiled here, not while the worker's time runs
    expected, anew, inherited = in_worker("spawn", fork_after_step, task, scene)
    np.testing.assert_array_equal(anew, expected)
    np.testing.assert_array_equal(inherited, expected)


def step_many(env: BatchedEnv) -> np.ndarray:
    return np.asarray(env.step({"psm_0": np.full((env.num_envs, 7), 0.5)}).state)


def fork_many() -> list[Any]:
    env = BatchedEnv("reach", "psm", num_envs=128, engine="fused")  # a share for each of several threads
    env.reset(0)
    step_many(env)
    inherited = in_worker("fork", step_many, env)
    return [inherited, step_many(env)]


def test_a_fork_does_not_wait_for_threads_of_its_parent() -> None:
    BatchedEnv("reach", "psm", num_envs=128, engine="fused").reset(0)
    inherited, expected = in_worker("spawn", fork_many)
    np.testing.assert_array_equal(inherited, expected)


@pytest.mark.parametrize("form", [{}, {"num_envs": 2}, {"num_envs": 2, "arrays": "torch"}])
def test_spawned_workers_go_on_where_an_environment_stands(form: dict[str, Any]) -> None:
    if form:
        env = BatchedEnv("reach", "bimanual_psm", engine="fused", **form)
        env.reset(5)
        found = pickle.loads(in_worker("spawn", pickle.dumps, env))
        np.testing.assert_array_equal(found.qpos, env.qpos)
        return
    env = sm.parallel_env("reach", scene="bimanual_psm", engine="fused")
    rollout(env, 5)
    copies = [pickle.loads(pickle.dumps(env)), cloudpickle.loads(cloudpickle.dumps(env)), copy.deepcopy(env)]
    found = in_worker("spawn", rollout, env, None)
    for each in (found, *(rollout(other, None) for other in copies)):
        np.testing.assert_array_equal(each, rollout(env, None) if each is found else found)


def test_a_copy_of_a_closed_environment_is_closed() -> None:
    env = sm.parallel_env("reach", scene="psm", engine="fused")
    env.reset(seed=0)
    env.close()
    with pytest.raises(ValueError, match="the environment is closed"):
        copy.deepcopy(env).reset()


@pytest.mark.parametrize(
    ("task", "scene"),
    [
        ("reach", "psm"),
        ("match_image", "ecm"),
        pytest.param("needle_handover", "bimanual_psm_needle", marks=pytest.mark.slow),
    ],
)
def test_a_worker_with_warm_caches_imports_nothing_that_takes_long(task: str, scene: str) -> None:
    """Also where an episode ends and the next one begins."""
    code = f"""
import sys
import numpy as np
import surgical_marl as sm
env = sm.parallel_env({task!r}, scene={scene!r}, engine="fused", device="cpu", num_envs=2, max_cycles=2)
env.reset(seed=0)
for _ in range(3):
    env.step({{agent: np.zeros((2, *env.action_space(agent).shape)) for agent in env.agents}})
print([name for name in ("torch", "jax", "mujoco.mjx", "scipy") if name in sys.modules])
"""
    for _ in range(2):  # the first one may have to fill the caches
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "[]\n", done.stderr
