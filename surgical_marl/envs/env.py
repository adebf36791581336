"""One environment, in pure JAX: `reset(key) -> State`, `step(carry, actions) -> State`.

    env = Env("reach", "bimanual_psm")
    state = env.reset(jax.random.PRNGKey(0))
    state = env.step(state.carry, {agent: jnp.zeros(env.num_actions(agent)) for agent in env.agents})

A step is defined only here. Engines run it for many environments, and interfaces present it to users. An
environment that ends is reset within the same step: `observations` then belong to the new episode,
`final_observations` to the one that ended.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from gymnasium import spaces

from surgical_marl.cache import cached
from surgical_marl.control.controller import Controller, actuators_of
from surgical_marl.engines.stepper import describe
from surgical_marl.envs.agent_observation import AgentObservation
from surgical_marl.envs.information_level import InformationLevel
from surgical_marl.envs.infos import infos
from surgical_marl.envs.observations import Scale
from surgical_marl.envs.state import Carry, Moved, State
from surgical_marl.physics.skip import switched_off
from surgical_marl.plugins.task_file import label
from surgical_marl.plugins.tasks import TASKS, find_task, scene_of
from surgical_marl.runtime import jax, jax_scope, jnp, prepare_jax
from surgical_marl.scenes.load import load_scene
from surgical_marl.tasks.base.options import Options, make_options
from surgical_marl.tasks.base.task import Task
from surgical_marl.tasks.base.world import World

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.physics.outputs import ArmView, Contacts
    from surgical_marl.physics.plant import Plant
    from surgical_marl.physics.simulator import Simulator

PICTURES = "pictures"
"""The stage in which the host draws what agents see."""
HIDDEN, NOISE, PLACES = 2**31 - 1, 2**31 - 2, 2**31 - 3
"""Folded into an episode's key for the draws of a scene's randomisation, so that they are independent of a task's
draws."""


class Env:
    """A task on a scene, for one environment.

    Args:
        task: a name of `list_tasks()`, or a task file, `my_task.py` or `my_task.py:Escort`.
        scene: a name of `list_scenes()` or the path of a scene file; the task's own, or "psm", if None.
        options: further fields of `surgical_marl.tasks.base.options.Options`.

    Raises:
        ValueError: naming what is unknown or out of range.
    """

    def __init__(self, task: str = "reach", scene: str | None = "bimanual_psm", **options: Any) -> None:
        prepare_jax()
        task = find_task(task)
        scene = scene_of(task) if scene is None else scene
        self.options: Options = make_options(task, scene, options)
        self.task_name = self.options.task
        task_class = TASKS.load(self.task_name)
        self.scene = load_scene(self.options.scene, actuators_of(self.options.control))
        self.task: Task = task_class(self.scene, self.options)
        self.max_steps = self.options.max_steps or self.task.max_steps
        self.agents = self.scene.agents
        self.decimation = self.options.decimation
        self.control_dt = self.decimation * self.scene.model.opt.timestep
        self.controller = Controller(
            self.scene, self.options.control, dt=self.control_dt, frame=self.options.control_frame
        )
        chosen = {**self.scene.observe, **self.options.observe}
        for agent in chosen:
            if agent not in self.agents:
                raise ValueError(
                    f"observe names {agent!r}, which is not an agent of the scene ({', '.join(self.agents)})"
                )
        self.scaled, self.messages = self.options.observations == "scaled", self.options.messages
        if self.messages and len(self.agents) < 2:
            raise ValueError(f"messages must be 0 in a scene of one arm such as {scene!r}, not {self.messages}")
        known = {a: InformationLevel(self.task, a, self.options.knowledge, self.messages) for a in self.agents}
        self.observed = {a: AgentObservation(self.task, own, chosen.get(a), self.scaled) for a, own in known.items()}

    @property
    def _sizes(self) -> list[int]:
        """The length of each agent's action without a message."""
        return [self.controller.num_actions(agent) for agent in self.agents]

    @property
    def title(self) -> str:
        """Name for messages."""
        return f"{label(self.task_name)} on {self.scene.name}"

    @property
    def pauses(self) -> bool:
        """True if a step calls a stage of the host: pictures are drawn after the physics.

        This is so if an agent observes pictures, or if the task computes numbers from them.
        """
        return bool(self.task.senses) or any(seen.pictures for seen in self.observed.values())

    @cached_property
    def begins_at_home(self) -> bool:
        """True if all episodes begin with all arms at home. It is kept on disk: JAX finds it out by tracing."""

        def start(key: Array, parameters: Any) -> Any:
            return self._bound(parameters)[0].start(key)

        @jax_scope()
        def trace() -> np.ndarray:
            found = jax.eval_shape(start, jax.ShapeDtypeStruct((2,), np.uint32), self.parameters)
            return np.array(found.qpos is None)

        return bool(cached("starts", trace, self.content, describe(self.parameters), classes=self.classes))

    @property
    def content(self) -> bytes:
        """All that a step depends on besides code and `parameters`.

        This is the model, with its masses and gains, the options, and the task's constants.
        """
        model = np.empty(mujoco.mj_sizeModel(self.scene.model), np.uint8)
        mujoco.mj_saveModel(self.scene.model, None, model)
        observed = {agent: (seen.names, seen.stated) for agent, seen in self.observed.items()}
        control = self.options.control, self.options.control_frame
        how = (control, self.decimation, self.scene.randomisation, self.options.start, self.scaled, self.pauses)
        physics = sorted(switched_off()), self.scene.attachments, self.scene.systems
        about = f"{self.task_name} {self.task.constants} {how} {physics} {observed} {self.messages}"
        return self.scene.fingerprint + about.encode() + model.tobytes()

    @property
    def classes(self) -> tuple[type, ...]:
        """Classes whose code a step runs."""
        systems = (type(system) for system in self.scene.systems.values())
        return type(self), type(self.task), *self.controller.classes, *systems

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """Numbers that a step reads as inputs, so that nothing is compiled again when one of them changes.

        A tree of numpy arrays: `max_steps`, the `weights` of reward terms, the task's `tables`, and `autoreset`,
        whether a step that ends an episode begins the next one.
        """
        return {
            "autoreset": np.bool_(True),
            "max_steps": np.int32(self.max_steps),
            "weights": {name: np.float32(weight) for name, weight in self.task.weights.items()},
            "tables": {name: _single(table) for name, table in self.task.tables.items()},
        }

    @cached_property
    @jax_scope()
    def simulator(self) -> Simulator:
        """The physics, set up when first needed, even while JAX traces a step."""
        from surgical_marl.physics.simulator import Simulator

        with jax.ensure_compile_time_eval():
            return Simulator(self.scene, self.decimation)

    @cached_property
    def plant(self) -> Plant:
        """The physics with motors and encoders, randomised as the scene says."""
        from surgical_marl.physics.plant import Plant

        return Plant(self.simulator, self.controller)

    def num_actions(self, agent: str) -> int:
        """Return the length of an agent's action.

        An action is the numbers of the agent's terms (`action_terms`). Those of a message follow, if there are
        `messages`.
        """
        return self.controller.num_actions(agent) + self.messages

    def action_terms(self, agent: str) -> dict[str, slice]:
        """Return the names of the terms of an agent's action, a message's as "message", and where each stands in it."""
        found, end = self.controller.slices(agent), self.controller.num_actions(agent)
        return {**found, "message": slice(end, end + self.messages)} if self.messages else found

    def action_space(self, agent: str) -> spaces.Box:
        """[-1, 1] for every number of the terms, and of a message."""
        return spaces.Box(-1.0, 1.0, (self.num_actions(agent),), np.float32)

    def observation_space(self, agent: str) -> spaces.Box:
        """Bounds of the vector that an agent observes."""
        return _box(*self.observed[agent].bounds())

    @property
    def state_space(self) -> spaces.Box:
        """Bounds of `State.state`."""
        every = [self.observed[agent].bounds(stated=True) for agent in self.agents]
        every.append(self._privileged_scale.bounds if self.scaled else self.task.privileged_bounds)
        ends = np.ones(len(self.agents) * self.messages)
        every.append((-ends, ends))
        return _box(*map(np.concatenate, zip(*every, strict=True)))

    @cached_property
    def _privileged_scale(self) -> Scale:
        return Scale(*self.task.privileged_bounds)

    def reset(self, key: Array, episode: Array | int = 0, parameters: Any = None) -> State:
        """Return the state at the start of an episode.

        Args:
            key: a raw key (uint32 [2], as `jax.random.PRNGKey` returns it). The episodes of a key are numbered.
            episode: the number of the episode among those of the key.
            parameters: a tree like `self.parameters`; None for the environment's own.
        """
        task, *_ = self._bound(parameters)
        carry, contacts, arms = self._start(task, key, jnp.int32(episode))
        observations, state = self._observe(task, carry, contacts, arms)
        world = World(arms, carry.goal, self._unsensed(), *self.plant.things(carry.physics, carry.hidden))
        nothing = jax.tree.map(jnp.zeros_like, task.reward_terms(world))
        return State(
            carry=carry,
            observations=observations,
            state=state,
            rewards={agent: jnp.float32(0.0) for agent in self.agents},
            terminated=jnp.bool_(False),
            truncated=jnp.bool_(False),
            final_observations=observations,
            final_state=state,
            infos=infos(
                self.scene, task, world, jnp.zeros_like(carry.tips), self.control_dt, nothing, self._untold(carry)
            ),
            contacts=contacts,
        )

    def step(self, carry: Carry, actions: dict[str, Array], parameters: Any = None) -> State:
        """Do one control step, and a reset if it ends the episode.

        Numbers that a task senses in pictures are 0 where no engine draws them.
        """
        moved = self._move(carry, actions, parameters)
        sensed = self._unsensed()
        if self.pauses:
            from surgical_marl.engines.stages import host_stage

            sensed = host_stage(PICTURES, lambda carry: self._unsensed())(moved.carry)
        return self._finish(moved, sensed, parameters)

    def _move(self, carry: Carry, actions: dict[str, Array], parameters: Any) -> Moved:
        """Do the first part of a step: physics, and the goals after it."""
        task, *_ = self._bound(parameters)
        actions, messages = self._part(actions)
        commanded = jnp.clip(jnp.concatenate([actions[agent] for agent in self.agents]), -1.0, 1.0)
        physics, hidden, told = self.plant.command(carry.physics, carry.hidden, actions)
        physics, contacts, arms = self.plant.advance(physics, hidden)
        goal = task.advance(carry.goal, self.control_dt)
        tips = jnp.stack([view.tool_tip for view in arms.values()])
        after = carry._replace(
            physics=physics, hidden=hidden, goal=goal, tips=tips, steps=carry.steps + 1, messages=messages,
            actions=commanded,
        )  # fmt: skip
        return Moved(after, carry.tips, contacts, arms, commanded - carry.actions, told)

    def _part(self, actions: dict[str, Array]) -> tuple[dict[str, Array], Any]:
        """Return what actions command the joints, and the messages in them as in `Carry`."""
        if not self.messages:
            return actions, ()
        ends = {agent: self.num_actions(agent) - self.messages for agent in self.agents}
        said = jnp.stack([actions[agent][end:] for agent, end in ends.items()])
        return {agent: actions[agent][:end] for agent, end in ends.items()}, jnp.clip(said, -1.0, 1.0)

    def _finish(self, moved: Moved, sensed: dict[str, Array], parameters: Any) -> State:
        """Do the rest of a step: observations, reward, and a reset if the step ends the episode."""
        task, max_steps, autoreset = self._bound(parameters)
        carry, contacts = moved.carry, moved.contacts
        arms = {agent: moved.arms[agent] for agent in self.agents}  # JAX sorts them by name
        things, ends = self.plant.things(carry.physics, carry.hidden), np.cumsum(self._sizes)[:-1]
        changes = dict(zip(self.agents, jnp.split(moved.changes, ends), strict=True))
        world = World(arms, carry.goal, sensed, *things, changes=changes)
        terms = task.rewards(world)
        carry = carry._replace(goal=task.remember(world))
        terminated = task.terminated(world)
        truncated = (carry.steps >= max_steps) & ~terminated
        final_observations, final_state = self._observe(task, carry, contacts, arms)

        def begin(_: Any) -> Any:
            fresh, touching, seen = self._start(task, carry.key, carry.episode + 1)
            return fresh, *self._observe(task, fresh, touching, seen)

        going = carry, final_observations, final_state
        done = (terminated | truncated) & autoreset
        next_carry, observations, state = jax.lax.cond(done, begin, lambda going: going, going)
        return State(
            carry=next_carry,
            observations=observations,
            state=state,
            rewards={agent: sum(values.values(), start=jnp.float32(0.0)) for agent, values in terms.items()},
            terminated=terminated,
            truncated=truncated,
            final_observations=final_observations,
            final_state=final_state,
            infos=infos(self.scene, task, world, carry.tips - moved.tips, self.control_dt, terms, moved.told),
            contacts=contacts,
        )

    def _bound(self, parameters: Any) -> tuple[Task, Array, Array]:
        """Return the task with the given parameters, the time limit in steps, and whether an end is a reset too.

        Where `parameters` is None, the environment's own are used.
        """
        known = jax.tree.map(jnp.asarray, self.parameters) if parameters is None else parameters
        return self.task.bound(known["weights"], known["tables"]), known["max_steps"], known["autoreset"]

    def _unsensed(self) -> dict[str, Array]:
        return {name: jnp.float32(0.0) for name in self.task.senses}

    def _untold(self, carry: Carry) -> dict[str, dict[str, Array]]:
        """Return zeros for the infos of action terms, which tell nothing of a reset."""
        still = {agent: jnp.zeros(self.controller.num_actions(agent)) for agent in self.agents}
        told = jax.eval_shape(self.controller.command, carry.physics.ctrl, carry.physics.qpos, still)[1]
        return {agent: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), told[agent]) for agent in self.agents}

    def _start(self, task: Task, key: Array, episode: Array) -> tuple[Carry, Contacts, dict[str, ArmView]]:
        """Return how an episode starts, and the views of the arms there."""
        own = jax.random.fold_in(key, episode)
        start = task.start(own)
        hidden = self.plant.start(jax.random.fold_in(own, HIDDEN), start.qpos)
        poses = self.plant.place(jax.random.fold_in(own, PLACES), start.poses)
        physics = self.plant.at_rest(hidden, start.qpos, poses, start.threads)
        contacts, arms = self.simulator.home_contacts, self.simulator.home_views
        if start.qpos is not None:
            contacts, arms = self.simulator.look(physics)
        tips = jnp.stack([view.tool_tip for view in arms.values()])
        goal = task.remember(World(arms, start.goal, self._unsensed(), *self.plant.things(physics, hidden)))
        silence = jnp.zeros((len(self.agents), self.messages)) if self.messages else ()
        rest = jnp.zeros(sum(self._sizes))
        return Carry(physics, goal, key, episode, jnp.int32(0), tips, hidden, silence, rest), contacts, arms

    def _observe(
        self, task: Task, carry: Carry, contacts: Contacts, arms: dict[str, ArmView]
    ) -> tuple[dict[str, Array], Array]:
        """Return what policies observe, and what critics observe, of arms that are as in `arms`."""
        noise = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(carry.key, carry.episode), NOISE), carry.steps)
        measured = self.plant.measure(carry.physics, carry.hidden, contacts, arms, noise)
        objects, systems = self.plant.things(carry.physics, carry.hidden)
        world = World(measured, carry.goal, objects=objects, systems=systems, messages=carry.messages)
        observations = {agent: seen.read(task, world) for agent, seen in self.observed.items()}
        every = [
            observations[agent] if seen.stated == seen.names else seen.read(task, world, stated=True)
            for agent, seen in self.observed.items()
        ]
        privileged = task.privileged(carry.goal)
        every.append(self._privileged_scale.apply(privileged) if self.scaled else privileged)
        if self.messages:
            every.append(carry.messages.ravel())
        return observations, jnp.concatenate(every)


def alike(env: Env) -> dict[str, list[str]]:
    """Return the agents whose arms are alike and that observe alike, by the name of their arms' type."""
    found: dict[str, list[str]] = {}
    for name, agents in env.scene.types.items():
        kinds: dict[Any, list[str]] = {}
        for agent in agents:
            seen = env.observed[agent]
            names = tuple(_of_type(env, name) for name in seen.names)
            kinds.setdefault((names, tuple(seen.pictures)), []).append(agent)
        found |= {name if k == 0 else f"{name}-seeing-{k + 1}": list(own) for k, own in enumerate(kinds.values())}
    return found


def _of_type(env: Env, term: str) -> str:
    """Return the name of a term; if it is a teammate's, with the type of its arm for the teammate's name."""
    mate, stroke, name = term.partition("/")
    return f"{env.scene.type_of(mate)}/{name}" if stroke else term


def _box(low: np.ndarray, high: np.ndarray) -> spaces.Box:
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def _single(table: np.ndarray) -> np.ndarray:
    """Return a table in the types that kernels use: floats as float32, all else as int32 or bool."""
    if table.dtype == bool:
        return table
    return table.astype(np.float32 if table.dtype.kind == "f" else np.int32)
