"""The true state of arms, which physics moves, and the measured state, which policies observe.

    plant = Plant(simulator, controller)
    hidden = plant.start(key)
    physics, hidden, infos = plant.command(plant.at_rest(hidden), hidden, actions)
    physics, contacts, views = plant.advance(physics, hidden)
    seen = plant.measure(physics, hidden, contacts, views, key)

In a scene without randomisation the plant is the simulator itself: `hidden` is None, and measured values are the true
ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl.control.controller import Controller
from surgical_marl.physics.outputs import ArmView, Contacts, ObjectView
from surgical_marl.physics.randomisation import Factors
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.state import Physics
from surgical_marl.physics.systems.rigid_motion import product
from surgical_marl.scenes.poses import Pose

Views = dict[str, ArmView]

FACTORS, SYSTEMS = 10, 11
"""Numbers by which the keys of free objects and of systems follow from an episode's key."""


class Hidden(NamedTuple):
    """Values that were drawn for an episode, and the memory of motors and latency. No policy observes them."""

    offset: Array
    """Offset of each joint's reading, [nq], rad or m."""
    backlash: Array
    """Play of each joint, [nq], rad or m."""
    stiffness: Array
    """Factor of each actuator's gain, [nu]; `damping` likewise."""
    damping: Array
    friction: Array
    """Factor of each joint's friction, [nv]."""
    payload: Array
    """Mass at each tool tip, [arms], kg."""
    latency: Array
    """Control steps until an action acts, []."""
    motor: Array
    """The newest commands of the motors, on the motors' side of the play, [nu]."""
    pending: Array
    """The last actions of all agents, newest first, [greatest latency, n]."""
    objects: Factors | None = None
    """Factors of the free objects; None if the scene randomises none of them."""
    systems: Array | None = None
    """The key by which systems of plug-ins draw their values; None in a scene without any."""


