"""A scene of a suture as a whole: a needle and its thread in tissue on both engines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.robots.rotation import quaternion

SCENE = "psm_suture"
BODY = ".physics.rigid_bodies.bodies."
CENTRE, RADIUS = np.array([0.0, 0.0, 0.0243]), 0.0082
"""Of the arc on which the needle is led through both edges of the wound, m."""
UPRIGHT = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Axes of a needle across the slit."""


def led(env: BatchedEnv, angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return position and orientation of the needle's body, and the place of its tail, at an angle of the arc, rad."""
    c, s = np.cos(angle), np.sin(angle)
    axes = UPRIGHT @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    centre = np.asarray(env.scene.objects["needle"].object.center)
    return CENTRE + axes @ centre, quaternion(axes), CENTRE + axes @ [RADIUS, 0.0, 0.0]


@pytest.mark.slow
def test_both_engines_hold_a_needle_and_its_thread_in_tissue_alike() -> None:
    """A needle is led through both edges, with its thread behind it; then it is free, for three control steps."""
    one, other = (BatchedEnv("reach", SCENE, num_envs=1, engine=engine, device="cpu") for engine in ("fused", "mjx"))
    for env in (one, other):
        env.reset(seed=0)
    still = {a: np.zeros((1, len(mount.arm.actuated)), np.float32) for a, mount in one.scene.mounts.items()}
    for k, angle in enumerate(np.linspace(0.3, 1.9, 41)):
        carry, (place, turn, tail) = one.carry(), led(one, angle)
        if k == 0:
            nodes = carry[".physics.thread.chain.position"]
            carry[".physics.thread.chain.position"] = nodes + (tail - nodes[:, :1]).astype(np.float32)
        carry[f"{BODY}position"][:, 0], carry[f"{BODY}quaternion"][:, 0] = place, turn
        carry[f"{BODY}velocity"][:] = 0
        one.set_carry(carry)
        one.step(still)
    begun = one.carry()
    assert (begun[".physics.wound.channels.needle"] >= 0).any()
    other.set_carry(begun)
    close = {f"{BODY}position": 2e-5, ".physics.wound.nodes.position": 2e-5, ".physics.thread.chain.position": 1e-4}
    for _ in range(3):
        found: list[Any] = []
        for env in (one, other):
            env.step(still)
            found.append(env.carry())
        for name, atol in close.items():
            np.testing.assert_allclose(found[0][name], found[1][name], atol=atol, err_msg=name)
        for name in ("needle", "total", "through", "thread"):
            np.testing.assert_array_equal(*(x[f".physics.wound.channels.{name}"] for x in found), err_msg=name)
    for env in (one, other):
        env.close()
