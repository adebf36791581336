"""The state of the physics: one entry for each system that moves."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
from jax import Array

ARMS, RIGID_BODIES, ATTACHMENTS = "arms", "rigid_bodies", "attachments"
"""Names of what the solver knows: two systems, and what holds bodies at arms. All others meet them in contacts."""


class ArmState(NamedTuple):
    """The joints of all arms of a scene."""

    qpos: Array
    """Positions, rad or m, [nq]."""
    qvel: Array
    """Velocities, rad/s or m/s, [nv]."""
    qacc_warmstart: Array
    """Accelerations that the last step found, with which the solver begins, [nv]."""
    ctrl: Array
    """Command of every actuator: position target, velocity or torque, [nu]."""


@jax.tree_util.register_pytree_with_keys_class
@dataclass(frozen=True)
class Physics:
    """The state of the physics: all that is kept between two steps. Everything else follows from it.

    It is a tree whose branches are the systems: engines name the joints' positions `.physics.arms.qpos`.
    """

    systems: dict[str, Any]
    """The state of each system by its name."""

    @property
    def arms(self) -> ArmState:
        """The joints of the arms."""
        state: ArmState = self.systems[ARMS]
        return state

    @property
    def qpos(self) -> Array:
        """Positions of the arms' joints, rad or m, [nq]."""
        return self.arms.qpos

    @property
    def qvel(self) -> Array:
        """Velocities of the arms' joints, rad/s or m/s, [nv]."""
        return self.arms.qvel

    @property
    def ctrl(self) -> Array:
        """Commands of the actuators, [nu]."""
        return self.arms.ctrl

    @property
    def rigid_bodies(self) -> Any:
        """The free rigid bodies (`RigidBodyState`), in a scene that has any objects."""
        return self.systems[RIGID_BODIES]

    def with_systems(self, **states: Any) -> Physics:
        """Return the physics with other states of some systems."""
        return Physics(self.systems | states)

    def with_arms(self, **fields: Any) -> Physics:
        """Return the physics with other values of some fields of `ArmState`."""
        return self.with_systems(arms=self.arms._replace(**fields))

    def tree_flatten_with_keys(self) -> tuple[list[tuple[Any, Any]], tuple[str, ...]]:
        """Return the systems' states, and their names."""
        return [(jax.tree_util.GetAttrKey(name), state) for name, state in self.systems.items()], tuple(self.systems)

    @classmethod
    def tree_unflatten(cls, names: tuple[str, ...], states: Iterable[Any]) -> Physics:
        """Return the physics of systems with these names and states."""
        return cls(dict(zip(names, states, strict=True)))
