"""Contacts along the direction of a Newton step: their forces, and the slope of the cost.

After a whole step all forces balance, if contacts feel there what their linear prediction says. The slope of the cost
there is therefore the part of the forces that was not predicted, times the direction.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.contact.friction_cone import Forces, Parting, Stuck, falls, nearest, presses, stretched
from surgical_marl.physics.solver.arm_solver import Arms
from surgical_marl.physics.solver.problem import Contacts, Point, Pressed, Problem
from surgical_marl.physics.tree_utils import Listed, put, room, row_of

TOLERANCE = 3e-3
"""Force of a contact that a Newton step did not foresee, as a share of the largest normal force on the same object, at
which it is the last one. The error that is left in the forces is about as large: what was not foreseen is all that does
not balance."""


class Base(NamedTuple):
    """The forces of contacts where a direction begins, [s]."""

    stuck: Stuck
    felt: Forces
    pressing: Listed
    """Which of them press."""
    pressed: Pressed
    """The part of `felt` that is kept, or of the forces after a whole step."""

    @classmethod
    def of(cls, contacts: Contacts) -> Base:
        """Return what contacts feel without acceleration."""
        pressed = room(jax.eval_shape(lambda: Pressed.of(row_of(contacts.felt, 0))), len(contacts.second))
        return cls(contacts.stuck, contacts.felt, contacts.pressing, pressed)

    def ahead(self, problem: Problem, by: Parting, length: Array) -> Base:
        """Return what they feel at a length of a direction, along which they part by so much more."""

        def one(n: Array, base: Base) -> Base:
            springs, here, more = row_of((problem.contacts.springs, base.stuck, by), n)
            stuck = stretched(springs, here, _times(length, more))
            felt = nearest(springs, stuck)
            stuck, felts, pressed = put((base.stuck, base.felt, base.pressed), n, (stuck, felt, Pressed.of(felt)))
            return Base(stuck, felts, base.pressing.after(n, presses(felt)), pressed)

        start = self._replace(pressing=self.pressing._replace(length=jnp.int32(0)))
        found: Base = jax.lax.fori_loop(0, problem.total, one, start)
        return found


class End(NamedTuple):
    """The forces of contacts after a whole Newton step, and the slope of the cost there."""

    pressed: Pressed
    """What contacts feel, [s]."""
    missed: Array
    """Square of the largest force that a contact of each object feels and would not if contacts were linear from the
    beginning of the direction on, N2; at the end of contacts without an object, [k + 1]."""
    largest: Array
    """Largest normal force likewise, N, [k + 1]."""
    slope: Array
    """Of the cost, []."""
    growth: Array
    """Growth of the slope of the cost of contacts along the direction, had they been linear, [].

    Without contacts it grows, too. So the slope where the direction begins is less than minus this.
    """

    @property
    def foreseen(self) -> Array:
        """Whether contacts feel what was foreseen, [] bool."""
        return (self.missed <= (TOLERANCE * self.largest) ** 2).all()


def look_ahead(problem: Problem, base: Base, by: Parting, direction: Point) -> End:
    """Return forces and slope after a whole Newton step.

    Args:
        problem: whose contacts [s] they are.
        base: what these feel where the direction begins.
        by: how much more the bodies of each contact accelerate per length, [s].
        direction: of arms and bodies.
    """

    def look(n: Array, end: End) -> End:
        springs, here, before, step = row_of((problem.contacts.springs, base.stuck, base.felt, by), n)
        found, (normal, friction) = nearest(springs, stretched(springs, here, step)), falls(springs, before, step)
        ahead, across = before.normal - normal - found.normal, before.friction - friction - found.friction
        pressed, square = Pressed.of(found), jnp.sum(ahead**2) + jnp.sum(across**2)
        missed, largest, first = end.missed, end.largest, problem.contacts.at(n).first
        for number, on in ((first, True), (problem.contacts.second[n], problem.contacts.second[n] < objects)):
            missed = put(missed, number, jnp.maximum(missed[number], jnp.where(on, square, 0.0)))
            largest = put(largest, number, jnp.maximum(largest[number], jnp.where(on, pressed.normal, 0.0)))
        return End(
            put(end.pressed, n, pressed),
            missed,
            largest,
            end.slope + ahead @ step.normal + across @ step.along,
            end.growth + normal @ step.normal + friction @ step.along,
        )

    none, each, objects = jnp.float32(0.0), jnp.zeros(len(problem.free) + 1), len(problem.free)
    found: End = jax.lax.fori_loop(0, problem.total, look, End(base.pressed, each, each, none, none))
    if problem.attachments is not None:
        found = found._replace(growth=found.growth + problem.attachments.growth(direction))
    return found


class Along(NamedTuple):
    """A direction, from an acceleration `here`."""

    here: Point
    direction: Point
    moves: Array
    """Which arms move, [a]."""
    by: Parting
    """How much more the bodies of each contact accelerate per length, [s]."""
    slope: Array
    """Of the cost where it begins, without contacts and without friction and limits of joints, []."""
    growth: Array
    """By how much this slope grows per length, []."""

    def measure(self, arms: Arms, problem: Problem, stuck: Stuck) -> Callable[[Array], tuple[Array, Array]]:
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
    arms: Arms, problem: Problem, forces: Point, here: Point, direction: Point, moves: Array, by: Parting
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
