"""The acceleration of arms and objects at which all forces balance, by Newton's method on what touches.

All forces are gradients of convex functions of the acceleration (`constraint_rows.py`, `friction_cone.py`), and so is
their sum. A Newton step is a linear system in which each object is six numbers that only meet arms, so objects are
eliminated first: what is left is as large as the arms, whatever the number of objects. Objects that touch each other
are eliminated together.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.friction_cone import Parting, parting
from surgical_marl.physics.contact.relative_motion import RelativeMotion
from surgical_marl.physics.solver import schur
from surgical_marl.physics.solver.arm_solver import ArmSolver, ArmSystem
from surgical_marl.physics.solver.constraint_rows import JointRows, Rows
from surgical_marl.physics.solver.contact_line import ContactState, set_out, whole_step
from surgical_marl.physics.solver.hessian import Hessian
from surgical_marl.physics.solver.newton import line_search, newton
from surgical_marl.physics.solver.problem import Point, Problem, Solution
from surgical_marl.physics.tree_utils import filled

STEPS, STEPS_ALONE = 12, 24
"""Newton steps at most, with arms and of objects alone, whose steps are short. A GPU waits for the last one of its
environments (docs/physics.md)."""
LEAST = 1e-7
"""Slope of the cost along a Newton step, N m/s2 (about twice its fall), below which no step follows: that of a needle
of 0.03 g whose acceleration changes by 0.06 m/s2."""


class ContactSolver:
    """Solves problems of one scene with k objects.

    `dofs` [a, m] are the numbers of each arm's joints; where it has fewer than others, that of no joint.
    """

    def __init__(self, dofs: np.ndarray, joints: int, objects: int) -> None:
        self._dofs, self._objects, self._arms = dofs, objects, ArmSolver(dofs, joints)
        self.twists = RelativeMotion(dofs, objects)
        self._steps = STEPS if len(dofs) else STEPS_ALONE

    def solve_arms(
        self, mass: Array, smooth: Array, joints: JointRows, start: Array, between: Rows
    ) -> tuple[Array, Array]:
        """Return accelerations [a, m] and forces of contacts [r] of arms alone: see `ArmSolver.with_rows`."""
        return self._arms.with_rows(mass, smooth, joints, start, between)

    def solve(self, problem: Problem) -> Solution:
        """Return the accelerations and forces."""

        def step(state: tuple[Point, ContactState], count: Array) -> tuple[tuple[Point, ContactState], Array]:
            here, forces = state
            sums = Hessian.of(problem, forces, here)
            direction, touching = self._direction(problem, here, sums, count == 0), _touching(problem)
            # Arms that touch nothing take their whole step at once, as if nothing else were there, and are done.
            free = jnp.where(touching[:, None], 0.0, direction.arms)
            direction = direction._replace(arms=jnp.where(touching[:, None], direction.arms, 0.0))
            by, whole = self._partings(problem, direction), here.ahead(direction, jnp.float32(1.0))
            pressed, converged = whole_step(problem, forces, by)
            forces = forces._replace(pressed=pressed)
            if len(problem.between.low):
                converged &= (self._sides(problem, here.arms) == self._sides(problem, whole.arms)).all()

            def search() -> tuple[Point, ContactState, Array]:
                loads = Point(sums.arm_force, sums.force[: self._objects])
                begin, along = set_out(self._arms, problem, loads, here, direction, touching, by)
                found = line_search(begin, LEAST, along.measure(self._arms, problem, forces.stuck))
                there = here.ahead(direction, found.length), forces.ahead(problem, by, found.length)
                return *there, found.looks == 0

            there, forces, converged = jax.lax.cond(converged, lambda: (whole, forces, jnp.bool_(True)), search)
            return (there._replace(arms=there.arms + free), forces), converged

        here = Point(jnp.zeros(self._dofs.shape), jnp.zeros((self._objects, 6)))
        here, forces = newton(step, (here, ContactState.of(problem.contacts)), self._steps)
        return Solution(here.arms, here.objects, forces.pressed, self._arms.between(problem, here.arms))

    def _partings(self, problem: Problem, direction: Point) -> Parting:
        """Return how the bodies of all contacts accelerate relative to each other per length of a direction, [s]."""
        motion = direction.arms, self.twists.by_object(direction.objects)

        def one(n: Array) -> Parting:
            contact = problem.contacts.at(n)
            return parting(contact.cone, self.twists.of(contact, *motion))

        found: Parting = filled(one, problem.total, len(problem.contacts.second))
        return found

    # -- the search direction

    def _direction(self, problem: Problem, here: Point, sums: Hessian, first: Array) -> Point:
        """Return the Newton direction: forces of contacts are linearised, friction and limits of joints are exact.

        Objects are eliminated, arms solved, and objects found from them. Unless it is the `first` Newton step, arms
        that touch nothing are solved already, and their direction is zero.
        """
        k, linked = self._objects, sums.linked
        touched = sums.met.reshape(k + 1, len(self._dofs))[:k]
        gone = schur.eliminate(sums.object[:k], sums.cross, sums.force[:k], sums.coupling, touched, linked)
        found = here.arms
        if len(self._dofs):
            left = ArmSystem(sums.arm, sums.on_arm, sums.arm_force, gone)
            found = self._directions(problem, here.arms, left, first)
        return Point(found, schur.back_substitute(gone, found, linked))

    def _directions(self, problem: Problem, here: Array, left: ArmSystem, first: Array) -> Array:
        """Return the directions [a, m] of arms: of each alone, of those that one object joins, or of all at once."""
        begin = jnp.where(first, problem.start, here)
        together = partial(self._arms.together, problem, here, begin)
        joined = partial(self._arms.joined, problem, here, begin)
        each = partial(self._arms.each, problem, here, begin, _touching(problem) | first)
        if len(self._dofs) < 2:
            return each(left)
        joins, pressed = left.objects.touched.sum(1) > 1, self._sides(problem, here).any()
        if not self._objects:  # nothing joins arms but their own contacts
            return jax.lax.cond(pressed, together, each, left)

        def linked(left: ArmSystem) -> Any:
            return jax.lax.cond(pressed | (joins.sum() > 1), together, joined, left)

        return jax.lax.cond(pressed | joins.any(), linked, each, left)

    def _sides(self, problem: Problem, arms: Array) -> Array:
        """Return which contacts of arms with arms press, [r] bool."""
        return self._arms.between(problem, arms) > 0


def _touching(problem: Problem) -> Array:
    """Return which arms have contacts, [a] bool: all of them if any two overlap."""
    return problem.contacts.on_arm | problem.overlap
