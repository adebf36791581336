"""Grips: the memory of friction between fingers and bodies, and whether an arm holds a body."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.contact_pairs import ContactPairs
from surgical_marl.physics.contact.contact_patch import Patch
from surgical_marl.physics.contact.detection import Slots
from surgical_marl.physics.contact.relative_motion import RelativeMotion
from surgical_marl.physics.outputs import Handled
from surgical_marl.physics.solver.problem import Contacts, Pressed
from surgical_marl.physics.systems.rigid_motion import Bodies, carried, conjugate, product, rotation, turn, turned
from surgical_marl.physics.tree_utils import picked, put, row_of, when

DAMPING = 5e-3
"""Damping of a contact in the normal direction, s: this times its stiffness, N s/m."""
SHEAR = 0.8
"""Stiffness of a contact along the surface, relative to that of a point along the normal (R. D. Mindlin, 1949: 2 (1 -
nu) / (2 - nu) for materials of Poisson's ratio nu, 0.8 for 0.33)."""
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
    """The state of friction between k objects and f fingers, and for how long each of a arms has held each object."""

    position: Array
    """Centre of mass in the finger's frame when the spring of friction was relaxed, m, [k, f, 3]."""
    quaternion: Array
    """Orientation likewise, [k, f, 4]."""
    force: Array
    """Normal force of the finger at the end of the last step, N, [k, f]; 0 where it does not touch."""
    slid: Array
    """Distance that the object has slid along the finger since it was touched, m, [k, f]."""
    held: Array
    """Time for which the arm has held the object, s, [k, a]: both fingers press, from opposite sides."""


OF_FINGERS = Grips._fields[:4]
"""The fields that are kept for each finger."""


class Fingers(NamedTuple):
    """The frames of all fingers in the world, [f]."""

    position: Array
    quaternion: Array


def no_grips(k: int, fingers: int, arms: int) -> Grips:
    """Return the grips of k bodies that nothing touches."""
    facing = jnp.zeros((k, fingers, 4), jnp.float32).at[..., 0].set(1.0)
    zeros = [jnp.zeros(shape, jnp.float32) for shape in ((k, fingers, 3), (k, fingers), (k, arms))]
    return Grips(zeros[0], facing, zeros[1], zeros[1], zeros[2])


def released(grips: Grips) -> Grips:
    """Return the grips of bodies that no arm is near."""
    return grips._replace(force=0 * grips.force, slid=0 * grips.slid, held=0 * grips.held)


class GripMemory:
    """The memory of friction in a scene: where each finger took hold of each body."""

    def __init__(self, tables: ContactPairs, twists: RelativeMotion) -> None:
        self.tables, self._twists = tables, twists

    def view(self, grips: Grips, arm: int) -> dict[str, Handled]:
        """Return how an arm handles every free body, by name."""
        fingers, found = list(self.tables.jaws.get(arm, ())), {}
        for o, name in enumerate(self.tables.names):
            force, slid = (of[o, np.array(fingers, int)] for of in (grips.force, grips.slid))
            held = grips.held[o, arm] >= DWELL
            found[name] = Handled(jnp.sum(force), held, jnp.max(slid, initial=0.0))
        return found

    def slip(self, patch: Patch, number: Array, fingers: Fingers | None, at: Any, grips: Grips) -> Array:
        """Return how far the object has moved along the finger since friction was relaxed, m, [3]; 0 elsewhere."""
        if fingers is None or not self.tables.grip:
            return jnp.zeros(3)
        f, o = finger_of(self.tables, number), jnp.asarray(self.tables.first_object.astype(np.int32))[number]
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

    def remember(
        self, contacts: Contacts, slip: Array, slots: Slots, pressed: Pressed, fingers: Fingers, bodies: Bodies,
        shift: tuple[Array, Array], grips: Grips, dt: Any,
    ) -> Grips:  # fmt: skip
        """Return what friction remembers after a step with these forces.

        Args:
            contacts: of the step.
            slip: how far friction's springs are stretched, m, [s, 3].
            slots: the patches of the step.
            pressed: their forces.
            fingers: where they were at its start.
            bodies: likewise.
            shift: by how much all arms' joints [n] and bodies [k, 6] move in the step.
            grips: what friction remembered before.
            dt: duration of the step, s.
        """
        t, k = self.tables, len(bodies.position)
        if not t.grip:
            return grips
        moves = self._twists.by_arm(shift[0]), self._twists.by_object(shift[1])
        at = self._twists.by_object(bodies.position), self._twists.by_object(bodies.quaternion)
        normal = jnp.zeros((k, len(t.fingers), 3))
        fresh = grips._replace(force=jnp.zeros_like(grips.force), slid=jnp.zeros_like(grips.slid))

        def one(n: Array, kept: tuple[Grips, Array]) -> tuple[Grips, Array]:
            number, f, contact = slots.number[n], finger_of(self.tables, slots.number[n]), contacts.at(n)
            place = contact.first, f
            finger, own = picked(fingers, f), _of_finger(grips, *place)  # as in `slip`

            def note(kept: tuple[Grips, Array]) -> tuple[Grips, Array]:
                patch, was, forces = row_of((slots.patch, slip, pressed), n)
                after = was + contact.cone.along @ self._twists.of(contact, *moves)
                pose = at[0][contact.first], at[1][contact.first]
                new = self._kept(patch, forces, was, self._slid(number, forces, was, after, dt), finger, pose, own)
                found = put(tuple(getattr(kept[0], name) for name in OF_FINGERS), place, new)
                return kept[0]._replace(**dict(zip(OF_FINGERS, found, strict=True))), put(kept[1], place, patch.normal)

            return when(f < len(t.fingers), note, kept)

        kept, normal = jax.lax.fori_loop(0, slots.found, one, (fresh, normal))
        return kept._replace(held=self._held(normal, kept.force, kept.held, dt))

    def _slid(self, number: Array, forces: Pressed, slip: Array, after: Array, dt: Any) -> Array:
        """Return how far friction slides in a step that would stretch its spring from `slip` to `after`, m, [3].

        A slider is in series with a spring and a damper, which are parallel and bear the friction together.
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

        Where friction slides, the pose in which its spring is relaxed becomes the present pose, moved back by what the
        spring stays stretched along the surface and about the normal. In all other directions the present pose is
        taken: otherwise an object that rolls as it slides would be pulled as if it had to roll back.
        """
        (place, faces), (position, quaternion, force, before), axes = finger, grip, rotation(finger.quaternion)
        new, left = force <= 0, slip - slid
        # Kept as it is while nothing slips: rounding errors of a pose made anew in each step would add up.
        moves, distance = new | forces.slips, jnp.sqrt(jnp.sum(slid[:2] ** 2))
        spin = left[2] / patch.radius * patch.normal
        was = at[0] + carried(turn(spin), patch.centre - at[0]) - left[:2] @ patch.frame[1:]
        return (
            jnp.where(moves, axes.T @ (was - place), position),
            jnp.where(moves, product(conjugate(faces), turned(-spin, at[1])), quaternion),
            forces.normal,
            jnp.where(new, 0.0, before + jnp.where(forces.slips, distance, 0.0)),
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


def finger_of(tables: ContactPairs, number: Array) -> Array:
    """Return the finger that a patch is on, []."""
    return jnp.asarray(tables.finger.astype(np.int32))[number]
