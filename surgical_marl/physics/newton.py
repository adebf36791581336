"""The acceleration of arms and objects at which all forces balance, by Newton's method on what touches.

All forces are gradients of convex functions of the acceleration (`solver.py`, `cone.py`), and so is their sum. A Newton
step is a linear system in which each object is six numbers that only meet arms, so objects are eliminated first: what
is left is as large as the arms, whatever the number of objects. Objects that touch each other are eliminated together.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics import elimination
from surgical_marl.physics.along import look_ahead, set_out, stretch
from surgical_marl.physics.arms import Arms, Left
from surgical_marl.physics.cone import Forces, Parting, Stuck, between, curvature, nearest, parting, wrench
from surgical_marl.physics.factor import packed
from surgical_marl.physics.problem import Contact, Point, Pressed, Problem, Solution
from surgical_marl.physics.rows import absent, add, filled, put, room, row_of
from surgical_marl.physics.search import ENOUGH, search
from surgical_marl.physics.twists import Twists, moved_cone

PASSES, ALONE = 12, 24
"""Newton steps at most, with arms and of objects alone, whose steps are short. A GPU waits for the last one of its
environments (docs/physics.md)."""
LEAST = 1e-7
"""Fall of the cost in a Newton step, N m/s2, after which none follows: that of a needle of 0.03 g whose acceleration
changes by 0.06 m/s2."""
FIRST = 10.0
"""Slope at the end of the first Newton step, as a share of what contacts resist along it, up to which it is gone whole.
A search might find a better place to go on from, but seldom saves a step."""


class _Base(NamedTuple):
    """All contacts where a Newton step begins, [s]."""

    stuck: Stuck
    felt: Forces
    pressed: Pressed


class _Local(NamedTuple):
    """Sums over contacts: forces, and by how much they fall with the acceleration."""

    arm_force: Array
    """[a, m]"""
    arm: Array
    """Lower halves, [a, m (m + 1) / 2]; nothing for an arm without contacts."""
    force: Array
    """With the rest of what an object's acceleration takes, [k, 6]."""
    object: Array
    """Lower halves, [k, 21]."""
    cross: Array
    """Of objects with each other: see `elimination.Blocks`."""
    coupling: Array
    """Of object o and arm i in row a o + i, [(k + 1) a, 6, m]; nothing where they were not met."""
    met: Array
    """Which objects touch which arms, [k, a] bool."""
    on_arm: Array
    """Which arms have contacts, [a] bool."""


_WHOLE = packed(6)


