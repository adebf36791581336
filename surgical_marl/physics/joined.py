"""The physics step of arms of which some touch each other, in a scene without objects.

Each arm's forces, and how it moves once its acceleration is known, are computed as if it were alone, in loops over
arms. Only what the constraint solver does concerns all arms at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.contact.arm_contacts import Pairs
from surgical_marl.physics.outputs import Touch
from surgical_marl.physics.solver.cholesky import packed
from surgical_marl.physics.solver.constraint_rows import JointRows, Rows, rows_of, solve
from surgical_marl.physics.systems.arm_forces import ArmForces, changes, relaxed
from surgical_marl.physics.systems.arms import Kind
from surgical_marl.physics.systems.dynamics import Dynamics, Physics

ITERATIONS = (6, 6)
"""Most Newton steps, and line search steps in each: see docs/physics.md."""

MOST_JOINED = 32
"""Joints up to which all arms are one dense problem: the code of a dense one grows with the cube of them."""


class Joined:
    """Steps the arms of a scene together."""

    def __init__(self, dynamics: Dynamics, pairs: Pairs, kinds: Sequence[Kind]) -> None:
        self._dynamics, self._pairs, self._kinds = dynamics, pairs, kinds

    def step(self, physics: Physics, touch: Touch, fields: dict[str, Array]) -> tuple[Physics, Touch]:
        """Return the state after one physics step, and the hardest touch up to the start of that step.

        `fields` replaces values of some fields of the scene's model.
        """
        data = self._dynamics.axes(physics.qpos)  # again: quicker than to keep poses until here
        distance = self._pairs.distance_by_arms(data.geom_xpos, data.geom_xmat)
        touching = self._pairs.deepest(data, distance)
        contacts = self._dynamics.contact_rows(touching.jacobian, touching.distance, touching.weight, physics.qvel)
        found = [kind.forces(physics, fields) for kind in self._kinds]
        qacc, force = self._solve(found, contacts)
        hardest = touch._replace(
            penetration=jnp.maximum(touch.penetration, -distance),
            force=jnp.maximum(touch.force, self._pairs.spread(touching.pair, force)),
            overflow=jnp.maximum(touch.overflow, touching.left_out),
        )
        return self._moved(physics, found, qacc), hardest

    def _solve(self, found: list[ArmForces], contacts: Rows) -> tuple[Array, Array]:
        """Return the accelerations [n] of all joints, and the forces of contacts [r]."""
        n = contacts.jacobian.shape[1]
        mass, smooth, start = jnp.zeros((n, n)), jnp.zeros(n), jnp.zeros(n)
        joints = JointRows(*[jnp.zeros(n)] * len(JointRows._fields))
        for kind, own in zip(self._kinds, found, strict=True):
            dofs = kind.dofs
            mass = mass.at[dofs[:, :, None], dofs[:, None]].set(own.mass[:, packed(dofs.shape[1])])
            smooth, start = smooth.at[dofs].set(own.smooth), start.at[dofs].set(relaxed(own))
            joints = JointRows(*(all_.at[dofs].set(its) for all_, its in zip(joints, own.joints, strict=True)))
        rows = Rows(*(jnp.concatenate(parts) for parts in zip(rows_of(joints), contacts, strict=True)))
        arms = [kind.dofs for kind in self._kinds] if n > MOST_JOINED else []
        qacc, force = solve(mass, smooth, rows, start, *ITERATIONS, arms)
        return qacc, force[2 * n :]

    def _moved(self, physics: Physics, found: list[ArmForces], qacc: Array) -> Physics:
        """Return the state one step later, as `Dynamics.step` does, for accelerations [n] of all joints."""
        dt, qvel = self._dynamics.dt, physics.qvel
        for kind, own in zip(self._kinds, found, strict=True):
            qvel = qvel.at[kind.dofs].add(dt * changes(own, qacc[kind.dofs]))
        return physics._replace(qpos=physics.qpos + dt * qvel, qvel=qvel, qacc_warmstart=qacc)
