"""One environment, in pure JAX: `reset(key) -> State`, `step(carry, actions) -> State`.

    env = Env("reach", "bimanual_psm")
    state = env.reset(jax.random.PRNGKey(0))
    state = env.step(state.carry, {agent: jnp.zeros(env.num_actions(agent)) for agent in env.agents})

This is the one place where a step is written. Engines run it for many environments; interfaces show it to others. An
environment that ends is reset within the same step: `observations` then belong to the new episode,
`final_observations` to the one that ended.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from gymnasium import spaces
from jax import Array

from surgical_marl.content import list_tasks, unknown
from surgical_marl.runtime import prepare_jax
from surgical_marl.scene import DECIMATION, load_scene


class Physics(NamedTuple):
    """What MuJoCo needs to go on. All that lives between two steps: everything else follows from it."""

    qpos: Array
    qvel: Array
    qacc_warmstart: Array
    ctrl: Array
    """Command of every actuator: position target, velocity or torque."""


class Carry(NamedTuple):
    """What the next step reads. Random numbers come from `key` and the `episode` counter alone."""

    physics: Physics
    goal: Any
    key: Array
    episode: Array
    steps: Array


class ArmView(NamedTuple):
    """What a task sees of one arm in the newest state. Base frame; SI units."""

    qpos: Array
    """Positions of the actuated joints, [n]."""
    qvel: Array
    command: Array
    """Position targets (or the last velocity or torque command), [n]."""
    tool_tip: Array
    """[3]"""
    nearest_tip: Array
    """From this tool tip to that of the nearest other arm, [3]; zero if there is none."""
    min_distance: Array
    """Least distance to any other arm, []; inf if there is none."""
    collision: Array
    """Whether it touched another arm during the step, []."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """The outcome of a reset or a step. Dicts are keyed by agent."""

    carry: Carry
    observations: dict[str, Array]
    """[d] each, of the new episode where one ended."""
    state: Array
    """What a centralised critic sees: all observations, one after the other."""
    rewards: dict[str, Array]
    terminated: Array
    truncated: Array
    """The time limit was reached and the episode did not terminate."""
    final_observations: dict[str, Array]
    """Of this step's episode, even if it ended."""
    final_state: Array
    infos: dict[str, dict[str, Array]]
    """tip_error (m), success, collision, min_distance (m) of this step's episode, even if it ended."""


