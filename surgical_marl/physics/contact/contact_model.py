"""The contact model: springs and dampers of each patch along its normal and along the surface."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.broadphase import Joints
from surgical_marl.physics.contact.contact_pairs import ContactPairs
from surgical_marl.physics.contact.contact_patch import AWAY, Patch
from surgical_marl.physics.contact.detection import AHEAD, MARGIN, Slots
from surgical_marl.physics.contact.friction_cone import Cone, Forces, Springs, Stuck, nearest, presses
from surgical_marl.physics.contact.grips import DAMPING, SHEAR, Fingers, GripMemory, Grips, finger_of
from surgical_marl.physics.contact.relative_motion import RelativeMotion, bends
from surgical_marl.physics.solver.problem import Contact, Contacts
from surgical_marl.physics.systems.rigid_motion import Bodies
from surgical_marl.physics.tree_utils import Listed, picked, put, room, row_of

FIRM = 1e-5
"""Overlap now or at the end of the step from which on this damping is whole, m. It begins with none, so that a force is
continuous where it begins (K. H. Hunt and F. R. E. Crossley, 1975), and what will not touch is not slowed."""
SHARE = 0.5
"""Stiffness of each of the four points of a contact, relative to that of a point in an object's file: a contact is as
stiff as a capsule that lies flat, on its two ends."""
FASTEST = 0.04
"""Speed at which an overlap is pushed out at most, m/s: a deep one, as after a fall within one step, meets more
damping. The force of something that is pressed in grows with its overlap nevertheless."""
STOPS = 2.0
"""Speed that friction takes from sliding in an impact, relative to the coefficient of friction times the speed of
approach: 1 for a body that can't turn, 3.5 for a ball. With less, what hits and then sticks goes in; with more, what
slides on bounces."""
CREEP = 0.025
"""Friction of a contact that remembers no position is a damper until it slips: this time, s, times its stiffness."""


class Felt(NamedTuple):
    """The contacts of a step, and how far their friction springs are stretched, m, [s, 3]."""

    contacts: Contacts
    slip: Array


class _Kept(NamedTuple):
    """The part of a contact that is stored; the rest is computed again from the patch and the poses where needed."""

    second: Array
    """Number of the other object."""
    springs: Springs
    stuck: Stuck
    felt: Forces
    slip: Array
    """Stretch of friction's spring, m, [3]."""


class _Speeds(NamedTuple):
    """Velocities of arms and objects."""

    joints: Array
    """Velocities of the arms' joints, [a, m]."""
    objects: Array
    """[k, 6]"""


class _Motion(NamedTuple):
    """Relative velocity and convective acceleration of two bodies."""

    twist: Array
    """[6]"""
    bends: Array
    """Relative acceleration at all points and at the centre if no joint and no object accelerates, [s + 1, 3].

    In a step joints move bodies on arcs, and an object turns about its centre of mass, which moves straight. Half of
    this acceleration times dt turns the velocity at the start of the step into the mean velocity over it (the chord).
    """


