"""A system of a stranger's: beads on a string of springs that hangs from a fixed point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.point_contact import moved, respond, yielding
from surgical_marl.physics.systems.system import Ends, Response, Shapes, System
from surgical_marl.scenes.objects import Surface
from surgical_marl.untrusted.schema import Vector, lengths, number

GRAVITY = 9.81


class Beads(NamedTuple):
    """The state of the beads."""

    position: Array
    """m, [n, 3]"""
    velocity: Array
    """m/s, [n, 3]"""


@dataclass(frozen=True)
class BeadString(System):
    """Beads that hang one below the other, each from a linear spring whose pull has no direction of its own."""

    position: Vector = lengths()
    """Where the string is fixed."""
    beads: int = number(5, 1, 64)
    mass: float = number(1e-3, 1e-6, 1.0, unit="kg")
    stiffness: float = number(20.0, 1e-3, 1e4, unit="N/m")
    damping: float = number(0.05, 0.0, 1e3, unit="N s/m")
    length: float = number(0.01, 1e-4, 1.0, unit="m")
    radius: float = number(0.003, 1e-5, 0.1, unit="m")
    surface: ClassVar[Surface] = Surface(sliding=0.3, torsion=0.0, stiffness=2e3)

    @property
    def hanging(self) -> np.ndarray:
        """Where the beads hang at rest, m, [n, 3]: a spring bears the weight of all beads below it."""
        borne = np.arange(self.beads, 0, -1) * self.mass * GRAVITY / self.stiffness
        below = np.cumsum(self.length + borne)
        return np.array(self.position) - below[:, None] * [0.0, 0.0, 1.0]

    @property
    def contacts(self) -> int:
        return 4 * self.beads

    def start(self, places: Array) -> Beads:
        del places
        unstretched = np.array(self.position) - np.outer(self.length * np.arange(1, self.beads + 1), [0, 0, 1])
        return Beads(jnp.asarray(unstretched, jnp.float32), jnp.zeros((self.beads, 3), jnp.float32))

    def shapes(self, state: Beads) -> Shapes:
        radius = jnp.full(self.beads, self.radius, jnp.float32)
        return Shapes(state.position, state.position, radius, jnp.linalg.norm(state.velocity, axis=-1))

    def free_motion(self, state: Beads, dt: Any) -> tuple[Array, Array]:
        """Return matrices and forces of the beads: springs and dampers at the end of the step, neighbours go on."""
        ahead = state.position + dt * state.velocity
        above = jnp.concatenate([jnp.asarray([self.position], jnp.float32), ahead[:-1]])
        drop = jnp.array([0.0, 0.0, self.length], jnp.float32)
        pull = self.stiffness * (above - drop - ahead)  # of each bead's own spring
        force = pull - jnp.concatenate([pull[1:], jnp.zeros((1, 3))]) - self.damping * state.velocity
        force = force - jnp.array([0.0, 0.0, self.mass * GRAVITY], jnp.float32)
        springs = np.append(np.full(self.beads - 1, 2.0), 1.0) * self.stiffness
        matrix = (self.mass + dt**2 * springs + dt * self.damping)[:, None, None] * np.eye(3)
        return jnp.asarray(matrix, jnp.float32), force

    def respond(self, state: Beads, motion: tuple[Array, Array], ends: Ends, dt: Any) -> Response:
        return respond(*motion, state.velocity, ends, dt)

    def yielding(self, response: Response, ends: Ends, accelerations: Array, dt: Any) -> Array:
        return yielding(response, ends, accelerations, dt)

    def apply(self, state: Beads, response: Response, ends: Ends, accelerations: Array, dt: Any) -> Beads:
        velocity = moved(response, ends, accelerations, dt)
        return Beads(state.position + dt * velocity, velocity)
