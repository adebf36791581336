"""A needle that is let go in tissue stays there, as a free body."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.physics.simulator import Simulator
from surgical_marl.robots.rotation import quaternion
from tests.helpers.needle_bench import DT, turning

CENTRE = np.array([0.0015, 0.0, 0.0195])
"""Of the needle's arc; the sheet's upper face is at 19 mm."""
UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Axes of a needle that stands upright, its tip to the left, both ends level."""
TISSUE = {
    "kind": "tissue", "size": [0.03, 0.02, 0.005], "cells": [6, 4, 1], "young": 27040.0,
    "fixed": ["left", "right", "front", "back"], "friction": {"sliding": 0.8, "torsion": 0.0},
    "channels": {"puncture": 0.05, "cutting": 0.02},
}  # fmt: skip
"""A sheet that gives way to a tip by less than its thickness before the tip enters."""


def scene_file(folder: Path) -> str:
    """Write a scene of a sheet of tissue with a needle in the air, far below an arm."""
    arm = {"arm": "psm", "position": [0.0, 0.0, 0.25], "workspace": [0.0, 0.0, -0.11]}
    (folder / "sheet.yaml").write_text(yaml.safe_dump(TISSUE))
    sheet = {"object": "sheet.yaml", "position": [-0.015, -0.01, 0.014]}
    needle = {"object": "needle_sh", "position": CENTRE.tolist(), "tilt": [90.0, 0.0, 0.0]}
    path = folder / "let_go.yaml"
    path.write_text(yaml.safe_dump({"arms": {"psm_0": arm}, "objects": {"sheet": sheet, "needle": needle}}))
    return str(path)


@pytest.mark.slow
def test_a_needle_that_is_let_go_stays(tmp_path: Path) -> None:
    """It is led through the sheet along its arc. In the fourth second after that nothing moves or is swept."""
    simulator = Simulator(sm.load_scene(scene_file(tmp_path)))
    centre, angles = simulator.scene.objects["needle"].object.center, np.linspace(0.1, -1.9, 800)
    axes = turning(CENTRE.tolist(), angles).axes[:, 0] @ UPRIGHT
    turns, places = np.array([quaternion(one) for one in axes], np.float32), np.float32(CENTRE + axes @ centre)
    velocity = jnp.zeros((1, 6)).at[0, 4].set((angles[1] - angles[0]) / DT)

    @jax.jit
    def step(physics: Any) -> Any:
        return simulator.step(physics, simulator.untouched)[0]

    physics = simulator.home
    for place, turn in zip(places, turns, strict=True):
        inner = physics.rigid_bodies
        bodies = inner.bodies._replace(position=place[None], quaternion=turn[None], velocity=velocity)
        physics = step(physics.with_systems(rigid_bodies=inner._replace(bodies=bodies)))
    channels = physics.systems["sheet"].channels
    assert channels.through[0] and int(channels.needle[0]) == 0 and int(channels.total[0]) > 2
    seen, swept = [], []
    for _ in range(1600):
        physics = step(physics)
        seen.append(np.asarray(physics.rigid_bodies.bodies.position[0]))
        swept.append(float(physics.systems["sheet"].channels.swept[0]))
    assert int(physics.systems["sheet"].channels.needle[0]) == 0
    assert np.ptp(seen[1200:], 0).max() < 1e-6
    assert swept[-1] - swept[1200] < 1e-4
    assert float(physics.systems["sheet"].force) < 0.05
