"""The fused engine's physics step with objects beside the reference, from any states."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from surgical_marl.bench.physics import PhysicsAlone
from surgical_marl.engines.choose import make_engine
from surgical_marl.envs.env import Env

PARTS = (
    *(f".arms.{name}" for name in ("qpos", "qvel")),
    *(f".rigid_bodies.bodies.{name}" for name in ("position", "quaternion", "velocity")),
    *(f".rigid_bodies.grips.{name}" for name in ("force", "position")),
)
DRAWS = 4
"""Random ways to change last digits. One way is too few: a light needle in a stiff grip answers some far more."""


class Beside:
    """Both engines on a scene."""

    def __init__(self, scene: str, count: int) -> None:
        self.env = Env("reach", scene)
        self.simulator = simulator = self.env.simulator
        self._engine = make_engine(PhysicsAlone(self.env), count, "fused", "cpu")
        self._engine.reset(0)
        plant = self.env.plant
        drawn = jax.vmap(plant.start)(self._engine.read(".key", "numpy"))
        step = jax.vmap(lambda physics, hidden: plant.actual(hidden).step(physics, simulator.untouched)[0])
        self._step = jax.jit(lambda physics: step(physics, drawn))

    def step(self, now: Any, compared: bool = True) -> Any:
        """Return the reference's states [n] after a step, once the fused engine's are found to be the same.

        Equal to 1e-5 of their scale, or as near as the reference is to itself when the last digit of the state changes.
        """
        now = jax.tree.map(np.asarray, now)
        after = jax.tree.map(np.asarray, self._step(now))
        if compared:
            for path, values in _leaves(now).items():
                self._engine.write(f".physics{path}", values)
            self._engine.step({})
            draws, expected = map(np.random.default_rng, range(DRAWS)), _leaves(after)
            others = [_leaves(self._step(_nudged(now, way))) for way in (-99.0, 99.0, *draws)]
            for part in PARTS:
                found = self._engine.read(f".physics{part}", "numpy")
                scale = np.abs(expected[part]).max() + 1e-3
                response = max(np.abs(other[part] - expected[part]).max() for other in others)
                off = np.abs(found - expected[part]).max()
                assert off <= 1e-5 * scale + 5 * response, f"{part} is off by {off}, the response is {response}"
        return after


def _nudged(physics: Any, way: float | np.random.Generator) -> Any:
    """Return the same states with the last digit changed of all joints, and of how objects are and move.

    All change towards a number, or each up or down by itself.
    """

    def change(values: np.ndarray) -> np.ndarray:
        towards = way if isinstance(way, float) else way.choice((-99.0, 99.0), values.shape)
        return np.nextafter(values, np.asarray(towards, np.float32))

    bodies = physics.rigid_bodies.bodies
    moved = bodies._replace(**{part: change(getattr(bodies, part)) for part in ("position", "quaternion", "velocity")})
    return physics.with_arms(qpos=change(physics.qpos)).with_systems(
        rigid_bodies=physics.rigid_bodies._replace(bodies=moved)
    )


def _leaves(tree: Any) -> dict[str, np.ndarray]:
    found = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in found}
