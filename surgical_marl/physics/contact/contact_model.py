"""How patches resist: springs and dampers along the normal, friction that remembers how fingers hold objects."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.broadphase import Joints
from surgical_marl.physics.contact.contact_pairs import Tables
from surgical_marl.physics.contact.contact_patch import AWAY, Patch
from surgical_marl.physics.contact.detection import AHEAD, MARGIN, Slots
from surgical_marl.physics.contact.friction_cone import Cone, Forces, Springs, Stuck, nearest, presses
from surgical_marl.physics.contact.relative_motion import Twists, bends
from surgical_marl.physics.solver.problem import Contact, Contacts, Pressed
from surgical_marl.physics.systems.rigid_bodies import Bodies, carried, conjugate, product, rotation, turn, turned
from surgical_marl.physics.tree_utils import Listed, picked, put, room, row_of

DAMPING = 5e-3
"""Damping of a contact in the normal direction, s: this times its stiffness, N s/m."""
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
SHEAR = 0.8
"""Stiffness of a contact along the surface, relative to that of a point along the normal (R. D. Mindlin, 1949: 2 (1 -
nu) / (2 - nu) for materials of Poisson's ratio nu, 0.8 for 0.33)."""
CREEP = 0.025
"""Friction of a contact that remembers no position is a damper until it slips: this time, s, times its stiffness."""
OPPOSITE = float(np.cos(np.radians(45.0)))
"""Cosine of the angle by which the normals of two fingers that hold an object may miss being opposite. Like the least
force it is of Isaac Lab's test whether a needle is held (pull request 6570), which allows 25 degrees. A wire that lies
on a pad is gripped by the round ends of the fingers, whose normals lean by up to 34 degrees; friction of 0.8 holds
until 77."""
SPARE = 0.5
"""Acceleration that the friction of a held object can take besides gravity, m/s2."""
DWELL = 1.0 / 30.0
"""Time that fingers must press before an object counts as held, s."""


class Grips(NamedTuple):
    """How k objects are held by f fingers of a arms, and what friction remembers of it."""

    position: Array
    """Centre of mass in the finger's frame when the spring of friction was relaxed, m, [k, f, 3]."""
    quaternion: Array
    """Orientation likewise, [k, f, 4]."""
    force: Array
    """Normal force of the finger at the end of the last step, N, [k, f]; 0 where it does not touch."""
    slid: Array
    """How far the object has slid along the finger since it was touched, m, [k, f]."""
    held: Array
    """For how long the arm has held the object, s, [k, a]: both fingers press, from opposite sides."""


OF_FINGERS = Grips._fields[:4]
"""What is kept for each finger."""


class Fingers(NamedTuple):
    """The frames of all fingers in the world, [f]."""

    position: Array
    quaternion: Array


class Felt(NamedTuple):
    """Contacts, and how far friction's springs are stretched, m, [s, 3]."""

    contacts: Contacts
    slip: Array


class _Kept(NamedTuple):
    """What is kept of a contact: all that its patch and the poses of arms and objects do not say."""

    second: Array
    """As in `Contact`."""
    springs: Springs
    stuck: Stuck
    felt: Forces
    slip: Array
    """As in `Felt`."""


class _Speeds(NamedTuple):
    """Velocities."""

    joints: Array
    """Of arms, [a, m]."""
    objects: Array
    """[k, 6]"""


class _Motion(NamedTuple):
    """How two bodies move relative to each other."""

    twist: Array
    """[6]"""
    bends: Array
    """Relative acceleration at all points and at the centre, [s + 1, 3], with which both go on at the velocities of
    now.

    In a step joints move bodies on arcs, and an object turns about its centre of mass, which goes straight on. Half of
    this acceleration times the step's duration makes velocities at its start those of its chords.
    """


class Handling:
    """What friction and contact do in a scene."""

    def __init__(self, tables: Tables, twists: Twists) -> None:
        self.tables, self._twists = tables, twists

    def feel(
        self, slots: Slots, joints: Joints | None, fingers: Fingers | None, qvel: Array, bodies: Bodies, grips: Grips,
        dt: Any,
    ) -> Felt:  # fmt: skip
        """Return how the patches that were found resist. There are neither joints nor fingers without arms."""
        speeds = _Speeds(self._twists.by_arm(qvel), self._twists.by_object(bodies.velocity))
        at = self._twists.by_object(bodies.position), self._twists.by_object(bodies.quaternion)
        columns = None if joints is None else joints.columns(jnp.asarray(self.tables.slides), jnp.zeros(3))
        moved = jnp.append((grips.held > 0).any(1), True)  # objects that arms hold, and arms

        def bare(n: Array) -> Contact:
            return self._contact(row_of(slots.patch, n), slots.number[n], columns, at[0])

        def one(n: Array) -> tuple[_Kept, Array]:
            patch, number, contact = row_of(slots.patch, n), slots.number[n], bare(n)
            slip = self._slip(patch, number, fingers, at, grips)
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
        """Return a contact that does not resist yet: what it is between, and its directions.

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
        along = [jnp.concatenate([way, jnp.cross(lever, way)]) for way in across]
        about = jnp.concatenate([jnp.zeros(3), patch.radius * ahead])
        cone = Cone(normal, jnp.stack([*along, about]), Springs(jnp.zeros(len(normal)), none, none))
        return Contact(cone, first, second, offset, arm, origin, pulls, moving, turning)

    def _resisting(
        self, cone: Cone, patch: Patch, number: Array, slip: Array, motion: _Motion, goes_on: Array, dt: Any
    ) -> tuple[Springs, Stuck]:
        """Return the springs, and the forces of springs and dampers at a motion of now, without acceleration.

        What `goes_on` is not stopped by friction, as an arm moves it along something fixed.
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
        remembers, sliding = self._finger(number) < len(t.fingers), jnp.sqrt(jnp.sum(rubbed * rubbed))
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

    def _finger(self, number: Array) -> Array:
        """Return the finger that a patch is on, []."""
        return jnp.asarray(self.tables.finger.astype(np.int32))[number]

    def _slip(self, patch: Patch, number: Array, fingers: Fingers | None, at: Any, grips: Grips) -> Array:
        """Return how far the object has moved along the finger since friction was relaxed, m, [3]; 0 elsewhere."""
        if fingers is None or not self.tables.grip:
            return jnp.zeros(3)
        f, o = self._finger(number), jnp.asarray(self.tables.first_object.astype(np.int32))[number]
        # outside of the branch, so that the fused engine has one array of them for all that asks for a row
        frame, (position, quaternion, force, _slid) = picked(fingers, f), _of_finger(grips, o, f)

        def moved(_: None) -> Array:
            was = frame.position + rotation(frame.quaternion) @ position
            turns = product(at[1][o], conjugate(product(frame.quaternion, quaternion)))
            angle = 2 * turns[1:] * jnp.where(turns[0] < 0, -1.0, 1.0)
            # Exact, as jaws that close rock a wire by tens of degrees.
            shift = at[0][o] - was + carried(turns, patch.centre - at[0][o])
            slip = jnp.concatenate([patch.frame[1:] @ shift, (patch.radius * (patch.normal @ angle))[None]])
            return jnp.where(force > 0, slip, 0.0)

        return jax.lax.cond(f < len(self.tables.fingers), moved, lambda _: jnp.zeros(3), None)

    # -- what is remembered

    def remember(
        self, felt: Felt, slots: Slots, pressed: Pressed, fingers: Fingers, bodies: Bodies,
        shift: tuple[Array, Array], grips: Grips, dt: Any,
    ) -> Grips:  # fmt: skip
        """Return what friction remembers after a step with these forces.

        `shift` is by how much all arms' joints [n] and objects [k, 6] move in the step.
        """
        t, k = self.tables, len(bodies.position)
        if not t.grip:
            return grips
        moves = self._twists.by_arm(shift[0]), self._twists.by_object(shift[1])
        at = self._twists.by_object(bodies.position), self._twists.by_object(bodies.quaternion)
        normal = jnp.zeros((k, len(t.fingers), 3))
        fresh = grips._replace(force=jnp.zeros_like(grips.force), slid=jnp.zeros_like(grips.slid))

        def one(n: Array, kept: tuple[Grips, Array]) -> tuple[Grips, Array]:
            number, f, contact = slots.number[n], self._finger(slots.number[n]), felt.contacts.at(n)
            place = contact.first, f
            finger, own = picked(fingers, f), _of_finger(grips, *place)  # as in `_slip`

            def note(kept: tuple[Grips, Array]) -> tuple[Grips, Array]:
                patch, slip, forces = row_of((slots.patch, felt.slip, pressed), n)
                after = slip + contact.cone.along @ self._twists.of(contact, *moves)
                pose = at[0][contact.first], at[1][contact.first]
                new = self._kept(patch, forces, slip, self._slid(number, forces, slip, after, dt), finger, pose, own)
                found = put(tuple(getattr(kept[0], name) for name in OF_FINGERS), place, new)
                return kept[0]._replace(**dict(zip(OF_FINGERS, found, strict=True))), put(kept[1], place, patch.normal)

            return jax.lax.cond(f < len(t.fingers), note, lambda kept: kept, kept)

        kept, normal = jax.lax.fori_loop(0, slots.found, one, (fresh, normal))
        return kept._replace(held=self._held(normal, kept.force, kept.held, dt))

    def _slid(self, number: Array, forces: Pressed, slip: Array, after: Array, dt: Any) -> Array:
        """Return how far friction slides in a step that would stretch its spring from `slip` to `after`, m, [3].

        What slides is in series with the spring and the damper beside it, which bear its force together.
        """
        pulled = -forces.friction / (SHEAR * jnp.asarray(self.tables.stiffness)[number])
        return jnp.where(forces.slips, after - (dt * pulled + DAMPING * slip) / (dt + DAMPING), 0.0)

    def _kept(
        self, patch: Patch, forces: Pressed, slip: Array, slid: Array, finger: Fingers, at: tuple[Array, Array],
        grip: tuple[Array, Array, Array, Array],
    ) -> tuple[Array, Array, Array, Array]:  # fmt: skip
        """Return what is kept for one finger and one object after a step: `OF_FINGERS`, as in `grip`.

        Args:
            patch: at the start of the step.
            forces: in the step.
            slip: how far friction's spring was stretched, m, [3].
            slid: how far friction slid, m, [3].
            finger: its place and orientation.
            at: place and orientation of the object.
            grip: what was kept.

        Where it slides, friction's spring is relaxed in the pose of now, less what it stays stretched by along the
        surface and about the normal. In all other directions that pose is taken as it is: if an object that rolls as it
        slides kept its old one, the spring would feel it roll back.
        """
        (place, faces), (position, quaternion, force, before), axes = finger, grip, rotation(finger.quaternion)
        new, left = force <= 0, slip - slid
        # Kept as it is while nothing slips: rounding errors of a pose made anew in each step would add up.
        moves, way = new | forces.slips, jnp.sqrt(jnp.sum(slid[:2] ** 2))
        spin = left[2] / patch.radius * patch.normal
        was = at[0] + carried(turn(spin), patch.centre - at[0]) - left[:2] @ patch.frame[1:]
        return (
            jnp.where(moves, axes.T @ (was - place), position),
            jnp.where(moves, product(conjugate(faces), turned(-spin, at[1])), quaternion),
            forces.normal,
            jnp.where(new, 0.0, before + jnp.where(forces.slips, way, 0.0)),
        )

    def _held(self, normal: Array, force: Array, held: Array, dt: Any) -> Array:
        """Return for how long each arm has held each object, s, [k, a]."""
        t = self.tables
        for o in range(t.count):
            for a, (one, other) in t.jaws.items():
                sliding = t.sliding[t.grip[o, one]]
                least = t.masses.mass[o] * (9.81 + SPARE) / sliding * jnp.where(held[o, a] > 0, 0.5, 1.0)
                presses = (force[o, one] >= least) & (force[o, other] >= least)
                opposite = jnp.sum(normal[o, one] * normal[o, other]) <= -OPPOSITE
                held = held.at[o, a].set(jnp.where(presses & opposite, held[o, a] + dt, 0.0))
        return held


def _of_finger(grips: Grips, o: Array, f: Array) -> tuple[Array, Array, Array, Array]:
    """Return what is kept for a finger f and an object o: `OF_FINGERS`."""
    k, fingers = grips.force.shape
    rows = tuple(getattr(grips, name).reshape(k * fingers, *getattr(grips, name).shape[2:]) for name in OF_FINGERS)
    found: tuple[Array, Array, Array, Array] = picked(rows, fingers * o + f)
    return found
