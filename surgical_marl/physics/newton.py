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
from surgical_marl.physics.cone import Cone, Forces, between, curvature, fall, forces, wrench
from surgical_marl.physics.factor import packed
from surgical_marl.physics.problem import SLIPS, Contact, Point, Pressed, Problem, Solution
from surgical_marl.physics.rows import absent, add, put, room, row_of
from surgical_marl.physics.search import search

PASSES, ALONE = 12, 24
"""Newton steps at most, with arms and of objects alone, whose steps are short. A GPU waits for the last one of its
environments (docs/physics.md)."""
LEAST = 1e-7
"""Fall of the cost in a Newton step, N m/s2, after which none follows: that of a needle of 0.03 g whose acceleration
changes by 0.06 m/s2."""
TOLERANCE = 1e-2
"""Change of friction in a Newton step, as a share of the normal force, at which sliding contacts have converged."""


class _Seen(NamedTuple):
    """The forces of contacts at a point, and how they differ from those at the point where a Newton step began."""

    pressed: Pressed
    """[s]"""
    same: Array
    """Whether each contact is on the same side, [] bool."""
    turned: Array
    """Whether friction has changed of any that slips, [] bool."""


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
        self._passes = PASSES if len(dofs) else ALONE

    def twist(self, contact: Contact, arms: Array, objects: Array) -> Array:
        """Return the twist [6] of a contact by motions of arms (`by_arm`) and of objects (`by_object`)."""
        return self.twists(contact, (arms, objects))[0]

    def twists(self, contact: Contact, *motions: tuple[Array, Array]) -> list[Array]:
        """Return the twist [6] of a contact by each of several motions, as `twist` does."""
        found = [objects[contact.first] for _, objects in motions]
        if self._objects > 1:
            others = [_moved_to(objects[contact.second], contact.offset) for _, objects in motions]
            found = [twist - other for twist, other in zip(found, others, strict=True)]
        if not len(self._dofs):
            return found

        def with_arm(found: list[Array]) -> list[Array]:
            moved = [contact.by_joints(arms[contact.arm]) for arms, _ in motions]
            return [twist + more for twist, more in zip(found, moved, strict=True)]

        return jax.lax.cond(contact.arm < len(self._dofs), with_arm, lambda found: found, found)

    def by_arm(self, joints: Array) -> Array:
        """Return what belongs to the joints [n] of all arms by arm, [a, m]; 0 for joints that are not."""
        return jnp.append(joints, 0.0)[np.minimum(self._dofs, len(joints))]

    def by_object(self, each: Array) -> Array:
        """Return what belongs to objects [k, ...], and 0 for the one that stands for none, [k + 1, ...]."""
        return _with_none(each)

    def solve(self, problem: Problem, arms: Array, objects: Array) -> Solution:
        """Return the accelerations and forces, beginning with accelerations of arms [a, m] and objects [k, 6]."""
        shape = jax.eval_shape(lambda: Pressed(jnp.float32(0.0), jnp.zeros(3), jnp.int32(0)))
        state = Point(arms, objects), room(shape, len(problem.contacts.second)), jnp.bool_(False), jnp.int32(0)

        def going(state: Any) -> Array:
            settled, count = state[-2:]
            return ~settled & (count < self._passes)

        def iterate(state: Any) -> Any:
            here, pressed, _, count = state
            local, pressed = self._contacts(problem, here, pressed)
            touching = (local.on_arm | problem.overlap)[:, None]
            way = self._direction(problem, here, pressed, local, touching[:, 0] | (count == 0))
            # Arms that touch nothing go all of their way at once, as if nothing else were there, and are done.
            free, way = jnp.where(touching, 0.0, way.arms), way._replace(arms=jnp.where(touching, way.arms, 0.0))
            begin, slope, growth = self._arms.slopes(problem, here.arms, way.arms, local.arm_force)
            begin -= jnp.sum(local.force * way.objects)
            inertia = problem.masses @ jnp.stack([here.objects - problem.free, way.objects], -1)
            of_objects = jnp.sum(way.objects[..., None] * inertia, (0, 1))
            slope, growth = slope + of_objects[0], growth + of_objects[1]
            seen = _Seen(pressed, jnp.bool_(True), jnp.bool_(False))
            found = search(begin, LEAST, self._measure(problem, here, way, slope, growth), seen)
            there = jax.tree.map(lambda x, step: x + found.length * step, here, way)
            there = there._replace(arms=there.arms + free)
            settled = (found.looks < 2) & found.seen.same & ~found.seen.turned
            if len(problem.between.low):
                settled &= (self._sides(problem, here.arms) == self._sides(problem, there.arms)).all()
            return there, found.seen.pressed, settled | (found.looks == 0), count + 1

        here, pressed, _, _ = jax.lax.while_loop(going, iterate, state)
        return Solution(here.arms, here.objects, pressed, self._arms.between(problem, here.arms))

    def _measure(
        self, problem: Problem, here: Point, way: Point, slope: Array, growth: Array
    ) -> Callable[[Array, _Seen], tuple[Array, Array, _Seen]]:
        """Return what measures the slope of the cost at a length of a way, and by how much it grows per length.

        It also notes the forces of contacts there. `slope` and `growth` are those at the beginning, without contacts,
        friction and limits.
        """
        motions = [(point.arms, self.by_object(point.objects)) for point in (here, way)]

        def measure(length: Array, seen: _Seen) -> tuple[Array, Array, _Seen]:
            def look(n: Array, state: tuple[Array, Array, _Seen]) -> tuple[Array, Array, _Seen]:
                contact, before = problem.contacts.at(n), row_of(state[2].pressed, n)
                cone, (at, by) = contact.cone, self.twists(contact, *motions)
                felt = forces(cone, at + length * by)
                own, normal, along = _pressed(felt), cone.normal @ by, cone.along @ by
                slope = state[0] - felt.normal @ normal - felt.friction @ along
                change = jnp.sum((own.friction - before.friction) ** 2) > TOLERANCE**2 * own.normal**2
                same = state[2].same & (own.sides == before.sides)
                seen = _Seen(put(state[2].pressed, n, own), same, state[2].turned | (change & felt.slips))
                return slope, state[1] + fall(cone, felt, normal, along), seen

            resists, gives = self._arms.resisted(problem, here.arms, way.arms, length)
            start = slope + length * growth + resists, growth + gives, seen
            return jax.lax.fori_loop(0, problem.total, look, start)

        return measure

    # -- forces at a point

    def _contacts(self, problem: Problem, point: Point, pressed: Pressed) -> tuple[_Local, Pressed]:
        """Return sums over all contacts, and their forces, in the place of those before."""
        k, (a, m) = self._objects, self._dofs.shape
        objects = self.by_object(point.objects)
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

        def one(n: Array, sums: tuple[_Local, Pressed]) -> tuple[_Local, Pressed]:
            contact = problem.contacts.at(n)
            found = forces(contact.cone, self.twist(contact, point.arms, objects))
            return self._add(sums[0], contact, found), put(sums[1], n, _pressed(found))

        local, pressed = jax.lax.fori_loop(0, problem.total, one, (none, pressed))
        cut = lambda each: each[:k]  # noqa: E731
        met = cut(local.met.reshape(k + 1, a))
        local = local._replace(force=cut(local.force), object=cut(local.object), met=met)
        return local, pressed

    def _add(self, local: _Local, contact: Contact, felt: Forces) -> _Local:
        """Return sums with one more contact."""
        first, second, cone = contact.first, contact.second, contact.cone
        pull, stiff = wrench(cone, felt), curvature(cone, felt)
        if self._objects > 1:

            def on_other(local: _Local) -> _Local:
                moved = _moved_cone(contact)
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

    def _direction(self, problem: Problem, here: Point, pressed: Pressed, local: _Local, moving: Array) -> Point:
        """Return the way to the least cost if contacts are linear functions; friction and limits of joints are not.

        Objects are eliminated, arms solved, and objects found from them. Arms that are not `moving` [a] are where their
        forces balance.
        """
        touched, pressing = local.met, pressed.normal > 0
        linked = self._linked(problem, pressing)
        blocks = elimination.Blocks(local.object, local.cross)
        gone = elimination.eliminate(blocks, local.force, local.coupling, touched, linked)
        found = here.arms
        if len(self._dofs):
            on = touched | (linked & touched.any(0))  # what an object touches moves those that it touches
            left = Left(local.arm, local.on_arm, local.arm_force, gone.half, gone.wide, on)
            found = self._ways(problem, here.arms, left, moving)
        return Point(found, elimination.ways(gone, found, touched, linked))

    def _ways(self, problem: Problem, here: Array, left: Left, moving: Array) -> Array:
        """Return the ways [a, m] of arms: of each alone, of those that one object joins, or of all at once."""
        bridged, together = (partial(ways, problem, here) for ways in (self._arms.bridged, self._arms.together))
        each = partial(self._arms.each, problem, here, moving)
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


