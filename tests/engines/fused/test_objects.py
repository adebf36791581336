"""The fused engine's step of scenes with objects against the reference, from states along grasps."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from surgical_marl.bench.starts import grasps
from tests.helpers.fused_kernels import gpu_code
from tests.helpers.object_parity import Beside

COUNT, STEPS, EVERY = 16, 40, 8
LARGER = "bimanual_psm_needle", "bimanual_psm_pegs", "trimanual_psm_ecm_needle", "trimanual_psm_ecm_pegs"


@pytest.mark.parametrize("name", ["psm_needle", *(pytest.param(name, marks=pytest.mark.slow) for name in LARGER)])
def test_a_step_with_objects_is_that_of_the_reference(name: str) -> None:
    follow_grasps(Beside(name, COUNT))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["psm_needle", "bimanual_psm_needle"])
def test_the_code_for_a_gpu_makes_the_same_step(name: str) -> None:
    with gpu_code():
        follow_grasps(Beside(name, COUNT))


def follow_grasps(both: Beside) -> None:
    """Close jaws on objects, and compare both engines on the way."""
    simulator, starts = both.simulator, grasps(both.env.scene, COUNT, np.random.default_rng(0))
    qpos, position, quaternion = (x.astype(np.float32) for x in starts[:3])
    now = jax.vmap(simulator.at)(qpos)
    bodies = now.rigid_bodies.bodies._replace(position=position, quaternion=quaternion)
    closed = np.array(simulator.home.ctrl)
    now = now.with_systems(rigid_bodies=now.rigid_bodies._replace(bodies=bodies))
    now = now.with_arms(ctrl=np.where(closed > 0, closed, now.ctrl))
    now = now.with_arms(ctrl=np.array(now.ctrl) - 0.03)  # jaws close, and wrists move
    held = 0.0
    for k in range(STEPS):
        # Nothing is known of accelerations in the first step: one state of 16 takes all Newton steps that there may be,
        # and how near that comes depends on rounding.
        now = both.step(now, compared=k % EVERY == EVERY - 1)
        held = max(held, float(now.rigid_bodies.grips.force.max()))
    assert held > 1.0
