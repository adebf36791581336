"""The physics step of a scene with objects: all that touches is solved together."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.bodies import Bodies, free_acceleration, inertias, moved, rotation
from surgical_marl.physics.cone import solve_contacts
from surgical_marl.physics.dynamics import Dynamics, Physics
from surgical_marl.physics.handling import Grips, Handling

ITERATIONS = (8, 4)
"""Most Newton steps, and line search steps in each."""
GRAVITY = np.array([0.0, 0.0, -9.81], np.float32)


class Objects(NamedTuple):
    """The state of all free objects of a scene."""

    bodies: Bodies
    grips: Grips


class Outcome(NamedTuple):
    """What a step felt."""

    force: Array
    """Normal force of every patch, N, [g]."""
    friction: Array
    """[g, 3]"""
    depth: Array
    """Deepest overlap of every patch at the start of the step, m, [g]."""
    slip: Array
    """[g, 3]"""
    steps: Array


def step_together(
    dynamics: Dynamics, handling: Handling, physics: Physics, objects: Objects, more: Any = None
) -> tuple[Physics, Objects, Outcome]:
    """Return the state after one step of all arms and objects.

    The arms' damping is part of their mass matrix here, so the solver sees the velocities at the end of the step.
    """
    dt, bodies = dynamics.dt, objects.bodies
    forces = dynamics.forces(physics)
    frames = rotation(bodies.quaternion)
    patches = handling.find(forces.data, bodies, dt)
    felt = handling.feel(patches, forces.data, bodies, physics.qvel, objects.grips, dt)
    n, k = len(physics.qvel), bodies.position.shape[0]
    masses = inertias(handling.tables.masses, frames)
    free = free_acceleration(bodies, handling.tables.masses, frames, jnp.asarray(GRAVITY), dt)
    mass = jnp.zeros((n + 6 * k, n + 6 * k)).at[:n, :n].set(forces.mass + dt * forces.damping)
    for o in range(k):
        own = slice(n + 6 * o, n + 6 * o + 6)
        mass = mass.at[own, own].set(masses[o])
    smooth = jnp.concatenate([forces.smooth, (masses @ free[..., None]).ravel()])
    wide = jnp.concatenate([forces.rows.jacobian, jnp.zeros((len(forces.rows.low), 6 * k))], 1)
    rows = forces.rows._replace(jacobian=wide)
    start = jnp.concatenate([dynamics.relaxed(forces, physics.qacc_warmstart), bodies.acceleration.ravel()])
    found = solve_contacts(mass, smooth, rows, felt.cones, start, *ITERATIONS)
    qacc, acceleration = found.acceleration[:n], found.acceleration[n:].reshape(k, 6)
    velocity = jnp.concatenate([physics.qvel, bodies.velocity.ravel()])
    shift = dt * (velocity + dt * found.acceleration)
    grips = handling.remember(felt, found.forces, forces.data, bodies, shift, objects.grips)
    qvel = physics.qvel + dt * qacc
    after = physics._replace(qpos=physics.qpos + dt * qvel, qvel=qvel, qacc_warmstart=qacc)
    felt_now = found.forces
    outcome = Outcome(felt_now.normal.sum(-1), felt_now.friction, patches.points.depth.max(-1), felt.slip, found.steps)
    return after, Objects(moved(bodies, acceleration, dt), grips), outcome