class ContactModel:
    """The contact model of one scene."""

    def __init__(self, tables: ContactPairs, twists: RelativeMotion) -> None:
        self.tables, self._twists, self._memory = tables, twists, GripMemory(tables, twists)

    def feel(
        self, slots: Slots, joints: Joints | None, fingers: Fingers | None, qvel: Array, bodies: Bodies, grips: Grips,
        dt: Any,
    ) -> Felt:  # fmt: skip
        """Return the contacts of all patches, with the forces at zero acceleration.

        Args:
            slots: the patches.
            joints: axes of the arms' joints; None without arms, as `fingers`.
            fingers: frames of the fingers.
            qvel: velocities of the arms' joints, [nv].
            bodies: the free objects.
            grips: memory of friction.
            dt: duration of a step, s.
        """
        speeds = _Speeds(self._twists.by_arm(qvel), self._twists.by_object(bodies.velocity))
        at = self._twists.by_object(bodies.position), self._twists.by_object(bodies.quaternion)
        columns = None if joints is None else joints.columns(jnp.asarray(self.tables.slides), jnp.zeros(3))
        moved = jnp.append((grips.held > 0).any(1), True)  # objects that arms hold, and arms

        def bare(n: Array) -> Contact:
            return self._contact(row_of(slots.patch, n), slots.number[n], columns, at[0])

        def one(n: Array) -> tuple[_Kept, Array]:
            patch, number, contact = row_of(slots.patch, n), slots.number[n], bare(n)
            slip = self._memory.slip(patch, number, fingers, at, grips)
            twist = self._twists.of(contact, speeds.joints, speeds.objects)
            motion = self._motion(contact, twist, patch, number, speeds)
            goes_on = moved[contact.first] & (contact.second >= self.tables.count)
            springs, stuck = self._resisting(contact.cone, patch, number, slip, motion, goes_on, dt)
            return _Kept(contact.second, springs, stuck, nearest(springs, stuck), slip), contact.arm

        def note(n: Array, found: tuple[_Kept, Listed, Array]) -> tuple[_Kept, Listed, Array]:
            kept, pressing, on_arm = found
            own, arm = one(n)
            return put(kept, n, own), pressing.after(n, presses(own.felt)), put(on_arm, arm, True)

        s, arms = len(slots.number), len(speeds.joints)
        start = room(jax.eval_shape(one, jnp.int32(0))[0], s), Listed.none(s), jnp.zeros(arms + 1, bool)
        kept, pressing, on_arm = jax.lax.fori_loop(0, slots.found, note, start)

        def whole(n: Array) -> Contact:
            contact = bare(n)
            return contact._replace(cone=contact.cone._replace(springs=row_of(kept.springs, n)))

        found = kept.second, kept.springs, kept.stuck, kept.felt, pressing, on_arm[:arms], whole
        return Felt(Contacts(*found), kept.slip)

    def _contact(self, patch: Patch, number: Array, columns: tuple[Array, Array] | None, position: Array) -> Contact:
        """Return the geometry of a contact: its bodies and the rows of its Jacobian; its springs are still zero.

        `columns` are those of all joints of arms [a, m, 3], about the world's origin.
        """
        t = self.tables
        first, second, arm = (
            jnp.asarray(x.astype(np.int32))[number] for x in (t.first_object, t.second_object, t.owner)
        )
        origin = jnp.where(first < t.count, position[first], patch.centre)
        offset, pulls, none = jnp.zeros(3), jnp.zeros(t.most), jnp.float32(0.0)
        moving = turning = jnp.zeros((t.most, 3))
        if t.count > 1:
            offset = jnp.where(second < t.count, position[second] - origin, 0.0)
        if columns is not None:
            pulls, (moving, turning) = jnp.asarray(t.pulls)[number], picked(columns, arm)
        points, (ahead, *across) = patch.points, patch.frame
        normal = jnp.concatenate([points.normal, jnp.cross(points.place - origin, points.normal)], -1)
        lever = patch.centre - origin
        along = [jnp.concatenate([axis, jnp.cross(lever, axis)]) for axis in across]
        about = jnp.concatenate([jnp.zeros(3), patch.radius * ahead])
        cone = Cone(normal, jnp.stack([*along, about]), Springs(jnp.zeros(len(normal)), none, none))
        return Contact(cone, first, second, offset, arm, origin, pulls, moving, turning)

    def _resisting(
        self, cone: Cone, patch: Patch, number: Array, slip: Array, motion: _Motion, goes_on: Array, dt: Any
    ) -> tuple[Springs, Stuck]:
        """Return the springs, and the trial forces of springs and dampers at zero acceleration.

        `goes_on` [] is true if an arm moves the first body along something fixed: friction will not stop it then.
        """
        t, points = self.tables, patch.points
        speed = cone.normal @ motion.twist + dt / 2 * jnp.sum(points.normal * motion.bends[:-1], -1)
        reach = points.depth + jnp.clip(-dt * speed, 0.0, AHEAD)
        near = jnp.clip(1 + reach / MARGIN, 0.0, 1.0)
        stiffness = jnp.asarray(t.stiffness)[number]
        k = near * SHARE * stiffness
        rate = k * jnp.maximum(dt + DAMPING * jnp.clip(reach / FIRM, 0.0, 1.0), points.depth / FASTEST)
        rubbed = cone.along @ motion.twist + dt / 2 * jnp.append(patch.frame[1:] @ motion.bends[-1], 0.0)
        coefficient = jnp.asarray(t.sliding)[number]
        # The cone lifts what slides by this speed times a step, as if the surfaces came closer (docs/physics.md). So
        # they part that much faster here, at the speed at which they slide on. Nothing slides for long in a jaw.
        remembers, sliding = finger_of(self.tables, number) < len(t.fingers), jnp.sqrt(jnp.sum(rubbed * rubbed))
        slows = jnp.where(goes_on, 0.0, coefficient * (STOPS * jnp.maximum(-speed, 0.0) + 9.81 * dt))
        lifts = jnp.where(remembers, 0.0, coefficient * jnp.maximum(sliding - slows, 0.0))
        push = jnp.where(near > 0, k * points.depth - rate * (speed + lifts), AWAY)
        k = SHEAR * stiffness
        springs = jnp.where(remembers, k, 0.0)
        drag = jnp.where(remembers, k * (dt + DAMPING), k * CREEP)
        pull = -springs * slip - drag * rubbed
        return Springs(dt * rate, dt * drag, coefficient), Stuck(push, pull)

    def _motion(self, contact: Contact, twist: Array, patch: Patch, number: Array, speeds: _Speeds) -> _Motion:
        """Return how the two bodies of a contact move relative to each other now, with a twist [6]."""
        t, places = self.tables, jnp.concatenate([patch.points.place, patch.centre[None]]) - contact.origin
        spin = speeds.objects[contact.first][3:]
        bend = jnp.cross(spin, jnp.cross(spin, places))
        if t.count > 1:
            spin = speeds.objects[contact.second][3:]
            bend -= jnp.cross(spin, jnp.cross(spin, places - contact.offset))
        if len(speeds.joints):
            columns = contact.jacobian * speeds.joints.at[contact.arm].get(mode="clip")
            bend += jnp.asarray(t.sign)[number] * bends(columns, places)
        return _Motion(twist, bend)
