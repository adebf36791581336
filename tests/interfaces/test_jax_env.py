"""The JAX face: the numbers of the other faces, under JAX's transformations, and bad input."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.tasks.base.task import TipTask
from tests.helpers.scenes import APART

STEPS = 4
CLOSE = {"atol": 2e-4, "rtol": 1e-4}


def make(scene: str = "psm", **options: Any) -> Any:
    return sm.jax_env("reach", scene=scene, max_steps=STEPS, **options)


def draw(env: Any, rng: np.random.Generator, *batch: int) -> dict[str, np.ndarray]:
    shapes = {agent: (*batch, *env.action_space(agent).shape) for agent in env.possible_agents}
    return {agent: rng.uniform(-1, 1, shape).astype(np.float32) for agent, shape in shapes.items()}


def assert_close(one: Any, other: Any) -> None:
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, **CLOSE), one, other)


@pytest.mark.parametrize("scene", ["psm", pytest.param("bimanual_psm", marks=pytest.mark.slow)])
def test_it_plays_what_the_pettingzoo_face_plays_over_several_episodes(scene: str) -> None:
    env, rng = make(scene), np.random.default_rng(0)
    team: Any = sm.parallel_env("reach", scene=scene, max_steps=STEPS)
    observations, state = env.reset(jax.random.key(7))
    expected, _ = team.reset(seed=7)
    for step in range(2 * STEPS + 1):
        assert list(observations) == env.agents == team.possible_agents
        assert_close(dict(observations), expected)
        assert_close(state.global_state, team.state())
        actions = draw(team, rng)
        observations, state, rewards, dones, infos = env.step(None, state, actions)
        expected, expected_rewards, _, truncations, expected_infos = team.step(actions)
        assert_close(dict(rewards), expected_rewards)
        ended = step % STEPS == STEPS - 1
        assert set(dones) == {*env.agents, "__all__"} and {bool(done) for done in dones.values()} == {ended}
        for agent in env.agents:
            final = infos[agent].pop("final_observation")
            assert_close(final, expected[agent])
            assert bool(infos[agent].pop("truncated")) == truncations[agent] == ended
            assert_close(dict(infos[agent]), expected_infos[agent])
            assert np.array_equal(final, observations[agent]) != ended
        if ended:
            expected, _ = team.reset()


def test_many_by_vmap_are_the_batched_environments_of_the_seed() -> None:
    env, count = make(), 3
    many: Any = sm.parallel_env("reach", scene="psm", max_steps=STEPS, num_envs=count)
    expected, _ = many.reset(seed=3)
    observations, state = jax.vmap(lambda i: env.reset(jax.random.key(3), number=i))(jnp.arange(count))
    assert_close(dict(observations), expected)
    rng, step = np.random.default_rng(0), jax.jit(jax.vmap(env.step, (None, 0, 0)))
    for _ in range(STEPS + 1):
        actions = draw(many, rng, count)
        observations, state, rewards, dones, _ = step(None, state, actions)
        expected, expected_rewards, _, truncations, _ = many.step(actions)
        assert_close(dict(observations), expected)
        assert_close(dict(rewards), expected_rewards)
        np.testing.assert_array_equal(dones["__all__"], truncations["psm_0"])


def test_a_scan_under_jit_steps_alike() -> None:
    env = make()
    actions = jax.random.uniform(jax.random.key(1), (STEPS + 2, 7), minval=-1)
    _, start = env.reset(jax.random.PRNGKey(0))

    def step(state: Any, action: Any) -> Any:
        observations, state, rewards, dones, _ = env.step(None, state, {"psm_0": action})
        return state, (observations["psm_0"], rewards["psm_0"], dones["__all__"])

    _, (seen, rewards, dones) = jax.jit(lambda state: jax.lax.scan(step, state, actions))(start)
    state = start
    for k, action in enumerate(actions):
        observations, state, reward, done, _ = env.step(None, state, {"psm_0": action})
        assert_close((seen[k], rewards[k]), (observations["psm_0"], reward["psm_0"]))
        assert bool(dones[k]) == bool(done["__all__"])


def test_spaces_are_pytrees() -> None:
    env = make(APART)
    team: Any = sm.parallel_env("reach", scene=APART)
    sample = jax.jit(lambda space, key: space.sample(key))
    for agent in env.agents:
        for own, other in (
            (env.observation_space(agent), team.observation_space(agent)),
            (env.action_space(agent), team.action_space(agent)),
        ):
            assert own.shape == other.shape and own.dtype == other.dtype
            drawn = sample(own, jax.random.key(0))
            assert bool(own.contains(drawn)) and other.contains(np.asarray(drawn))
            assert not own.contains(own.high + 1)
    assert env.state_space.shape == team.state_space.shape
    with pytest.raises(ValueError, match=r"unknown agent 'psm_7'.*psm_0"):
        env.action_space("psm_7")


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (None, "actions must be a dict of agents to arrays, not None"),
        (np.zeros(7), "actions must be a dict of agents to arrays, not array"),
        ({}, "no action for agent 'psm_0'"),
        ({"psm_0": np.zeros(7), "ecm_0": np.zeros(4)}, "'ecm_0', which is not an agent of the scene"),
        ({"psm_0": np.zeros(6)}, r"action of 'psm_0' has shape \(6,\), it must be \(7,\)"),
        ({"psm_0": None}, "action of 'psm_0' must hold real numbers, not None"),
        ({"psm_0": ["open"] * 7}, "action of 'psm_0' must hold real numbers"),
        ({"psm_0": np.zeros(7, bool)}, "must hold real numbers, not bool"),
        ({"psm_0": np.zeros(7, complex)}, "must hold real numbers, not complex64"),
        ({"psm_0": np.full(7, np.nan)}, "action of 'psm_0' holds a value that is not finite"),
        ({"psm_0": np.ma.masked_equal(np.ones(7), 1)}, "action of 'psm_0' has masked entries"),
    ],
)
def test_a_bad_action_is_one_sentence(actions: Any, words: str) -> None:
    env = make()
    _, state = jax.eval_shape(env.reset, jax.random.key(0))
    with pytest.raises(ValueError, match=words) as caught:
        env.step(None, state, actions)
    assert "\n" not in str(caught.value)


def test_bad_input_is_found_while_tracing() -> None:
    env = make()
    _, state = jax.eval_shape(env.reset, jax.random.key(0))
    with pytest.raises(ValueError, match=r"action of 'psm_0' has shape \(6,\)"):
        jax.eval_shape(lambda state, action: env.step(None, state, {"psm_0": action}), state, jnp.zeros(6))
    with pytest.raises(ValueError, match=r"state must be what reset\(\) or step\(\) returned, not None"):
        env.step(None, None, {"psm_0": jnp.zeros(7)})
    for key in (0, None, jax.random.split(jax.random.key(0)), jax.random.key(0, impl="rbg")):
        with pytest.raises(ValueError, match="key must be one key such as"):
            env.reset(key)
    with pytest.raises(ValueError, match="match_image on ecm needs pictures, which are drawn outside JAX"):
        sm.jax_env("match_image", scene="ecm")
    with pytest.raises(ValueError, match="unexpected keyword argument 'num_envs'"):
        make(num_envs=4)


def test_environments_that_are_alike_share_what_is_compiled() -> None:
    one, other, longer = make(), make(), sm.jax_env("reach", scene="psm", max_steps=50, reward={"distance": -1.0})
    different = make(control="velocity")
    assert one._functions is other._functions is longer._functions is not different._functions
    assert longer.max_steps == 50


@pytest.fixture
def again(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], Any]:
    """Define a task again, as a notebook does it: the class has the name, module and options of the first."""
    monkeypatch.setattr(TASKS, "_registered", {})

    def define(gain: float) -> Any:
        class Again(TipTask):
            def rewards(self, world: Any) -> Any:
                return {agent: {"gain": jnp.float32(gain)} for agent in world.arms}

            def start(self, key: Any) -> Any:
                from surgical_marl.tasks.base.task import Goal, Start

                return Start(Goal(jnp.zeros((1, 3))))

        sm.register_task("again", Again)
        return sm.jax_env("again", scene="psm")

    return define


def test_a_task_that_is_defined_again_is_another(again: Callable[[float], Any]) -> None:
    assert again(1.0)._functions is not again(2.0)._functions


@pytest.mark.slow
def test_a_task_that_is_defined_again_plays_its_new_reward(again: Callable[[float], Any]) -> None:
    for gain in (1.0, 2.0):
        env = again(gain)
        _, state = env.reset(jax.random.key(0))
        assert env.step(None, state, {"psm_0": jnp.zeros(7)})[2]["psm_0"] == gain


def test_a_tip_at_its_target_has_a_finite_derivative() -> None:
    env = make()
    task, (_, state) = env.env.task, env.reset(jax.random.key(0))
    views = env.env.simulator.home_views
    goal = state.carry.goal._replace(targets=views["psm_0"].tool_tip[None])

    def error(tip: Any) -> Any:
        from surgical_marl.tasks.base.world import World

        return task.tip_errors(World({"psm_0": views["psm_0"]._replace(tool_tip=tip)}, goal))["psm_0"]

    tip = views["psm_0"].tool_tip
    assert not error(tip) and not np.any(jax.grad(error)(tip))
    np.testing.assert_allclose(jax.grad(error)(tip + jnp.array([3.0, 0.0, 4.0])), [0.6, 0, 0.8], rtol=1e-6)
