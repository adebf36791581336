"""One physics step of a scene, in the order in which it is computed.

    free motion   forces on each system, and how it would move without contacts
    contacts      where arms and rigid bodies touch, or will within the step
    solve         the accelerations at which all forces balance
    move          positions and velocities at the end of the step
    outputs       the hardest touch so far

Arms and bodies that touch nothing do not affect each other: `skip.cond` takes a cheaper branch then, in which each is
solved alone.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics import skip
from surgical_marl.physics.contact.arm_contacts import Pairs
from surgical_marl.physics.contact.attachment import Attachments
from surgical_marl.physics.contact.broadphase import Joints
from surgical_marl.physics.contact.contact_model import ContactModel
from surgical_marl.physics.contact.detection import Detection, Slots
from surgical_marl.physics.contact.grips import Fingers, GripMemory, released
from surgical_marl.physics.outputs import Touch
from surgical_marl.physics.solver.constraint_rows import Rows
from surgical_marl.physics.solver.contact_solver import ContactSolver
from surgical_marl.physics.solver.problem import Contacts, Pressed, Problem, no_arms
from surgical_marl.physics.state import ATTACHMENTS, Physics
from surgical_marl.physics.systems.arms import ArmForces, Arms, accelerations_apart, implicit_change, relaxed
from surgical_marl.physics.systems.coupling import Coupling, Sewing
from surgical_marl.physics.systems.rigid_bodies import RigidBodies, RigidBodyState
from surgical_marl.physics.systems.system import (
    Ends,
    Followed,
    Response,
    Skin,
    SkinnedSystem,
    Springs,
    Strand,
    System,
)
from surgical_marl.physics.tree_utils import empty_like
from surgical_marl.scenes.scene import Scene


class ArmContacts(NamedTuple):
    """Contacts of arms with arms."""

    rows: Rows
    """Frictionless, along normals; their Jacobian is [r, a, m]."""
    pair: Array
    """Pair of each row, [r]."""
    penetration: Array
    """Overlap of all pairs, m, [P]."""
    overflow: Array
    """Number of overlapping pairs beyond the rows, []."""


class Found(NamedTuple):
    """Contacts with rigid bodies at the start of a step."""

    poses: Any
    """MJX's data with the poses of the arms."""
    slots: Slots
    joints: Joints
    fingers: Fingers


class Meeting(NamedTuple):
    """A system of a plug-in before arms and rigid bodies are solved: its forces, contacts and loads."""

    ends: Ends
    response: Response
    felt: Response
    """The same with the forces on arms and bodies as the skins of other systems move."""
    expected: tuple[Array, Array]
    """Accelerations of joints [a, m] and of bodies [k, 6] that its response assumes: those of the last step."""
    awake: Any
    """True if it moves, [] bool; always of a system that never sleeps. There is nothing in the rest unless it does."""
    state: Any = None
    """At the start of the step, if it follows needles; None for that after the last step."""


class Following(NamedTuple):
    """A system that follows needles, at the start of a step."""

    state: Any
    ends: Ends
    needles: Followed
    owners: list[str]
    """Name of the system whose thread is behind each needle; empty where none is."""

    def behind(self, thread: str) -> list[Sewing]:
        """Return the needles to whose tails a thread is tied."""
        return [Sewing(self.state, self.needles, n) for n, owner in enumerate(self.owners) if owner == thread]


