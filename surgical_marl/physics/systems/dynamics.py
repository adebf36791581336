"""The dynamics of a model without contacts, and the terms that contacts are solved with: pure JAX, by MJX.

    dynamics = Dynamics(model)
    forces = dynamics.forces(arm_state)

This is the only module that calls MJX. docs/physics.md says how a step is computed and compares it with C MuJoCo.
"""

from __future__ import annotations

import copy
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl.physics.solver.constraint_rows import JointRows, Rows
from surgical_marl.physics.solver.solref import response
from surgical_marl.physics.state import ArmState
from surgical_marl.runtime import prepare_mjx


class Forces(NamedTuple):
    """Position-dependent quantities of a model and the forces on it, for n degrees of freedom."""

    mass: Array
    """[n, n]"""
    smooth: Array
    """Sum of all forces except constraint forces, [n]."""
    damping: Array
    """Damping matrix [n, n] for the implicit part of a step."""
    rows: Rows
    """Constraint rows: friction of joints, then limits of joints."""


class Dynamics:
    """MJX on a model of joints that have one degree of freedom each."""

    def __init__(self, model: mujoco.MjModel) -> None:
        mjx = prepare_mjx()
        smooth = copy.copy(model)
        smooth.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT  # `arm_contacts.py` detects collisions
        self.model, self._data = mjx.put_model(smooth), mjx.make_data(smooth)
        self.dt = np.float32(model.opt.timestep)
        self._stop = [jnp.asarray(of[0], jnp.float32) for of in (model.pair_solref, model.pair_solimp) if model.npair]
        self._rubbing, self._limited = np.flatnonzero(model.dof_frictionloss), model.jnt_dofadr[model.jnt_limited > 0]

    def varied(self, fields: dict[str, Array]) -> Dynamics:
        """Return a copy of these dynamics whose model has other values in some fields."""
        varied = copy.copy(self)
        varied.model = self.model.tree_replace(fields)
        return varied

    def pose(self, qpos: Array) -> Any:
        """Return MJX's data with the poses of all bodies, geoms and sites."""
        return _stage("kinematics")(self.model, self._data.replace(qpos=qpos))

    def axes(self, qpos: Array) -> Any:
        """Return MJX's data with the axes of all joints, beside the poses."""
        return _stage("com_pos")(self.model, self.pose(qpos))

    def forces(self, state: ArmState) -> Forces:
        """Compute all of `mjx.forward` that arms need, except collision and solver."""
        qpos, qvel, warmstart, ctrl = state
        data = self._data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=ctrl)
        data = self._with_cables(self._stages(data, "kinematics", "com_pos"))
        data = self._stages(data, "crb", "tendon_armature", "make_constraint", "transmission")
        data = data.tree_replace({"_impl.actuator_velocity": _internal(data).actuator_moment @ qvel})
        data = self._stages(data, "com_vel", "passive", "rne", "fwd_actuation")
        smooth = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
        return Forces(_internal(data).M, smooth, self._damping(data), self._rows(data))

    def _stages(self, data: Any, *names: str) -> Any:
        for name in names:
            data = _stage(name)(self.model, data)
        return data

    def _with_cables(self, data: Any) -> Any:
        """Return data with the lengths and velocities of the cables that couple joints, and their moments.

        MJX's own function also traces tendons through space, which no arm has: a third of the time to trace a PSM.
        """
        model = self.model
        if not model.ntendon:
            return data
        cable, joint = np.repeat(np.arange(model.ntendon), model.tendon_num), model.wrap_objid
        moved = model.wrap_prm * data.qpos[model.jnt_qposadr[joint]]
        moment = jnp.zeros_like(_internal(data).ten_J).at[cable, model.jnt_dofadr[joint]].set(model.wrap_prm)
        length = jax.ops.segment_sum(moved, cable, model.ntendon)
        return data.tree_replace(
            {"ten_length": length, "_impl.ten_J": moment, "_impl.ten_velocity": moment @ data.qvel}
        )

    def _rows(self, data: Any) -> Rows:
        rows = _internal(data)
        friction = rows.efc_frictionloss
        rubs = np.arange(len(friction)) < len(self._rubbing)
        low, high = jnp.where(rubs, -friction, 0.0), jnp.where(rubs, friction, np.inf)
        return Rows(rows.efc_J, rows.efc_D, rows.efc_aref, low, high)

    def joint_rows(self, rows: Rows) -> JointRows:
        """Return constraint rows by joint; each row concerns one joint."""
        n, k = rows.jacobian.shape[1], len(self._rubbing)
        friction, limit = (jnp.zeros(n).at[where].set for where in (self._rubbing, self._limited))
        side = rows.jacobian[np.arange(k, k + len(self._limited)), self._limited]
        return JointRows(
            *(friction(column[:k]) for column in (rows.high, rows.impedance, rows.reference)),
            *(limit(column) for column in (side, rows.impedance[k:], rows.reference[k:])),
        )

    def _damping(self, data: Any) -> Array:
        """Return the damping matrix [n, n] of joints and actuators, without actuators at their effort limit.

        An actuator at its effort limit can't damp any more, so its damping is left out, as in C MuJoCo. `mjx.step`
        keeps it, which would slow each joint that moves at full effort.
        """
        model = self.model
        low, high = model.actuator_forcerange[:, 0], model.actuator_forcerange[:, 1]
        saturated = (data.actuator_force <= low) | (data.actuator_force >= high)
        own = jnp.where(saturated, 0.0, -model.actuator_biasprm[:, 2])
        moment = _internal(data).actuator_moment
        return moment.T @ (own[:, None] * moment) + jnp.diag(model.dof_damping)

    def contact_rows(self, jacobian: Array, distance: Array, weight: Array, qvel: Array) -> Rows:
        """Return rows of frictionless contacts (condim 1) along normals: jacobian [k, n], distance and weight [k]."""
        solref, solimp = self._stop
        stiffness, damping, impedance = response(solref, solimp, distance, self.dt)
        resistance = jnp.maximum(weight * (1 - impedance) / impedance, mujoco.mjMINVAL)
        depth = jnp.minimum(distance, 0.0)
        reference = -damping * (jacobian @ qvel) - stiffness * impedance * depth
        none = jnp.zeros_like(depth)
        return Rows(jacobian, 1 / resistance, reference, none, none + np.inf)


@cache
def _stage(name: str) -> Any:
    """Return a function of MJX, which is traced once for all models of one structure."""
    return jax.jit(getattr(prepare_mjx(), name))


def _internal(data: Any) -> Any:
    """Return what MJX computes but keeps private: mass matrix, rows of constraints, moments of actuators and cables.

    MJX's own error messages point to `_impl` for these. Nothing else in this module reads private names of MJX.
    """
    return data._impl