class Env:
    """A task on a scene, for one environment.

    Args:
        task: a name of `list_tasks()`.
        scene: a name of `list_scenes()` or the path of a scene file.
        control: how actions drive the joints: "position" moves position targets, "velocity" and "torque" command
            those. Actions are in [-1, 1]; 1 is the joint's `speed`, or its effort limit for torque.
        max_steps: control steps until truncation; the task's own number if None.

    Raises:
        ValueError: naming what is unknown or out of range.
    """

    def __init__(
        self, task: str = "reach", scene: str = "bimanual_psm", control: str = "position", max_steps: int | None = None
    ) -> None:
        if task not in list_tasks():
            raise unknown("task", task, list_tasks())
        if max_steps is not None and (isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1):
            raise ValueError(f"max_steps must be a whole number of at least 1, not {max_steps!r}")
        prepare_jax()
        from importlib import import_module

        from mujoco import mjx

        self.scene = load_scene(scene, control)
        self.task_name = task
        self.task = import_module(f"surgical_marl.tasks.{task}").Task(self.scene)
        self.max_steps = max_steps or self.task.max_steps
        self.agents = self.scene.agents
        self.control_dt = DECIMATION * self.scene.model.opt.timestep
        self._mjx = mjx
        self._model = mjx.put_model(self.scene.model)
        self._index_model()
        self._home_views = self._measure_home()
        self._bounds = {agent: self.task.bounds(agent) for agent in self.agents}

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
        low, high = (np.concatenate([self._bounds[agent][i] for agent in self.agents]) for i in (0, 1))
        return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)

    def reset(self, key: Array, episode: Array | int = 0) -> State:
        """The start of an episode. `key` is raw (uint32 [2], as of `jax.random.PRNGKey`) and numbers its episodes."""
        carry = self._start(key, jnp.int32(episode))
        observations, state = self._observe(self._home_views, carry.goal)
        return State(
            carry=carry,
            observations=observations,
            state=state,
            rewards={agent: jnp.float32(0.0) for agent in self.agents},
            terminated=jnp.bool_(False),
            truncated=jnp.bool_(False),
            final_observations=observations,
            final_state=state,
            infos=self._infos(self._home_views, carry.goal),
        )

    def step(self, carry: Carry, actions: dict[str, Array]) -> State:
        """One control step, and a reset if it ends the episode."""
        ctrl = self._command(carry.physics.ctrl, actions)
        physics, distances = self._advance(carry.physics._replace(ctrl=ctrl))
        views = self._views(physics, distances)
        rewards = self.task.rewards(views, carry.goal)
        terminated = self.task.terminated(views, carry.goal)
        steps = carry.steps + 1
        truncated = (steps >= self.max_steps) & ~terminated
        final_observations, final_state = self._observe(views, carry.goal)
        going = carry._replace(physics=physics, steps=steps)
        fresh = self._start(carry.key, carry.episode + 1)
        fresh_observations, fresh_state = self._observe(self._home_views, fresh.goal)
        done = terminated | truncated
        pick = lambda new, old: jnp.where(done, new, old)  # noqa: E731
        return State(
            carry=jax.tree.map(pick, fresh, going),
            observations=jax.tree.map(pick, fresh_observations, final_observations),
            state=pick(fresh_state, final_state),
            rewards=rewards,
            terminated=terminated,
            truncated=truncated,
            final_observations=final_observations,
            final_state=final_state,
            infos=self._infos(views, carry.goal),
        )

    def _index_model(self) -> None:
        """Where each agent's joints and sites stand in the model's arrays, and what an action does to a command."""
        model, jaws = self.scene.model, []
        leaders: list[int] = []
        speed, effort, low, high, opened, closed = [], [], [], [], [], []
        names = [model.actuator(i).name for i in range(model.nu)]
        for agent, mount in self.scene.mounts.items():
            for joint in mount.arm.joints:
                leaders.append(names.index(f"{agent}/{joint.leader}"))
                is_jaw = mount.arm.jaw is not None and joint.leader == mount.arm.jaw.joint
                jaws.append(is_jaw)
                speed.append(joint.drive.speed)
                effort.append(joint.effort)
                low.append(joint.lower)
                high.append(joint.upper)
                opened.append(mount.arm.jaw.open if is_jaw and mount.arm.jaw else 0.0)
                closed.append(mount.arm.jaw.closed if is_jaw and mount.arm.jaw else 0.0)
        self._leaders, self._jaws = np.array(leaders), np.array(jaws)
        self._speed, self._effort = np.array(speed, np.float32), np.array(effort, np.float32)
        self._low, self._high = np.array(low, np.float32), np.array(high, np.float32)
        self._open, self._closed = np.array(opened, np.float32), np.array(closed, np.float32)
        home = self.scene.home
        self._home_command = home if self.scene.control == "position" else np.where(self._jaws, home, 0.0)
        self._qpos_index = {agent: self.scene.qpos_index(agent) for agent in self.agents}
        self._actuators = {
            agent: np.array([names.index(f"{agent}/{joint.name}") for joint in mount.arm.actuated])
            for agent, mount in self.scene.mounts.items()
        }
        self._sites = {agent: model.site(f"{agent}/tool_tip").id for agent in self.agents}
        data = self._mjx.make_data(self.scene.model)
        self._data = data
        if model.npair:
            owner = {
                geom: agent for agent in self.agents for geom in range(model.ngeom)
                if model.geom(geom).name.startswith(f"{agent}/")
            }  # fmt: skip
            # MJX sorts contacts in an order of its own: ask it which geoms each is between
            pairs = np.asarray(jax.jit(self._mjx.collision)(self._model, data)._impl.contact.geom)
            self._pairs = {
                agent: np.flatnonzero([agent in (owner[a], owner[b]) for a, b in pairs]) for agent in self.agents
            }

    def _measure_home(self) -> dict[str, ArmView]:
        """What tasks see where every episode starts, by C MuJoCo: constants, so that a step computes no second pose."""
        model = self.scene.model
        data = mujoco.MjData(model)
        data.qpos[:] = self.scene.home
        mujoco.mj_kinematics(model, data)
        distances = [
            (model.geom(a).name, model.geom(b).name, mujoco.mj_geomDistance(model, data, a, b, 100.0, None))
            for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)
        ]
        views = {}
        for agent, mount in self.scene.mounts.items():
            tip = data.site_xpos[self._sites[agent]]
            offsets = [data.site_xpos[self._sites[other]] - tip for other in self.agents if other != agent]
            nearest = min(offsets, key=np.linalg.norm, default=np.zeros(3))
            near = min((d for *names, d in distances if any(n.startswith(f"{agent}/") for n in names)), default=np.inf)
            qpos = self.scene.home[self._qpos_index[agent]]
            start = {
                "qpos": qpos,
                "qvel": np.zeros_like(qpos),
                "command": self._home_command[self._actuators[agent]],
                "tool_tip": (tip - mount.position) @ mount.rotation,
                "nearest_tip": nearest @ mount.rotation,
                "min_distance": near,
            }
            views[agent] = ArmView(
                **{key: jnp.asarray(value, jnp.float32) for key, value in start.items()}, collision=jnp.bool_(near < 0)
            )
        return views

    def _start(self, key: Array, episode: Array) -> Carry:
        still = jnp.zeros(self.scene.model.nv, jnp.float32)
        home, command = (jnp.asarray(a, jnp.float32) for a in (self.scene.home, self._home_command))
        return Carry(
            physics=Physics(home, still, still, command),
            goal=self.task.goal(jax.random.fold_in(key, episode)),
            key=key,
            episode=episode,
            steps=jnp.int32(0),
        )

    def _command(self, ctrl: Array, actions: dict[str, Array]) -> Array:
        """The next command of every actuator. A jaw moves to open or closed at its speed, whatever the mode."""
        own = jnp.zeros(self.scene.model.nu, jnp.float32)
        for agent in self.agents:
            own = own.at[self._actuators[agent]].set(jnp.clip(actions[agent], -1.0, 1.0))
        action = own[self._leaders]
        reach = self._speed * np.float32(self.control_dt)
        if self.scene.control == "position":
            command = jnp.clip(ctrl + action * reach, self._low, self._high)
        else:
            command = action * (self._speed if self.scene.control == "velocity" else self._effort)
        jaw = ctrl + jnp.clip(jnp.where(action > 0, self._open, self._closed) - ctrl, -reach, reach)
        return jnp.where(self._jaws, jaw, command)

    def _advance(self, physics: Physics) -> tuple[Physics, Array]:
        """A control step of physics, and the least distance of each contact pair on the way (before its last step)."""

        def substep(now: Physics, _: None) -> tuple[Physics, Array]:
            data = self._mjx.forward(self._model, self._data.replace(**now._asdict()))
            distances = self._contact_distances(data)
            data = self._integrate(data)
            return Physics(data.qpos, data.qvel, data.qacc_warmstart, now.ctrl), distances

        physics, distances = jax.lax.scan(substep, physics, None, length=DECIMATION)
        return physics, distances.min(axis=0)

    def _integrate(self, data: Any) -> Any:
        """The implicitfast step. An actuator at its effort limit can't damp any more, so its damping leaves the
        implicit matrix, as in C MuJoCo; `mjx.step` would keep it there and brake each joint that moves at full effort.
        """
        from mujoco.mjx._src.forward import implicit

        model = self._model
        low, high = model.actuator_forcerange[:, 0], model.actuator_forcerange[:, 1]
        saturated = (data.actuator_force <= low) | (data.actuator_force >= high)
        biasprm = jnp.where(saturated[:, None], 0.0, model.actuator_biasprm)
        return implicit(model.replace(actuator_biasprm=biasprm), data)

    def _contact_distances(self, data: Any) -> Array:
        return data._impl.contact.dist if self.scene.model.npair else jnp.zeros(0, jnp.float32)

    def _views(self, physics: Physics, before: Array) -> dict[str, ArmView]:
        """The arms in this very state. MuJoCo leaves tips and distances one step behind its `qpos`: compute them
        anew."""
        data = self._data.replace(qpos=physics.qpos, qvel=physics.qvel)
        data = self._mjx.kinematics(self._model, data)
        if self.scene.model.npair:
            data = self._mjx.collision(self._model, data)
        now = self._contact_distances(data)
        views = {}
        for agent in self.agents:
            mount = self.scene.mounts[agent]
            rotation = np.asarray(mount.rotation, np.float32)
            tip = data.site_xpos[self._sites[agent]]
            others = [data.site_xpos[self._sites[other]] for other in self.agents if other != agent]
            if others:
                offsets = jnp.stack(others) - tip
                nearest = offsets[jnp.argmin(jnp.sum(offsets**2, axis=-1))]
                distance = now[self._pairs[agent]].min()
                collision = jnp.minimum(distance, before[self._pairs[agent]].min()) < 0
            else:
                nearest, distance, collision = jnp.zeros(3), jnp.float32(jnp.inf), jnp.bool_(False)
            index = self._qpos_index[agent]
            views[agent] = ArmView(
                qpos=physics.qpos[index],
                qvel=physics.qvel[index],  # every joint has one position and one velocity: the indices agree
                command=physics.ctrl[self._actuators[agent]],
                tool_tip=(tip - np.asarray(mount.position, np.float32)) @ rotation,
                nearest_tip=nearest @ rotation,
                min_distance=distance,
                collision=collision,
            )
        return views

    def _observe(self, views: dict[str, ArmView], goal: Any) -> tuple[dict[str, Array], Array]:
        observations = {
            agent: jnp.clip(observation.astype(jnp.float32), *(b.astype(np.float32) for b in self._bounds[agent]))
            for agent, observation in self.task.observations(views, goal).items()
        }
        return observations, jnp.concatenate([observations[agent] for agent in self.agents])

    def _infos(self, views: dict[str, ArmView], goal: Any) -> dict[str, dict[str, Array]]:
        errors = self.task.tip_errors(views, goal)
        return {
            agent: {
                "tip_error": errors[agent],
                "success": errors[agent] < self.task.success,
                "collision": view.collision,
                "min_distance": view.min_distance,
            }
            for agent, view in views.items()
        }
