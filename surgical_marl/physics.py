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

from surgical_marl.collision import Pairs, Touching
from surgical_marl.runtime import prepare_jax
from surgical_marl.scene import DECIMATION, Scene
from surgical_marl.solver import JointRows, Rows, relax, solve, solve_positive

ARM_ITERATIONS, TOUCHING_ITERATIONS = (1, 1), (6, 4)
"""Most Newton steps, and line search steps in each, for an arm that touches nothing and for arms that touch: what it
takes to solve limits, friction and contacts nearly as well as C MuJoCo, which goes on until they are: see
docs/physics.md."""


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
    """MJX on one scene, `decimation` physics steps a control step. `home` is the physics that every episode starts
    with, `home_views` what tasks see there."""

    def __init__(self, scene: Scene, decimation: int = DECIMATION) -> None:
        prepare_jax()
        from mujoco import mjx

        self.scene, self._mjx = scene, mjx
        self._pairs = Pairs(scene.model)
        smooth = copy.copy(scene.model)
        smooth.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT  # that is for `collision.py`
        self._model, self._data = mjx.put_model(smooth), mjx.make_data(smooth)
        self._dt = np.float32(scene.model.opt.timestep)
        self.decimation, self.control_dt = decimation, decimation * scene.model.opt.timestep
        self._index_joints()
        self._index_pairs()
        start = scene.home[self._address]
        start = start if scene.control == "position" else np.where(self._jaws, start, 0.0)
        self._home = np.asarray(scene.home, np.float32), np.asarray(self._moment @ start, np.float32)
        self.home_contacts, self.home_views = self._measure_home()

    @property
    def home(self) -> Physics:
        """All arms at home, at rest."""
        qpos, ctrl = map(jnp.asarray, self._home)
        still = jnp.zeros(self.scene.model.nv, jnp.float32)
        return Physics(qpos, still, still, ctrl)

    def command(self, physics: Physics, actions: dict[str, Array]) -> Physics:
        """The next command of every actuator. A jaw moves to open or closed at its speed, whatever the mode; a cable
        follows its joints' commands.

        A position target leads its joint by no more than full effort at full speed takes: one that is held up would
        wind up its target, and race after it once free.
        """
        ctrl, own = physics.ctrl[self._drives], jnp.zeros(self.scene.model.nu, jnp.float32)
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
        return physics._replace(ctrl=jnp.matmul(self._moment, jnp.where(self._jaws, jaw, command)))

    def advance(self, physics: Physics) -> tuple[Physics, Contacts, dict[str, ArmView]]:
        """A control step of physics, and what is seen where it ends. MuJoCo leaves tips and distances one physics step
        behind its `qpos`, so they are computed anew."""

        def substep(state: tuple[Physics, Array, Array], _: None) -> tuple[tuple[Physics, Array, Array], None]:
            physics, nearest, strongest = state
            distance = self._look(physics.qpos)[1]
            physics, force = self._step(physics, distance)
            return (physics, jnp.minimum(nearest, distance), jnp.maximum(strongest, force)), None

        none = jnp.zeros(self._pairs.count, jnp.float32)
        start = physics, none, none
        (physics, nearest, strongest), _ = jax.lax.scan(substep, start, None, length=self.decimation)
        tips, distance = self._look(physics.qpos)
        contacts = Contacts(distance, -jnp.minimum(nearest, distance), strongest)
        return physics, contacts, self._view(jnp, physics, tips, contacts)

    def _look(self, qpos: Array) -> tuple[Array, Array]:
        """Tool tips [arms, 3] in the world and the distance of every pair, at a posture."""
        data = self._mjx.kinematics(self._model, self._data.replace(qpos=qpos))
        tips = data.site_xpos[np.array(list(self._sites.values()))]
        return tips, self._pairs.closest(data.geom_xpos, data.geom_xmat).distance

    def _step(self, physics: Physics, distance: Array) -> tuple[Physics, Array]:
        """A physics step, and the normal force of every pair during it. Arms that don't touch anything don't know of
        each other: each is solved on its own."""
        if not self._pairs.count:
            return self._apart(physics)
        return jax.lax.cond((distance < 0).any(), self._touching_step, self._apart, physics)

    def _apart(self, physics: Physics) -> tuple[Physics, Array]:
        data = self._forward(physics)
        rows = self._constraints(data)
        qvel, qacc = physics.qvel, physics.qacc_warmstart
        for agent, dofs in self._dofs.items():
            mass, damping = data._impl.M[dofs][:, dofs], self._damping(data)[dofs][:, dofs]
            block, start = self._relaxed(agent, data, rows, physics.qacc_warmstart)
            found, _ = solve(mass, data.qfrc_smooth[dofs], block, start, *ARM_ITERATIONS)
            qacc = qacc.at[dofs].set(found)
            qvel = qvel.at[dofs].add(self._dt * solve_positive(mass + self._dt * damping, mass @ found))
        return self._moved(physics, qvel, qacc), jnp.zeros(self._pairs.count, jnp.float32)

    def _relaxed(self, agent: str, data: Any, rows: Rows, qacc: Array) -> tuple[Rows, Array]:
        """An arm's own rows, and its acceleration near to what they allow."""
        dofs, own = self._dofs[agent], self._own_rows[agent]
        block = Rows(rows.jacobian[own][:, dofs], *(column[own] for column in rows[1:]))
        mass = data._impl.M[dofs][:, dofs]
        return block, relax(mass, data.qfrc_smooth[dofs], self._joint_rows(agent, block), qacc[dofs])

    def _joint_rows(self, agent: str, rows: Rows) -> JointRows:
        """An arm's rows, each of which concerns one joint, by joint."""
        n, (rubbing, limited) = len(self._dofs[agent]), self._own_joints[agent]
        friction, limit = (jnp.zeros(n).at[where].set for where in (rubbing, limited))
        k = len(rubbing)
        side = rows.jacobian[np.arange(k, k + len(limited)), limited]
        return JointRows(
            *(friction(column[:k]) for column in (rows.high, rows.impedance, rows.reference)),
            *(limit(column) for column in (side, rows.impedance[k:], rows.reference[k:])),
        )

    def _touching_step(self, physics: Physics) -> tuple[Physics, Array]:
        data = self._forward(physics)
        mass, rows = data._impl.M, self._constraints(data)
        touching = self._pairs.deepest(data, self._pairs.closest(data.geom_xpos, data.geom_xmat))
        contacts = self._contact_rows(touching, physics.qvel)
        joined = Rows(*(jnp.concatenate(parts) for parts in zip(rows, contacts, strict=True)))
        start = physics.qacc_warmstart
        for agent, dofs in self._dofs.items():
            start = start.at[dofs].set(self._relaxed(agent, data, rows, start)[1])
        qacc, force = solve(mass, data.qfrc_smooth, joined, start, *TOUCHING_ITERATIONS)
        qvel = physics.qvel + self._dt * solve_positive(mass + self._dt * self._damping(data), mass @ qacc)
        its_own = touching.pair == np.arange(self._pairs.count)[:, None]
        return self._moved(physics, qvel, qacc), jnp.where(its_own, force[len(rows.low) :], 0.0).sum(-1)

    def _contact_rows(self, touching: Touching, qvel: Array) -> Rows:
        """Frictionless contacts (condim 1): one row each, along the normal."""
        from mujoco.mjx._src.constraint import _kbi

        model = self.scene.model
        solref, solimp = jnp.asarray(model.pair_solref[0], jnp.float32), jnp.asarray(model.pair_solimp[0], jnp.float32)
        stiffness, damping, impedance = jax.vmap(lambda d: _kbi(self._model, solref, solimp, d))(touching.distance)
        resistance = jnp.maximum(touching.weight * (1 - impedance) / impedance, mujoco.mjMINVAL)
        depth = jnp.minimum(touching.distance, 0.0)
        reference = -damping * (touching.jacobian @ qvel) - stiffness * impedance * depth
        none = jnp.zeros_like(depth)
        return Rows(touching.jacobian, 1 / resistance, reference, none, none + np.inf)

    def _moved(self, physics: Physics, qvel: Array, qacc: Array) -> Physics:
        return Physics(physics.qpos + self._dt * qvel, qvel, qacc, physics.ctrl)

    def _forward(self, physics: Physics) -> Any:
        """All of `mjx.forward` but collision and solver: mass matrix, smooth forces, rows of friction and limits."""
        data = self._data.replace(**physics._asdict())
        for stage in ("fwd_position", "fwd_velocity", "fwd_actuation"):
            data = getattr(self._mjx, stage)(self._model, data)
        return data.replace(qfrc_smooth=data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator)

    def _constraints(self, data: Any) -> Rows:
        rows = data._impl
        friction = rows.efc_frictionloss
        rubs = np.arange(len(friction)) < self._model._impl.dof_hasfrictionloss.sum()  # these rows come first
        low, high = jnp.where(rubs, -friction, 0.0), jnp.where(rubs, friction, np.inf)
        return Rows(rows.efc_J, rows.efc_D, rows.efc_aref, low, high)

    def _damping(self, data: Any) -> Array:
        """What velocity costs, [nv, nv]: the implicit part of the step. An actuator at its effort limit can't damp
        any more, so its damping is not in it, as in C MuJoCo; `mjx.step` would brake each joint that moves at full
        effort."""
        model = self._model
        low, high = model.actuator_forcerange[:, 0], model.actuator_forcerange[:, 1]
        saturated = (data.actuator_force <= low) | (data.actuator_force >= high)
        own = jnp.where(saturated, 0.0, -model.actuator_biasprm[:, 2])
        moment = data._impl.actuator_moment
        return moment.T @ (own[:, None] * moment) + jnp.diag(model.dof_damping)

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
        # actuators of joints: they stand in the URDF's order, `qpos` in that of the tree
        self._drives = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        self._address = model.jnt_qposadr[model.actuator_trnid[self._drives, 0]]
        self._moment = np.asarray(scene.moment[:, self._address], np.float32)
        rows = [
            (names.index(f"{agent}/{joint.leader}"), bool(arm.jaw and joint.leader == arm.jaw.joint), joint, arm.jaw)
            for agent, arm in ((agent, mount.arm) for agent, mount in scene.mounts.items())
            for joint in arm.joints
        ]
        single = np.float32
        self._leaders, self._jaws = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
        self._speed = np.array([joint.drive.speed for _, _, joint, _ in rows], single)
        self._effort = np.array([joint.effort for _, _, joint, _ in rows], single)
        # what a joint feels that moves alone: its own gains and its cables'
        gains = np.array([model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]], single)
        stiffness, damping = gains @ self._moment**2
        self._lead = (self._effort + damping * self._speed) / stiffness
        self._low = np.array([joint.lower for _, _, joint, _ in rows], single)
        self._high = np.array([joint.upper for _, _, joint, _ in rows], single)
        self._open = np.array([jaw.open if is_jaw and jaw else 0.0 for _, is_jaw, _, jaw in rows], single)
        self._closed = np.array([jaw.closed if is_jaw and jaw else 0.0 for _, is_jaw, _, jaw in rows], single)
        self._joints = {agent: scene.qpos_index(agent) for agent in scene.agents}
        self._actuators = {
            agent: np.array([names.index(f"{agent}/{joint.name}") for joint in mount.arm.actuated])
            for agent, mount in scene.mounts.items()
        }
        # constraint rows without contacts: friction of some joints, then limits of all
        kinds = np.flatnonzero(model.dof_frictionloss), model.jnt_dofadr[model.jnt_limited > 0]
        owners = np.array([model.joint(i).name.split("/")[0] for i in range(model.njnt)])
        self._dofs = {agent: model.jnt_dofadr[owners == agent] for agent in scene.agents}
        self._own_rows = {a: np.flatnonzero(np.isin(np.concatenate(kinds), own)) for a, own in self._dofs.items()}
        self._own_joints = {a: [np.flatnonzero(np.isin(own, kind)) for kind in kinds] for a, own in self._dofs.items()}
        self._sites = {agent: model.site(f"{agent}/tool_tip").id for agent in scene.agents}

    def _index_pairs(self) -> None:
        """Which pairs concern each agent."""
        owners = [tuple(name.split("/")[0] for name in pair) for pair in self.scene.pairs]
        self._touching = {a: np.flatnonzero([a in pair for pair in owners]) for a in self.scene.agents}
        self._between = {
            a: np.flatnonzero([a in pair and len(set(pair)) > 1 for pair in owners]) for a in self.scene.agents
        }

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
