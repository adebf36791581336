"""One environment, in pure JAX: `reset(key) -> State`, `step(carry, actions) -> State`.

    env = Env("reach", "bimanual_psm")
    state = env.reset(jax.random.PRNGKey(0))
    state = env.step(state.carry, {agent: jnp.zeros(env.num_actions(agent)) for agent in env.agents})

This is the one place where a step is written. Engines run it for many environments; interfaces show it to others. An
environment that ends is reset within the same step: `observations` then belong to the new episode,
`final_observations` to the one that ended.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from gymnasium import spaces
from jax import Array

from surgical_marl.content import list_tasks, unknown
from surgical_marl.envs.costs import costs
from surgical_marl.physics.plant import Hidden, Plant
from surgical_marl.physics.simulator import ArmView, Contacts, Physics, Simulator
from surgical_marl.runtime import prepare_jax
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.scene import DECIMATION

HIDDEN, NOISE = 2**31 - 1, 2**31 - 2
"""What the episode's key is folded with for what a scene's randomisation draws: far from what tasks take."""


class Carry(NamedTuple):
    """What the next step reads. Random numbers come from `key` and the `episode` counter alone."""

    physics: Physics
    goal: Any
    key: Array
    episode: Array
    steps: Array
    tips: Any = ()
    """Tool tips [arms, 3], each in its arm's base frame, m: the next step has their speed from it."""
    hidden: Hidden | None = None
    """What the episode drew for the arms (`surgical_marl/physics/plant.py`)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """The outcome of a reset or a step. Dicts are keyed by agent."""

    carry: Carry
    observations: dict[str, Array]
    """[d] each, of the new episode where one ended."""
    state: Array
    """What a centralised critic sees: all observations, one after the other, and `Task.privileged`."""
    rewards: dict[str, Array]
    terminated: Array
    truncated: Array
    """The time limit was reached and the episode did not terminate."""
    final_observations: dict[str, Array]
    """Of this step's episode, even if it ended."""
    final_state: Array
    infos: dict[str, dict[str, Array]]
    """tip_error (m), success, collision, min_distance (m), contact_force (N); `reward_<term>`, the weighted terms that
    the reward is the sum of; `cost_<name>`, the limits broken (`envs/costs.py`), and their number `cost`. Of
    this step's episode, even if it ended."""
    contacts: Contacts
    """Every pair of geoms that can touch, likewise."""
    qpos: Any = ()
    """Joint positions of the whole scene [nq], likewise, for a task with pictures; else nothing."""