def _with_none(each: Array) -> Array:
    """Return what belongs to objects [k, ...], and 0 for the one that stands for none, [k + 1, ...]."""
    return jnp.concatenate([each, jnp.zeros((1, *each.shape[1:]))])


def _with_room(each: Array) -> Array:
    """Return what belongs to objects [k, ...], and room for the one that stands for none, [k + 1, ...]."""
    return jnp.concatenate([each, absent(jax.ShapeDtypeStruct((1, *each.shape[1:]), each.dtype))])


def _begun(sums: Array, i: Array, row: Array, begun: Array) -> Array:
    """Return sums with more in one row, which begins with it if it was not `begun`."""
    return put(sums, i, jax.lax.cond(begun[i], lambda: sums[i] + row, lambda: row))


def _pressed(felt: Forces) -> Pressed:
    """Return what is kept of the forces of a contact."""
    bits = jnp.where(felt.normal > 0, 1 << np.arange(len(felt.normal), dtype=np.int32), 0)
    return Pressed(jnp.sum(felt.normal), felt.friction, jnp.sum(bits) + jnp.where(felt.slips, SLIPS, 0))


def _moved_to(twist: Array, offset: Array) -> Array:
    """Return the twist [6] at a place from that of a body whose centre of mass is `offset` [3] away."""
    return jnp.concatenate([twist[:3] - jnp.cross(twist[3:], offset), twist[3:]])


def _moved_cone(contact: Contact) -> Cone:
    """Return the cone with its twists at the centre of mass of the other object, and as that one feels it.

    Its rows are moved before anything is made of them: in float32 a curvature about one body's centre, moved to that of
    a small one, would be wrong by more than that one's inertia.
    """
    shift, cone = _shift(contact.offset), contact.cone
    return cone._replace(normal=-cone.normal @ shift, along=-cone.along @ shift)


def _shift(offset: Array) -> Array:
    """Return the matrix [6, 6] of `_moved_to`."""
    return jax.vmap(lambda unit: _moved_to(unit, offset), out_axes=1)(jnp.eye(6))
