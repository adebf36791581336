"""The JAX face: pure functions in the convention of JaxMARL and gymnax, for `jit`, `vmap`, `scan` and `grad`.

    env = jax_env("reach", scene="bimanual_psm")
    observations, state = env.reset(jax.random.key(0))
    actions = {agent: env.action_space(agent).sample(key) for agent in env.agents}
    observations, state, rewards, dones, infos = env.step(key, state, actions)

An environment whose episode ends starts the next one in the same step, as in JaxMARL.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.content import unknown
from surgical_marl.engines.stepper import MOST_KEPT, Stepper, representative
from surgical_marl.envs.actions import check_agents, check_unmasked, shown
from surgical_marl.envs.env import Env
from surgical_marl.envs.state import Carry
from surgical_marl.runtime import jax, jax_scope, jnp
from surgical_marl.tasks.base.options import scaled_by_default

if TYPE_CHECKING:
    from gymnasium import spaces
    from jax import Array


class Box(NamedTuple):
    """A space as a pytree, so that it can go into a function that JAX traces."""

    low: Array
    """Least values, [d]."""
    high: Array
    """Greatest values, [d]."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of an element."""
        return self.low.shape

    @property
    def dtype(self) -> Any:
        """Type of an element's numbers."""
        return self.low.dtype

    def sample(self, key: Array) -> Array:
        """Return an element that is drawn evenly, [d]."""
        return jax.random.uniform(key, self.shape, self.dtype, self.low, self.high)

    def contains(self, x: Array) -> Array:
        """Return whether all numbers of an element are within the bounds, [] bool."""
        return jnp.all((x >= self.low) & (x <= self.high))


class EnvState(NamedTuple):
    """State of an environment: everything that its next step depends on, and the view of a critic."""

    carry: Carry
    """Input of the next step."""
    global_state: Array
    """View of a centralised critic, [S]: `state()` of the PettingZoo face."""


