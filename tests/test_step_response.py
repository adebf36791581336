"""The PSM's joints answer a step of their target as the identified arm would: what docs/step_response.py draws."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from surgical_marl import load_arm

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))
from step_response import IDENTIFIED, SHARE, expected, model_response, simulated_response

JOINTS = load_arm("psm").actuated[:6]


@pytest.mark.parametrize("joint", JOINTS, ids=lambda joint: joint.name)
def test_a_step_is_answered_as_by_the_model(joint: object) -> None:
    """Within 5 % of the step, and what Coulomb friction, which the linear model lacks, takes of the effort."""
    time, way = simulated_response(joint)
    off = np.abs(way - model_response(time, *expected(joint)))
    assert off.max() < 0.05 + joint.coulomb / (SHARE * joint.effort)
    assert off[-1] < 0.01 + joint.coulomb / (SHARE * joint.effort)


def test_the_identified_numbers_follow_from_inertia_and_gains() -> None:
    """The dVRK's gains on the identified inertias 0.210 and 0.208 kg m2 and 0.713 kg."""
    for joint, inertia in zip(JOINTS[:3], (0.210, 0.208, 0.713), strict=True):
        natural, damping = IDENTIFIED[joint.name]
        assert natural == pytest.approx(np.sqrt(joint.drive.stiffness / inertia), rel=0.01)
        assert damping == pytest.approx((joint.drive.damping + joint.viscous) / (2 * inertia * natural), rel=0.03)


def test_the_model_solves_its_equation() -> None:
    """x'' + 2 d w x' + w^2 (x - 1) = 0, for overshooting, critical and creeping systems."""
    time = np.linspace(0, 0.5, 5001)
    for natural, damping in ((24.0, 0.6), (24.0, 1.0), (90.0, 1.5)):
        x = model_response(time, natural, damping)
        speed = np.gradient(x, time)
        rest = np.gradient(speed, time) + 2 * damping * natural * speed + natural**2 * (x - 1)
        assert np.abs(rest[5:-5]).max() < 1e-2 * natural**2
        assert x[0] == pytest.approx(0, abs=1e-9)
