"""The end of an episode as faces show it, and copies of their environments."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

import surgical_marl as sm

STEPS = 6

PICTURED: dict[str, Callable[..., Any]] = {
    "pettingzoo": lambda limit: sm.parallel_env("reach", "psm", max_steps=limit, render_mode="rgb_array"),
    "gymnasium": lambda limit: gymnasium.make(
        "surgical_marl/Reach-v0", scene="psm", max_steps=limit, render_mode="rgb_array"
    ),
    **{
        mode: lambda limit, mode=mode: gymnasium.make_vec(
            "surgical_marl/Reach-v0",
            scene="psm",
            num_envs=1,
            max_steps=limit,
            render_mode="rgb_array",
            autoreset_mode=mode,
        )
        for mode in ("NextStep", "Disabled")
    },
}


@pytest.mark.parametrize("face", PICTURED)
def test_the_picture_after_the_last_step_is_of_that_step(face: str) -> None:
    seen = []
    for limit in (STEPS, 2 * STEPS):
        env = PICTURED[face](limit)
        env.reset(seed=3)
        parallel = face == "pettingzoo"
        action = np.full((env.action_space("psm_0") if parallel else env.action_space).shape, 0.7)
        for _ in range(STEPS):
            env.step({"psm_0": action} if parallel else action)
        seen.append(np.asarray(env.render()))
        env.reset()
        assert (np.asarray(env.render()) != seen[-1]).any()
        env.close()
    np.testing.assert_array_equal(*seen)


@pytest.mark.parametrize("form", [{}, {"num_envs": 2}])
def test_a_copy_draws_the_same_from_its_spaces(form: dict[str, Any]) -> None:
    env = sm.parallel_env("reach", "psm", **form)
    env.action_space("psm_0").seed(5), env.observation_space("psm_0").seed(6)
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        for space in ("action_space", "observation_space"):
            one, two = (copy.deepcopy(getattr(each, space)("psm_0")).sample() for each in (env, other))
            np.testing.assert_array_equal(one, two)
        assert other.action_spaces["psm_0"] is other.action_space("psm_0")
