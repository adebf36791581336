"""The physics of a scene in pure JAX, for one environment: commands in, newest state and contacts out.

    simulator = Simulator(load_scene("bimanual_psm"))
    physics = simulator.command(simulator.home, actions)
    physics, contacts, views = simulator.advance(physics)

This is the one module that knows MJX. docs/physics.md says how a step is computed and compares it with C MuJoCo.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl.runtime import prepare_jax
from surgical_marl.scene import DECIMATION, Scene

SOLVER_ITERATIONS, LINE_SEARCH_ITERATIONS = 3, 4
"""What limits, friction and contacts take to be solved nearly as well as by C MuJoCo, which goes on until they are:
docs/physics.md compares."""


class Physics(NamedTuple):
    """What MuJoCo needs to go on. All that lives between two steps: everything else follows from it."""

    qpos: Array
    qvel: Array
    qacc_warmstart: Array
    ctrl: Array
    """Command of every actuator: position target, velocity or torque."""


class Contacts(NamedTuple):
    """The pairs of geoms that can touch, in the order of `Scene.pairs`, [P] each."""

    distance: Array
    """Signed distance in the newest state, m."""
    penetration: Array
    """The deepest overlap during the control step, m; 0 without any."""
    force: Array
    """The largest normal force during the control step, N."""


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
    """Whether it touched another arm or itself during the step, []."""
    contact_force: Array
    """The largest normal force on it during the step, N, []."""


class Simulator:
    """MJX on one scene. `home` is the physics that every episode starts with, `home_views` what tasks see there."""

    def __init__(self, scene: Scene) -> None:
        prepare_jax()
        from mujoco import mjx

        self.scene, self._mjx = scene, mjx
        model = copy.copy(scene.model)
        model.opt.ls_iterations = LINE_SEARCH_ITERATIONS
        self._model, self._data = mjx.put_model(model), mjx.make_data(scene.model)
        self.control_dt = DECIMATION * scene.model.opt.timestep
        self._index_joints()
        self._index_pairs()
        start = scene.home[self._address]
        start = start if scene.control == "position" else np.where(self._jaws, start, 0.0)
        self._home = np.asarray(scene.home, np.float32), np.asarray(start, np.float32)
        self.home_contacts, self.home_views = self._measure_home()

    @property
    def home(self) -> Physics:
        """All arms at home, at rest."""
        qpos, ctrl = map(jnp.asarray, self._home)
        still = jnp.zeros(self.scene.model.nv, jnp.float32)
        return Physics(qpos, still, still, ctrl)

    def command(self, physics: Physics, actions: dict[str, Array]) -> Physics:
        """The next command of every actuator. A jaw moves to open or closed at its speed, whatever the mode.

        A position target leads its joint by no more than full effort at full speed takes: one that is held up would
        wind up its target, and race after it once free.
        """
        ctrl, own = physics.ctrl, jnp.zeros(self.scene.model.nu, jnp.float32)
        for agent in self.scene.agents:
            own = own.at[self._actuators[agent]].set(jnp.clip(actions[agent], -1.0, 1.0))
        action = own[self._leaders]
        reach = self._speed * np.float32(self.control_dt)
        if self.scene.control == "position":
            now = physics.qpos[self._address]
            lead = jnp.clip(ctrl + action * reach - now, -self._lead, self._lead)
            command = jnp.clip(now + lead, self._low, self._high)
        else:
            command = action * (self._speed if self.scene.control == "velocity" else self._effort)
        jaw = ctrl + jnp.clip(jnp.where(action > 0, self._open, self._closed) - ctrl, -reach, reach)
        return physics._replace(ctrl=jnp.where(self._jaws, jaw, command))

    def advance(self, physics: Physics) -> tuple[Physics, Contacts, dict[str, ArmView]]:
        """A control step of physics, and what is seen where it ends. MuJoCo leaves tips and distances one physics step
        behind its `qpos`, so they are computed anew."""

        def substep(now: Physics, _: None) -> tuple[Physics, tuple[Array, Array]]:
            data = self._forward(self._data.replace(**now._asdict()))
            contact = self._distances(data), self._forces(data)
            data = self._integrate(data)
            return Physics(data.qpos, data.qvel, data.qacc_warmstart, now.ctrl), contact

        physics, (distances, forces) = jax.lax.scan(substep, physics, None, length=DECIMATION)
        data = self._mjx.kinematics(self._model, self._data.replace(qpos=physics.qpos))
        if self.scene.model.npair:
            data = self._mjx.collision(self._model, data)
        distance = self._distances(data)
        deepest = jnp.minimum(distances.min(axis=0), distance)
        contacts = Contacts(distance, jnp.maximum(-deepest, 0.0), forces.max(axis=0))
        tips = data.site_xpos[np.array(list(self._sites.values()))]
        return physics, contacts, self._view(jnp, physics, tips, contacts)

    def _view(self, xp: Any, physics: Physics, tips: Any, contacts: Contacts) -> dict[str, ArmView]:
        """Views by the array library `xp` from tool tips [arms, 3] in the world."""
        views = {}
        for i, agent in enumerate(self.scene.agents):
            mount, touching = self.scene.mounts[agent], self._touching[agent]
            nearest = xp.zeros(3)
            if len(tips) > 1:
                offsets = tips[np.arange(len(tips)) != i] - tips[i]
                nearest = offsets[xp.argmin(xp.sum(offsets**2, axis=-1))]
            near = self._between[agent]
            views[agent] = ArmView(
                qpos=physics.qpos[self._joints[agent]],
                qvel=physics.qvel[self._joints[agent]],  # one velocity a position: the indices agree
                command=physics.ctrl[self._actuators[agent]],
                tool_tip=(tips[i] - mount.position.astype(tips.dtype)) @ mount.rotation.astype(tips.dtype),
                nearest_tip=nearest @ mount.rotation.astype(tips.dtype),
                min_distance=contacts.distance[near].min(initial=np.inf),
                collision=contacts.penetration[touching].max(initial=0.0) > 0,
                contact_force=contacts.force[touching].max(initial=0.0),
            )
        return views

    def _index_joints(self) -> None:
        """Where each agent's joints and sites stand in the model's arrays, and what an action does to a command."""
        scene, model = self.scene, self.scene.model
        names = [model.actuator(i).name for i in range(model.nu)]
        rows = [
            (names.index(f"{agent}/{joint.leader}"), bool(arm.jaw and joint.leader == arm.jaw.joint), joint, arm.jaw)
            for agent, arm in ((agent, mount.arm) for agent, mount in scene.mounts.items())
            for joint in arm.joints
        ]
        single = np.float32
        self._leaders, self._jaws = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
        self._speed = np.array([joint.drive.speed for _, _, joint, _ in rows], single)
        self._effort = np.array([joint.effort for _, _, joint, _ in rows], single)
        pd = [(joint.effort, joint.drive) for _, _, joint, _ in rows]
        self._lead = np.array([(effort + d.damping * d.speed) / d.stiffness for effort, d in pd], single)
        self._low = np.array([joint.lower for _, _, joint, _ in rows], single)
        self._high = np.array([joint.upper for _, _, joint, _ in rows], single)
        self._open = np.array([jaw.open if is_jaw and jaw else 0.0 for _, is_jaw, _, jaw in rows], single)
        self._closed = np.array([jaw.closed if is_jaw and jaw else 0.0 for _, is_jaw, _, jaw in rows], single)
        # actuators stand in the URDF's order of joints, `qpos` in that of the tree
        self._address = model.jnt_qposadr[model.actuator_trnid[:, 0]]
        self._joints = {agent: scene.qpos_index(agent) for agent in scene.agents}
        self._actuators = {
            agent: np.array([names.index(f"{agent}/{joint.name}") for joint in mount.arm.actuated])
            for agent, mount in scene.mounts.items()
        }
        self._sites = {agent: model.site(f"{agent}/tool_tip").id for agent in scene.agents}

    def _index_pairs(self) -> None:
        """Where MJX keeps each pair of `Scene.pairs`: it sorts contacts in an order of its own."""
        scene = self.scene
        self._order, self._rows = np.zeros(0, int), np.zeros(0, int)
        if scene.model.npair:
            contact = jax.jit(lambda data: self._mjx.collision(self._model, data)._impl.contact)(self._data)
            found = [tuple(sorted(pair)) for pair in np.asarray(contact.geom).tolist()]
            ids = zip(scene.model.pair_geom1.tolist(), scene.model.pair_geom2.tolist(), strict=True)
            self._order = np.array([found.index(tuple(sorted(pair))) for pair in ids])
            self._rows = np.asarray(contact.efc_address)[self._order]
        owners = [tuple(name.split("/")[0] for name in pair) for pair in scene.pairs]
        self._touching = {a: np.flatnonzero([a in pair for pair in owners]) for a in scene.agents}
        self._between = {a: np.flatnonzero([a in pair and len(set(pair)) > 1 for pair in owners]) for a in scene.agents}

    def _measure_home(self) -> tuple[Contacts, dict[str, ArmView]]:
        """Contacts and views at home, by C MuJoCo: constants, so that a reset within a step computes no second pose."""
        model = self.scene.model
        data = mujoco.MjData(model)
        data.qpos[:] = self.scene.home
        mujoco.mj_kinematics(model, data)
        ids = zip(model.pair_geom1, model.pair_geom2, strict=True)
        distance = np.array([mujoco.mj_geomDistance(model, data, a, b, 100.0, None) for a, b in ids])
        still = np.zeros(model.nv)
        contacts: Any = Contacts(distance, np.maximum(-distance, 0.0), 0.0 * distance)  # type: ignore[arg-type]
        physics: Any = Physics(self.scene.home, still, still, self._home[1])  # type: ignore[arg-type]
        views = self._view(np, physics, data.site_xpos[list(self._sites.values())], contacts)
        single = lambda x: jnp.asarray(x, jnp.bool_ if x.dtype == bool else jnp.float32)  # noqa: E731
        # one by one: JAX would sort the agents by name
        return jax.tree.map(single, contacts), {agent: jax.tree.map(single, view) for agent, view in views.items()}

    def _distances(self, data: Any) -> Array:
        return data._impl.contact.dist[self._order] if self.scene.model.npair else jnp.zeros(0, jnp.float32)

    def _forces(self, data: Any) -> Array:
        # pairs have condim 1: one row each, the normal force
        return data._impl.efc_force[self._rows] if self.scene.model.npair else jnp.zeros(0, jnp.float32)

    def _forward(self, data: Any) -> Any:
        """`mjx.forward`, but with a fixed number of Newton iterations: `mjx.solve` would loop until all environments
        have converged, which a GPU waits for, and factorises the Hessian once more than it needs to."""
        from mujoco.mjx._src import solver

        for stage in ("fwd_position", "fwd_velocity", "fwd_actuation", "fwd_acceleration"):
            data = getattr(self._mjx, stage)(self._model, data)

        def at(qacc: Array, grad: bool = False) -> Any:
            return solver.Context.create(self._model, data.replace(qacc=qacc), grad=grad)

        def iterate(qacc: Array, _: None) -> tuple[Array, None]:
            return solver._linesearch(self._model, data, at(qacc, grad=True)).qacc, None

        warm, smooth = data.qacc_warmstart, data.qacc_smooth
        start = jnp.where(at(warm).cost < at(smooth).cost, warm, smooth)
        qacc, _ = jax.lax.scan(iterate, start, None, length=SOLVER_ITERATIONS)
        end = at(qacc)
        return data.tree_replace(
            {"qacc": qacc, "qfrc_constraint": end.qfrc_constraint, "_impl.efc_force": end.efc_force}
        )

    def _integrate(self, data: Any) -> Any:
        """The implicitfast step. An actuator at its effort limit can't damp any more, so its damping leaves the
        implicit matrix, as in C MuJoCo; `mjx.step` would keep it there and brake each joint that moves at full effort.
        """
        from mujoco.mjx._src.forward import implicit
        from mujoco.mjx._src.support import mul_m

        model = self._model
        low, high = model.actuator_forcerange[:, 0], model.actuator_forcerange[:, 1]
        saturated = (data.actuator_force <= low) | (data.actuator_force >= high)
        biasprm = jnp.where(saturated[:, None], 0.0, model.actuator_biasprm)
        # what the solver found, as a force: `qfrc_constraint` equals it only once the solver has converged
        data = data.replace(qfrc_smooth=mul_m(model, data, data.qacc), qfrc_constraint=jnp.zeros_like(data.qacc))
        return implicit(model.replace(actuator_biasprm=biasprm), data)
