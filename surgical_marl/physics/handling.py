"""What can touch objects in a scene, and the rows that these contacts add to the solver."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.bodies import Bodies, conjugate, product, rotation, turn
from surgical_marl.physics.collision import moved_bodies
from surgical_marl.physics.cone import Cones, Forces
from surgical_marl.physics.patches import AWAY, Patch, find_patch
from surgical_marl.physics.shapes import Plate, Points, Segments, between_segments, on_plate
from surgical_marl.physics.tables import Tables

DAMPING = 5e-3
"""Damping of a contact in the normal direction, s: this times its stiffness, N s/m."""
FIRM = 1e-5
"""Overlap now or at the end of the step from which on this damping is whole, m. It begins with none, so that a force is
continuous where it begins (K. H. Hunt and F. R. E. Crossley, 1975), and what will not touch is not slowed."""
SHARE = 0.5
"""Stiffness of each of the four points of a contact, relative to that of a point in an object's file: a contact is as
stiff as a capsule that lies flat, on its two ends."""
MARGIN = 2e-4
"""Distance within which a point that might touch during the step is watched, m: its stiffness grows from none there."""
AHEAD = 0.02
"""Distance up to which a point is watched, m, however fast it comes: 8 m/s in a step of 2.5 ms. What spins fast would
seem to come nearer from anywhere: by the angle times its distance."""
FASTEST = 0.04
"""Speed at which an overlap is pushed out at most, m/s: a deep one, as after a fall within one step, meets more
damping. The force of something that is pressed in grows with its overlap nevertheless."""
SHEAR = 0.8
"""Stiffness of a contact along the surface, relative to that of a point along the normal (R. D. Mindlin, 1949: 2 (1 -
nu) / (2 - nu) for materials of Poisson's ratio nu, 0.8 for 0.33)."""
CREEP = 0.025
"""Friction of a contact that remembers no position is a damper until it slips: this time, s, times its stiffness."""


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


class Way(NamedTuple):
    """How a body moves in a step at the velocity of now: a point p of it by shift + turn x p. World."""

    shift: Array
    """m, [3]"""
    turn: Array
    """rad, [3]"""

    def soon(self, points: Points, other: Way) -> Array:
        """Return the depth of points [c] between this body and another one after the step, m, [c]."""
        shift = self.shift - other.shift + jnp.cross(self.turn - other.turn, points.place)
        return points.depth - jnp.maximum(jnp.sum(shift * points.normal, -1), -AHEAD)


STILL = Way(np.zeros(3, np.float32), np.zeros(3, np.float32))  # type: ignore[arg-type]


class Felt(NamedTuple):
    """Patches, and how they resist."""

    patches: Patch
    cones: Cones
    slip: Array
    """How far friction's springs are stretched, m, [g, 3]."""


OPPOSITE = float(np.cos(np.radians(25.0)))
"""Cosine of the angle by which the normals of two fingers that hold an object may miss being opposite. Like the least
force it is of Isaac Lab's test whether a needle is held (pull request 6570)."""
SPARE = 0.5
"""Acceleration that the friction of a held object can take besides gravity, m/s2."""
DWELL = 1.0 / 30.0
"""Time that fingers must press before an object counts as held, s."""


class Handling:
    """The free objects of a scene, and all that can touch them or stands fixed in the world."""

    def __init__(self, scene: Any, arms: bool = True) -> None:
        self.tables = Tables(scene, arms)
        model = scene.model
        moved = moved_bodies(model)
        t = self.tables
        self._roots, self._root_of = model.body_rootid[model.dof_bodyid], model.body_rootid
        sign = lambda body: np.where(body[:, None] >= 0, moved[np.maximum(body, 0)], 0.0)  # noqa: E731
        self._links = (sign(t.first_body) - sign(t.second_body)).astype(np.float32)
        self._body = np.maximum(np.maximum(t.first_body, t.second_body), 0)
        self._sign = ((t.first_body >= 0).astype(np.float32) - (t.second_body >= 0)).astype(np.float32)
        one_hot = lambda which: (which[:, None] == np.arange(t.count)).astype(np.float32)  # noqa: E731
        self._objects = one_hot(t.first_object) - one_hot(t.second_object)

    def find(self, data: Any, bodies: Bodies, moving: Any = None, dt: Any = 0.0) -> Patch:
        """Return all patches [g], in the order of `Tables`.

        Args:
            data: MJX's data with the poses of the arms.
            bodies: the objects.
            moving: the same with velocities; None if the arms count as standing.
            dt: time over which motions are looked ahead, s.
        """
        t, found, start = self.tables, [], 0
        shapes = self._shapes(data, bodies)
        ways = self._ways(bodies, moving, dt)
        for meeting in t.meetings:
            torsion = t.torsion[start : start + len(meeting.one)]
            start += len(meeting.one)
            one, way = (_rows(of[meeting.first], meeting.one) for of in (shapes, ways))
            if meeting.second == "fixed":
                fixed = t.fixed[meeting.other[0]]
                alone = lambda row, fixed=fixed: _patch(row[0], row[1], fixed, STILL, row[2])  # noqa: E731
                found.append(jax.lax.map(alone, (one, way, torsion)))
            else:
                other, its = (_rows(of[meeting.second], meeting.other) for of in (shapes, ways))
                found.append(jax.lax.map(lambda row: _patch(*row), (one, way, other, its, torsion)))
        return jax.tree.map(lambda *x: jnp.concatenate(x), *found)

    def _shapes(self, data: Any, bodies: Bodies) -> dict[str, Plate | Segments]:
        """Return the shapes of all bodies in the world by kind of body, [bodies, shapes of one]."""
        t, every = self.tables, lambda x: x[:, None]
        found: dict[str, Plate | Segments] = {"objects": t.segments(bodies.position, rotation(bodies.quaternion))}
        if t.fingers:
            found["pads"] = jax.tree.map(every, t.pads(data))
        if len(t.near):
            found["links"] = jax.tree.map(every, t.links(data))
        return found

    def _ways(self, bodies: Bodies, data: Any, dt: Any) -> dict[str, Way]:
        """Return how all bodies move in a step, by kind of body; arms stand if `data` is None."""
        t, turns = self.tables, dt * bodies.velocity[:, 3:]
        found = {"objects": Way(dt * bodies.velocity[:, :3] - jnp.cross(turns, bodies.position), turns)}
        for kind, links in t.bodies.items():
            turn, shift = jnp.zeros((len(links), 3)), jnp.zeros((len(links), 3))
            if data is not None and len(links):
                turn = dt * data.cvel[links, :3]
                shift = dt * data.cvel[links, 3:] - jnp.cross(turn, data.subtree_com[self._root_of[links]])
            found[kind] = Way(shift, turn)
        return found

    def feel(self, patches: Patch, data: Any, bodies: Bodies, qvel: Array, grips: Grips, dt: Any) -> Felt:
        """Return the rows of patches [g] on the joints of all arms and then on all objects."""
        t = self.tables
        velocity = jnp.concatenate([qvel, bodies.velocity.ravel()])
        linear, _ = self._jacobians(data, bodies, patches.points.place)
        normal = jnp.einsum("gsi,gsin->gsn", patches.points.normal, linear)
        depth, speed = patches.points.depth, normal @ velocity
        bends = self._bends(data, bodies, qvel, jnp.concatenate([patches.points.place, patches.centre[:, None]], 1))
        speed += dt / 2 * jnp.sum(patches.points.normal * bends[:, :-1], -1)
        reach = depth + jnp.clip(-dt * speed, 0.0, AHEAD)
        near = jnp.clip(1 + reach / MARGIN, 0.0, 1.0)
        k = near * SHARE * jnp.asarray(t.stiffness)[:, None]
        rate = k * jnp.maximum(dt + DAMPING * jnp.clip(reach / FIRM, 0.0, 1.0), depth / FASTEST)
        push = jnp.where(near > 0, k * depth - rate * speed, AWAY)
        linear, angular = self._jacobians(data, bodies, patches.centre[:, None])
        along = jnp.einsum("gti,gin->gtn", patches.frame[:, 1:], linear[:, 0])
        about = patches.radius[:, None] * jnp.einsum("gi,gin->gn", patches.frame[:, 0], angular)
        along = jnp.concatenate([along, about[:, None]], 1)
        slip = self._slips(patches, data, bodies, grips)
        k = SHEAR * jnp.asarray(t.stiffness)
        springs = jnp.where(t.remembers, k, 0.0)
        drag = jnp.where(t.remembers, k * (dt + DAMPING), k * CREEP)
        bent = jnp.einsum("gti,gi->gt", patches.frame[:, 1:], bends[:, -1])
        rubbed = along @ velocity + dt / 2 * jnp.pad(bent, ((0, 0), (0, 1)))  # turning about the normal: too little
        pull = -springs[:, None] * slip - drag[:, None] * rubbed
        cones = Cones(normal, dt * rate, push, along, dt * drag, pull, jnp.asarray(t.sliding))
        return Felt(patches, cones, slip)

    def _slips(self, patches: Patch, data: Any, bodies: Bodies, grips: Grips) -> Array:
        """Return how far objects have moved along fingers since friction was relaxed, m, [g, 3]; 0 elsewhere."""
        t = self.tables
        slips = jnp.zeros((len(t.remembers), 3))
        for (o, f), g in t.grip.items():
            centre, frame = patches.centre[g], patches.frame[g]
            place, axes = self._finger(data, f)
            was = place + axes @ grips.position[o, f]
            turned = product(bodies.quaternion[o], conjugate(product(_quaternion(axes), grips.quaternion[o, f])))
            angle = 2 * turned[1:] * jnp.where(turned[0] < 0, -1.0, 1.0)
            arm = centre - bodies.position[o]
            shift = bodies.position[o] - was + jnp.cross(angle, arm)
            slip = jnp.concatenate([frame[1:] @ shift, (patches.radius[g] * (frame[0] @ angle))[None]])
            slips = slips.at[g].set(jnp.where(grips.force[o, f] > 0, slip, 0.0))
        return slips

    def remember(
        self, felt: Felt, forces: Forces, data: Any, bodies: Bodies, shift: Array, grips: Grips, dt: Any
    ) -> Grips:
        """Return what friction remembers after a step with these forces, in which everything moves by `shift` [n].

        Where friction slips, its spring is stretched no further than its force says.
        """
        t, patches = self.tables, felt.patches
        pressed = forces.normal.sum(-1)
        after = felt.slip + felt.cones.along @ shift
        springs = (SHEAR * jnp.asarray(t.stiffness))[:, None]
        stretched = jnp.where(forces.slips[:, None], -forces.friction / springs, after)
        excess = after - stretched
        position, quaternion, force, slid = grips[:4]
        for (o, f), g in t.grip.items():
            place, axes = self._finger(data, f)
            frame, centre, faces = patches.frame[g], patches.centre[g], _quaternion(axes)
            # Kept as it is while nothing slips: rounding errors of a pose made anew in each step would add up.
            along, about = excess[g, :2] @ frame[1:], turn(excess[g, 2] / patches.radius[g] * frame[0])
            was, faced = place + axes @ position[o, f], product(faces, quaternion[o, f])
            was, faced = centre + rotation(about) @ (was - centre) + along, product(about, faced)
            new = grips.force[o, f] <= 0
            was, faced = jnp.where(new, bodies.position[o] + along, was), jnp.where(new, bodies.quaternion[o], faced)
            facing = product(conjugate(faces), faced)
            moves = new | forces.slips[g]
            position = position.at[o, f].set(jnp.where(moves, axes.T @ (was - place), position[o, f]))
            quaternion = quaternion.at[o, f].set(jnp.where(moves, facing / jnp.linalg.norm(facing), quaternion[o, f]))
            force = force.at[o, f].set(pressed[g])
            way = jnp.sqrt(jnp.sum(excess[g, :2] ** 2))
            slid = slid.at[o, f].set(jnp.where(new, 0.0, slid[o, f] + jnp.where(forces.slips[g], way, 0.0)))
        return Grips(position, quaternion, force, slid, self._held(patches, pressed, grips.held, dt))

    def _held(self, patches: Patch, pressed: Array, held: Array, dt: Any) -> Array:
        """Return for how long each arm has held each object, s, [k, a]."""
        t = self.tables
        for o in range(t.count):
            for a, (one, other) in t.jaws.items():
                g, h = t.grip[o, one], t.grip[o, other]
                least = t.masses.mass[o] * (9.81 + SPARE) / t.sliding[g] * jnp.where(held[o, a] > 0, 0.5, 1.0)
                presses = (pressed[g] >= least) & (pressed[h] >= least)
                opposite = jnp.sum(patches.frame[g, 0] * patches.frame[h, 0]) <= -OPPOSITE
                held = held.at[o, a].set(jnp.where(presses & opposite, held[o, a] + dt, 0.0))
        return held

    def _finger(self, data: Any, f: int) -> tuple[Array, Array]:
        body = self.tables.fingers[f].body
        return data.xpos[body], data.xmat[body]

    def _bends(self, data: Any, bodies: Bodies, qvel: Array, places: Array) -> Array:
        """Return the relative acceleration, [g, s, 3], at places [g, s, 3] if all goes on at the velocities of now.

        In a step joints move bodies on arcs, and an object turns about its centre of mass, which goes straight on.
        Half of this acceleration times the step's duration makes velocities at its start those of its chords.
        """
        spin, signs = bodies.velocity[:, 3:], jnp.asarray(self._objects)[:, None, :, None]
        lever = places[:, :, None] - bodies.position
        found = jnp.sum(signs * jnp.cross(spin, jnp.cross(spin, lever)), 2)
        if data is None:
            return found
        body, sign = self._body, jnp.asarray(self._sign)[:, None]
        arm = places - data.subtree_com[self._root_of[body]][:, None]
        turning, moving = (data.cvel[body][:, None, half] for half in (slice(3), slice(3, 6)))
        own = jnp.einsum("gn,nk,n->gk", jnp.asarray(self._links), data.cdof_dot, qvel)[:, None]
        round_ = jnp.cross(turning, moving + jnp.cross(turning, arm))
        return found + own[..., 3:] + jnp.cross(own[..., :3], arm) + sign[..., None] * round_

    def _jacobians(self, data: Any, bodies: Bodies, places: Array) -> tuple[Array, Array]:
        """Return the Jacobians of the relative velocity at places [g, s, 3], [g, s, 3, n] and [g, 3, n]."""
        lever = places[:, :, None] - bodies.position  # [g, s, k, 3]
        signs, eye = jnp.asarray(self._objects), jnp.eye(3)  # [g, k]
        linear = jnp.concatenate([jnp.broadcast_to(eye, (*lever.shape, 3)), jnp.cross(eye, lever[..., None, :])], -2)
        linear = (linear * signs[:, None, :, None, None]).reshape(*places.shape[:2], -1, 3)  # [g, s, 6 k, 3]
        half = jnp.concatenate([jnp.zeros((3, 3)), eye])
        angular = (signs[:, :, None, None] * half).reshape(len(signs), -1, 3)
        if data is None:
            return jnp.swapaxes(linear, -1, -2), jnp.swapaxes(angular, -1, -2)
        offset = places[:, :, None] - data.subtree_com[self._roots]  # [g, s, nv, 3]
        links = jnp.asarray(self._links)
        turning = data.cdof[:, :3]
        moving = (data.cdof[:, 3:] + jnp.cross(turning, offset)) * links[:, None, :, None]
        spin = turning * links[:, :, None]
        whole = jnp.swapaxes(jnp.concatenate([moving, linear], -2), -1, -2)
        return whole, jnp.swapaxes(jnp.concatenate([spin, angular], -2), -1, -2)


def _rows(tree: Any, which: np.ndarray) -> Any:
    """Return some rows of the arrays of a tree."""
    return jax.tree.map(lambda x: x[which], tree)


def _patch(one: Segments, way: Way, other: Plate | Segments, its: Way, torsion: Array) -> Patch:
    """Return the patch of a body's capsules [c] on another's plates or capsules [d], and on which way both are."""
    first, second = jax.tree.map(lambda x: x[:, None], one), jax.tree.map(lambda x: x[None], other)
    if isinstance(second, Plate):
        points, axes = on_plate(first, second), second.frame[0, 0, :, :2].T
    else:
        points, axes = between_segments(first, second), jnp.eye(3)[:2]
    points = Points(points.depth.reshape(-1), points.place.reshape(-1, 3), points.normal.reshape(-1, 3))
    return find_patch(points, way.soon(points, its), axes, torsion)


def _quaternion(axes: Array) -> Array:
    """Return the quaternion of a rotation matrix [3, 3]."""
    m = axes
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    sizes = jnp.stack([trace, m[0, 0], m[1, 1], m[2, 2]])
    a, b, c = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    d, e, f = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    rows = jnp.stack(
        [
            jnp.stack([1 + trace, a, b, c]),
            jnp.stack([a, 1 + 2 * m[0, 0] - trace, d, e]),
            jnp.stack([b, d, 1 + 2 * m[1, 1] - trace, f]),
            jnp.stack([c, e, f, 1 + 2 * m[2, 2] - trace]),
        ]
    )
    row = rows[jnp.argmax(sizes)]
    return row / jnp.sqrt(jnp.sum(row * row))
