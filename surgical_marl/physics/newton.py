"""The acceleration of arms and objects at which all forces balance, by Newton's method on what touches.

All forces are gradients of convex functions of the acceleration (`solver.py`, `cone.py`), and so is their sum. A Newton
step is a linear system in which each object is six numbers that only meet arms, so objects are eliminated first: what
is left is as large as the arms, whatever the number of objects. Objects that touch each other are eliminated together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics import elimination
from surgical_marl.physics.arms import Arms, Reduced
from surgical_marl.physics.cone import Cone, Forces, between, curvature, fall, forces, nearest, wrench
from surgical_marl.physics.factor import packed
from surgical_marl.physics.patches import POINTS
from surgical_marl.physics.problem import SLIPS, Contact, Point, Pressed, Problem, Solution, not_pressed
from surgical_marl.physics.rows import filled, room, row_of, stored
from surgical_marl.physics.search import search
from surgical_marl.physics.solver import Rows, row_forces

PASSES = 12
"""Newton steps at most. A GPU waits for the last one of its environments (docs/physics.md)."""
LEAST = 1e-7
"""Fall of the cost in a Newton step, N m/s2, after which none follows: that of a needle of 0.03 g whose acceleration
changes by 0.06 m/s2."""
_OTHERS = np.array([[0, 1], [1, 0], [1, 1]])
"""Of which of a contact's two bodies there are blocks, besides that of the first one alone."""
TOLERANCE = 1e-2
"""Change of friction in a Newton step, as a share of the normal force, at which sliding contacts have converged."""


class _Line(NamedTuple):
    """A contact along a way."""

    push: Array
    """Normal forces that stick, at the beginning, N, [s]; friction likewise, `pull` [3]."""
    pull: Array
    normal: Array
    """Acceleration along the normals per length of the way, [s]; along the surface, `along` [3]."""
    along: Array


class _Felt(NamedTuple):
    """The forces of contacts at a point, in memory: what their sums are made of besides `Pressed`, [s]."""

    normal: Array
    """Of each point, N, [s, p]."""
    way: Array
    """Unit vectors of friction, [s, 3]."""
    left: Array
    """Shares of the friction that would stick, [s]."""


class _Local(NamedTuple):
    """Sums over contacts: forces, and by how much they fall with the acceleration."""

    arm_excess: Array
    """[a, m]"""
    arm: Array
    """Lower halves, [a, m (m + 1) / 2]."""
    excess: Array
    """[k, 6]"""
    object: Array
    """[k, 6, 6]; if there are several objects, each with each one, [k, k, 6, 6]."""
    coupling: Array
    """[k, a, 6, m]"""


