"""The PSM's joints answer a step of their target as the identified arm would: what docs/step_response.png shows."""

from __future__ import annotations

import numpy as np
import pytest

from docs.studies.step_response import SHARE, WRIST, Linear, identified, simulated_response
from surgical_marl import load_arm
from surgical_marl.robots.arm import Joint

JOINTS = load_arm("psm").actuated[:6]


@pytest.mark.parametrize("joint", JOINTS, ids=lambda joint: joint.name)
def test_a_step_is_answered_as_by_the_model(joint: Joint) -> None:
    """By the joint, and at the wrist by those that share its motors: within 5 % of the step, and what Coulomb friction,
    which the linear model lacks, takes of the effort."""
    time, ways = simulated_response(joint)
    off = np.abs(ways - identified(joint).response(time, joint.name))
    assert off.max() < 0.05 + joint.coulomb / (SHARE * joint.effort)
    assert off[-1].max() < 0.01 + joint.coulomb / (SHARE * joint.effort)


@pytest.mark.parametrize(
    ("joint", "natural", "damping"),
    [("yaw", 23.9, 0.61), ("pitch", 24.0, 0.52), ("insertion", 91.7, 1.54), ("roll", 115, 0.89)],
)
def test_the_models_are_as_fast_as_published_gains_and_inertias_make_them(
    joint: str, natural: float, damping: float
) -> None:
    frequencies, ratios = identified(next(j for j in JOINTS if j.name == joint)).modes()
    assert frequencies[0] == pytest.approx(natural, rel=0.003)
    assert ratios[0] == pytest.approx(damping, abs=0.006)


def test_the_model_solves_its_equation() -> None:
    """M x'' + D x' + K (x - target) = 0, for overshooting and creeping joints, alone and coupled."""
    time = np.linspace(0, 0.5, 5001)
    for natural, damping in ((24.0, 0.6), (90.0, 1.5)):
        inertia = np.array([[1.0, 0.4], [0.4, 0.7]])
        friction = 2 * damping * natural * np.array([[1.0, -0.2], [-0.2, 0.6]])
        linear = Linear(WRIST[1:], inertia, friction, natural**2 * np.array([[1.0, 0.3], [0.3, 0.8]]))
        for part in (linear, Linear(WRIST[1:2], *(matrix[:1, :1] for matrix in linear[1:]))):
            x = part.response(time, WRIST[1])
            target = np.eye(len(part.joints))[0]
            speed = np.gradient(x, time, axis=0)
            rest = np.gradient(speed, time, axis=0) @ part.inertia + speed @ part.damping
            rest += (x - target) @ part.stiffness
            assert np.abs(rest[5:-5]).max() < 1e-2 * natural**2
            assert np.abs(x[0]).max() < 1e-9 and np.abs(x).max() > 0.5