class Newton:
    """Solves problems of one scene with k objects.

    `dofs` [a, m] are the numbers of each arm's joints; where it has fewer than others, that of no joint.
    """

    def __init__(self, dofs: np.ndarray, joints: int, objects: int) -> None:
        self._dofs, self._objects, self._arms = dofs, objects, Arms(dofs, joints)
        self.twists = Twists(dofs, objects)
        self._passes = PASSES if len(dofs) else ALONE

    def solve(self, problem: Problem) -> Solution:
        """Return the accelerations and forces."""
        contacts = problem.contacts
        found = jax.eval_shape(lambda: nearest(*row_of((contacts.springs, contacts.stuck), 0)))
        base = _Base(contacts.stuck, *room((found, jax.eval_shape(Pressed.of, found)), len(contacts.second)))

        def going(state: Any) -> Array:
            *_, settled, count = state
            return ~settled & (count < self._passes)

        def iterate(state: Any) -> Any:
            here, base, _, count = state
            local, base = self._contacts(problem, here, base)
            way, touching = self._direction(problem, here, base.pressed, local, count == 0), _touching(problem, local)
            # Arms that touch nothing go all of their way at once, as if nothing else were there, and are done.
            free = jnp.where(touching[:, None], 0.0, way.arms)
            way = way._replace(arms=jnp.where(touching[:, None], way.arms, 0.0))
            by, whole = self._partings(problem, way), here.ahead(way, jnp.float32(1.0))
            end = look_ahead(problem, base.stuck, base.felt, by, base.pressed)
            base = base._replace(pressed=end.pressed)
            settled = end.foreseen
            good = jnp.abs(end.slope) <= jnp.where(count == 0, FIRST, ENOUGH) * end.growth
            good &= end.growth > LEAST
            if len(problem.between.low):
                same = (self._sides(problem, here.arms) == self._sides(problem, whole.arms)).all()
                settled, good = settled & same, good & same

            def searched() -> tuple[Array, Pressed, Array]:
                forces = Point(local.arm_force, local.force)
                begin, along = set_out(self._arms, problem, forces, here, way, touching, by)
                found = search(begin, LEAST, along.measure(self._arms, problem, base.stuck), base.pressed)
                return found.length, found.seen, found.looks == 0

            def gone_on() -> tuple[Point, _Base, Array]:
                as_seen = lambda: (jnp.float32(1.0), base.pressed, jnp.bool_(False))  # noqa: E731
                length, pressed, settled = jax.lax.cond(good, as_seen, searched)
                stuck = stretch(problem, base.stuck, by, length)
                return here.ahead(way, length), base._replace(stuck=stuck, pressed=pressed), settled

            there, base, settled = jax.lax.cond(settled, lambda: (whole, base, jnp.bool_(True)), gone_on)
            return there._replace(arms=there.arms + free), base, settled, count + 1

        state = Point(jnp.zeros(self._dofs.shape), jnp.zeros((self._objects, 6))), base, jnp.bool_(False), jnp.int32(0)
        here, base, _, _ = jax.lax.while_loop(going, iterate, state)
        return Solution(here.arms, here.objects, base.pressed, self._arms.between(problem, here.arms))

    def _partings(self, problem: Problem, way: Point) -> Parting:
        """Return how the bodies of all contacts accelerate relative to each other per length of a way, [s]."""
        motion = way.arms, self.twists.by_object(way.objects)

        def one(n: Array) -> Parting:
            contact = problem.contacts.at(n)
            return parting(contact.cone, self.twists.of(contact, *motion))

        found: Parting = filled(one, problem.total, len(problem.contacts.second))
        return found

    # -- forces at a point

    def _contacts(self, problem: Problem, point: Point, base: _Base) -> tuple[_Local, _Base]:
        """Return sums over all contacts, and these with what they feel."""
        k, (a, m) = self._objects, self._dofs.shape
        inertia = (problem.masses @ (problem.free - point.objects)[..., None])[..., 0]
        none = _Local(
            jnp.zeros((a, m)),
            absent(jax.ShapeDtypeStruct((a, m * (m + 1) // 2), jnp.float32)),
            _with_room(inertia),
            _with_room(problem.masses[:, *np.tril_indices(6)]),
            jax.lax.cond(self._linked(problem), jnp.zeros_like, absent, jnp.zeros(36 * k * k if k > 1 else 0)),
            absent(jax.ShapeDtypeStruct(((k + 1) * a, 6, m), jnp.float32)),
            jnp.zeros((k + 1) * a, bool),
            jnp.zeros(a, bool),
        )

        def one(n: Array, sums: tuple[_Local, Forces, Pressed]) -> tuple[_Local, Forces, Pressed]:
            (local, felt, pressed), contact = sums, problem.contacts.at(n)
            found = nearest(contact.cone.springs, row_of(base.stuck, n))
            return self._add(local, contact, found), put(felt, n, found), put(pressed, n, Pressed.of(found))

        local, felt, pressed = jax.lax.fori_loop(0, problem.total, one, (none, base.felt, base.pressed))
        cut = lambda each: each[:k]  # noqa: E731
        met = cut(local.met.reshape(k + 1, a))
        local = local._replace(force=cut(local.force), object=cut(local.object), met=met)
        return local, base._replace(felt=felt, pressed=pressed)

    def _add(self, local: _Local, contact: Contact, felt: Forces) -> _Local:
        """Return sums with one more contact."""
        first, second, cone = contact.first, contact.second, contact.cone
        pull, stiff = wrench(cone, felt), curvature(cone, felt)
        if self._objects > 1:

            def on_other(local: _Local) -> _Local:
                moved = moved_cone(contact)
                at = (36 * (self._objects * first + second),)
                block = jax.lax.dynamic_slice(local.cross, at, (36,)) + between(cone, moved, felt).ravel()
                return local._replace(
                    force=add(local.force, second, wrench(moved, felt)),
                    object=add(local.object, second, curvature(moved, felt)),
                    cross=jax.lax.dynamic_update_slice(local.cross, block, at),
                )

            local = jax.lax.cond(second < self._objects, on_other, lambda local: local, local)
        local = local._replace(force=add(local.force, first, pull), object=add(local.object, first, stiff))
        if not len(self._dofs):
            return local

        def on_arm(local: _Local) -> _Local:
            arm, jacobian = contact.arm, contact.jacobian
            half = stiff[_WHOLE] @ jacobian
            first_joint, second_joint = np.tril_indices(jacobian.shape[1])
            own, pair = jnp.sum(jacobian[:, first_joint] * half[:, second_joint], 0), len(self._dofs) * first + arm
            return local._replace(
                arm_force=add(local.arm_force, arm, jacobian.T @ pull),
                arm=_begun(local.arm, arm, own, local.on_arm),
                coupling=_begun(local.coupling, pair, half, local.met),
                met=put(local.met, pair, True),
                on_arm=put(local.on_arm, arm, True),
            )

        return jax.lax.cond(contact.arm < len(self._dofs), on_arm, lambda local: local, local)

    # -- the way from there

    def _direction(self, problem: Problem, here: Point, pressed: Pressed, local: _Local, first: Array) -> Point:
        """Return the way to the least cost if contacts are linear functions; friction and limits of joints are not.

        Objects are eliminated, arms solved, and objects found from them. Unless it is the `first` Newton step, arms
        that touch nothing are where their forces balance.
        """
        touched, pressing = local.met, pressed.normal > 0
        linked = self._linked(problem, pressing)
        blocks = elimination.Blocks(local.object, local.cross)
        gone = elimination.eliminate(blocks, local.force, local.coupling, touched, linked)
        found = here.arms
        if len(self._dofs):
            on = touched | (linked & touched.any(0))  # what an object touches moves those that it touches
            left = Left(local.arm, local.on_arm, local.arm_force, gone.half, gone.wide, on)
            found = self._ways(problem, here.arms, left, first)
        return Point(found, elimination.ways(gone, found, touched, linked))

    def _ways(self, problem: Problem, here: Array, left: Left, first: Array) -> Array:
        """Return the ways [a, m] of arms: of each alone, of those that one object joins, or of all at once."""
        begin = jnp.where(first, problem.eased, here)
        together = partial(self._arms.together, problem, here, begin)
        bridged = partial(self._arms.bridged, problem, here, begin)
        each = partial(self._arms.each, problem, here, begin, _touching(problem, left) | first)
        if len(self._dofs) < 2:
            return each(left)
        bridges, pressed = left.touched.sum(1) > 1, self._sides(problem, here).any()
        joined = lambda left: jax.lax.cond(pressed | (bridges.sum() > 1), together, bridged, left)  # noqa: E731
        return jax.lax.cond(pressed | bridges.any(), joined, each, left)

    def _linked(self, problem: Problem, pressing: Any = True) -> Array:
        """Return whether any contact joins two objects, [], of those that are `pressing`, [s]."""
        if self._objects < 2:
            return jnp.bool_(False)
        contacts = problem.contacts
        there = np.arange(len(contacts.second)) < problem.total
        return (there & (contacts.second < self._objects) & pressing).any()

    def _sides(self, problem: Problem, arms: Array) -> Array:
        """Return which contacts of arms with arms press, [r] bool."""
        return self._arms.between(problem, arms) > 0


def _with_room(each: Array) -> Array:
    """Return what belongs to objects [k, ...], and room for the one that stands for none, [k + 1, ...]."""
    return jnp.concatenate([each, absent(jax.ShapeDtypeStruct((1, *each.shape[1:]), each.dtype))])


def _begun(sums: Array, i: Array, row: Array, begun: Array) -> Array:
    """Return sums with more in one row, which begins with it if it was not `begun`."""
    return put(sums, i, jax.lax.cond(begun[i], lambda: sums[i] + row, lambda: row))


def _touching(problem: Problem, local: _Local | Left) -> Array:
    """Return which arms touch anything, [a] bool."""
    return local.on_arm | problem.overlap
