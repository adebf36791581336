"""The physics of a scene in pure JAX, for one environment: commands in, newest state and contacts out.

    simulator = Simulator(load_scene("bimanual_psm"))
    physics = simulator.home.with_arms(ctrl=commands)         # [nu], those of `surgical_marl.control`
    physics, contacts, views = simulator.advance(physics)

docs/physics.md says how a step is computed and compares it with C MuJoCo.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl.content import unknown
from surgical_marl.physics.outputs import ArmView, Contacts, ObjectView, Touch
from surgical_marl.physics.randomisation import Factors
from surgical_marl.physics.state import ARMS, ATTACHMENTS, RIGID_BODIES, ArmState, Physics
from surgical_marl.physics.step import Step
from surgical_marl.scenes.poses import Pose
from surgical_marl.scenes.scene import Scene
from surgical_marl.scenes.timing import DECIMATION


class Simulator:
    """The physics of one scene.

    One control step is `decimation` physics steps. `home` is the state that every episode starts with, and `home_views`
    is what tasks see there.
    """

    def __init__(self, scene: Scene, decimation: int = DECIMATION) -> None:
        self.scene = scene
        self.step = Step(scene)
        self.decimation, self.control_dt = decimation, decimation * scene.model.opt.timestep
        self._index_joints()
        self._index_pairs()
        self.home_contacts, self.home_views = self._measure_home()

    @property
    def home(self) -> Physics:
        """Return all arms at home, at rest."""
        return self.at(jnp.asarray(self.scene.home, jnp.float32))

    def at(
        self, qpos: Array, poses: Mapping[str, Pose] | None = None, threads: Mapping[str, Array] | None = None
    ) -> Physics:
        """Return arms and objects at rest.

        Args:
            qpos: joint positions [nq] of the scene; the commands keep them there.
            poses: of free objects by name. The others are where the scene places them.
            threads: places of the nodes of loose threads by name, m, [n, 3]. Others lie as the scene says.

        Raises:
            ValueError: a name that is not that of a free object, or of a loose thread.
        """
        for kind, given, known in (
            ("free object", poses, self.scene.free_objects),
            ("thread", threads, self.step.systems),
        ):
            for name in given or {}:
                if name not in known:
                    raise unknown(f"{kind} of scene {self.scene.name!r}", name, list(known))
        states: dict[str, Any] = {ARMS: self.step.arms.start(qpos, self._holding(qpos))}
        if self.step.bodies:
            states[RIGID_BODIES] = self.step.bodies.start(poses or {})
            if self.step.attachments:
                poses = self.step.arms.dynamics.pose(qpos)
                states[ATTACHMENTS] = self.step.attachments.start(poses, states[RIGID_BODIES].bodies)
        return Physics(states | self.step.start_systems(states.get(RIGID_BODIES), threads or {}))

    def _holding(self, qpos: Any) -> Any:
        """Return the commands [nu] that keep the arms where they are."""
        joints = qpos[self.address]
        if self.scene.control != "position":
            joints = joints * self.jaws  # a jaw is under position control in every mode
        return self.moment @ joints

    def advance(self, physics: Physics) -> tuple[Physics, Contacts, dict[str, ArmView]]:
        """Advance physics by one control step, and return it with the contacts and views at its end.

        MuJoCo leaves tips and distances one physics step behind its `qpos`, so they are computed anew.
        """
        # A reverse derivative computes each physics step again, instead of keeping all that is in it: that takes less
        # time, to compile and to run, and far less memory. Without a derivative it changes nothing.
        step = jax.checkpoint(self.step)

        def substep(state: tuple[Physics, Touch], _: None) -> tuple[tuple[Physics, Touch], None]:
            return step(*state), None

        (physics, touch), _ = jax.lax.scan(substep, (physics, self.untouched), None, length=self.decimation)
        tools, distance = self._look(physics.qpos)
        contacts = Contacts(distance, jnp.maximum(touch.penetration, -distance), touch.force, touch.overflow)
        handled = touch.handled if self.step.bodies else None
        return physics, contacts, self._view(jnp, physics, tools, contacts, handled)

    @property
    def untouched(self) -> Touch:
        """Return the touch of a control step so far, at its beginning."""
        none = jnp.zeros(self.step.pairs.count, jnp.float32)
        arms = len(self.scene.agents) if self.step.bodies else 0
        return Touch(none, none, jnp.zeros((2, arms), jnp.float32), jnp.int32(0))

    def objects(self, physics: Physics) -> dict[str, ObjectView]:
        """Return the view of every free object of the scene, by name."""
        bodies = self.step.bodies
        return bodies.view(physics.rigid_bodies.bodies) if bodies else {}

    def systems(self, physics: Physics) -> dict[str, Any]:
        """Return the view of every system of a plug-in in the scene, by name."""
        return {name: system.view(physics.systems[name]) for name, system in self.step.systems.items()}

    def varied(
        self, stiffness: Array, damping: Array, friction: Array, payload: Array, offset: Array,
        objects: Factors | None = None, systems: Array | None = None,
    ) -> Simulator:  # fmt: skip
        """Return a copy of this simulator whose arms and objects differ from their models.

        Args:
            stiffness: factors of the stiffness of every actuator, [nu].
            damping: factors of the damping of every actuator, [nu].
            friction: factors of the friction of every joint, [nv].
            payload: masses at the tool tips, [arms], kg; used only if the scene has room for them.
            offset: by how much the controllers of joints misread their positions, [nq], rad or m.
            objects: factors of the free objects; None if they are as in their files.
            systems: a key by which systems of plug-ins draw their values; None if they are as in the scene file.
        """
        varied, bodies = copy.copy(self), self.step.bodies
        misread = self.moment @ offset[self.address]
        arms = self.step.arms.randomise(stiffness, damping, friction, payload, misread)
        if objects is not None and bodies:
            bodies = bodies.randomise(objects)
        drawn = self.step.systems
        if systems is not None:
            drawn = {n: own.randomise(jax.random.fold_in(systems, i)) for i, (n, own) in enumerate(drawn.items())}
        varied.step = self.step.varied(arms, bodies, drawn)
        return varied

    def look(self, physics: Physics) -> tuple[Contacts, dict[str, ArmView]]:
        """Return contacts and views of arms at rest, without penetrations and forces."""
        tools, distance = self._look(physics.qpos)
        contacts = Contacts(distance, jnp.maximum(-distance, 0.0), jnp.zeros_like(distance), jnp.int32(0))
        return contacts, self._view(jnp, physics, tools, contacts)

    def view(self, physics: Physics, contacts: Contacts) -> dict[str, ArmView]:
        """Return what tasks see at a posture.

        Distances are computed anew. Penetrations and forces are those in `contacts`, from the step before.
        """
        tools, distance = self._look(physics.qpos)
        return self._view(jnp, physics, tools, contacts._replace(distance=distance))

    def _look(self, qpos: Array) -> tuple[tuple[Array, Array], Array]:
        """Return tool tips [arms, 3] and their axes [arms, 3, 3] in the world, and the distance of every pair."""
        data = self.step.arms.dynamics.pose(qpos)
        sites = np.array(list(self._sites.values()))
        return (data.site_xpos[sites], data.site_xmat[sites]), self.step.pairs.distance(data.geom_xpos, data.geom_xmat)

    def _view(
        self, xp: Any, physics: Physics, tools: tuple[Any, Any], contacts: Contacts, handled: Any = None
    ) -> dict[str, ArmView]:
        """Return the views, computed with the array library `xp`.

        Args:
            xp: numpy or JAX's.
            physics: the state.
            tools: tool tips in the world, [arms, 3], and their axes, [arms, 3, 3].
            contacts: of arms with each other.
            handled: as in `Touch`, [2, arms]; None without any objects.
        """
        views = {}
        tips, axes = tools
        most = np.zeros((2, len(self.scene.agents)), np.float32) if handled is None else handled
        for i, agent in enumerate(self.scene.agents):
            mount, touching = self.scene.mounts[agent], self._touching[agent]
            nearest = xp.zeros(3)
            if len(tips) > 1:
                offsets = tips[np.arange(len(tips)) != i] - tips[i]
                nearest = offsets[xp.argmin(xp.sum(offsets**2, axis=-1))]
            near = self._between[agent]
            views[agent] = ArmView(
                qpos=physics.qpos[self._joints[agent]],
                qvel=physics.qvel[self._joints[agent]],  # each position has one velocity, so the indices agree
                command=physics.ctrl[self._actuators[agent]],
                tool_tip=(tips[i] - mount.position.astype(tips.dtype)) @ mount.rotation.astype(tips.dtype),
                tool_axes=mount.rotation.T.astype(tips.dtype) @ axes[i],
                nearest_tip=nearest @ mount.rotation.astype(tips.dtype),
                min_distance=contacts.distance[near].min(initial=np.inf),
                collision=contacts.penetration[touching].max(initial=0.0) > 0,
                contact_force=contacts.force[touching].max(initial=most[0, i]),
                bump_force=contacts.force[touching].max(initial=most[1, i]),
                contact_overflow=contacts.overflow,
                handles=self.step.grips.view(physics.rigid_bodies.grips, i) if self.step.bodies else {},
            )
        return views

    def _index_joints(self) -> None:
        """Index each agent's joints, actuators and sites in the model's arrays."""
        scene, model = self.scene, self.scene.model
        names = [model.actuator(i).name for i in range(model.nu)]
        # actuators of joints are in the URDF's order, `qpos` is in that of the tree
        self.drives = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        self.address = model.jnt_qposadr[model.actuator_trnid[self.drives, 0]]
        self.moment = np.asarray(scene.moment[:, self.address], np.float32)
        self.jaws = np.array(
            [
                bool(mount.arm.jaw and joint.leader == mount.arm.jaw.joint)
                for mount in scene.mounts.values()
                for joint in mount.arm.joints
            ]
        )
        self._joints = {agent: scene.qpos_index(agent) for agent in scene.agents}
        self._actuators = {
            agent: np.array([names.index(f"{agent}/{joint.name}") for joint in mount.arm.actuated])
            for agent, mount in scene.mounts.items()
        }
        self._sites = {agent: model.site(f"{agent}/tool_tip").id for agent in scene.agents}

    def _index_pairs(self) -> None:
        """Index the pairs that concern each agent."""
        owners = [tuple(name.split("/")[0] for name in pair) for pair in self.scene.pairs]
        self._touching = {a: np.flatnonzero([a in pair for pair in owners]) for a in self.scene.agents}
        self._between = {
            a: np.flatnonzero([a in pair and len(set(pair)) > 1 for pair in owners]) for a in self.scene.agents
        }

    def _measure_home(self) -> tuple[Contacts, dict[str, ArmView]]:
        """Compute contacts and views at home with C MuJoCo: as constants they cost nothing in a reset."""
        model = self.scene.model
        data = mujoco.MjData(model)
        data.qpos[:] = self.scene.home
        mujoco.mj_kinematics(model, data)
        ids = zip(model.pair_geom1, model.pair_geom2, strict=True)
        distance = np.array([mujoco.mj_geomDistance(model, data, a, b, 100.0, None) for a, b in ids])
        still = np.zeros(model.nv)
        contacts: Any = Contacts(distance, np.maximum(-distance, 0.0), 0.0 * distance, np.int32(0))  # type: ignore[arg-type]
        physics: Any = Physics({ARMS: ArmState(self.scene.home, still, still, self._holding(self.scene.home))})  # type: ignore[arg-type]
        if self.step.bodies:
            physics = physics.with_systems(rigid_bodies=self.step.bodies.start({}))
        sites = list(self._sites.values())
        views = self._view(np, physics, (data.site_xpos[sites], data.site_xmat[sites].reshape(-1, 3, 3)), contacts)
        kinds = {"b": jnp.bool_, "i": jnp.int32}

        def single(x: Any) -> Any:
            return jnp.asarray(x, kinds.get(x.dtype.kind, jnp.float32))

        # one by one: JAX would sort the agents by name
        return jax.tree.map(single, contacts), {agent: jax.tree.map(single, view) for agent, view in views.items()}
