"""Some arms of a scene as one agent: infos that systems of the scene report."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium import spaces

import surgical_marl as sm
from surgical_marl.interfaces.joint import JointAgent


def test_the_agent_is_told_what_systems_report() -> None:
    scene = sm.load_scene("bimanual_psm_tissue")
    box = spaces.Box(-1.0, 1.0, (7,), np.float32)
    batch: Any = SimpleNamespace(
        agents=list(scene.agents), scene=scene, num_envs=2, observation_space=lambda _: box, action_space=lambda _: box
    )
    felt = {"psm_0": np.array([0.1, 0.2]), "psm_1": np.array([0.1, 0.2])}
    infos = {agent: {"tissue_force": force, "own": force} for agent, force in felt.items()}
    told = JointAgent(batch).info(infos)
    np.testing.assert_array_equal(told["tissue_force"], [0.1, 0.2])
    assert set(told) == {"tissue_force", "agents"}
