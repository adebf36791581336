"""Six arms in a ring: more pairs of shapes, and more joints, than are looked at side by side."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from surgical_marl.bench.physics import PhysicsAlone
from surgical_marl.engines.choose import make_engine
from surgical_marl.envs.env import Env
from surgical_marl.physics.contact.arm_contacts import AT_ONCE, SLOTS

ARMS, RADIUS, COUNT = 6, 0.16, 48


def ring(folder: Path) -> Path:
    """Write a scene of PSMs that face one field from all around."""
    arms = {}
    for k, angle in enumerate(np.linspace(0, 360, ARMS, endpoint=False)):
        away = [-RADIUS * float(np.cos(np.radians(angle))), -RADIUS * float(np.sin(np.radians(angle))), 0.15]
        arms[f"psm_{k}"] = {"arm": "psm", "position": away, "turn": -20.0, "tilt": [0.0, -34.25, float(angle)],
                            "workspace": [0.0, 0.0, -0.11]}  # fmt: skip
    path = folder / "ring.yaml"
    path.write_text(yaml.safe_dump({"arms": arms}, sort_keys=False))
    return path


@pytest.mark.slow
def test_six_arms_step_as_in_c_mujoco(tmp_path: Path) -> None:
    """One physics step of the fused engine, from states of which some touch and none in more pairs than are solved."""
    env = Env("reach", str(ring(tmp_path)))
    scene, model, rng = env.scene, env.scene.model, np.random.default_rng(0)
    assert model.npair > AT_ONCE
    data, states, touching = mujoco.MjData(model), [], 0
    limits = np.concatenate([[joint.velocity for joint in mount.arm.joints] for mount in scene.mounts.values()])
    while len(states) < COUNT:
        q = {
            agent: np.clip(mount.arm.home + rng.uniform(-0.25, 0.25, 7), mount.arm.lower, mount.arm.upper)
            for agent, mount in scene.mounts.items()
        }
        data.qpos[:], data.qvel[:] = scene.full_qpos(q), 0.05 * limits * rng.uniform(-1, 1, model.nv)
        data.ctrl[:], data.qacc_warmstart[:] = scene.moment @ data.qpos, 0.0
        mujoco.mj_forward(model, data)
        if data.ncon > SLOTS or (data.ncon == 0 and len(states) - touching >= COUNT // 2):
            continue
        touching += data.ncon > 0
        before = [data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()]
        data.qacc_warmstart[:] = 0.0
        mujoco.mj_step(model, data)
        states.append([*before, data.qvel.copy()])
    assert touching >= COUNT // 2
    qpos, qvel, ctrl, expected = (np.array(part, np.float32) for part in zip(*states, strict=True))
    engine = make_engine(PhysicsAlone(env), COUNT, "fused", "cpu")
    engine.reset(0)
    for name, values in (("qpos", qpos), ("qvel", qvel), ("ctrl", ctrl), ("qacc_warmstart", 0 * qvel)):
        engine.write(f".physics.arms.{name}", values)
    engine.step({})
    off = np.abs(engine.read(".physics.arms.qvel", "numpy") - expected) / limits
    assert off.max() < 1e-3