class Plant:
    """A simulator behind motors, encoders and a network that are not ideal."""

    def __init__(self, simulator: Simulator, controller: Controller) -> None:
        self._simulator, self._controller, self._ranges = simulator, controller, simulator.scene.randomisation
        model = simulator.scene.model
        exact = np.zeros(model.nq, bool)
        exact[simulator.address[simulator.jaws]] = True
        slides = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE

        def each(angle: Any, slide: Any) -> Any:
            return np.where(exact, 0.0, np.where(slides, slide, angle)).astype(np.float32)

        r = self._ranges
        self._offset, self._noise = each(r.offset_angle, r.offset_slide), each(r.noise_angle, r.noise_slide)
        self._positions = simulator.scene.control == "position"
        self._backlash = each(r.backlash_angle, r.backlash_slide) * self._positions

    def start(self, key: Array, qpos: Array | None = None) -> Hidden | None:
        """Draw the hidden values of one episode.

        `key` is used for nothing else. The arms begin at `qpos` [nq], or at home if it is None. Return None if the
        scene randomises nothing.
        """
        r, simulator, scene = self._ranges, self._simulator, self._simulator.scene
        if not r:
            return None
        keys = iter(jax.random.split(key, 7))

        def even(n: Any, low: Any, high: Any) -> Any:
            return jax.random.uniform(next(keys), (n,), jnp.float32, low, high)

        nq, nu, nv, arms = scene.model.nq, scene.model.nu, scene.model.nv, len(scene.agents)
        offset = even(nq, -1.0, 1.0) * self._offset
        believed = jnp.matmul(simulator.moment, offset[simulator.address]) if self._positions else 0.0
        return Hidden(
            offset=offset,
            backlash=even(nq, 0.0, 1.0) * self._backlash,
            stiffness=even(nu, 1 - r.stiffness, 1 + r.stiffness),
            damping=even(nu, 1 - r.damping, 1 + r.damping),
            friction=even(nv, 1 - r.friction, 1 + r.friction),
            payload=even(arms, 0.0, r.payload),
            latency=jax.random.randint(next(keys), (), 0, r.latency + 1),
            motor=(simulator.home if qpos is None else simulator.at(qpos)).ctrl
            + believed,  # so that the arms stay where they are
            pending=jnp.zeros((r.latency, sum(map(self._controller.num_actions, scene.agents)))),
            objects=self._factors(jax.random.fold_in(key, FACTORS)),
            systems=jax.random.fold_in(key, SYSTEMS) if scene.systems else None,
        )

    def _factors(self, key: Array) -> Factors | None:
        """Draw what free objects are like. If their mass isn't drawn, it grows with the cube of their size."""
        r, count = self._ranges, len(self._simulator.scene.free_objects)
        shares = np.array([r.object_size, r.object_mass, r.object_friction], np.float32)
        if not (count and shares.any()):
            return None
        size, mass, friction = 1 + jax.random.uniform(key, (3, count), jnp.float32, -1.0, 1.0) * shares[:, None]
        return Factors(size, mass if r.object_mass else size**3, friction)

    def place(self, key: Array, poses: Mapping[str, Pose]) -> Mapping[str, Pose]:
        """Return poses of free objects, shifted and turned about the vertical as far as the scene randomises them.

        Args:
            key: used for nothing else.
            poses: by name, where a task places objects. The scene places the others.
        """
        shift, angle = self._ranges.object_shift, self._ranges.object_turn
        free = self._simulator.scene.free_objects
        if not (free and (shift or angle)):
            return poses
        reach = np.array([shift, shift, 0.0, angle], np.float32)
        draws = jax.random.uniform(key, (len(free), 4), jnp.float32, -1.0, 1.0) * reach
        placed = {name: Pose(*(np.float32(part) for part in place.pose)) for name, place in free.items()} | dict(poses)

        def upright(angle: Any) -> Any:
            return jnp.stack([jnp.cos(angle / 2), 0.0, 0.0, jnp.sin(angle / 2)])

        return {
            name: Pose(pose.position + own[:3], product(upright(own[3]), pose.quaternion))
            for (name, pose), own in zip(placed.items(), draws, strict=True)
        }

    def at_rest(
        self,
        hidden: Hidden | None,
        qpos: Array | None = None,
        poses: Mapping[str, Pose] | None = None,
        threads: Mapping[str, Array] | None = None,
    ) -> Physics:
        """Return arms and objects at rest.

        Args:
            hidden: what was drawn for the episode.
            qpos: joint positions [nq] of the whole scene; None for home.
            poses: of free objects by name. The others are where the scene places them.
            threads: places of the nodes of loose threads by name, m, [n, 3]. Others lie as the scene says.
        """
        simulator = self.actual(hidden)
        physics = simulator.at(jnp.asarray(simulator.scene.home, jnp.float32) if qpos is None else qpos, poses, threads)
        return physics if hidden is None else physics.with_arms(ctrl=hidden.motor)

    def command(
        self, physics: Physics, hidden: Hidden | None, actions: dict[str, Array]
    ) -> tuple[Physics, Hidden | None, dict[str, dict[str, Array]]]:
        """Return the state and the hidden values after actions have set the commands, and infos of the action terms.

        The actions command the motors, at once or after the latency. The motors move the targets of the joints.
        """
        simulator = self._simulator
        if hidden is None:
            ctrl, infos = self._controller.command(physics.ctrl, physics.qpos, actions)
            return physics.with_arms(ctrl=ctrl), None, infos
        actions, pending = self._delay(actions, hidden)
        read = physics.qpos + hidden.offset + self._play(physics, hidden)
        motor, infos = self._controller.command(hidden.motor, read, actions)
        hidden = hidden._replace(motor=motor, pending=pending)
        if not self._backlash.any():
            return physics.with_arms(ctrl=motor), hidden, infos
        # a joint's target moves once the motor has crossed the play
        half, target = hidden.backlash[simulator.address] / 2, motor[simulator.drives]
        target = jnp.clip(physics.ctrl[simulator.drives], target - half, target + half)
        return physics.with_arms(ctrl=jnp.matmul(simulator.moment, target)), hidden, infos

    def advance(self, physics: Physics, hidden: Hidden | None) -> tuple[Physics, Contacts, Views]:
        """Advance physics by one control step, as `Simulator.advance` does, with the drawn values in place."""
        return self.actual(hidden).advance(physics)

    def things(self, physics: Physics, hidden: Hidden | None) -> tuple[dict[str, ObjectView], dict[str, Any]]:
        """Return the true views of every free object, and of every system of a plug-in, by name."""
        simulator = self.actual(hidden)
        return simulator.objects(physics), simulator.systems(physics)

    def actual(self, hidden: Hidden | None) -> Simulator:
        """Return the simulator with the drawn values in place."""
        if hidden is None:
            return self._simulator
        return self._simulator.varied(
            hidden.stiffness, hidden.damping, hidden.friction, hidden.payload, hidden.offset, hidden.objects,
            hidden.systems,
        )  # fmt: skip

    def measure(self, physics: Physics, hidden: Hidden | None, contacts: Contacts, views: Views, key: Array) -> Views:
        """Return the views as the encoders report them, for arms whose true views are `views`.

        `key` is used for this step alone.
        """
        if hidden is None:
            return views
        noise = jax.random.normal(key, self._noise.shape) * self._noise
        read = physics.qpos + hidden.offset + self._play(physics, hidden) + noise
        return self._simulator.view(physics.with_arms(qpos=read, ctrl=hidden.motor), contacts)

    def _delay(self, actions: dict[str, Array], hidden: Hidden) -> tuple[dict[str, Array], Array]:
        """Return the actions that act now, and those that are stored for later steps."""
        agents = self._simulator.scene.agents
        newest = jnp.concatenate([jnp.clip(actions[agent], -1.0, 1.0) for agent in agents])
        known = jnp.concatenate([newest[None], hidden.pending])
        ends = np.cumsum([actions[agent].shape[-1] for agent in agents])[:-1]
        now = jnp.split(known[hidden.latency], ends)
        return dict(zip(agents, now, strict=True)), known[:-1]

    def _play(self, physics: Physics, hidden: Hidden) -> Array:
        """Return how far motors are ahead of their joints, [nq]."""
        simulator, ahead = self._simulator, jnp.zeros(len(self._backlash))
        if not self._backlash.any():
            return ahead
        return ahead.at[simulator.address].set((hidden.motor - physics.ctrl)[simulator.drives])
