"""Code that is not of this package can depend on anything: what is kept of it on disk must be what it computes now."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl import cache
from surgical_marl.bench.physics import bare_state
from surgical_marl.engines.compilation import unsaid
from surgical_marl.engines.fused import source_cache
from surgical_marl.engines.fused.compiler import trace
from surgical_marl.engines.fused.jaxpr_digest import jaxpr_digest
from surgical_marl.engines.fused.source_cache import load_source
from surgical_marl.engines.stepper import representative
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.envs.state import Carry
from surgical_marl.interfaces.registration import register_task
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.tasks.reach import Task as Reach


class Stepper:
    """The smallest environment: a number that each step adds something to."""

    agents, decimation, title, content, parameters = (), 1, "tiny", b"tiny", {}
    pauses = False

    def __init__(self, add: Callable[[Any], Any]) -> None:
        self.add = add

    @property
    def classes(self) -> tuple[type, ...]:
        return (type(self),)

    def num_actions(self, agent: str) -> int:
        raise AssertionError(agent)

    def reset(self, key: Any, episode: Any, parameters: Any) -> Any:
        return bare_state(Carry(jnp.float32(0), (), key, episode, jnp.int32(0)), jnp.zeros(1))

    def step(self, carry: Any, actions: Any, parameters: Any) -> Any:
        return bare_state(carry._replace(physics=self.add(carry.physics)), jnp.zeros(1))


CHANGED = 1.0


def by_global(value: float) -> Callable[[Any], Any]:
    global CHANGED
    CHANGED = value
    return lambda x: x + CHANGED


def by_closure(value: float) -> Callable[[Any], Any]:
    return lambda x: x + value


def by_argument(value: float) -> Callable[[Any], Any]:
    sys.argv[1:] = [str(value)]
    return lambda x: x + float(sys.argv[1])


def by_default(value: float) -> Callable[[Any], Any]:
    return lambda x, more=value: x + more


def by_table(value: float) -> Callable[[Any], Any]:
    table = np.full(300, value, np.float32)  # so large that it stays a table
    return lambda x: x + jnp.asarray(table)[jnp.int32(x) % 300]


def by_attribute(value: float) -> Callable[[Any], Any]:
    config = SimpleNamespace(deep=[{"value": value}])
    return lambda x: x + config.deep[0]["value"]


def by_branch(value: float) -> Callable[[Any], Any]:
    return lambda x: jax.lax.cond(x > 0, lambda y: y * 1.5, lambda y: y + value, x)


def by_loop(value: float) -> Callable[[Any], Any]:
    return lambda x: jax.lax.scan(lambda y, _: (y + value, None), x, None, length=40)[0]


def by_operation(value: float) -> Callable[[Any], Any]:
    return (lambda x: jnp.sin(x)) if value == 1.0 else (lambda x: jnp.cos(x))


WAYS = [by_global, by_closure, by_argument, by_default, by_table, by_attribute, by_branch, by_loop, by_operation]


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
def test_a_kernel_computes_what_code_computes_now(
    way: Callable[[float], Callable[[Any], Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "cache_dir", lambda: tmp_path)
    monkeypatch.setattr(sys, "argv", ["program"])
    made: list[None] = []
    make = source_cache._make
    monkeypatch.setattr(source_cache, "_make", lambda *arguments: (made.append(None), make(*arguments))[1])
    source_cache._make.__module__ = source_cache.__name__

    def source(value: float) -> str:
        found = load_source(Stepper(way(value)), vector=False)  # type: ignore[arg-type]
        return found.bodies["step"] + str(found.tables)

    one, two = source(1.0), source(2.0)
    assert one != two and len(made) == 2
    assert source(1.0) == one and source(2.0) == two
    assert len(made) == 2  # found again


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=1, max_size=4), st.integers(0, 3), st.booleans())
@settings(max_examples=40, deadline=None)
def test_equal_functions_have_equal_digests_and_others_do_not(numbers: list[float], at: int, nested: bool) -> None:
    def digest(values: list[float], names: str) -> str:
        def function(x: Any) -> Any:
            for value in values:
                x = (jax.jit(lambda y: y * value) if nested else lambda y: y * value)(x)  # noqa: B023
            return {names[0]: x}

        return jaxpr_digest({"step": trace(function, jax.ShapeDtypeStruct((2,), np.float32))})

    other = list(numbers)
    other[at % len(numbers)] = np.float32(other[at % len(numbers)] + 1).item()
    assert digest(numbers, "a") == digest(numbers, "a") != digest(numbers, "b")
    assert (digest(other, "a") == digest(numbers, "a")) == (
        np.float32(other).tobytes() == np.float32(numbers).tobytes()
    )


DIGEST = """
import jax, jax.numpy as jnp, numpy as np
from surgical_marl.engines.fused.jaxpr_digest import jaxpr_digest
from surgical_marl.engines.fused.compiler import trace
step = lambda x: jax.nn.relu(x @ np.eye(3, dtype=np.float32)).sum() + jax.random.uniform(jax.random.PRNGKey(3))
print(jaxpr_digest({"step": trace(step, jax.ShapeDtypeStruct((3,), np.float32))}))
"""


def test_a_digest_is_the_same_in_another_process() -> None:
    runs = [subprocess.run([sys.executable, "-c", DIGEST], capture_output=True, text=True, check=True)
            for _ in range(2)]  # fmt: skip
    assert runs[0].stdout == runs[1].stdout and len(runs[0].stdout.strip()) == 64


def test_a_stepper_of_somebody_else_stands_for_itself_alone() -> None:
    one, other = Stepper(lambda x: x), Stepper(lambda x: x)
    assert representative(one) is one and representative(other) is other  # type: ignore[arg-type]


CELL = """
class Task(Reach):
    def reward_terms(self, world):
        return {a: {n: 0.0 * v + VALUE for n, v in t.items()} for a, t in super().reward_terms(world).items()}
