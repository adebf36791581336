"""Settings of JAX that a user has changed alter neither what is computed nor whether it works."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax._src import config as jax_config

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.runtime import jax_scope

SETTINGS: dict[str, Callable[[], Any]] = {
    "x64": lambda: jax.enable_x64(True),
    "rbg": lambda: jax.default_prng_impl("rbg"),
    "rank promotion": lambda: jax.numpy_rank_promotion("raise"),
    "dtype promotion": lambda: jax.numpy_dtype_promotion("strict"),
    "old threefry": lambda: jax.threefry_partitionable(False),
    "low precision": lambda: jax.default_matmul_precision("bfloat16"),
    "no jit": lambda: jax.disable_jit(True),
    "debug NaN": lambda: jax.debug_nans(True),
}


def probe(key: Any, x: Any) -> Any:
    """Use what settings change: draws, types, shapes, products."""
    draw = jax.random.uniform(jax.random.fold_in(key, 3), (4,)) + jax.random.randint(key, (4,), 0, 9)
    product = jnp.ones((3, 4)) @ x + jnp.arange(3) / 2 * np.float64(0.1)
    added = jax.lax.cond(x[0] > 0, lambda v: v + 1, lambda v: v * 2, product)
    return draw + jnp.zeros((2, 1)), added, jax.lax.scan(lambda c, v: (c + v, c), 0.0, x), jnp.argsort(x)


def drawn() -> list[bytes]:
    with jax_scope():
        key, x = np.uint32([1, 2]), np.float32([1, -2, 3, 0.5])
        return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(jax.jit(lambda *given: probe(*given))(key, x))]


def traced() -> str:
    with jax_scope():
        key, x = jax.ShapeDtypeStruct((2,), np.uint32), jax.ShapeDtypeStruct((4,), np.float32)
        return str(jax.make_jaxpr(lambda *given: probe(*given))(key, x))


def switches() -> list[Any]:
    """Return every setting of JAX that is true or false and belongs to what a trace is kept by."""
    found, usual = [], jax_config.trace_context()
    for state in vars(jax_config).values():
        if isinstance(state, jax_config.State) and isinstance(state.value, bool):
            with state(not state.value):
                if jax_config.trace_context() != usual and state not in found:
                    found.append(state)
    return found


@pytest.mark.parametrize("state", switches(), ids=lambda state: state._name)
def test_no_switch_of_jax_changes_what_is_computed(state: Any) -> None:
    if state._name in ("jax_no_tracing", "jax_no_execution"):
        pytest.skip("it forbids to trace or to run")
    usual = drawn()
    with state(not state.value):
        assert drawn() == usual


@pytest.mark.parametrize("name", SETTINGS)
def test_no_setting_of_jax_changes_a_trace(name: str) -> None:
    usual = traced()
    with SETTINGS[name]():
        assert traced() == usual


@pytest.fixture(scope="module")
def course() -> np.ndarray:
    return play(contextlib.nullcontext())


def play(setting: Any) -> np.ndarray:
    with setting:
        env = BatchedEnv("reach", "ecm", num_envs=2, engine="mjx", device="cpu", start="random")
        seen = [env.reset(seed=2)[0]["ecm_0"]]
        for _ in range(2):
            seen.append(env.step({"ecm_0": np.full((2, 4), 0.3)}).observations["ecm_0"])
        env.reset(mask=np.array([True, False]))
        env.set_carry(env.carry())
    return np.stack(seen)


@pytest.mark.parametrize("name", SETTINGS)
def test_the_reference_engine_plays_the_same_whatever_a_user_sets(name: str, course: np.ndarray) -> None:
    np.testing.assert_array_equal(play(SETTINGS[name]()), course)


@pytest.mark.parametrize("name", SETTINGS)
def test_the_jax_face_plays_the_same_whatever_a_user_sets(name: str) -> None:
    env = sm.jax_env("reach", "ecm")
    seen = []
    for setting in (contextlib.nullcontext(), SETTINGS[name]()):
        key = jax.random.key(1, impl="threefry2x32")
        with setting:
            _, state = env.reset(key)
            seen.append(env.step(None, state, {"ecm_0": jnp.full(4, 0.3)})[0]["ecm_0"])
    assert seen[1].dtype == np.float32
    np.testing.assert_array_equal(*seen)


def run(program: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                          env={**os.environ, **environment}, timeout=120)  # fmt: skip


@pytest.mark.parametrize("platform", ["cuda", "nonsense"])
def test_a_platform_that_is_not_there_is_one_sentence(platform: str) -> None:
    if platform == "cuda" and jax.default_backend() == "gpu":
        pytest.skip("it is there")
    done = run("import surgical_marl as sm; sm.parallel_env('reach', 'ecm', engine='mjx')", JAX_PLATFORMS=platform)
    assert done.stderr.splitlines()[-1].startswith(f"ValueError: JAX has no device of JAX_PLATFORMS={platform}: set it")


FORK = """
import os
import jax
import surgical_marl as sm
jax.devices()
if os.fork() == 0:
    try:
        sm.parallel_env("reach", "ecm", engine="mjx")
    except ValueError as error:
        print(error, flush=True)
    os._exit(0)
os.wait()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes can't fork here")
def test_a_process_that_was_forked_beside_jax_says_so_and_does_not_hang() -> None:
    assert run(FORK).stdout.startswith("this process was forked from one in which JAX had started")
