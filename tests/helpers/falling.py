"""Objects that fall, slide and spin far from any arm, in environments side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import yaml

import surgical_marl as sm
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.step import Step
from surgical_marl.physics.systems import rigid_bodies, sleeping
from surgical_marl.physics.systems.rigid_bodies import RigidBodyState
from surgical_marl.physics.systems.rigid_motion import Bodies, rotation

DT = 0.0025
DOWN = np.array([0.0, 0.0, -9.81], np.float32)


class Trace(NamedTuple):
    """What objects [k] did in environments [E] at the end of every step [T]."""

    position: np.ndarray
    """Of the centres of mass, m, [E, T, k, 3]."""
    quaternion: np.ndarray
    velocity: np.ndarray
    depth: np.ndarray
    """The deepest overlap with anything, m, [E, T]."""


class Falling:
    """The free objects of a scene and what is fixed in it, under any gravity."""

    def __init__(self, folder: Path, objects: dict[str, dict[str, Any]]) -> None:
        path = folder / "falling.yaml"
        arms = {"ecm_0": {"arm": "ecm", "position": [0.0, 0.0, 5.0]}}  # compiles in less time than a PSM
        path.write_text(yaml.safe_dump({"arms": arms, "objects": objects}, sort_keys=False))
        self.scene = sm.load_scene(path)
        self.step = Step(self.scene)
        self.masses, self.names = self.bodies.tables.masses, self.bodies.names
        self._arms = Simulator(self.scene).home
        self._play = jax.jit(jax.vmap(self._advance, in_axes=(0, 0, None, None)), static_argnums=3)
        self.depths = jax.jit(jax.vmap(self.depth))
        """`depth` in many environments [E]. Without `jit` each call would compile each of its loops once more, and some
        hundred calls take all the memory maps that Linux gives to a process."""

    @property
    def bodies(self) -> Any:
        return self.step.bodies

    def begin(self, count: int) -> RigidBodyState:
        """Return the objects where the scene has them, [count]."""
        start = self.bodies.start({})
        return jax.tree.map(lambda x: jnp.repeat(x[None], count, 0), start)

    def play(
        self, objects: RigidBodyState, seconds: float, gravity: np.ndarray = DOWN, slow: float = sleeping.SLOW
    ) -> tuple[RigidBodyState, Trace]:
        """Return the objects after a time, and what they did. With `slow` 0 m/s nothing counts as at rest."""
        each = jnp.broadcast_to(jnp.asarray(gravity, jnp.float32), (len(objects.bodies.position), 3))
        objects, path = self._play(objects, each, slow, round(seconds / DT))
        return objects, Trace(*(np.asarray(part, float) for part in path))

    def _advance(self, objects: RigidBodyState, gravity: Any, slow: Any, steps: int) -> tuple[RigidBodyState, Trace]:
        def step(objects: RigidBodyState, _: None) -> tuple[RigidBodyState, Trace]:
            physics = self._arms.with_systems(rigid_bodies=objects)
            slots = self.step.slots(physics)
            objects = self.step.step_bodies(objects, slots, *self.step._free_bodies(physics, slots, {}))
            bodies, depth = objects.bodies, self.depth(objects)
            return objects, Trace(bodies.position, bodies.quaternion, bodies.velocity, depth)

        with patch.object(rigid_bodies, "GRAVITY", gravity), patch.object(sleeping, "SLOW", slow):
            return jax.lax.scan(step, objects, None, length=steps)

    def depth(self, objects: RigidBodyState) -> Any:
        """Return the deepest overlap of anything, m."""
        return self.step.depths(self._arms.with_systems(rigid_bodies=objects)).max(initial=-1.0)

    def energy(self, path: Trace) -> np.ndarray:
        """Return kinetic and potential energy, J, [E, T, k]."""
        mass, spin = self.masses.mass, path.velocity[..., 3:]
        turning = np.einsum("...ki,...kij,...kj->...k", spin, self.tensors(path), spin)
        return mass * ((path.velocity[..., :3] ** 2).sum(-1) / 2 + 9.81 * path.position[..., 2]) + turning / 2

    def momentum(self, path: Trace) -> np.ndarray:
        """Return angular momentum about the centres of mass, [E, T, k, 3]."""
        return np.einsum("...ij,...j->...i", self.tensors(path), path.velocity[..., 3:])

    def tensors(self, path: Trace) -> np.ndarray:
        frames = np.asarray(rotation(jnp.asarray(path.quaternion)), float)
        return np.einsum("...ij,...jk,...lk->...il", frames, self.masses.inertia.astype(float), frames)


def wide_pad(folder: Path) -> dict[str, str]:
    """Write a pad into a folder that is so wide that nothing rolls off it, and return where a scene has it."""
    path = folder / "wide.yaml"
    pad = yaml.safe_load((Path(sm.__file__).parents[1] / "scenes/objects/pad.yaml").read_text())
    pad["shapes"][0]["box"]["size"][:2] = [1.0, 1.0]
    path.write_text(yaml.safe_dump(pad))
    return {"object": str(path)}


def thrown(objects: RigidBodyState, **changes: Any) -> RigidBodyState:
    """Return objects with other fields of their bodies."""
    values = {name: jnp.asarray(value, jnp.float32) for name, value in changes.items()}
    bodies: Bodies = objects.bodies._replace(**values)
    return objects._replace(bodies=bodies)


def random_turns(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Return unit quaternions [*shape, 4]."""
    drawn = rng.standard_normal((*shape, 4))
    return drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)