"""


def define(value: float) -> None:
    """Run a notebook's cell, as somebody would who has just changed it."""
    cell: dict[str, Any] = {"Reach": Reach, "VALUE": value, "__name__": "__main__"}
    exec(CELL, cell)
    register_task("cell", cell["Task"])


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget what a test registers."""
    monkeypatch.setattr(TASKS, "_registered", dict(TASKS._registered))


@pytest.mark.usefixtures("registered")
def test_a_task_that_is_defined_again_has_a_kernel_of_its_own() -> None:
    bodies = []
    for value in (1.0, 2.0):
        define(value)
        bodies.append(load_source(Env("cell", "ecm"), vector=True).bodies["step"])
    assert bodies[0] != bodies[1]


@pytest.mark.slow
@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("engine", ["fused", "mjx"])
def test_a_task_that_is_defined_again_plays_its_new_reward(engine: str) -> None:
    rewards = []
    for value in (1.0, 2.0):
        define(value)
        env = BatchedEnv("cell", "ecm", num_envs=2, engine=engine, device="cpu")
        env.reset(seed=0)
        rewards.append(env.step({"ecm_0": np.zeros((2, 4), np.float32)}).rewards["ecm_0"][0])
    assert rewards[1] == pytest.approx(2 * rewards[0]) and rewards[0] != 0


def test_a_helper_in_another_folder_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    found = []
    for value in (1.0, 2.0):
        (tmp_path / "helper_elsewhere.py").write_text(f"def add(x):\n    return x + {value}\n")
        importlib.invalidate_caches()
        sys.modules.pop("helper_elsewhere", None)
        helper = importlib.import_module("helper_elsewhere")
        functions = source_cache._trace(Stepper(helper.add), unsaid)  # type: ignore[arg-type]
        found.append(jaxpr_digest(functions))
    assert found[0] != found[1]
