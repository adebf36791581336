"""Contacts along the direction of a Newton step: their forces, and the slope of the cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.contact.friction_cone import Forces, Parting, Stuck, falls, nearest, presses, stretched
from surgical_marl.physics.solver.arm_solver import ArmSolver
from surgical_marl.physics.solver.problem import Contacts, Point, Pressed, Problem
from surgical_marl.physics.tree_utils import Listed, put, room, row_of

TOLERANCE = 3e-3
"""Difference between the force of a contact after a Newton step and its linear prediction, as a share of the largest
normal force on the same object, up to which the step is the last one. The error that is left in the forces is about as
large: the difference is all that does not balance."""


class ContactState(NamedTuple):
    """The forces of contacts where a direction begins, [s]."""

    stuck: Stuck
    felt: Forces
    pressing: Listed
    """The contacts that press."""
    pressed: Pressed
    """The part of `felt` that is kept, or of the forces after a whole step."""

    @classmethod
    def of(cls, contacts: Contacts) -> ContactState:
        """Return the forces without acceleration."""
        pressed = room(jax.eval_shape(lambda: Pressed.of(row_of(contacts.felt, 0))), len(contacts.second))
        return cls(contacts.stuck, contacts.felt, contacts.pressing, pressed)

    def ahead(self, problem: Problem, by: Parting, length: Array) -> ContactState:
        """Return the forces at a length of a direction, along which bodies part by `by` per length, [s]."""

        def one(n: Array, state: ContactState) -> ContactState:
            springs, here, more = row_of((problem.contacts.springs, state.stuck, by), n)
            stuck = stretched(springs, here, _times(length, more))
            felt = nearest(springs, stuck)
            stuck, felts, pressed = put((state.stuck, state.felt, state.pressed), n, (stuck, felt, Pressed.of(felt)))
            return ContactState(stuck, felts, state.pressing.after(n, presses(felt)), pressed)

        start = self._replace(pressing=self.pressing._replace(length=jnp.int32(0)))
        found: ContactState = jax.lax.fori_loop(0, problem.total, one, start)
        return found


def whole_step(problem: Problem, state: ContactState, by: Parting) -> tuple[Pressed, Array]:
    """Return the forces of contacts after a whole Newton step, [s], and whether the step converged, [] bool.

    It converged if no force is off from its linear prediction by more than `TOLERANCE` of the largest normal force on
    the same object.

    Args:
        problem: whose contacts [s] they are.
        state: their forces where the step begins.
        by: by how much more the bodies of each contact accelerate in the step, [s].
    """

    def look(n: Array, sums: tuple[Pressed, Array, Array]) -> tuple[Pressed, Array, Array]:
        all_, missed, largest = sums
        springs, here, before, step = row_of((problem.contacts.springs, state.stuck, state.felt, by), n)
        found, (normal, friction) = nearest(springs, stretched(springs, here, step)), falls(springs, before, step)
        ahead, across = before.normal - normal - found.normal, before.friction - friction - found.friction
        pressed, square = Pressed.of(found), jnp.sum(ahead**2) + jnp.sum(across**2)
        first, second = problem.contacts.at(n).first, problem.contacts.second[n]
        for number, on in ((first, True), (second, second < objects)):
            missed = put(missed, number, jnp.maximum(missed[number], jnp.where(on, square, 0.0)))
            largest = put(largest, number, jnp.maximum(largest[number], jnp.where(on, pressed.normal, 0.0)))
        return put(all_, n, pressed), missed, largest

    # for each object, and at the end for contacts without one
    each, objects = jnp.zeros(len(problem.free) + 1), len(problem.free)
    pressed, missed, largest = jax.lax.fori_loop(0, problem.total, look, (state.pressed, each, each))
    return pressed, (missed <= (TOLERANCE * largest) ** 2).all()


class Along(NamedTuple):
    """A direction, from an acceleration `here`."""

    here: Point
    direction: Point
    moves: Array
    """Arms that move, [a] bool."""
    by: Parting
    """Relative acceleration of the bodies of each contact per length, [s]."""
    slope: Array
    """Slope of the cost where the direction begins, without contacts and without friction and limits of joints, []."""
    growth: Array
    """Growth of this slope per length, []."""

    def measure(self, arms: ArmSolver, problem: Problem, stuck: Stuck) -> Callable[[Array], tuple[Array, Array]]:
        """Return a function from a length along the direction to the slope of the cost there and its growth per length.

        `stuck` are the forces of contacts that would stick where the direction begins, [s].
        """
        here, direction, moves, by, slope, growth = self

        def measure(length: Array) -> tuple[Array, Array]:
            def look(n: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
                slope, growth = sums
                springs, own_stuck, own = row_of((problem.contacts.springs, stuck, by), n)
                felt = nearest(springs, stretched(springs, own_stuck, _times(length, own)))
                normal, friction = falls(springs, felt, own)
                slope -= felt.normal @ own.normal + felt.friction @ own.along
                return slope, growth + normal @ own.normal + friction @ own.along

            resists, gives = arms.resisted(problem, moves, here.arms, direction.arms, length)
            start = slope + length * growth + resists, growth + gives
            found: tuple[Array, Array] = jax.lax.fori_loop(0, problem.total, look, start)
            return found

        return measure


def set_out(
    arms: ArmSolver, problem: Problem, forces: Point, here: Point, direction: Point, moves: Array, by: Parting
) -> tuple[Array, Along]:
    """Return the slope of the whole cost where a direction begins, and the direction with its constants.

    Args:
        arms: which find what is due to arms.
        problem: what is solved.
        forces: of contacts on arms, and all on objects, at `here`.
        here: an acceleration.
        direction: from there.
        moves: which arms move, [a].
        by: how much more the bodies of each contact accelerate per length, [s].
    """
    begin, slope, growth = arms.slopes(problem, moves, here.arms, direction.arms, forces.arms)
    begin -= jnp.sum(forces.objects * direction.objects)
    inertia = problem.masses @ jnp.stack([here.objects - problem.free, direction.objects], -1)
    of_objects = jnp.sum(direction.objects[..., None] * inertia, (0, 1))
    slope, growth = slope + of_objects[0], growth + of_objects[1]
    if problem.attachments is not None:
        slope, growth = (
            slope + problem.attachments.slope(here, direction),
            growth + problem.attachments.growth(direction),
        )
    return begin, Along(here, direction, moves, by, slope, growth)


def _times(length: Array, by: Parting) -> Parting:
    return Parting(length * by.normal, length * by.along)
