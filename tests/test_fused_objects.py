"""The fused engine's step of scenes with objects against the reference, from states along grasps."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest

from surgical_marl.bench.grasping import grasps
from surgical_marl.bench.physics import PhysicsAlone
from surgical_marl.engines.choose import make_engine
from surgical_marl.envs.env import Env

COUNT, STEPS, EVERY = 16, 40, 8
PARTS = (".qpos", ".qvel", ".objects.bodies.position", ".objects.bodies.quaternion", ".objects.bodies.velocity",
         ".objects.grips.force", ".objects.grips.position")  # fmt: skip


def leaves(tree: Any) -> dict[str, np.ndarray]:
    found = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in found}


def nudged(physics: Any) -> Any:
    """The same joints and objects, with the last digit of every joint changed."""
    return physics._replace(qpos=np.nextafter(physics.qpos, np.float32(1)))


@pytest.mark.parametrize("name", ["psm_needle", pytest.param("bimanual_psm_needle", marks=pytest.mark.slow)])
def test_a_step_with_objects_is_that_of_the_reference(name: str) -> None:
    """Equal to 1e-5 of its scale, or as near as the reference is to itself when the last digit of the state changes."""
    env = Env("reach", name)
    simulator, rng = env.simulator, np.random.default_rng(0)
    step = jax.jit(jax.vmap(lambda physics: simulator._step(physics, simulator.untouched)[0]))
    qpos, position, quaternion = (x.astype(np.float32) for x in grasps(env.scene, COUNT, rng)[:3])
    now = jax.vmap(simulator.at)(qpos)
    bodies = now.objects.bodies._replace(position=position, quaternion=quaternion)
    closed = np.array(simulator.home.ctrl)
    now = now._replace(objects=now.objects._replace(bodies=bodies), ctrl=np.where(closed > 0, closed, now.ctrl))
    now = now._replace(ctrl=np.array(now.ctrl) - 0.03)  # jaws close, and wrists move
    engine = make_engine(PhysicsAlone(env), COUNT, "fused", "cpu")
    engine.reset(0)
    held = 0.0
    for k in range(STEPS):
        now = jax.tree.map(np.asarray, now)
        after = jax.tree.map(np.asarray, step(now))
        if k % EVERY == 0:
            for path, values in leaves(now).items():
                engine.write(f".physics{path}", values)
            engine.step({})
            other, expected = leaves(step(nudged(now))), leaves(after)
            for part in PARTS:
                found = engine.read(f".physics{part}", "numpy")
                scale = np.abs(expected[part]).max() + 1e-3
                response = np.abs(other[part] - expected[part]).max()
                assert np.abs(found - expected[part]).max() <= 1e-5 * scale + 10 * response, (part, k)
            held = max(held, float(expected[".objects.grips.force"].max()))
        now = after
    assert held > 1.0
