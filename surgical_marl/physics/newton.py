"""The acceleration of arms and objects at which all forces balance, by Newton's method on what touches.

All forces are gradients of convex functions of the acceleration (`solver.py`, `cone.py`), and so is their sum. A Newton
step is a linear system in which each object is six numbers that only meet arms, so objects are eliminated first: what
is left is as large as the arms, whatever the number of objects. Objects that touch each other are eliminated together.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics import elimination
from surgical_marl.physics.arms import Arms, Left
from surgical_marl.physics.cone import (
    Forces,
    Parting,
    Stuck,
    between,
    curvature,
    falls,
    nearest,
    parting,
    stretched,
    wrench,
)
from surgical_marl.physics.factor import packed
from surgical_marl.physics.problem import Contact, Point, Pressed, Problem, Solution
from surgical_marl.physics.rows import absent, add, filled, put, room, row_of
from surgical_marl.physics.search import search
from surgical_marl.physics.twists import Twists, moved_cone

PASSES, ALONE = 12, 24
"""Newton steps at most, with arms and of objects alone, whose steps are short. A GPU waits for the last one of its
environments (docs/physics.md)."""
LEAST = 1e-7
"""Fall of the cost in a Newton step, N m/s2, after which none follows: that of a needle of 0.03 g whose acceleration
changes by 0.06 m/s2."""
TOLERANCE = 3e-3
"""Force of a contact that a Newton step did not foresee, as a share of its normal force, at which it is the last one.
The error that is left in the forces is about as large: what was not foreseen is all that does not balance."""


class _Base(NamedTuple):
    """All contacts where a Newton step begins, [s]."""

    stuck: Stuck
    felt: Forces
    pressed: Pressed


class _Along(NamedTuple):
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
        base = _Base(contacts.stuck, *room((found, jax.eval_shape(_pressed, found)), len(contacts.second)))

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
            by, whole = self._partings(problem, way), _ahead(here, way, jnp.float32(1.0))
            pressed, settled = self._foreseen(problem, base, by)
            if len(problem.between.low):
                settled &= (self._sides(problem, here.arms) == self._sides(problem, whole.arms)).all()
            base = base._replace(pressed=pressed)

            def searched() -> tuple[Point, _Base, Array]:
                begin, along = self._along(problem, local, here, way, touching, by)
                found = search(begin, LEAST, self._measure(problem, base, along), base.pressed)
                there = self._stretched(problem, base, by, found.length)._replace(pressed=found.seen)
                return _ahead(here, way, found.length), there, found.looks == 0

            there, base, settled = jax.lax.cond(settled, lambda: (whole, base, jnp.bool_(True)), searched)
            return there._replace(arms=there.arms + free), base, settled, count + 1

        state = Point(jnp.zeros(self._dofs.shape), jnp.zeros((self._objects, 6))), base, jnp.bool_(False), jnp.int32(0)
        here, base, _, _ = jax.lax.while_loop(going, iterate, state)
        return Solution(here.arms, here.objects, base.pressed, self._arms.between(problem, here.arms))

    def _along(
        self, problem: Problem, local: _Local, here: Point, way: Point, moves: Array, by: Parting
    ) -> tuple[Array, _Along]:
        """Return the slope of the whole cost at the beginning of a way, and what is known of the way."""
        begin, slope, growth = self._arms.slopes(problem, moves, here.arms, way.arms, local.arm_force)
        begin -= jnp.sum(local.force * way.objects)
        inertia = problem.masses @ jnp.stack([here.objects - problem.free, way.objects], -1)
        of_objects = jnp.sum(way.objects[..., None] * inertia, (0, 1))
        return begin, _Along(here, way, moves, by, slope + of_objects[0], growth + of_objects[1])

    def _partings(self, problem: Problem, way: Point) -> Parting:
        """Return how the bodies of all contacts accelerate relative to each other per length of a way, [s]."""
        motion = way.arms, self.twists.by_object(way.objects)

        def one(n: Array) -> Parting:
            contact = problem.contacts.at(n)
            return parting(contact.cone, self.twists.of(contact, *motion))

        found: Parting = filled(one, problem.total, len(problem.contacts.second))
        return found

    def _stretched(self, problem: Problem, base: _Base, by: Parting, length: Array) -> _Base:
        """Return all contacts a length further along a way, but for what they feel there."""

        def one(n: Array, stuck: Stuck) -> Stuck:
            springs, here, more = row_of((problem.contacts.springs, stuck, by), n)
            return put(stuck, n, stretched(springs, here, _times(length, more)))

        return base._replace(stuck=jax.lax.fori_loop(0, problem.total, one, base.stuck))

    def _foreseen(self, problem: Problem, base: _Base, by: Parting) -> tuple[Pressed, Array]:
        """Return what contacts feel at the end of a way, and whether it is as foreseen.

        It is if no contact feels much else than if it were linear from the beginning of the way on.
        """

        def look(n: Array, seen: tuple[Pressed, Array]) -> tuple[Pressed, Array]:
            springs, stuck, before, step = row_of((problem.contacts.springs, base.stuck, base.felt, by), n)
            felt, (normal, friction) = nearest(springs, stretched(springs, stuck, step)), falls(springs, before, step)
            missed = jnp.sum((before.normal - normal - felt.normal) ** 2)
            missed += jnp.sum((before.friction - friction - felt.friction) ** 2)
            pressed = _pressed(felt)
            return put(seen[0], n, pressed), seen[1] & (missed <= TOLERANCE**2 * pressed.normal**2)

        found: tuple[Pressed, Array] = jax.lax.fori_loop(0, problem.total, look, (base.pressed, jnp.bool_(True)))
        return found

    def _measure(
        self, problem: Problem, base: _Base, along: _Along
    ) -> Callable[[Array, Pressed], tuple[Array, Array, Pressed]]:
        """Return what measures the slope of the cost at a length of a way, and by how much it grows per length.

        It also notes what contacts feel there.
        """
        here, way, moves, by, slope, growth = along

        def measure(length: Array, seen: Pressed) -> tuple[Array, Array, Pressed]:
            def look(n: Array, state: tuple[Array, Array, Pressed]) -> tuple[Array, Array, Pressed]:
                slope, growth, seen = state
                springs, stuck, own = row_of((problem.contacts.springs, base.stuck, by), n)
                felt = nearest(springs, stretched(springs, stuck, _times(length, own)))
                normal, friction = falls(springs, felt, own)
                slope -= felt.normal @ own.normal + felt.friction @ own.along
                growth += normal @ own.normal + friction @ own.along
                return slope, growth, put(seen, n, _pressed(felt))

            resists, gives = self._arms.resisted(problem, moves, here.arms, way.arms, length)
            start = slope + length * growth + resists, growth + gives, seen
            return jax.lax.fori_loop(0, problem.total, look, start)

        return measure

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
            return self._add(local, contact, found), put(felt, n, found), put(pressed, n, _pressed(found))

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


def _ahead(here: Point, way: Point, length: Array) -> Point:
    """Return the point at a length of a way."""
    return Point(here.arms + length * way.arms, here.objects + length * way.objects)


def _times(length: Array, by: Parting) -> Parting:
    return Parting(length * by.normal, length * by.along)


def _pressed(felt: Forces) -> Pressed:
    """Return what is kept of the forces of a contact."""
    return Pressed(jnp.sum(felt.normal), felt.friction, felt.slips)