class Step:
    """The physics step of a scene with arms and, if it has any objects or other systems, rigid bodies."""

    def __init__(self, scene: Scene) -> None:
        self.arms, self.pairs, self._agents = Arms(scene), Pairs(scene.model), len(scene.agents)
        self.bodies = RigidBodies(scene, self.arms.dt) if scene.objects or scene.systems else None
        self.attachments = Attachments(scene, self.bodies.tables) if self.bodies and scene.attachments else None
        self.systems: dict[str, System] = dict(scene.systems)
        joints, count = scene.model.nv, len(scene.free_objects)
        none = np.zeros((0, 0), int)
        self._solver, self._solver_of_bodies, self._solver_of_one = (
            ContactSolver(self.arms.dofs, joints, count),
            ContactSolver(none, 0, count),
            ContactSolver(none, 0, 1),
        )
        self._index()

    def varied(
        self, arms: Arms, bodies: RigidBodies | None, systems: dict[str, System]
    ) -> Step:  # fmt: skip
        """Return the step of a scene whose arms, bodies and other systems differ from their files."""
        own = copy.copy(self)
        own.arms, own.bodies, own.systems = arms, bodies, systems
        own._index()
        return own

    def _index(self) -> None:
        if self.bodies:
            self.detection = Detection(self.bodies.tables)
            self.grips = GripMemory(self.bodies.tables, self._solver.twists)
            self._skinned = {name: one for name, one in self.systems.items() if isinstance(one, SkinnedSystem)}
            self._couplings = {
                name: Coupling(self.bodies.tables, system, self._skinned_of(system))
                for name, system in self.systems.items()
            }

    def _skinned_of(self, system: System) -> dict[str, SkinnedSystem]:
        """Return the systems whose skins one touches."""
        return {} if isinstance(system, SkinnedSystem) else self._skinned

    def __call__(self, physics: Physics, touch: Touch, distance: Array | None = None) -> tuple[Physics, Touch]:
        """Return the state after one physics step, and the hardest touch up to the start of that step.

        Args:
            physics: the state.
            touch: the hardest touch so far.
            distance: of every pair of arms' shapes at the start, m, [P], if it is known.
        """
        if not (self.pairs.count or self.bodies):
            return self._arms_apart(physics, touch)
        poses = self.arms.dynamics.pose(physics.qpos)
        places = poses.geom_xpos, poses.geom_xmat
        overlap = self.pairs.overlap(*places) if distance is None else (distance < 0).any()
        if not self.bodies:
            return skip.cond("arms_apart", overlap, self._arms_coupled, self._arms_apart, physics, touch)
        return self._with_bodies(physics, touch, self.find(physics, poses), overlap)

    @property
    def _rigid(self) -> RigidBodies:
        assert self.bodies, "a scene without objects has no rigid bodies"
        return self.bodies

    def slots(self, physics: Physics) -> Slots:
        """Return the patches at which bodies, arms and fixed things touch, or nearly do."""
        return self.find(physics, self.arms.dynamics.pose(physics.qpos)).slots

    def depths(self, physics: Physics) -> Array:
        """Return the overlap of each pair of bodies, m, in the order of `ContactPairs`; negative for a distance."""
        poses = self.arms.dynamics.pose(physics.qpos)
        return self.detection.depths(poses, self.detection.joints(poses), physics.rigid_bodies.bodies)

    # -- arms alone

    def _arms_apart(self, physics: Physics, touch: Touch) -> tuple[Physics, Touch]:
        return physics.with_systems(arms=self.arms.step_apart(physics.arms)), touch

    def _arms_coupled(
        self, physics: Physics, touch: Touch, forces: ArmForces | None = None
    ) -> tuple[Physics, Touch]:  # fmt: skip
        """Step arms that touch each other alone, from the forces on them, if these are known.

        Damping is taken implicitly after the solve, as MuJoCo does, so forces of contacts are MuJoCo's.
        """
        between = self._contacts_of_arms(physics)
        forces = self.arms.free_motion(physics.arms) if forces is None else forces
        found, pressed = self._solver.solve_arms(
            forces.mass, forces.smooth, forces.joints, relaxed(forces), between.rows
        )
        arms = self.arms.apply(physics.arms, found, implicit_change(forces, found))
        return physics.with_systems(arms=arms), self._touched(touch, between, pressed)

    # -- arms and rigid bodies

    def _with_bodies(
        self, physics: Physics, touch: Touch, found: Found, overlap: Array
    ) -> tuple[Physics, Touch]:  # fmt: skip
        """Step arms and bodies: together if an arm touches anything, else each on its own."""
        forces = self.arms.free_motion(physics.arms)
        meetings = self._meetings(physics, found)
        for name, met in meetings.items():
            own, expected = self._couplings[name], met.expected[0]
            forces = own.on_arms(forces, met.felt, met.ends, found.joints, expected, self.arms.dt)
        # loads of other systems are long code, which is not to be in both branches
        loaded = self._free_bodies(physics, found.slots, meetings) if meetings else ()
        near = overlap | (self._arm_of(found.slots) < self._agents).any() if self.detection.slots else overlap

        def free(physics: Physics) -> tuple[Array, ...]:
            return loaded or self._free_bodies(physics, found.slots, meetings)

        def coupled(physics: Physics, touch: Touch) -> tuple[Physics, Touch]:
            if not self.detection.slots:  # nothing but arms, and systems whose loads are in the forces on them
                return self._arms_coupled(physics, touch, forces)
            return self._all_coupled(physics, touch, forces, found, overlap, *free(physics))

        def apart(physics: Physics, touch: Touch) -> tuple[Physics, Touch]:
            bodies = self.step_bodies(physics.rigid_bodies, found.slots, *free(physics))
            arms = self.arms.apply(physics.arms, *accelerations_apart(forces))
            overflow = jnp.maximum(touch.overflow, found.slots.total - len(found.slots.number))
            return physics.with_systems(arms=arms, rigid_bodies=bodies), touch._replace(overflow=overflow)

        if self.attachments:
            near |= physics.systems[ATTACHMENTS].active.any()
        if self.pairs.count or self.detection.slots:
            after, touch = skip.cond("arms_apart", near, coupled, apart, physics, touch)
        else:  # one arm, and systems whose loads are in the forces on it
            after, touch = apart(physics, touch)
        return self._systems_moved(physics, after, found, meetings), self._loaded(touch, meetings)

    # -- other systems

    def start_systems(self, bodies: RigidBodyState | None, threads: Mapping[str, Array]) -> dict[str, Any]:
        """Return the states of all systems at the beginning of an episode, by name.

        Args:
            bodies: the free objects; None in a scene of arms alone.
            threads: places of the nodes of threads that do not begin where the scene says, m, [n, 3].
        """
        found = {
            name: system.start(self._couplings[name].tied(bodies.bodies))
            for name, system in self.systems.items() if bodies
        }  # fmt: skip
        return found | {name: self.systems[name].laid(found[name], places) for name, places in threads.items()}

    def _meetings(self, physics: Physics, found: Found) -> dict[str, Meeting]:
        """Return the contacts of all systems, and their answers.

        Systems with skins follow needles first, as threads may be behind these, and answer last: others load them.
        """
        meetings: dict[str, Meeting] = {}
        following = {name: self._follow(name, physics, found) for name, one in self.systems.items() if one.follows}
        for name in sorted(self.systems, key=lambda name: name in self._skinned):
            meetings[name] = self._meet(name, physics, found, meetings, following)
        moved = {name: one.displacements(meetings[name].response) for name, one in self._skinned.items()}
        for name, met in meetings.items():
            if touched := [moved[other] for other in self._couplings[name].skinned]:
                felt = self._couplings[name].after_skins(met.response, met.ends, touched, self.arms.dt)
                meetings[name] = met._replace(felt=felt)
        return meetings

    def _expected(self, physics: Physics) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Return accelerations of joints [a, m] and bodies [k, 6] as in the last step, and velocities after this."""
        bodies, by_arm, dt = physics.rigid_bodies.bodies, self._solver.twists.by_arm, self.arms.dt
        expected = by_arm(physics.arms.qacc_warmstart), bodies.acceleration
        return expected, (by_arm(physics.qvel) + dt * expected[0], bodies.velocity + dt * expected[1])

    def _follow(self, name: str, physics: Physics, found: Found) -> Following:
        """Return a system that follows needles, as these and their threads are at the start of the step."""
        system, state, coupling, dt = self.systems[name], physics.systems[name], self._couplings[name], self.arms.dt
        bodies, (_, motion) = physics.rigid_bodies.bodies, self._expected(physics)
        scenery, skins = coupling.scenery(found.poses, found.joints, bodies, motion, dt), self._skins_of(name, physics)
        ends = coupling.ends(system.shapes(state), skins, scenery, found.joints, bodies, motion, dt)
        behind = [self._behind(body, physics) for body in system.follows]
        needles = coupling.followed(bodies, motion[1])._replace(strands=tuple(strand for _, strand in behind))
        return Following(*system.follow(state, ends, needles, dt), needles, [owner for owner, _ in behind])

    def _behind(self, body: str, physics: Physics) -> tuple[str, Strand | None]:
        """Return the thread at the tail of a body, and the name of its system."""
        strands = [(name, one.strand(physics.systems[name], body)) for name, one in self.systems.items()]
        return next(((name, strand) for name, strand in strands if strand), ("", None))

    def _meet(
        self, name: str, physics: Physics, found: Found, others: dict[str, Meeting], following: dict[str, Following]
    ) -> Meeting:
        """Return the contacts of a system, and its answer to them and to the loads of others on its skin."""
        system, state, dt = self.systems[name], physics.systems[name], self.arms.dt
        bodies, (expected, motion) = physics.rigid_bodies.bodies, self._expected(physics)
        shapes, coupling, awake = system.shapes(state), self._couplings[name], system.awake(state)
        scenery = coupling.scenery(found.poses, found.joints, bodies, motion, dt)
        skins, loads = self._skins_of(name, physics), self._loads(name, others)

        def meet() -> tuple[Ends, Response, Any]:
            if own := following.get(name):
                now, ends = own.state, own.ends
            else:
                sewn = {other: one.behind(name) for other, one in following.items()}
                now, ends = state, coupling.ends(shapes, skins, scenery, found.joints, bodies, motion, dt, sewn)
            response = system.respond(now, system.free_motion(now, dt), ends, dt, **loads)
            return ends, response, now if own else None

        if awake is True:
            ends, response, now = meet()
            return Meeting(ends, response, response, expected, awake, now)
        awake |= coupling.visited(shapes, skins, scenery, dt)
        nothing: Any = empty_like(jax.eval_shape(meet))
        ends, response, now = skip.cond("sleeping", awake, meet, lambda: nothing)
        return Meeting(ends, response, response, expected, awake, now)

    def _skins_of(self, name: str, physics: Physics) -> list[Skin]:
        """Return the skins that a system touches."""
        return [other.skin(physics.systems[at]) for at, other in self._couplings[name].skinned.items()]

    def _loads(self, name: str, others: dict[str, Meeting]) -> dict[str, tuple[Springs, ...]]:
        """Return the loads of other systems on the skin of one as an argument of `respond`; nothing if none can be."""
        if name not in self._skinned:
            return {}
        loads = tuple(
            self._couplings[other].on_skin(name, met.response, met.ends, self.arms.dt)
            for other, met in others.items() if name in self._couplings[other].skinned
        )  # fmt: skip
        return {"loads": loads} if loads else {}

    def _systems_moved(
        self, before: Physics, after: Physics, found: Found, meetings: dict[str, Meeting]
    ) -> Physics:  # fmt: skip
        """Move all other systems by the accelerations of arms, bodies and skins in the step. Skins move first."""
        dt, bodies = self.arms.dt, before.rigid_bodies.bodies

        def move(name: str, met: Meeting, after: Physics) -> Any:
            by_arm = self._solver.twists.by_arm((after.qvel - before.qvel) / dt) - met.expected[0]
            by_body = (after.rigid_bodies.bodies.velocity - bodies.velocity) / dt - met.expected[1]
            moved = [dt * skin.velocity for skin in self._skins_of(name, after)]
            beyond = self._couplings[name].beyond(met.ends, found.joints, bodies, by_arm, by_body, moved, dt)
            state = before.systems[name] if met.state is None else met.state
            return self.systems[name].apply(state, met.response, met.ends, beyond, dt)

        def move_if(name: str, met: Meeting, after: Physics) -> Any:
            if met.awake is True:
                return move(name, met, after)
            return skip.cond("sleeping", met.awake, lambda: move(name, met, after), lambda: before.systems[name])

        for name, met in sorted(meetings.items(), key=lambda item: item[0] not in self._skinned):
            after = after.with_systems(**{name: move_if(name, met, after)})
        return after

    def _loaded(self, touch: Touch, meetings: dict[str, Meeting]) -> Touch:
        """Return the hardest touch with the forces of other systems on arms; those on fingers are no bumps."""
        for name, met in meetings.items():
            most = self._couplings[name].hardest(met.ends, met.felt.force, self._agents)
            overflow = jnp.maximum(touch.overflow, met.ends.left_out + met.response.left_out)
            touch = touch._replace(handled=jnp.maximum(touch.handled, most), overflow=overflow)
        return touch

    def find(self, physics: Physics, poses: Any) -> Found:
        """Return the contact patches at the start of a step, from MJX's data with the poses of the arms."""
        joints, bodies = self.detection.joints(poses), physics.rigid_bodies.bodies
        slots = self.detection.find(poses, joints, physics.qvel, bodies, self.arms.dt)
        pads = self._rigid.tables.bodies["pads"]
        return Found(poses, slots, joints, Fingers(poses.xpos[pads], poses.xquat[pads]))

    def _all_coupled(
        self, physics: Physics, touch: Touch, forces: ArmForces, found: Found, overlap: Array,
        masses: Array, free: Array, awake: Array,
    ) -> tuple[Physics, Touch]:  # fmt: skip
        """Step all arms and bodies together.

        Damping is a part of the arms' mass matrix here, so the solver sees the velocities at the end of the step.
        """
        dt, slots, (bodies, grips) = self.arms.dt, found.slots, physics.rigid_bodies
        model = ContactModel(self._rigid.tables, self._solver.twists)
        felt = model.feel(slots, found.joints, found.fingers, physics.qvel, bodies, grips, dt)
        contacts, rows = felt.contacts, None
        if self.attachments:
            rows = self.attachments.rows(
                physics.systems[ATTACHMENTS], found.poses, found.joints, physics.qvel, bodies, dt
            )
            held = (rows.active[:, None] & (rows.arm[:, None] == np.arange(self._agents))).any(0)
            contacts = contacts._replace(on_arm=contacts.on_arm | held)
        between = self._contacts_of_arms_if(physics, overlap)
        problem = Problem(
            forces.implicit, forces.smooth, forces.joints, self.arms.friction_start(forces), between.rows, overlap,
            masses, free, contacts, slots.found, rows,
        )  # fmt: skip
        solution = self._solver.solve(problem)
        arms = self.arms.apply(physics.arms, solution.arms)
        after = self._rigid.apply(bodies, solution.objects, awake, slots.company)
        moves = dt * arms.qvel, dt * after.velocity
        grips = self.grips.remember(
            contacts, felt.slip, slots, solution.pressed, found.fingers, bodies, moves, grips, dt
        )
        touch = touch._replace(
            handled=jnp.maximum(touch.handled, self._hardest(slots, solution.pressed)),
            overflow=jnp.maximum(touch.overflow, slots.total - len(slots.number)),
        )
        touch = self._touched_if(touch, between, solution.between, overlap)
        return physics.with_systems(arms=arms, rigid_bodies=RigidBodyState(after, grips)), touch

    def _free_bodies(
        self, physics: Physics, slots: Slots, meetings: dict[str, Meeting]
    ) -> tuple[Array, Array, Array]:  # fmt: skip
        """Return mass matrices and accelerations of bodies without contacts, with loads, and which are awake."""
        bodies, attached = physics.rigid_bodies.bodies, self._attached(physics)
        awake = slots.awake if attached is False else slots.awake | attached
        masses, free = self._rigid.free_motion(bodies, awake)
        for name, met in meetings.items():
            coupling = self._couplings[name]
            masses, free, touched = coupling.on_bodies(masses, free, met.felt, met.ends, bodies, self.arms.dt)
            awake |= touched
        return masses, free, awake

    def _attached(self, physics: Physics) -> Array | bool:
        """Return which bodies an attachment holds, [k] bool; False in a scene without attachments."""
        if not self.attachments:
            return False
        active = physics.systems[ATTACHMENTS].active
        return (active[:, None] & (self.attachments.bodies[:, None] == np.arange(len(self._rigid.names)))).any(0)

    def step_bodies(
        self, state: RigidBodyState, slots: Slots, masses: Array, free: Array, awake: Array
    ) -> RigidBodyState:  # fmt: skip
        """Return the bodies after a step in which no arm is near.

        Args:
            state: of the bodies.
            slots: where they touch.
            masses: mass matrices of the bodies, with loads, [k, 6, 6].
            free: accelerations of the bodies without contacts, [k, 6].
            awake: which of them do not sleep, [k] bool.
        """
        if not self._rigid.names:
            return state
        bodies, grips = state
        model = ContactModel(self._rigid.tables, self._solver_of_bodies.twists)
        felt = model.feel(slots, None, None, jnp.zeros(0), bodies, grips, self.arms.dt)
        found = self._solve_bodies(masses, free, felt.contacts, slots, awake)
        return RigidBodyState(self._rigid.apply(bodies, found, awake, slots.company), released(grips))

    def _solve_bodies(self, masses: Array, free: Array, contacts: Contacts, slots: Slots, awake: Array) -> Array:
        """Return the accelerations [k, 6] of bodies that touch no arm: one by one, if none touches another."""
        k, total = len(free), slots.found

        def whole() -> Array:
            return self._solver_of_bodies.solve(Problem(*no_arms(), masses, free, contacts, total)).objects

        def single(row: tuple[Array, ...]) -> Array:
            number, mass, free = row

            def own(n: Array) -> Any:
                contact = contacts.at(n)
                return contact._replace(first=jnp.where(contact.first == number, 0, 1))

            problem = Problem(*no_arms(), mass[None], free[None], contacts._replace(at=own), total)

            def solve() -> Any:
                return self._solver_of_one.solve(problem).objects[0]

            return skip.cond("sleeping", awake[number], solve, lambda: jnp.zeros(6))

        def each() -> Array:
            return jax.lax.map(single, (jnp.arange(k), masses, free))

        if k < 2:
            return whole()
        joined = (contacts.second < k) & (np.arange(len(contacts.second)) < total)
        return skip.cond("bodies_apart", joined.any(), whole, each)

    # -- contacts of arms with arms

    def _contacts_of_arms(self, physics: Physics) -> ArmContacts:
        poses = self.arms.dynamics.axes(physics.qpos)  # again: quicker than to keep poses until here
        distance = self.pairs.distance_by_arms(poses.geom_xpos, poses.geom_xmat)
        deepest = self.pairs.deepest(poses, distance)
        rows = self.arms.dynamics.contact_rows(deepest.jacobian, deepest.distance, deepest.weight, physics.qvel)
        by_arm = jnp.pad(rows.jacobian, ((0, 0), (0, 1)))[:, self.arms.dofs]
        return ArmContacts(rows._replace(jacobian=by_arm), deepest.pair, -distance, deepest.left_out)

    def _contacts_of_arms_if(self, physics: Physics, overlap: Array) -> ArmContacts:
        """Return the contacts of arms with arms. There is nothing in them unless any overlap."""
        if not self.pairs.count:
            empty = jnp.zeros(0)
            rows = Rows(jnp.zeros((0, *self.arms.dofs.shape)), empty, empty, empty, empty)
            return ArmContacts(rows, empty, empty, jnp.int32(0))

        def found(_: None) -> ArmContacts:
            return self._contacts_of_arms(physics)

        def nothing(_: None) -> ArmContacts:
            none: ArmContacts = empty_like(jax.eval_shape(lambda: found(None)))
            return none

        between: ArmContacts = skip.cond("arm_contacts", overlap, found, nothing, None)
        return between

    # -- outputs

    def _touched(self, touch: Touch, between: ArmContacts, forces: Array) -> Touch:
        """Return the hardest touch with these contacts of arms, and the forces [r] of their rows."""
        return touch._replace(
            penetration=jnp.maximum(touch.penetration, between.penetration),
            force=jnp.maximum(touch.force, self.pairs.spread(between.pair, forces)),
            overflow=jnp.maximum(touch.overflow, between.overflow),
        )

    def _touched_if(self, touch: Touch, between: ArmContacts, forces: Array, overlap: Array) -> Touch:
        if not self.pairs.count:
            return touch

        def found(touch: Touch) -> Touch:
            return self._touched(touch, between, forces)

        touched: Touch = skip.cond("arm_contacts", overlap, found, lambda touch: touch, touch)
        return touched

    def _arm_of(self, slots: Slots) -> Array:
        """Return the arm that the patch in each slot is on, [s]; the number of arms for none."""
        arm = jnp.asarray(self._rigid.tables.owner.astype(np.int32))[slots.number]
        return jnp.where(np.arange(len(slots.number)) < slots.total, arm, self._agents)

    def _hardest(self, slots: Slots, pressed: Pressed) -> Array:
        """Return the largest normal force of a patch on each arm, N, and of one that is not a finger's, [2, a]."""
        tables = self._rigid.tables
        mine = self._arm_of(slots)[:, None] == np.arange(self._agents)
        bumps = jnp.asarray(tables.finger == len(tables.fingers))[slots.number]
        force = jnp.stack([pressed.normal, jnp.where(bumps, pressed.normal, 0.0)])
        return jnp.max(jnp.where(mine, force[..., None], 0.0), 1, initial=0.0)
