"""An environment that is NaN or infinite is caught in that step, and begins anew; the others go on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from surgical_marl.engines.fused.finite_check import FiniteCheck
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.state import BatchStep

N = 70  # more than one sum takes together
BAD = {3: np.nan, 41: np.inf, 69: -np.inf}


def still(env: BatchedEnv) -> dict[str, np.ndarray]:
    return {agent: np.zeros((env.num_envs, *space.shape), np.float32) for agent, space in env.action_spaces.items()}


def poisoned(env: BatchedEnv, part: str, bad: dict[int, float]) -> None:
    """Set the first number of a part of the state in some environments."""
    carry = env.carry()
    for index, value in bad.items():
        carry[part][index].reshape(-1)[0] = value
    env.set_carry(carry)


def clean(step: BatchStep) -> bool:
    """Whether all that is learned from is finite."""
    parts = (step.observations, step.final_observations, step.rewards)
    return all(np.isfinite(own).all() for part in parts for own in part.values()) and bool(
        np.isfinite(step.state).all() and np.isfinite(step.final_state).all()
    )


@pytest.mark.parametrize(("engine", "count"), [("fused", N), ("fused", 4), ("mjx", 4)])
def test_a_state_at_fault_ends_its_episode_and_the_next_step_begins_another(engine: str, count: int) -> None:
    env = BatchedEnv("reach", "psm", num_envs=count, engine=engine, device="cpu")
    bad = {index: value for index, value in BAD.items() if index < count} or {0: np.nan}
    env.reset(seed=0)
    assert (env.step(still(env)).faults == -1).all()
    poisoned(env, ".physics.arms.qvel", bad)
    first = env.step(still(env))
    assert sorted(np.flatnonzero(first.faults >= 0)) == sorted(bad)
    for index in bad:
        place = env.fault_place(first.faults[index])
        assert place == ("psm_0", "state physics.arms.qpos[0] (joint psm_0/yaw)")
        assert first.terminated[index] and not first.truncated[index] and first.rewards["psm_0"][index] == 0
    second, third = env.step(still(env)), env.step(still(env))
    assert clean(first) and clean(second) and clean(third)
    assert (second.faults == -1).all() and second.terminated[list(bad)].all(), "its end is no fault of its own"
    assert not third.terminated.any() and env.steps.tolist() == [1 if k in bad else 4 for k in range(count)]
    env.close()


def test_other_environments_go_on_bit_for_bit() -> None:
    env, whole = (BatchedEnv("reach", "psm", num_envs=N, engine="fused", device="cpu") for _ in range(2))
    env.reset(seed=0), whole.reset(seed=0)
    poisoned(env, ".physics.arms.qpos", BAD)
    others = np.delete(np.arange(N), list(BAD))
    for _ in range(4):
        found, wanted = env.step(still(env)), whole.step(still(env))
        assert np.array_equal(found.observations["psm_0"][others], wanted.observations["psm_0"][others])
        assert np.array_equal(found.rewards["psm_0"][others], wanted.rewards["psm_0"][others])


def test_a_reward_at_fault_names_its_term_and_the_state_goes_on() -> None:
    env = BatchedEnv("reach", "psm", num_envs=2, engine="fused", device="cpu")
    env.reset(seed=0)
    poisoned(env, ".actions", {1: np.nan})  # the last actions: the change of actions costs reward
    step = env.step(still(env))
    assert env.fault_place(step.faults[1]) == ("psm_0", "reward action_change") and step.faults[0] == -1
    assert step.rewards["psm_0"][1] == 0 and step.terminated[1]
    assert (env.step(still(env)).faults == -1).all() and (env.steps == 2).all()


def test_an_end_that_was_ordered_before_a_checkpoint_is_no_new_fault_after_it() -> None:
    env = BatchedEnv("reach", "psm", num_envs=4, engine="fused", device="cpu")
    env.reset(seed=0)
    poisoned(env, ".physics.arms.qpos", {2: np.nan})
    env.step(still(env))
    carry = env.carry()
    env.reset(seed=1)
    env.set_carry(carry)
    assert (env.step(still(env)).faults == -1).all() and np.isfinite(env.qpos).all()


@pytest.mark.parametrize("part", [".physics.arms.qpos", ".actions"])
def test_the_kernel_of_a_gpu_does_what_numpy_does(part: str) -> None:
    """Here it runs on the CPU, on the same arrays."""
    found: list[Any] = []
    for kernel in (True, False):
        env = BatchedEnv("reach", "psm", num_envs=N, engine="fused", device="cpu")
        env.reset(seed=0)
        poisoned(env, part, BAD)
        check: FiniteCheck = env.engine.finite_check  # type: ignore[attr-defined]
        own, steps = check.on_device(), []
        for _ in range(3):
            env.engine.step(still(env))
            if kernel:
                check.launch(env.max_steps, own)
            codes = own[-1].copy() if kernel else check.check(env.max_steps).copy()
            arrays = {name: check._arrays.fields(name).copy() for name in ("state", "outs", "counts", "flags")}
            steps.append({"codes": codes, **arrays})
        found.append(steps)
    for one, other in zip(*found, strict=True):
        assert all(np.array_equal(one[name], other[name], equal_nan=True) for name in one)
    assert (found[0][0]["codes"] >= 0).sum() == len(BAD) and (found[0][1]["codes"] == -1).all()