class Newton:
    """Solves problems of one scene with k objects.

    `dofs` [a, m] are the numbers of each arm's joints; where it has fewer than others, that of no joint.
    """

    def __init__(self, dofs: np.ndarray, joints: int, objects: int) -> None:
        self._dofs, self._objects, self._arms = dofs, objects, Arms(dofs, joints)
        self._own = [np.flatnonzero(row < joints) for row in dofs]

    def twist(self, contact: Contact, arms: Array, objects: Array) -> Array:
        """Return the twist [6] of a contact by motions of arms (`by_arm`) and of objects (`by_object`)."""
        twist = objects[contact.first]
        if self._objects > 1:
            twist -= _moved_to(objects[contact.second], contact.offset)
        if len(self._dofs):
            still = lambda twist: twist  # noqa: E731
            with_arm = lambda twist: twist + contact.jacobian @ arms[contact.arm]  # noqa: E731
            twist = jax.lax.cond(contact.arm < len(self._dofs), with_arm, still, twist)
        return twist

    def by_arm(self, joints: Array) -> Array:
        """Return what belongs to the joints [n] of all arms by arm, in memory, [a, m]; 0 for joints that are not."""
        return stored(jnp.append(joints, 0.0)[np.minimum(self._dofs, len(joints))])

    def by_object(self, each: Array) -> Array:
        """Return what belongs to objects [k, ...], and 0 for the one that stands for none, in memory, [k + 1, ...]."""
        return stored(_with_none(each))

    def solve(self, problem: Problem, arms: Array, objects: Array) -> Solution:
        """Return the accelerations and forces, beginning with accelerations of arms [n] and objects [k, 6]."""
        slots, no = len(problem.contacts.arm), jnp.bool_(False)
        pressed = not_pressed(slots)._replace(sides=jnp.full(slots, -1, jnp.int32))
        felt = room(jax.eval_shape(lambda: _Felt(jnp.zeros(POINTS), jnp.zeros(3), jnp.float32(0.0))), slots)
        state = Point(arms, objects), (pressed, felt), self._sides(problem, arms), no, no, jnp.int32(0)

        def going(state: Any) -> Array:
            settled, count = state[-2:]
            return ~settled & (count < PASSES)

        def iterate(state: Any) -> Any:
            here, contacts, sides, whole, _, count = state
            *contacts, same, turned = self._forces(problem, here, *contacts)
            new_sides = self._sides(problem, here.arms)
            settled = whole & same & (new_sides == sides).all() & ~turned

            def on(here: Point) -> Any:
                local = self._sums(problem, here, *contacts)
                excess, stiff = self._excess(problem, here, local)
                way = self._direction(problem, here, contacts[0], excess, local, stiff)
                slope = -_dot(self._whole(problem, here, excess), way)
                last = -slope <= LEAST
                searched = lambda _: search(slope, self._line(problem, here, way))  # noqa: E731
                length = jax.lax.cond(last, lambda _: jnp.float32(1.0), searched, None)
                there = jax.tree.map(lambda x, step: x + length * step, here, way)
                return there, length == 1, last

            stay = lambda here: (here, whole, settled)  # noqa: E731
            here, whole, settled = jax.lax.cond(settled, stay, on, here)
            return here, tuple(contacts), new_sides, whole, settled, count + 1

        here, (pressed, _), _, _, _, count = jax.lax.while_loop(going, iterate, state)
        return Solution(here.arms, here.objects, pressed, self._between(problem, here.arms), count)

    def _line(self, problem: Problem, here: Point, way: Point) -> Callable[[Array], tuple[Array, Array]]:
        """Return what measures the slope of the cost at a length of a way, and by how much it grows per length.

        What all lengths have in common is computed once: the speeds of contacts along the way, and of rows.
        """
        arms, objects = self.by_arm(here.arms), self.by_object(here.objects)
        arms_way, objects_way = self.by_arm(way.arms), self.by_object(way.objects)

        def line(n: Array) -> _Line:
            contact = row_of(problem.contacts, n)
            cone, at, by = contact.cone, self.twist(contact, arms, objects), self.twist(contact, arms_way, objects_way)
            push, pull = cone.push - cone.stiff * (cone.normal @ at), cone.pull - cone.rub * (cone.along @ at)
            return _Line(push, pull, cone.normal @ by, cone.along @ by)

        lines = filled(line, problem.total, len(problem.contacts.arm))
        inertia = problem.masses @ jnp.stack([problem.free - here.objects, way.objects], -1)
        power, growth = jnp.sum(way.objects[..., None] * inertia, (0, 1))
        rows = [_along(problem.rows, here.arms, way.arms)] if len(way.arms) else []

        def press(length: Array) -> Callable[[tuple[Array, Array]], tuple[Array, Array]]:
            """Return what adds contacts of arms with arms, to the slope and its growth."""

            def add(sums: tuple[Array, Array], row: Rows) -> tuple[tuple[Array, Array], None]:
                at, by, along, low, high = _along(row, here.arms, way.arms)
                return _resisted(sums, along, at - length * by, by, low, high), None

            return lambda sums: jax.lax.scan(add, sums, problem.between)[0]

        if len(way.arms):
            power += way.arms @ (problem.smooth - problem.mass @ here.arms)
            growth += way.arms @ (problem.mass @ way.arms)

        def measure(length: Array) -> tuple[Array, Array]:
            def add(n: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
                own, cone = row_of(lines, n), row_of(problem.contacts.cone, n)
                push, pull = own.push - length * cone.stiff * own.normal, own.pull - length * cone.rub * own.along
                felt = nearest(cone, push, pull)
                power = felt.normal @ own.normal + felt.friction @ own.along
                return sums[0] - power, sums[1] + fall(cone, felt, own.normal, own.along)

            sums = jax.lax.fori_loop(0, problem.total, add, (length * growth - power, growth))
            for at, by, along, low, high in rows:
                sums = _resisted(sums, along, at - length * by, by, low, high)
            if len(problem.between.low):
                sums = jax.lax.cond(problem.overlap, press(length), lambda sums: sums, sums)
            return sums

        return measure

    # -- forces at a point

    def _forces(
        self, problem: Problem, point: Point, pressed: Pressed, felt: _Felt
    ) -> tuple[Pressed, _Felt, Array, Array]:
        """Return the forces of contacts in the place of those before.

        Also whether each is on the side on which it was, and whether friction that slips has changed, [] both.
        """
        arms, objects = self.by_arm(point.arms), self.by_object(point.objects)

        def one(n: Array, state: Any) -> Any:
            pressed, felt, same, turned = state
            contact, before = row_of(problem.contacts, n), row_of(pressed, n)
            found = forces(contact.cone, self.twist(contact, arms, objects))
            bits = jnp.where(found.normal > 0, 1 << np.arange(len(found.normal), dtype=np.int32), 0)
            sides = jnp.sum(bits) + jnp.where(found.slips, SLIPS, 0)
            own = Pressed(jnp.sum(found.normal), found.friction, sides)
            change = jnp.sum((own.friction - before.friction) ** 2) > TOLERANCE**2 * own.normal**2
            put = lambda all_, x: all_.at[n].set(x)  # noqa: E731
            pressed = jax.tree.map(put, pressed, own)
            felt = jax.tree.map(put, felt, _Felt(found.normal, found.way, found.left))
            return pressed, felt, same & (sides == before.sides), turned | (change & found.slips)

        start = pressed, felt, jnp.bool_(True), jnp.bool_(False)
        found: tuple[Pressed, _Felt, Array, Array] = jax.lax.fori_loop(0, problem.total, one, start)
        return found

    def _sums(self, problem: Problem, point: Point, pressed: Pressed, felt: _Felt) -> _Local:
        """Return sums over all contacts at a point with these forces."""
        k, (a, m) = self._objects, self._dofs.shape
        inertia = (problem.masses @ (problem.free - point.objects)[..., None])[..., 0]
        none = _Local(
            jnp.zeros((a, m)),
            jnp.zeros((a, m * (m + 1) // 2)),
            _with_none(inertia),
            self._masses(problem),
            jnp.zeros((k + 1, a, 6, m)),
        )

        def one(n: Array, local: _Local) -> _Local:
            contact, own, its = row_of((problem.contacts, felt, pressed), n)
            return self._add(local, contact, Forces(own.normal, its.friction, its.sides >= SLIPS, own.way, own.left))

        local = jax.lax.fori_loop(0, problem.total, one, none)
        own = local.object[:k] if k < 2 else local.object.reshape(k + 1, k + 1, 6, 6)[:k, :k]
        return local._replace(excess=local.excess[:k], object=own, coupling=local.coupling[:k])

    def _masses(self, problem: Problem) -> Array:
        """Return the blocks of masses alone, as `_add` adds to them, with those of no object."""
        if self._objects < 2:
            return _with_none(problem.masses)

        def note(blocks: Array, row: tuple[Array, Array]) -> tuple[Array, None]:
            return self._grown(blocks, row[0], row[0], row[1]), None

        none = jnp.zeros((self._objects + 1) ** 2 * 36)
        return jax.lax.scan(note, none, (jnp.arange(self._objects), problem.masses))[0]

    def _grown(self, blocks: Array, first: Array, second: Array, block: Array) -> Array:
        """Return blocks with more [6, 6] of two objects. Those of several objects are one array in memory."""
        if self._objects < 2:
            return blocks.at[first].add(block)
        at = (36 * ((self._objects + 1) * first + second),)
        more = jax.lax.dynamic_slice(blocks, at, (36,)) + block.ravel()
        return jax.lax.dynamic_update_slice(blocks, more, at)

    def _add(self, local: _Local, contact: Contact, felt: Forces) -> _Local:
        """Return sums with one more contact."""
        first, second, cone = contact.first, contact.second, contact.cone
        pull, stiff = wrench(cone, felt), curvature(cone, felt)
        if self._objects > 1:

            def on_other(parts: tuple[Array, Array]) -> tuple[Array, Array]:
                both = jax.tree.map(lambda *x: stored(jnp.stack(x)), cone, _moved_cone(contact))
                bodies = jnp.stack([first, second])

                def add(blocks: Array, pair: Array) -> tuple[Array, None]:
                    block = between(row_of(both, pair[0]), row_of(both, pair[1]), felt)
                    return self._grown(blocks, bodies[pair[0]], bodies[pair[1]], block), None

                pulled = parts[0].at[second].add(wrench(row_of(both, 1), felt))
                return pulled, jax.lax.scan(add, parts[1], jnp.asarray(_OTHERS))[0]

            touches = second < self._objects
            parts = jax.lax.cond(touches, on_other, lambda parts: parts, (local.excess, local.object))
            local = local._replace(excess=parts[0], object=parts[1])
        grown = self._grown(local.object, first, first, stiff)
        local = local._replace(excess=local.excess.at[first].add(pull), object=grown)
        if not len(self._dofs):
            return local

        def on_arm(local: _Local) -> _Local:
            arm, jacobian = contact.arm, contact.jacobian
            half = stiff @ jacobian
            first_joint, second_joint = np.tril_indices(jacobian.shape[1])
            return local._replace(
                arm_excess=local.arm_excess.at[arm].add(jacobian.T @ pull),
                arm=local.arm.at[arm].add(jnp.sum(jacobian[:, first_joint] * half[:, second_joint], 0)),
                coupling=local.coupling.at[first, arm].add(half),
            )

        return jax.lax.cond(contact.arm < len(self._dofs), on_arm, lambda local: local, local)

    def _excess(self, problem: Problem, point: Point, local: _Local) -> tuple[Point, Array]:
        """Return the forces that are left over, but for joints' rows, and how those on arms fall, [n, n]."""
        if not len(point.arms):
            return Point(point.arms, local.excess), problem.mass
        excess, stiff = problem.smooth - problem.mass @ point.arms, problem.mass
        places = packed(self._dofs.shape[1])
        for arm, own in enumerate(self._own):
            dofs = self._dofs[arm, own]
            excess = excess.at[dofs].add(local.arm_excess[arm, own])
            stiff = stiff.at[np.ix_(dofs, dofs)].add(local.arm[arm][places[np.ix_(own, own)]])

        def press(total: tuple[Array, Array], row: Rows) -> tuple[tuple[Array, Array], None]:
            force = jnp.maximum(row.impedance * (row.reference - row.jacobian @ point.arms), 0.0)
            whole = jnp.where(force > 0, row.impedance, 0.0) * row.jacobian
            return (total[0] + force * row.jacobian, total[1] + whole[:, None] * row.jacobian), None

        if len(problem.between.low):
            with_rows = lambda total: jax.lax.scan(press, total, problem.between)[0]  # noqa: E731
            excess, stiff = jax.lax.cond(problem.overlap, with_rows, lambda total: total, (excess, stiff))
        return Point(excess, local.excess), stiff

    def _whole(self, problem: Problem, point: Point, excess: Point) -> Point:
        """Return the forces that are left over, with those of joints' rows."""
        rows = problem.rows
        return excess._replace(arms=excess.arms + rows.jacobian.T @ row_forces(rows, point.arms))

    def _sides(self, problem: Problem, arms: Array) -> Array:
        """Return which contacts of arms with arms press, [r] bool."""
        return self._between(problem, arms) > 0

    def _between(self, problem: Problem, arms: Array) -> Array:
        """Return the forces of contacts of arms with arms, N, [r]."""
        none = jnp.zeros(len(problem.between.low))
        if not len(none):
            return none
        return jax.lax.cond(problem.overlap, lambda arms: row_forces(problem.between, arms), lambda _: none, arms)

    # -- the way from there

    def _direction(
        self, problem: Problem, here: Point, pressed: Pressed, excess: Point, local: _Local, stiff: Array
    ) -> Point:
        """Return the way to the least cost if contacts are linear functions; friction and limits of joints are not.

        Objects are eliminated, arms solved, each alone if nothing joins them, and objects found from them.
        """
        touched, linked = self._touched(problem), jnp.bool_(False)
        if self._objects > 1:
            there = np.arange(len(pressed.normal)) < problem.total
            linked = (there & (problem.contacts.second < self._objects) & (pressed.normal > 0)).any()
            gone = elimination.touching(local.object, local.excess, local.coupling)
        else:
            gone = elimination.apart(local.object, local.excess, local.coupling, touched.any(1))
        found = excess.arms
        if len(self._dofs):
            on = touched | (linked & touched.any(0))  # what an object touches moves those that it touches
            left = Reduced(stiff, excess.arms, here.arms, problem.rows, problem.joints, gone.half, gone.wide, on)
            joined = (on.sum(1) > 1).any() | self._sides(problem, here.arms).any()
            each, several = self._arms.each, len(self._dofs) > 1
            found = jax.lax.cond(joined, self._arms.together, each, left) if several else each(left)
        by_arm = self.by_arm(found)
        if self._objects > 1:
            return Point(found, elimination.ways_touching(gone, by_arm))
        return Point(found, elimination.ways_apart(gone, by_arm, touched.any(1)))

    def _touched(self, problem: Problem) -> Array:
        """Return which objects touch which arms, [k, a]."""
        contacts = problem.contacts
        there = jnp.arange(len(contacts.arm)) < problem.total
        first = there & (contacts.first == np.arange(self._objects)[:, None])
        return (first[:, None] & (contacts.arm == np.arange(len(self._dofs))[:, None])).any(-1)


def _with_none(each: Array) -> Array:
    """Return what belongs to objects [k, ...], and 0 for the one that stands for none, [k + 1, ...]."""
    return jnp.concatenate([each, jnp.zeros((1, *each.shape[1:]))])


def _along(rows: Rows, arms: Array, way: Array) -> tuple[Array, ...]:
    """Return forces of rows without bounds, by how much they fall per length of a way, its speeds, and the bounds."""
    along = rows.jacobian @ way
    return rows.impedance * (rows.reference - rows.jacobian @ arms), rows.impedance * along, along, rows.low, rows.high


def _resisted(
    sums: tuple[Array, Array], along: Array, force: Array, by: Array, low: Array, high: Array
) -> tuple[Array, Array]:
    """Return slope and growth of the cost along a way with those of rows: speeds, forces without bounds, their fall."""
    gives = jnp.where((force > low) & (force < high), by, 0.0)
    return sums[0] - jnp.sum(along * jnp.clip(force, low, high)), sums[1] + jnp.sum(along * gives)


def _dot(one: Point, other: Point) -> Array:
    return jnp.sum(one.arms * other.arms) + jnp.sum(one.objects * other.objects)


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