class Env:
    """A task on a scene, for one environment.

    Args:
        task: a name of `list_tasks()`.
        scene: a name of `list_scenes()` or the path of a scene file.
        control: how actions drive the joints: "position" moves position targets, "velocity" and "torque" command
            those. Actions are in [-1, 1]; 1 is the joint's `speed`, or its effort limit for torque.
        max_steps: control steps until truncation; the task's own number if None.
        decimation: physics steps a control step.
        difficulty: "easy", "default" or "hard"; the task's module says what each is.
        reward: weights of reward terms that replace the task's own, as in {"collision": -5}.

    Raises:
        ValueError: naming what is unknown or out of range.
    """

    def __init__(
        self,
        task: str = "reach",
        scene: str = "bimanual_psm",
        control: str = "position",
        max_steps: int | None = None,
        decimation: int = DECIMATION,
        difficulty: str = "default",
        reward: Mapping[str, float] | None = None,
    ) -> None:
        if task not in list_tasks():
            raise unknown("task", task, list_tasks())
        if max_steps is not None and (isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1):
            raise ValueError(f"max_steps must be a whole number of at least 1, not {max_steps!r}")
        if isinstance(decimation, bool) or not isinstance(decimation, int) or decimation < 1:
            raise ValueError(f"decimation must be a whole number of at least 1, not {decimation!r}")
        from importlib import import_module

        prepare_jax()
        self.scene = load_scene(scene, control)
        self.task_name = task
        self.task = import_module(f"surgical_marl.tasks.{task}").Task(self.scene, difficulty, reward)
        self.max_steps = max_steps or self.task.max_steps
        self.agents = self.scene.agents
        self.decimation, self.control_dt = decimation, decimation * self.scene.model.opt.timestep
        self.difficulty = difficulty
        self._bounds = {agent: self.task.bounds(agent) for agent in self.agents}

    @property
    def title(self) -> str:
        """What people call it."""
        return f"{self.task_name} on {self.scene.name}"

    @property
    def content(self) -> bytes:
        """All that a step depends on besides code: the model with its masses and gains, and the options."""
        model = np.empty(mujoco.mj_sizeModel(self.scene.model), np.uint8)
        mujoco.mj_saveModel(self.scene.model, None, model)
        weights = sorted(self.task.weights.items())
        how = f"{self.scene.control} {self.max_steps} {self.decimation} {self.scene.randomisation}"
        options = f"{self.task_name} {self.difficulty} {weights} {how}"
        return self.scene.fingerprint + options.encode() + model.tobytes()

    @property
    def roots(self) -> tuple[str, ...]:
        """Modules whose code a step runs, with all that these import."""
        return type(self).__module__, type(self.task).__module__

    @cached_property
    def simulator(self) -> Simulator:
        """The physics, set up when first needed, even while JAX traces a step."""
        with jax.ensure_compile_time_eval():
            return Simulator(self.scene, self.decimation)

    @cached_property
    def plant(self) -> Plant:
        """The physics behind motors and encoders, as good or bad as the scene has them."""
        return Plant(self.simulator)

    def num_actions(self, agent: str) -> int:
        """Length of an agent's action: one number a joint, the jaw's open (> 0) or closed command last in joint
        order."""
        return len(self.scene.mounts[agent].arm.actuated)

    def action_space(self, agent: str) -> spaces.Box:
        """[-1, 1] for every actuated joint."""
        return spaces.Box(-1.0, 1.0, (self.num_actions(agent),), np.float32)

    def observation_space(self, agent: str) -> spaces.Box:
        """Bounds that observations are clipped to."""
        low, high = self._bounds[agent]
        return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)

    @property
    def state_space(self) -> spaces.Box:
        """Bounds of `State.state`."""
        every = [*(self._bounds[agent] for agent in self.agents), self.task.privileged_bounds]
        low, high = map(np.concatenate, zip(*every, strict=True))
        return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)

    def reset(self, key: Array, episode: Array | int = 0) -> State:
        """The start of an episode. `key` is raw (uint32 [2], as of `jax.random.PRNGKey`) and numbers its episodes."""
        carry = self._start(key, jnp.int32(episode))
        views = self.simulator.home_views
        observations, state = self._observe(carry, self.simulator.home_contacts, views)
        nothing = jax.tree.map(jnp.zeros_like, self.task.rewards(views, carry.goal))
        return State(
            carry=carry,
            observations=observations,
            state=state,
            rewards={agent: jnp.float32(0.0) for agent in self.agents},
            terminated=jnp.bool_(False),
            truncated=jnp.bool_(False),
            final_observations=observations,
            final_state=state,
            infos=self._infos(views, carry, carry, nothing),
            contacts=self.simulator.home_contacts,
            qpos=self.simulator.home.qpos if self.task.camera else (),
        )

    def step(self, carry: Carry, actions: dict[str, Array]) -> State:
        """One control step, and a reset if it ends the episode."""
        physics, hidden = self.plant.command(carry.physics, carry.hidden, actions)
        physics, contacts, views = self.plant.advance(physics, hidden)
        goal = self.task.advance(carry.goal, self.control_dt)
        tips = jnp.stack([view.tool_tip for view in views.values()])
        terms = self.task.rewards(views, goal)
        terminated = self.task.terminated(views, goal)
        steps = carry.steps + 1
        truncated = (steps >= self.max_steps) & ~terminated
        moved = carry._replace(physics=physics, hidden=hidden, goal=goal, tips=tips, steps=steps)
        final_observations, final_state = self._observe(moved, contacts, views)
        going = moved, final_observations, final_state

        def begin(_: Any) -> Any:
            fresh = self._start(carry.key, carry.episode + 1)
            return fresh, *self._observe(fresh, self.simulator.home_contacts, self.simulator.home_views)

        done = terminated | truncated
        next_carry, observations, state = jax.lax.cond(done, begin, lambda going: going, going)
        return State(
            carry=next_carry,
            observations=observations,
            state=state,
            rewards={agent: sum(values.values()) for agent, values in terms.items()},
            terminated=terminated,
            truncated=truncated,
            final_observations=final_observations,
            final_state=final_state,
            infos=self._infos(views, carry, moved, terms),
            contacts=contacts,
            qpos=physics.qpos if self.task.camera else (),
        )

    def _start(self, key: Array, episode: Array) -> Carry:
        own = jax.random.fold_in(key, episode)
        hidden = self.plant.start(jax.random.fold_in(own, HIDDEN))
        return Carry(
            physics=self.plant.home(hidden),
            hidden=hidden,
            goal=self.task.start(own),
            tips=jnp.stack([view.tool_tip for view in self.simulator.home_views.values()]),
            key=key,
            episode=episode,
            steps=jnp.int32(0),
        )

    def _observe(self, carry: Carry, contacts: Contacts, views: dict[str, ArmView]) -> tuple[dict[str, Array], Array]:
        """What policies see of arms that are as in `views`."""
        noise = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(carry.key, carry.episode), NOISE), carry.steps)
        views = self.plant.measure(carry.physics, carry.hidden, contacts, views, noise)
        observations = {
            agent: jnp.clip(observation.astype(jnp.float32), *(b.astype(np.float32) for b in self._bounds[agent]))
            for agent, observation in self.task.observations(views, carry.goal).items()
        }
        every = [*(observations[agent] for agent in self.agents), self.task.privileged(carry.goal)]
        return observations, jnp.concatenate(every)

    def _infos(
        self, views: dict[str, ArmView], before: Carry, after: Carry, terms: dict[str, dict[str, Array]]
    ) -> dict[str, dict[str, Array]]:
        errors, infos = self.task.tip_errors(views, after.goal), {}
        metrics = self.task.metrics(views, after.goal)
        speeds = jnp.linalg.norm(after.tips - before.tips, axis=-1) / np.float32(self.control_dt)
        for i, (agent, view) in enumerate(views.items()):
            broken = costs(self.scene.mounts[agent].arm, view, speeds[i])
            infos[agent] = {
                "tip_error": errors[agent],
                "success": errors[agent] < self.task.success,
                "collision": view.collision,
                "min_distance": view.min_distance,
                "contact_force": view.contact_force,
                **{f"reward_{name}": value for name, value in terms[agent].items()},
                "cost": sum(cost.astype(jnp.float32) for cost in broken.values()),
                **{f"cost_{name}": cost for name, cost in broken.items()},
                **metrics[agent],
            }
        return infos
