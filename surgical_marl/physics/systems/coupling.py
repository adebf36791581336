"""Contacts of a system with arms, rigid bodies and other systems: their ends, the loads on these, their accelerations.

Shapes are numbered by kind: pads of fingers, capsules of links, capsules of free bodies, then what is fixed: plates and
rods. Skins of other systems have the numbers below 0. So contacts with what moves come first in a list.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from operator import add, or_
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.broadphase import Joints, Placed, Places
from surgical_marl.physics.contact.contact_pairs import ContactPairs
from surgical_marl.physics.contact.part_detection import NOWHERE, PartDetection, Scenery
from surgical_marl.physics.contact.shapes import Plate, Segments
from surgical_marl.physics.contact.skin_detection import add_skin_contacts, near_skin
from surgical_marl.physics.contact.spring_contact import each
from surgical_marl.physics.solver.cholesky import FULL, LOWER, cholesky, solve_factored
from surgical_marl.physics.systems.arms import ArmForces
from surgical_marl.physics.systems.rigid_motion import Bodies, point_jacobian, rotation
from surgical_marl.physics.systems.system import (
    End,
    Ends,
    Followed,
    Response,
    Shapes,
    Skin,
    SkinnedSystem,
    Spot,
    Springs,
    System,
    Tie,
)
from surgical_marl.physics.tree_utils import row_of
from surgical_marl.scenes.objects import JAW, LINK

TIE = 1e4
"""Stiffness of a tie, N/m: a pull of 1 N stretches it by 0.1 mm. Two that hold one thread reckon with each other's last
acceleration, which is stable for a needle and a jaw of 0.7 kg while all between them is below 9.5 kN/m."""

APART = 2.5
"""Factor of the stiffness of a contact that moves alone, with which a skin reckons. Contacts that move apart from
others are stiffer: twice along a chain, 2.8 times across one that resists bending. The step of a light skin is stable
if it takes them for 3/4 as stiff as they are, or more."""


class Sewing(NamedTuple):
    """A needle that a skinned system follows."""

    state: Any
    """Of that system, as the needles are now."""
    bodies: Followed
    """All that it follows."""
    n: int
    """Number of the needle among these."""


class Coupling:
    """The contacts of one system with all other shapes of a scene."""

    def __init__(self, tables: ContactPairs, system: System, skinned: Mapping[str, SkinnedSystem]) -> None:
        """Give numbers to the shapes.

        Args:
            tables: of arms and rigid bodies.
            system: whose contacts these are.
            skinned: systems whose skins it touches, by name.
        """
        self.skinned = skinned
        self._tables, self._places, self._system = tables, Places(tables), system
        links, (k, c) = tables.bare, tables.radius.shape
        counts = {"pads": len(tables.fingers), "links": len(links), "objects": k * c,
                  "plates": len(tables.plates.radius), "rods": len(tables.rods.radius)}  # fmt: skip
        self._starts = dict(zip(counts, np.cumsum([0, *counts.values()]), strict=False))
        self._counts, self._shapes = counts, sum(counts.values())
        bodies = np.repeat(np.arange(k), c)
        arms = [JAW] * counts["pads"] + [LINK] * counts["links"]
        fixed = [*tables.surfaces["plates"], *tables.surfaces["rods"]]
        surfaces = [*arms, *(tables.surfaces["objects"][body] for body in bodies), *fixed]
        met = [system.surface.against(other) for other in surfaces]
        tied = [(tie.part, first := self._first_shape(tie.body), first + c) for tie in system.ties if tie.body]
        self._detection = PartDetection(counts, met, system.contacts, tied)
        # The number of all shapes stands for none: the end of a tie to the world. So do numbers from the end: skins.
        none = self._shapes + 1 + len(skinned)
        self.arm, self.body = np.full(none, tables.arms, np.int32), np.full(none, k, np.int32)
        """The arm and the free body that each shape is of, [r + 1]; their numbers where it is of none."""
        self._moved = np.zeros((none, tables.most), np.float32)
        self._wires = np.array([tables.radius[tables.names.index(name), 0] for name in system.follows], np.float32)
        fingers = slice(0, counts["pads"])
        self.arm[fingers], self._moved[fingers] = tables.arm_of["pads"], tables.moves["pads"]
        own = slice(self._starts["links"], self._starts["objects"])
        self.arm[own], self._moved[own] = tables.arm_of["links"][links], tables.moves["links"][links]
        self.body[self._starts["objects"] : self._starts["plates"]] = bodies
        self.fingers = np.arange(none) < counts["pads"]
        """Which shapes are pads of fingers."""

    # -- where it touches

    def ends(
        self, shapes: Shapes, skins: Sequence[Skin], scenery: Scenery, joints: Joints, bodies: Bodies,
        motion: tuple[Array, Array], dt: Any, sewn: Mapping[str, Sequence[Sewing]] | None = None,
    ) -> Ends:  # fmt: skip
        """Return the contacts of a system.

        Args:
            shapes: of the system.
            skins: that it touches.
            scenery: all shapes of others.
            joints: axes of the arms' joints.
            bodies: the free bodies.
            motion: velocities of joints [a, m] and of bodies [k, 6] at the end of the step, if they accelerate as in
                the last one.
            dt: duration of a step, s.
            sewn: needles, by the names of skinned systems that follow them, to whose tails the system is tied.
        """
        ties = self._system.ties
        of_bodies, of_world = (
            [self._tied(tie, shapes, bodies) for tie in ties if (tie.body is None) == world] for world in (False, True)
        )
        begun = self._on_skins(shapes, skins, dt, sewn or {}) if skins else None
        found = self._detection.find(scenery, shapes, of_bodies, of_world, dt, begun)
        by_skins = partial(_mean_of, [skin.velocity for skin in skins]) if skins else None
        shift = dt * self.accelerations(found, joints, bodies, *motion, by_skins)
        if skins:
            shift = each(found, lambda row, end: _towards(end, shift[row]), moving=True)
        return found._replace(rows=found.rows._replace(shift=shift))

    def _on_skins(
        self, shapes: Shapes, skins: Sequence[Skin], dt: Any, sewn: Mapping[str, Sequence[Sewing]]
    ) -> Ends:  # fmt: skip
        """Return the contacts with skins, in the order of their numbers: the last one first. Those inside come then."""
        found, touched = self._detection.nothing(NOWHERE), [*enumerate(zip(skins, self.skinned.items(), strict=True))]
        for number, (skin, (name, other)) in reversed(touched):
            met, room = self._system.surface.against(other.surface), self._system.contacts
            inside = [other.inside(*needle) for needle in sewn.get(name, ())]
            left_out = reduce(or_, inside) if inside else None
            found = add_skin_contacts(found, number, skin, other.faces, shapes, met, room, dt, left_out)
        for number, (_, (name, other)) in touched:
            for needle in sewn.get(name, ()):
                found = other.held(*needle, found, number)
        return found

    def visited(self, shapes: Shapes, skins: Sequence[Skin], scenery: Scenery, dt: Any) -> Array:
        """Return whether anything that moves may touch a system in the step, [] bool."""
        by_skins = [near_skin(skin, shapes, dt) for skin in skins]
        return reduce(or_, by_skins, self._detection.visited(scenery, shapes, dt))

    def followed(self, bodies: Bodies, velocity: Array) -> Followed:
        """Return the free bodies that the system follows.

        Args:
            bodies: the free bodies.
            velocity: theirs at the end of the step, if they accelerate as in the last one, [k, 6].
        """
        t, names = self._tables, self._system.follows
        own = np.array([t.names.index(name) for name in names], np.int32)
        frames, centres = rotation(bodies.quaternion[own]), jnp.asarray(t.centers)[own]
        origins = bodies.position[own] - jnp.einsum("kij,kj->ki", frames, centres)
        shapes, size = t.radius.shape[1], jnp.asarray(t.radius)[own, 0] / self._wires
        first = self._starts["objects"] + own * shapes
        return Followed(
            origins, frames, size, bodies.position[own], velocity[own], jnp.asarray(first), jnp.full(len(own), shapes)
        )  # fmt: skip

    def scenery(
        self, poses: Any, joints: Joints, bodies: Bodies, motion: tuple[Array, Array], dt: Any
    ) -> Scenery:  # fmt: skip
        """Return the shapes of arms, bodies and fixed things. Arguments are those of `ends`, and MJX's data."""
        t = self._tables
        qvel = jnp.zeros(len(poses.qpos) + 1).at[t.dofs].set(motion[0])[:-1]
        placed = self._places.place(poses, joints, qvel, bodies._replace(velocity=motion[1]), dt)
        plates = Plate(*map(_joined, placed.pads, t.plates))
        links = row_of(placed.links, t.bare)
        capsules = Segments(*map(_joined, links, self._capsules_of_bodies(placed), t.rods))
        fixed = jnp.zeros(self._counts["plates"] + self._counts["rods"])
        moves = {kind: placed.balls[kind].moves for kind in ("pads", "links", "objects")}
        of_bodies = jnp.repeat(moves["objects"], t.radius.shape[1])
        return Scenery(plates, capsules, jnp.concatenate([moves["pads"], moves["links"][t.bare], of_bodies, fixed]))

    def _capsules_of_bodies(self, placed: Placed) -> Segments:
        """Return the capsules of all free bodies in the world, [k c]."""
        t = self._tables
        start, end = (placed.position[:, None] + jnp.einsum("kij,kcj->kci", placed.frames, x) for x in (t.start, t.end))
        return Segments(start.reshape(-1, 3), end.reshape(-1, 3), t.radius.ravel())

    def _first_shape(self, body: str) -> int:
        return int(self._starts["objects"]) + self._tables.names.index(body) * self._tables.radius.shape[1]

    def _tied(self, tie: Tie, shapes: Shapes, bodies: Bodies) -> End:
        """Return the contact by which the system is tied."""
        place, shape = self._tied_to(tie, bodies), self._shapes if tie.body is None else self._first_shape(tie.body)
        point = shapes.start[tie.part] + tie.share * (shapes.end[tie.part] - shapes.start[tie.part])
        normal, offset = jnp.array([0.0, 0.0, 1.0]), point - place
        return End(
            jnp.int32(tie.part), jnp.float32(tie.share), jnp.int32(shape), -offset[2], place, normal, jnp.float32(TIE),
            jnp.float32(0.0), jnp.bool_(True), jnp.zeros(3), offset,
        )  # fmt: skip

    def tied(self, bodies: Bodies) -> Array:
        """Return the places that the system is fastened to, m, [t, 3]."""
        places = [self._tied_to(tie, bodies) for tie in self._system.ties]
        return jnp.stack(places) if places else jnp.zeros((0, 3))

    def _tied_to(self, tie: Tie, bodies: Bodies) -> Array:
        place, t = jnp.asarray(tie.place, jnp.float32), self._tables
        if tie.body is None:
            return place
        body = t.names.index(tie.body)
        return bodies.position[body] + rotation(bodies.quaternion[body]) @ (place - t.centers[body])

    # -- loads

    def on_arms(
        self, forces: ArmForces, response: Response, ends: Ends, joints: Joints, expected: Array, dt: Any
    ) -> ArmForces:
        """Return the forces on arms with a system's: in `smooth`, and how they fall with acceleration in the masses.

        Args:
            forces: on the arms.
            response: of the system.
            ends: of its contacts.
            joints: axes of the arms' joints.
            expected: accelerations of the joints for which the response holds, [a, m].
            dt: duration of a step, s.
        """
        a, m = forces.smooth.shape
        arms, moved = jnp.asarray(self.arm), jnp.asarray(self._moved)

        def jacobian(row: Array, end: End) -> Array:
            return self._jacobian(joints, arms[end.shape], moved[end.shape], end.place).T

        def on_all(forces: ArmForces) -> ArmForces:
            columns = each(ends, jacobian, moving=True)

            def of_arm(arm: Array, forces: ArmForces) -> ArmForces:
                pushed, block = self._felt(
                    response, ends, lambda row, end: (arms[end.shape] == arm, columns[row]), m, dt
                )
                lower, pushed = block[np.tril_indices(m)], pushed + block @ expected[arm]
                return forces._replace(  # a force is added to an array in place, outside of a branch
                    mass=forces.mass.at[arm].add(lower, mode="promise_in_bounds"),
                    implicit=forces.implicit.at[arm].add(lower, mode="promise_in_bounds"),
                    smooth=forces.smooth.at[arm].add(pushed, mode="promise_in_bounds"),
                )

            return jax.lax.fori_loop(0, a, of_arm, forces)

        return jax.lax.cond(ends.moving > 0, on_all, lambda forces: forces, forces) if a else forces

    def _felt(
        self, response: Response, ends: Ends, column: Callable[[Array, End], tuple[Array, Array]], m: int, dt: Any
    ) -> tuple[Array, Array]:
        """Return the force on the m coordinates of a body or an arm, [m], and how it falls as they accelerate, [m, m].

        Args:
            response: of the system.
            ends: of its contacts.
            column: takes the number of a contact and its end; returns whether the end is on it, and the end's motion
                by each coordinate, [m, 3].
            m: number of coordinates.
            dt: duration of a step, s.
        """

        def total(forces: Array) -> Array:
            def add(row: Array, total: Array) -> Array:
                mine, own = column(row, row_of(ends.rows, row))
                return total + jnp.where(mine, own @ forces[row], 0.0)

            found: Array = jax.lax.fori_loop(0, ends.moving, add, jnp.zeros(m))
            return found

        def by_ends(falls: Array) -> Array:
            """Where each end's force depends on its own motion alone."""

            def add(row: Array, block: Array) -> Array:
                mine, own = column(row, row_of(ends.rows, row))
                return block + jnp.where(mine, own @ (dt * dt * falls[row][FULL]) @ own.T, 0.0)

            found: Array = jax.lax.fori_loop(0, ends.moving, add, jnp.zeros((m, m)))
            return found

        def by_coordinates() -> Array:
            def along(j: Array) -> Array:
                def moves(row: Array, end: End) -> Array:
                    mine, own = column(row, end)
                    return own[j] * mine

                return total(self._system.yielding(response, ends, each(ends, moves, moving=True), dt))

            found: Array = jax.lax.map(along, jnp.arange(m, dtype=jnp.int32))
            return found

        pushed, falls = total(response.force), response.falls
        block = by_coordinates if falls is None else lambda: by_ends(falls)
        return pushed, jax.lax.cond((pushed != 0).any(), block, lambda: jnp.zeros((m, m)))

    def on_bodies(
        self, masses: Array, free: Array, response: Response, ends: Ends, bodies: Bodies, dt: Any
    ) -> tuple[Array, Array, Array]:
        """Return mass matrices [k, 6, 6] and accelerations [k, 6] of bodies with loads, and which have any, [k]."""
        k, owner = len(free), jnp.asarray(self.body)
        if not k:
            return masses, free, jnp.zeros(0, bool)

        def of_body(row: tuple[Array, Array, Array, Bodies]) -> tuple[Array, Array, Array]:
            number, mass, free, body = row

            def column(row: Array, end: End) -> tuple[Array, Array]:
                return owner[end.shape] == number, point_jacobian(end.place - body.position).T

            pushed, block = self._felt(response, ends, column, 6, dt)
            touched = (pushed != 0).any()

            def loaded() -> tuple[Array, Array]:
                force = mass @ free + pushed + block @ body.acceleration
                return mass + block, solve_factored(cholesky(mass + block), force)

            return *jax.lax.cond(touched, loaded, lambda: (mass, free)), touched

        found: tuple[Array, Array, Array] = jax.lax.map(of_body, (jnp.arange(k), masses, free, bodies))
        return found

    def on_skin(self, name: str, response: Response, ends: Ends, dt: Any) -> Springs:
        """Return the forces of contacts on a skin, and by how much each falls as its point of the skin moves.

        The force on a point also depends on the motion of others, through the system that touches the skin. That part
        is reckoned with for the motion that is expected, and for all motion by the response after the skin's own.
        """
        number = [*self.skinned].index(name)

        def last(row: Array, found: Array) -> Array:
            return jnp.where(row_of(ends.rows, row).shape == -1 - number, row + 1, found)

        used: Array = jax.lax.fori_loop(0, ends.moving, last, jnp.int32(0))
        falls = response.falls if response.falls is not None else self._apart(response, ends, used, dt)

        def spring(row: Array, end: End) -> tuple[Any, ...]:
            spot, mine, stiffness = _spot(end, number), end.shape == -1 - number, falls[row]
            force = response.force[row] + stiffness[FULL] @ end.shift
            return *spot, jnp.where(mine, force, 0.0), jnp.where(mine, stiffness, 0.0)

        nodes, weights, force, stiffness = each(ends._replace(moving=used), spring, moving=True)
        return Springs(nodes, weights, force, stiffness, used)

    def _apart(self, response: Response, ends: Ends, count: Array, dt: Any) -> Array:
        """Return `APART` times by how much the force on each of the first ends falls as it alone moves, N/m, [c, 6]."""

        def fall(row: Array, end: End) -> Array:
            del end

            def along(axis: Array) -> Array:
                accelerations = jnp.zeros_like(response.force).at[row].set(axis / (dt * dt))
                return self._system.yielding(response, ends, accelerations, dt)[row]

            return APART * jax.lax.map(along, jnp.eye(3))[LOWER]

        found: Array = each(ends._replace(moving=count), fall, moving=True)
        return found

    def after_skins(self, response: Response, ends: Ends, moved: Sequence[Array], dt: Any) -> Response:
        """Return the response with its forces as the nodes of each skin move by this much, m, [n, 3]."""

        def eased() -> Array:
            beyond = each(ends, lambda row, end: _beyond(end, moved, dt), moving=True)
            return response.force - self._system.yielding(response, ends, beyond, dt)

        force = jax.lax.cond(self._on_skins_now(ends), eased, lambda: response.force)
        return response._replace(force=force)

    def beyond(
        self, ends: Ends, joints: Joints, bodies: Bodies, by_arm: Array, by_body: Array, moved: Sequence[Array], dt: Any
    ) -> Array:
        """Return the accelerations of the ends beyond those of `shift`, m/s2, [c, 3].

        Args:
            ends: of the contacts.
            joints: axes of the arms' joints.
            bodies: the free bodies at the start of the step.
            by_arm: accelerations of joints beyond those of the last step, [a, m].
            by_body: the same of bodies, [k, 6].
            moved: displacements of the nodes of each skin, m, [n, 3].
            dt: duration of a step, s.
        """
        by_skins = (lambda end: _beyond(end, moved, dt)) if moved else None
        return self.accelerations(ends, joints, bodies, by_arm, by_body, by_skins)

    def _on_skins_now(self, ends: Ends) -> Array:
        """Return whether the system touches any skin: such contacts come first."""
        return (ends.moving > 0) & (ends.rows.shape[0] < 0)

    def accelerations(
        self, ends: Ends, joints: Joints, bodies: Bodies, by_arm: Array, by_body: Array,
        by_skins: Callable[[End], Array] | None = None,
    ) -> Array:  # fmt: skip
        """Return the accelerations of the ends, m/s2, [c, 3], by those of joints [a, m] and of bodies [k, 6].

        By velocities it returns velocities. `by_skins` has that of an end by the motion of skins.
        """
        a, k, arms, owner = len(by_arm), len(by_body), jnp.asarray(self.arm), jnp.asarray(self.body)

        def one(row: Array, end: End) -> Array:
            del row
            arm, body, found = arms[end.shape], owner[end.shape], jnp.zeros(3)
            if a:
                moved = jnp.asarray(self._moved)[end.shape]
                found = jax.lax.cond(
                    arm < a,
                    lambda: self._jacobian(joints, arm, moved, end.place) @ by_arm.at[arm].get(mode="clip"),
                    lambda: jnp.zeros(3),
                )
            if k:
                motion = point_jacobian(end.place - bodies.position.at[body].get(mode="clip"))
                found += jnp.where(body < k, motion @ by_body.at[body].get(mode="clip"), 0.0)
            return found + by_skins(end) if by_skins else found

        accelerations: Array = each(ends, one, moving=True)
        return accelerations

    def hardest(self, ends: Ends, forces: Array, arms: int) -> Array:
        """Return the largest normal force on each arm, N, and the largest one that is not a finger's, [2, a]."""
        owner, fingers = jnp.asarray(self.arm), jnp.asarray(self.fingers)

        def more(row: Array, most: Array) -> Array:
            end = row_of(ends.rows, row)
            on_arm = owner[end.shape] == np.arange(arms)
            kinds = jnp.stack([on_arm, on_arm & ~fingers[end.shape]])
            return jnp.maximum(most, jnp.where(kinds, jnp.abs(forces[row] @ end.normal), 0.0))

        found: Array = jax.lax.fori_loop(0, ends.moving, more, jnp.zeros((2, arms)))
        return found

    def _jacobian(self, joints: Joints, arm: Array, moves: Array, place: Array) -> Array:
        """Return the velocity of a place of a link by velocity of its arm's joints, [3, m]."""
        moving, _ = joints.columns(jnp.asarray(self._tables.slides), place)
        return (moving.at[arm].get(mode="clip") * moves[:, None]).T


