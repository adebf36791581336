"""What happens along the way of a Newton step: what contacts feel, and how the cost changes.

At the whole length of a way all forces balance, if contacts feel there what was foreseen. The slope of the cost at its
end is therefore the force that was not foreseen, times the way.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from surgical_marl.physics.arms import Arms
from surgical_marl.physics.cone import Forces, Parting, Stuck, falls, nearest, stretched
from surgical_marl.physics.problem import Point, Pressed, Problem
from surgical_marl.physics.rows import put, row_of

TOLERANCE = 3e-3
"""Force of a contact that a Newton step did not foresee, as a share of the largest normal force on the same object, at
which it is the last one. The error that is left in the forces is about as large: what was not foreseen is all that does
not balance."""


class End(NamedTuple):
    """What is found at the whole length of a way."""

    pressed: Pressed
    """What contacts feel, [s]."""
    missed: Array
    """Square of the largest force that a contact of each object feels and would not if contacts were linear from the
    beginning of the way on, N2; at the end of contacts without an object, [k + 1]."""
    largest: Array
    """Largest normal force likewise, N, [k + 1]."""
    slope: Array
    """Of the cost, []."""
    growth: Array
    """By how much the slope of the cost of contacts grew on the way, had they been linear, [].

    Without contacts it grows, too. So the slope where the way begins is less than minus this.
    """

    @property
    def foreseen(self) -> Array:
        """Whether contacts feel what was foreseen, [] bool."""
        return (self.missed <= (TOLERANCE * self.largest) ** 2).all()


def look_ahead(problem: Problem, stuck: Stuck, felt: Forces, by: Parting, pressed: Pressed) -> End:
    """Return what is found at the whole length of a way.

    Args:
        problem: whose contacts [s] they are.
        stuck: forces that would stick where the way begins, [s].
        felt: forces there, [s].
        by: how much more the bodies of each contact accelerate per length, [s].
        pressed: room for what contacts feel, [s].
    """

    def look(n: Array, end: End) -> End:
        springs, here, before, step = row_of((problem.contacts.springs, stuck, felt, by), n)
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
    found: End = jax.lax.fori_loop(0, problem.total, look, End(pressed, each, each, none, none))
    return found


def stretch(problem: Problem, stuck: Stuck, by: Parting, length: Array) -> Stuck:
    """Return the forces of all contacts that would stick at a length of a way. See `look_ahead`."""

    def one(n: Array, stuck: Stuck) -> Stuck:
        springs, here, more = row_of((problem.contacts.springs, stuck, by), n)
        return put(stuck, n, stretched(springs, here, _times(length, more)))

    found: Stuck = jax.lax.fori_loop(0, problem.total, one, stuck)
    return found


class Along(NamedTuple):
    """A way, from an acceleration `here`."""

    here: Point
    way: Point
    moves: Array
    """Which arms move, [a]."""
    by: Parting
    """How much more the bodies of each contact accelerate per length, [s]."""
    slope: Array
    """Of the cost where it begins, without contacts and without friction and limits of joints, []."""
    growth: Array
    """By how much this slope grows per length, []."""

    def measure(
        self, arms: Arms, problem: Problem, stuck: Stuck
    ) -> Callable[[Array, Pressed], tuple[Array, Array, Pressed]]:
        """Return what measures the slope of the cost at a length of the way, and by how much it grows per length.

        It also notes what contacts feel there. `stuck` is as for `look_ahead`.
        """
        here, way, moves, by, slope, growth = self

        def measure(length: Array, seen: Pressed) -> tuple[Array, Array, Pressed]:
            def look(n: Array, state: tuple[Array, Array, Pressed]) -> tuple[Array, Array, Pressed]:
                slope, growth, seen = state
                springs, own_stuck, own = row_of((problem.contacts.springs, stuck, by), n)
                felt = nearest(springs, stretched(springs, own_stuck, _times(length, own)))
                normal, friction = falls(springs, felt, own)
                slope -= felt.normal @ own.normal + felt.friction @ own.along
                growth += normal @ own.normal + friction @ own.along
                return slope, growth, put(seen, n, Pressed.of(felt))

            resists, gives = arms.resisted(problem, moves, here.arms, way.arms, length)
            start: Any = slope + length * growth + resists, growth + gives, seen
            return jax.lax.fori_loop(0, problem.total, look, start)

        return measure


def set_out(
    arms: Arms, problem: Problem, forces: Point, here: Point, way: Point, moves: Array, by: Parting
) -> tuple[Array, Along]:
    """Return the slope of the whole cost where a way begins, and what is known of the way.

    Args:
        arms: which find what is due to arms.
        problem: what is solved.
        forces: of contacts on arms, and all on objects, at `here`.
        here: an acceleration.
        way: from there.
        moves: which arms move, [a].
        by: how much more the bodies of each contact accelerate per length, [s].
    """
    begin, slope, growth = arms.slopes(problem, moves, here.arms, way.arms, forces.arms)
    begin -= jnp.sum(forces.objects * way.objects)
    inertia = problem.masses @ jnp.stack([here.objects - problem.free, way.objects], -1)
    of_objects = jnp.sum(way.objects[..., None] * inertia, (0, 1))
    return begin, Along(here, way, moves, by, slope + of_objects[0], growth + of_objects[1])


def _times(length: Array, by: Parting) -> Parting:
    return Parting(length * by.normal, length * by.along)
