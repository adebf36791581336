"""Bad input through the parallel faces and `BatchedEnv`: one sentence, and the environment works on as if not asked."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv

COUNT, WIDTH = 2, 7


def one() -> Any:
    return sm.parallel_env("reach", scene="bimanual_psm", engine="fused")


def many(arrays: str = "numpy") -> Any:
    return sm.parallel_env("reach", scene="bimanual_psm", engine="fused", num_envs=COUNT, arrays=arrays)


def batch() -> Any:
    return BatchedEnv("reach", "bimanual_psm", num_envs=COUNT, engine="fused")


MAKERS: dict[str, tuple[Callable[[], Any], tuple[int, ...]]] = {
    "one": (one, (WIDTH,)),
    "many": (many, (COUNT, WIDTH)),
    "torch": (lambda: many("torch"), (COUNT, WIDTH)),
    "jax": (lambda: many("jax"), (COUNT, WIDTH)),
    "batch": (batch, (COUNT, WIDTH)),
}


@cache
def pair(face: str) -> tuple[Any, Any]:
    """Two of the same, one of which will be given bad input in between."""
    make, _ = MAKERS[face]
    return make(), make()


def poisoned(shape: tuple[int, ...], value: Any, dtype: Any = np.float32) -> np.ndarray:
    array = np.zeros(shape, dtype)
    array[..., -1] = value
    return array


def masked(shape: tuple[int, ...], value: float) -> np.ma.MaskedArray[Any, Any]:
    array = poisoned(shape, value)
    return np.ma.masked_array(array, array != 0)


BAD: dict[str, Callable[[tuple[int, ...]], Any]] = {
    "a column too few": lambda shape: np.zeros((*shape[:-1], shape[-1] - 1)),
    "an axis too many": lambda shape: np.zeros((1, *shape)),
    "no axis": lambda shape: 0.0,
    "nothing": lambda shape: None,
    "text": lambda shape: np.full(shape, "a"),
    "bytes": lambda shape: b"action",
    "objects": lambda shape: np.full(shape, None),
    "complex": lambda shape: np.zeros(shape, complex),
    "complex tensor": lambda shape: torch.zeros(shape, dtype=torch.complex64),
    "bool": lambda shape: np.zeros(shape, bool),
    "bool tensor": lambda shape: torch.zeros(shape, dtype=torch.bool),
    "bool of jax": lambda shape: jnp.zeros(shape, bool),
    "ragged list": lambda shape: [[0.0], [0.0, 1.0]],
    "dates": lambda shape: np.zeros(shape, "datetime64[s]"),
    "nan": lambda shape: poisoned(shape, np.nan),
    "infinity": lambda shape: poisoned(shape, -np.inf, np.float64),
    "nan of torch": lambda shape: torch.from_numpy(poisoned(shape, np.nan)),
    "infinity of torch": lambda shape: torch.from_numpy(poisoned(shape, np.inf)).to(torch.bfloat16),
    "nan of jax": lambda shape: jnp.asarray(poisoned(shape, np.nan)),
    "infinity of jax": lambda shape: jnp.asarray(poisoned(shape, np.inf), jnp.bfloat16),
    "nan under a mask": lambda shape: masked(shape, np.nan),
    "a number under a mask": lambda shape: masked(shape, 0.5),
    "masks in a list": lambda shape: list(masked(shape, 0.5)),
    "a sparse tensor": lambda shape: torch.zeros(shape).to_sparse(),
    "nan in a list": lambda shape: poisoned(shape, np.nan).tolist(),
    "a function": lambda shape: np.zeros,
}
WHOLE: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no actions": lambda good: None,
    "a list of actions": lambda good: list(good.values()),
    "one array for all": lambda good: np.stack(list(good.values())),
    "no agent": lambda good: {},
    "a missing agent": lambda good: {"psm_1": good["psm_1"]},
    "an agent too many": lambda good: {**good, "ecm_0": np.zeros(4)},
    "another agent": lambda good: {"psm_0": good["psm_0"], "psm_2": good["psm_1"]},
    "numbers for names": lambda good: dict(enumerate(good.values())),
}


def leaves(found: Any) -> list[np.ndarray]:
    if isinstance(found, dict):
        return [leaf for value in found.values() for leaf in leaves(value)]
    if isinstance(found, tuple):
        return [leaf for value in found for leaf in leaves(value)]
    return [np.asarray(found)]


def assert_refused(env: Any, actions: Any) -> None:
    with pytest.raises(ValueError) as caught:
        env.step(actions)
    assert "\n" not in str(caught.value) and len(str(caught.value)) > 20


@pytest.mark.parametrize("face", MAKERS)
@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    kinds=st.lists(st.sampled_from([*BAD, *WHOLE]), min_size=1, max_size=3),
    agent=st.sampled_from(["psm_0", "psm_1"]),
    seed=st.integers(0, 2**31),
)
def test_after_bad_input_an_environment_goes_on_as_if_it_had_not_been(
    face: str, kinds: list[str], agent: str, seed: int
) -> None:
    (asked, spared), (_, shape) = pair(face), MAKERS[face]
    rng = np.random.default_rng(seed)
    for env in (asked, spared):
        env.reset(seed=seed)
    for kind in kinds:
        good = {name: rng.uniform(-1, 1, shape).astype(np.float32) for name in ("psm_0", "psm_1")}
        assert_refused(asked, WHOLE[kind](good) if kind in WHOLE else {**good, agent: BAD[kind](shape)})
        for one, other in zip(leaves(asked.step(good)), leaves(spared.step(good)), strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("face", MAKERS)
@pytest.mark.parametrize("kind", [*BAD, *WHOLE])
def test_every_kind_of_bad_input_is_one_sentence(face: str, kind: str) -> None:
    (env, _), (_, shape) = pair(face), MAKERS[face]
    env.reset(seed=0)
    good = {name: np.zeros(shape) for name in ("psm_0", "psm_1")}
    assert_refused(env, WHOLE[kind](good) if kind in WHOLE else {**good, "psm_1": BAD[kind](shape)})
    env.step(good)


@pytest.mark.parametrize("face", MAKERS)
@pytest.mark.parametrize(
    "kind",
    [
        np.ndarray.tolist,
        lambda values: [tuple(row) for row in values] if values.ndim > 1 else tuple(values),
        lambda values: values.astype(np.float64),
        lambda values: values.astype(">f4"),
        lambda values: torch.from_numpy(values).requires_grad_(),
        lambda values: torch.nn.Parameter(torch.from_numpy(values).double()),
        jnp.asarray,
        np.ma.masked_array,
    ],
)
def test_numbers_of_any_kind_do_the_same(face: str, kind: Callable[[np.ndarray], Any]) -> None:
    (env, other), (_, shape) = pair(face), MAKERS[face]
    values = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    for each in (env, other):
        each.reset(seed=1)
    found = env.step(dict.fromkeys(("psm_0", "psm_1"), kind(values)))
    expected = other.step(dict.fromkeys(("psm_0", "psm_1"), values))
    for one, two in zip(leaves(found), leaves(expected), strict=True):
        np.testing.assert_array_equal(one, two)


def test_whole_numbers_and_values_beyond_single_precision_are_clipped() -> None:
    env, other = pair("one")
    for given_, same in ((np.full(7, 3), np.ones(7)), (np.full(7, -1e300), -np.ones(7))):
        env.reset(seed=0), other.reset(seed=0)
        found, expected = (e.step(dict.fromkeys(e.agents, a)) for e, a in ((env, given_), (other, same)))
        for one, two in zip(leaves(found), leaves(expected), strict=True):
            np.testing.assert_array_equal(one, two)


@pytest.mark.slow
def test_nan_is_refused_by_the_reference_engine_too() -> None:
    """Its JAX arrays would be NaN for ever."""
    env = BatchedEnv("reach", "psm", num_envs=1, engine="mjx", arrays="jax")
    env.reset(0)
    for library in (torch.from_numpy, jnp.asarray):
        with pytest.raises(ValueError, match="action of 'psm_0' holds a value that is not finite"):
            env.step({"psm_0": library(np.full((1, 7), np.nan, np.float32))})
    assert np.isfinite(np.asarray(env.step({"psm_0": np.zeros((1, 7))}).state)).all()


@pytest.mark.parametrize("face", MAKERS)
def test_a_step_before_a_reset_and_after_a_close_is_one_sentence(face: str) -> None:
    make, shape = MAKERS[face]
    env, still = make(), dict.fromkeys(("psm_0", "psm_1"), np.zeros(shape))
    with pytest.raises(ValueError, match=r"call reset\(\)"):
        env.step(still)
    env.reset(seed=0)
    env.step(still)
    env.close()
    env.close()
    calls = [lambda: env.step(still), lambda: env.reset(seed=1), lambda: env.reset()]
    calls += [env.carry, lambda: env.qpos, lambda: env.goal] if face == "batch" else [env.state, env.render]
    for call in calls:
        with pytest.raises(ValueError, match="the environment is closed: make a new one"):
            call()


def test_whole_numbers_of_numpy_are_whole_numbers() -> None:
    env = sm.parallel_env("reach", scene="psm", max_cycles=np.int64(30), decimation=np.uint8(10))
    assert env.max_cycles == 30 and type(env.batch.env.options.decimation) is int
    many = sm.parallel_env("reach", scene="psm", num_envs=np.int32(2), reward={"collision": np.float32(-5)})
    assert many.num_envs == 2 and type(many.num_envs) is int
    for bad in (np.float64(30), True, np.bool_(True), "30", np.nan):
        with pytest.raises(ValueError, match="max_steps must be a whole number from 1 to 1,000,000, not"):
            sm.parallel_env("reach", scene="psm", max_cycles=bad)
        with pytest.raises(ValueError, match="num_envs must be a whole number of at least 1, not"):
            sm.parallel_env("reach", scene="psm", num_envs=bad)


@pytest.mark.parametrize("face", MAKERS)
def test_an_unknown_agents_space_is_one_sentence(face: str) -> None:
    env, _ = pair(face)
    for space in (env.observation_space, env.action_space):
        with pytest.raises(ValueError, match="unknown agent 'psm_7', did you mean 'psm_"):
            space("psm_7")
