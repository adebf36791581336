"""A thread alone with shapes that stand still or move as told: contact without arms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.part_detection import PartDetection, Scenery
from surgical_marl.physics.contact.shapes import Plate, Segments
from surgical_marl.physics.contact.spring_contact import each, feel
from surgical_marl.physics.systems.system import End, Ends
from surgical_marl.physics.systems.thread import Thread, ThreadState
from surgical_marl.scenes.objects import Surface

DT = 2.5e-3
TIE = 2e4


def suture(path: np.ndarray, diameter: float = 0.22e-3, bending: float = 1.0, **more: Any) -> Thread:
    """Return a thread of nylon along a path [n, 3] of equal edges; `bending` is a factor of its stiffness."""
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum())
    given: dict[str, Any] = {"young": 2e9, "density": 1140.0, "surface": Surface(0.3, 0.0, 1e4), "drag": 20.0} | more
    thread = Thread(len(path), length, diameter, path=tuple(map(tuple, path.tolist())), **given)
    thread.__dict__["rod"] = thread.rod._replace(bending=bending * thread.rod.bending)
    return thread


def axis_plate(centre: Any, half: Any, radius: float) -> tuple[np.ndarray, Any, np.ndarray, float]:
    """Return a plate whose sides are along x and y."""
    return np.asarray(centre, float), np.eye(3), np.asarray(half, float), radius


class Told(NamedTuple):
    """What a step is told."""

    ties: Sequence[tuple[int, float, Any]] = ()
    """Part, share, and place of each tie at the end of the step, m."""
    moved: Any = None
    """Velocities of the shapes, m/s, [r, 3]; plates have been moved already."""
    pull: Any = 0.0
    """Other forces on nodes, N, [n, 3]."""


class Seen(NamedTuple):
    """What is measured in a step."""

    position: Array
    tension: Array
    normal: Array
    """Sum of the normal forces of contacts with shapes, N."""
    friction: Array
    """Sum of their friction on the thread, N, [3]."""
    tied: Array
    """Force of each tie on the thread, N, [t, 3]."""


@dataclass
class Bench:
    """A thread and some shapes: plates first, then capsules."""

    thread: Thread
    plates: Sequence[Any] = ()
    rods: Sequence[tuple[Any, Any, float]] = ()
    mu: float = 0.3
    stiffness: float = 1e4

    def run(self, state: ThreadState, steps: int, told: Callable[[Array], Told], first: int = 0) -> Any:
        """Return the state after some steps, and what was seen in each."""

        def one(state: ThreadState, k: Array) -> tuple[ThreadState, Seen]:
            return self.step(state, told(k), DT * k)

        run = jax.jit(lambda state: jax.lax.scan(one, state, jnp.arange(first, first + steps)))
        return run(state)

    def start(self) -> ThreadState:
        return self.thread.start(jnp.zeros((0, 3)))

    def step(self, state: ThreadState, told: Told, time: Any) -> tuple[ThreadState, Seen]:
        thread, shapes = self.thread, self.thread.shapes(state)
        count = len(self.plates) + len(self.rods)
        velocity = jnp.zeros((count, 3)) if told.moved is None else jnp.asarray(told.moved)
        counts = {"pads": 0, "links": 0, "objects": 0, "plates": len(self.plates), "rods": len(self.rods)}
        surfaces = [Surface(self.mu, 0.0, self.stiffness)] * count
        detection = PartDetection(counts, surfaces, thread.contacts)
        stacked = [np.array([p[i] for p in self.plates], np.float32) for i in range(4)]
        stacked = stacked if self.plates else [np.zeros(s, np.float32) for s in ((0, 3), (0, 3, 3), (0, 2), (0,))]
        plates = Plate(*map(jnp.asarray, stacked))
        plates = plates._replace(centre=plates.centre + time * velocity[: len(self.plates)])
        rods = [np.array([r[i] for r in self.rods], np.float32) for i in range(3)]
        rods = rods if self.rods else [np.zeros(s, np.float32) for s in ((0, 3), (0, 3), (0,))]
        moves = DT * jnp.linalg.norm(velocity, axis=-1)
        scenery = Scenery(plates, Segments(*map(jnp.asarray, rods)), moves)
        ties = [self._tie(shapes, *tie) for tie in told.ties]
        ends = detection.find(scenery, shapes, [], ties, DT)
        shift = DT * jnp.concatenate([velocity, jnp.zeros((1, 3))])[jnp.minimum(ends.rows.shape, count)]
        ends = ends._replace(rows=ends.rows._replace(shift=shift))
        motion = thread.free_motion(state, DT) + told.pull
        response = thread.respond(state, motion, ends, DT)
        after = thread.apply(state, response, ends, jnp.zeros((thread.contacts, 3)), DT)
        return after, self._seen(response.solved.ends, DT * after.chain.velocity, after, len(ties))

    def _tie(self, shapes: Any, part: int, share: float, place: Any) -> End:
        point = shapes.start[part] + share * (shapes.end[part] - shapes.start[part])
        place = jnp.asarray(place, jnp.float32)
        offset, up, none = point - place, jnp.array([0.0, 0.0, 1.0]), jnp.float32(0.0)
        return End(
            jnp.int32(part), jnp.float32(share), jnp.int32(len(self.plates) + len(self.rods)), -offset[2],
            place, up, jnp.float32(TIE), none, jnp.bool_(True), jnp.zeros(3), offset,
        )  # fmt: skip

    def _seen(self, ends: Ends, u: Array, after: ThreadState, ties: int) -> Seen:
        def force(row: Array, end: End) -> Array:
            del row
            moved = (1 - end.share) * u[end.part] + end.share * u[end.part + 1] - end.shift
            return feel(end, moved).force

        forces = each(ends, force)
        along = jnp.sum(forces * ends.rows.normal, -1)
        touching = (jnp.arange(len(along)) < ends.total - ties)[:, None]
        friction = jnp.where(touching, forces - along[:, None] * ends.rows.normal, 0.0).sum(0)
        tied = jax.lax.dynamic_slice(forces, (ends.total - ties, 0), (ties, 3)) if ties else jnp.zeros((0, 3))
        chain = after.chain
        return Seen(chain.position, chain.tension, jnp.where(touching[:, 0], along, 0.0).sum(), friction, tied)
