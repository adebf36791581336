"""The contact of a point mass with shapes of others: the force law of `contact_model`, at one point each.

loads = respond(mass, force, velocity, ends, dt)
acceleration = accelerate(mass, force, velocity, ends, accelerations, dt)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.contact.contact_model import CREEP, FASTEST, FIRM
from surgical_marl.physics.contact.contact_patch import AWAY, tangents
from surgical_marl.physics.contact.friction_cone import (
    Cone,
    Parting,
    Springs,
    Stuck,
    curvature,
    nearest,
    stretched,
    wrench,
)
from surgical_marl.physics.contact.grips import DAMPING, SHEAR
from surgical_marl.physics.solver.cholesky import cholesky, forward, packed, solve_factored
from surgical_marl.physics.solver.newton import line_search, newton
from surgical_marl.physics.systems.system import Ends, Loads

ITERATIONS = 6
"""Newton steps for one point mass at most: each contact is linear but for a change between free, stuck and sliding."""
LEAST = 1e-9
"""Fall of the cost in a Newton step, N m/s2, after which none follows."""
_BLOCK = packed(6)[:3, :3]


class _Law(NamedTuple):
    """The contact of one point mass with one shape."""

    cone: Cone
    stuck: Stuck


def respond(mass: Array, force: Array, velocity: Array, ends: Ends, dt: Any) -> Loads:
    """Return the loads of n point masses on r shapes each, with the accelerations of the masses eliminated.

    Args:
        mass: matrices of the masses, with implicit parts of their other forces, kg, [n, 3, 3].
        force: sums of their other forces, N, [n, 3].
        velocity: m/s, [n, 3].
        ends: of their contacts.
        dt: duration of a step, s.
    """

    def one(row: Any) -> Loads:
        mass, force, velocity, own = row
        laws = _laws(velocity, own, dt)
        still = jnp.zeros_like(own.normal)
        acceleration = _solve(mass, force, laws, still)
        forces, stiffness = jax.lax.map(lambda law: _force(law, acceleration), laws)
        factor = cholesky(mass + jnp.sum(stiffness, 0))

        def condensed(block: Array) -> Array:
            eased = forward(factor, block)
            return block - eased.T @ eased

        return Loads(-forces, jax.lax.map(condensed, stiffness))

    loads: Loads = jax.lax.map(one, (mass, force, velocity, _by_point(ends)))
    return loads


def accelerate(mass: Array, force: Array, velocity: Array, ends: Ends, accelerations: Array, dt: Any) -> Array:
    """Return the accelerations of point masses, m/s2, [n, 3], whose contacts' ends have these, m/s2, [n, r, 3]."""

    def one(row: Any) -> Array:
        mass, force, velocity, own, moves = row
        return _solve(mass, force, _laws(velocity, own, dt), moves)

    found: Array = jax.lax.map(one, (mass, force, velocity, _by_point(ends), accelerations))
    return found


def _by_point(ends: Ends) -> Ends:
    """Return ends whose stiffness and friction have an axis for points too, [n, r]."""
    shape = ends.depth.shape
    return ends._replace(stiffness=jnp.broadcast_to(jnp.asarray(ends.stiffness), shape),
                         sliding=jnp.broadcast_to(jnp.asarray(ends.sliding), shape))  # fmt: skip


def _laws(velocity: Array, ends: Ends, dt: Any) -> _Law:
    """Return the contacts of one point mass, [r]."""

    def law(end: Ends) -> _Law:
        frame = tangents(end.normal)
        speed, *rubbed = frame @ (velocity - end.velocity)
        reach = end.depth - dt * jnp.minimum(speed, 0.0)
        k = jnp.where(reach > 0, end.stiffness, 0.0)
        rate = k * jnp.maximum(dt + DAMPING * jnp.clip(reach / FIRM, 0.0, 1.0), end.depth / FASTEST)
        drag = SHEAR * end.stiffness * CREEP
        push = jnp.where(reach > 0, k * end.depth - rate * speed, AWAY)
        springs = Springs((dt * rate)[None], dt * drag, end.sliding)
        normal, across = jnp.zeros((1, 6)).at[0, :3].set(frame[0]), jnp.zeros((3, 6)).at[:2, :3].set(frame[1:])
        return _Law(Cone(normal, across, springs), Stuck(push[None], -drag * jnp.stack([*rubbed, jnp.float32(0.0)])))

    found: _Law = jax.lax.map(law, ends)
    return found


def _force(law: _Law, acceleration: Array) -> tuple[Array, Array]:
    """Return the force on the point mass, N, [3], and how much it falls per relative acceleration, kg, [3, 3]."""
    cone = law.cone
    by = Parting(cone.normal[:, :3] @ acceleration, cone.along[:, :3] @ acceleration)
    felt = nearest(cone.springs, stretched(cone.springs, law.stuck, by))
    return wrench(cone, felt)[:3], curvature(cone, felt)[_BLOCK]


def _solve(mass: Array, force: Array, laws: _Law, moves: Array) -> Array:
    """Return the acceleration [3] at which all forces on one point mass balance, by Newton's method."""

    def left(acceleration: Array) -> tuple[Array, Array]:
        """Return the force that does not balance, and how much it falls per acceleration."""

        def add(sums: Any, row: Any) -> tuple[Any, None]:
            law, move = row
            pushed, falls = _force(law, acceleration - move)
            return (sums[0] + pushed, sums[1] + falls), None

        found: tuple[Array, Array] = jax.lax.scan(add, (force - mass @ acceleration, mass), (laws, moves))[0]
        return found

    def step_from(acceleration: Array, _: Array) -> tuple[Array, Array]:
        excess, matrix = left(acceleration)
        factor = cholesky(matrix)
        step = solve_factored(factor, excess)

        def measure(length: Array) -> tuple[Array, Array]:
            excess, matrix = left(acceleration + length * step)
            return -(step @ excess), step @ (matrix @ step)

        return acceleration + line_search(-(step @ excess), LEAST, measure).length * step, step @ excess <= LEAST

    found: Array = newton(step_from, jnp.zeros(3), ITERATIONS)
    return found