class JaxEnv:
    """One environment as pure functions. `jax.vmap` makes many of it.

    Attributes:
        agents: names of the arms, in the order of the scene; `num_agents` is their number.
        observation_spaces: `Box` by agent; `action_spaces` likewise.
        max_steps: control steps until an episode is truncated.
        env: the environment behind it, which every face shares.
    """

    @jax_scope()
    def __init__(self, env: Env) -> None:
        if env.pauses:
            raise ValueError(f"{env.title} needs pictures, which are drawn outside JAX: use surgical_marl.parallel_env")
        self.env, self.max_steps = env, env.max_steps
        self.agents = list(env.agents)
        self.num_agents = len(self.agents)
        self.observation_spaces = {agent: _box(env.observation_space(agent)) for agent in self.agents}
        self.action_spaces = {agent: _box(env.action_space(agent)) for agent in self.agents}
        self.state_space = _box(env.state_space)
        self._functions = _functions(representative(env))

    @property
    def name(self) -> str:
        """Name for people, as in "reach on psm"."""
        return self.env.title

    def observation_space(self, agent: str) -> Box:
        """Return the space of an agent's observations. ValueError for an unknown agent."""
        return self._of(agent, self.observation_spaces)

    def action_space(self, agent: str) -> Box:
        """Return the space [-1, 1] of an agent's actions. ValueError for an unknown agent."""
        return self._of(agent, self.action_spaces)

    def action_terms(self, agent: str) -> dict[str, slice]:
        """Return the names of the terms of an agent's action, and where each stands in it."""
        self._of(agent, self.action_spaces)
        return self.env.action_terms(agent)

    @jax_scope()
    def reset(self, key: Array, *, number: Array | int = 0) -> tuple[dict[str, Array], EnvState]:
        """Return the observations, [d] by agent, and the state at the start of an episode.

        Args:
            key: the key of a seed, `jax.random.key(seed)` or `jax.random.PRNGKey(seed)`. The episode is the one that
                the PettingZoo face plays after `reset(seed=seed)`.
            number: which of many environments of that seed it is. Number i is environment i of
                `parallel_env(num_envs=N)`.

        Raises:
            ValueError: the key is no single threefry key, JAX's default kind.
        """
        state = self._functions[0](_raw(key), number, self.env.parameters)
        return state.observations, EnvState(state.carry, state.state)

    @jax_scope()
    def step(
        self, key: Array | None, state: EnvState, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Array], EnvState, dict[str, Array], dict[str, Array], dict[str, dict[str, Array]]]:
        """Do one control step, and begin the next episode if it ends this one.

        Args:
            key: not used, and so may be None: all random numbers come from the key that `reset` was given.
            state: of the last step, or of `reset`.
            actions: agent -> [n] in [-1, 1]. Larger values are clipped.

        Returns:
            Observations [d] by agent and the state, both of the next episode where one ended. Rewards [] by agent.
            Dones [] bool by agent and for "__all__". Infos by agent, of this step's episode: those of every face,
            "truncated" [] bool, which is False where a task ended the episode, and "final_observation" [d].

        Raises:
            ValueError: the state is none, an agent is missing or unknown, a shape is wrong, or a value is no real
                number, or not finite, where it is known when the step is called.
        """
        if not isinstance(state, EnvState):
            raise ValueError(f"state must be what reset() or step() returned, not {shown(state)}")
        after = self._functions[1](state.carry, self._checked(actions), self.env.parameters)
        done = after.terminated | after.truncated
        infos = {
            agent: {**info, "truncated": after.truncated, "final_observation": after.final_observations[agent]}
            for agent, info in after.infos.items()
        }
        dones = dict.fromkeys([*self.agents, "__all__"], done)
        return after.observations, EnvState(after.carry, after.state), after.rewards, dones, infos

    def _of(self, agent: str, spaces: dict[str, Box]) -> Box:
        if agent not in spaces:
            raise unknown("agent", agent, self.agents)
        return spaces[agent]

    def _checked(self, actions: Any) -> dict[str, Array]:
        check_agents(actions, self.agents)
        return {agent: self._checked_action(agent, actions) for agent in self.agents}

    def _checked_action(self, agent: str, actions: Mapping[str, Any]) -> Array:
        shape = self.action_spaces[agent].shape
        check_unmasked(agent, actions[agent])
        try:
            action = jnp.asarray(actions[agent])
        except (TypeError, ValueError):
            raise ValueError(f"action of {agent!r} must hold real numbers, not {shown(actions[agent])}") from None
        if action.dtype == bool or not jnp.isrealobj(action):
            raise ValueError(f"action of {agent!r} must hold real numbers, not {action.dtype}")
        if action.shape != shape:
            raise ValueError(f"action of {agent!r} has shape {action.shape}, it must be {shape}")
        if not isinstance(action, jax.core.Tracer) and not np.isfinite(action).all():
            raise ValueError(f"action of {agent!r} holds a value that is not finite")
        return action.astype(jnp.float32)


def jax_env(task: str = "reach", scene: str | None = "bimanual_psm", **options: Any) -> JaxEnv:
    """Make an environment of pure JAX functions: `reset(key)` and `step(key, state, actions)`.

    Args:
        task: a name of `list_tasks()`, or a task file, `my_task.py` or `my_task.py:Escort`.
        scene: a name of `list_scenes()` or the path of a scene file; the task's own, or "psm", if None.
        options: further fields of `surgical_marl.tasks.base.options.Options`, such as `control`, `difficulty`, `start`
            and `max_steps`. `observations` are "scaled" by default.

    Raises:
        ValueError: naming the unknown value and the good ones, or an environment that needs pictures.
    """
    return JaxEnv(Env(task, scene, **scaled_by_default(options)))


@lru_cache(MOST_KEPT)
def _functions(env: Stepper) -> tuple[Any, Any]:
    """Return `reset` and `step` of an environment: compiled once for all environments that are alike."""

    def reset(key: Array, number: Array, parameters: Any) -> Any:
        return env.reset(jax.random.fold_in(key, number), 0, parameters)

    return jax.jit(reset), jax.jit(env.step)


def _raw(key: Any) -> Array:
    """Return a key as the two words that environments carry."""
    raw = key
    if hasattr(key, "dtype") and jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        raw = jax.random.key_data(key)
    if getattr(raw, "shape", None) != (2,) or raw.dtype != jnp.uint32:
        raise ValueError(f"key must be one key such as jax.random.key(0), not {shown(key)}")
    return raw


def _box(space: spaces.Box) -> Box:
    return Box(jnp.asarray(space.low), jnp.asarray(space.high))
