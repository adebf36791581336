"""A system of plug-ins: something that moves by its own equations and meets arms and rigid bodies in contacts.

A package declares its systems in the entry-point group `surgical_marl.systems`, a program registers them
(`surgical_marl.register_system`), and a scene file names them:

    systems:
      beads: {type: bead_string, position: [0.0, 0.0, 0.05]}

docs/physics.md walks through one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

from jax import Array

from surgical_marl.scenes.objects import Surface


class Spheres(NamedTuple):
    """The collision shapes of a system: n spheres. World."""

    centre: Array
    """m, [n, 3]"""
    radius: Array
    """m, [n]"""
    velocity: Array
    """m/s, [n, 3]"""


class Ends(NamedTuple):
    """The ends, on arms, rigid bodies and fixed things, of contacts with n spheres: r shapes each. World."""

    depth: Array
    """Overlap, m, [n, r]; negative for a distance."""
    place: Array
    """Midway between the two surfaces, m, [n, r, 3]."""
    normal: Array
    """Unit vector from the shape to the sphere, [n, r, 3]."""
    velocity: Array
    """Of the shape at that place, m/s, [n, r, 3]."""
    stiffness: Any
    """Of the contact, N/m, [r]."""
    sliding: Any
    """Coefficient of friction, [r]."""


class Loads(NamedTuple):
    """Forces of a system on the ends of its contacts, linear in the accelerations of the ends, [n, r]. World."""

    force: Array
    """At the start of the step's solve, while ends do not accelerate, N, [n, r, 3]."""
    stiffness: Array
    """By how much the force falls per acceleration of its end, kg, [n, r, 3, 3]; symmetric, positive semidefinite."""


class System(ABC):
    """One system of a scene. Its state is a tree of arrays; all methods are pure JAX functions of one environment.

    A physics step calls `shapes`, finds the ends of contacts, asks `respond` for the loads on them, solves arms and
    rigid bodies with these, and calls `apply` with the accelerations of the ends.
    """

    surface: Surface
    """Friction and stiffness of its spheres."""

    @abstractmethod
    def start(self) -> Any:
        """Return the state at the beginning of an episode."""

    @abstractmethod
    def shapes(self, state: Any) -> Spheres:
        """Return the spheres that others can touch."""

    @abstractmethod
    def free_motion(self, state: Any, dt: Any) -> Any:
        """Return the forces on the system without contacts, in any form that `respond` and `apply` take."""

    @abstractmethod
    def respond(self, state: Any, motion: Any, ends: Ends, dt: Any) -> Loads:
        """Return the loads on the ends of contacts, with the system's own unknowns eliminated (Schur complement)."""

    @abstractmethod
    def apply(self, state: Any, motion: Any, ends: Ends, accelerations: Array, dt: Any) -> Any:
        """Return the state after a step in which the ends have these accelerations, m/s2, [n, r, 3]."""

    def view(self, state: Any) -> Any:
        """Return the part of the state that tasks see: all of it by default. Nothing in this package calls it."""
        return state

    def randomise(self, key: Array) -> System:
        """Return the system with values drawn by a key: itself by default. Nothing in this package calls it."""
        del key
        return self
