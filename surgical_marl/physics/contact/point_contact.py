"""Contacts of point masses, each a sphere, for systems that consist of such: the law is that of `spring_contact`.

response = respond(mass, force, velocity, ends, dt)
velocity = moved(response, ends, accelerations, dt)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.contact.spring_contact import each, feel
from surgical_marl.physics.solver.cholesky import cholesky, solve_factored
from surgical_marl.physics.systems.system import Ends, Response
from surgical_marl.physics.tree_utils import row_of

ITERATIONS = 6
"""Newton steps: each contact is linear but for a change between free, stuck and sliding."""


class Solved(NamedTuple):
    """A step of n point masses whose ends move as expected."""

    shift: Array
    """Displacements, m, [n, 3]."""
    factor: Array
    """Cholesky factor of the stiffness of each mass with its contacts, [n, 3, 3]."""
    falls: Array
    """Of the force of each contact as its point moves, N/m, [c, 3, 3]."""


def respond(mass: Array, force: Array, velocity: Array, ends: Ends, dt: Any) -> Response:
    """Return the forces of n point masses on the ends of their contacts.

    Args:
        mass: matrices of the masses, with implicit parts of their other forces, kg, [n, 3, 3].
        force: sums of their other forces, N, [n, 3].
        velocity: m/s, [n, 3].
        ends: of their contacts; the number of a part is that of its mass.
        dt: duration of a step, s.
    """
    inertia = mass / (dt * dt)

    def summed(u: Array) -> tuple[Array, Array]:
        def add(row: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
            end = row_of(ends.rows, row)
            felt = feel(end, u[end.part] - end.shift)
            return sums[0].at[end.part].add(felt.force), sums[1].at[end.part].add(felt.stiffness)

        found: tuple[Array, Array] = jax.lax.fori_loop(0, ends.total, add, (force, inertia))
        return found

    def step(_: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        u = state[0]
        pushed, stiffness = summed(u)
        excess = pushed - jnp.einsum("nij,nj->ni", inertia, u - dt * velocity)
        factor = jax.vmap(cholesky)(stiffness)
        return u + jax.vmap(solve_factored)(factor, excess), factor

    u, factor = jax.lax.fori_loop(0, ITERATIONS, step, (dt * velocity, inertia))
    felt = each(ends, lambda row, end: feel(end, u[end.part] - end.shift))
    return Response(-felt.force, Solved(u, factor, felt.stiffness))


def yielding(response: Response, ends: Ends, accelerations: Array, dt: Any) -> Array:
    """Return by how much the forces on the ends fall as these accelerate, N, [c, 3] (`System.yielding`)."""
    solved: Solved = response.solved
    carried = _carried(solved, ends, accelerations, dt)

    def eased(row: Array, end: Any) -> Array:
        return solved.falls[row] @ (dt * dt * accelerations[row] - carried[end.part])

    found: Array = each(ends, eased)
    return found


def moved(response: Response, ends: Ends, accelerations: Array, dt: Any) -> Array:
    """Return the velocities of the masses after a step, m/s, [n, 3] (`System.apply`)."""
    return (response.solved.shift + _carried(response.solved, ends, accelerations, dt)) / dt


def _carried(solved: Solved, ends: Ends, accelerations: Array, dt: Any) -> Array:
    """Return how far the ends carry the masses by accelerating, m, [n, 3]."""

    def add(row: Array, sums: Array) -> Array:
        pushed = solved.falls[row] @ (dt * dt * accelerations[row])
        return sums.at[ends.rows.part[row]].add(pushed)

    pushed = jax.lax.fori_loop(0, ends.total, add, jnp.zeros_like(solved.shift))
    return jax.vmap(solve_factored)(solved.factor, pushed)