def _spot(end: End, number: int) -> Spot:
    """Return where an end is on the skin of this number. On another one it has no weight."""
    assert end.on
    mine = end.shape == -1 - number
    return Spot(jnp.where(mine, end.on.nodes, 0), jnp.where(mine, end.on.weights, 0.0))


def _mean(spot: Spot, moves: Array) -> Array:
    return spot.weights @ moves[spot.nodes]


def _mean_of(moves: Sequence[Array], end: End) -> Array:
    """Return the motion of an end, [3], by those of the nodes of all skins, [n, 3] each; 0 if it is on none."""
    return reduce(add, [_mean(_spot(end, number), of_nodes) for number, of_nodes in enumerate(moves)])


def _beyond(end: End, moved: Sequence[Array], dt: Any) -> Array:
    """Return the acceleration of an end on a skin beyond that of `shift`, m/s2, [3]; 0 if it is on none."""
    return jnp.where(end.shape < 0, _mean_of(moved, end) - end.shift, 0.0) / (dt * dt)


def _towards(end: End, shift: Array) -> Array:
    """Return the displacement that is expected of an end, [3]: a skin is not expected to go away from what touches it.

    It would press on nothing, and come back in the next step: soft tissue has no momentum that would carry it away.
    """
    away = jnp.where((end.shape < 0) & ~end.bilateral, jnp.minimum(end.normal @ shift, 0.0), 0.0)
    return shift - away * end.normal


def _joined(*parts: Any) -> Array:
    return jnp.concatenate([jnp.asarray(part) for part in parts])
