"""Normalised observations, as networks see them."""

from __future__ import annotations

from rsl_rl.modules import EmpiricalNormalization
from torch import Tensor

from surgical_marl.policies.plain import FURTHEST


class LimitedNormaliser(EmpiricalNormalization):
    """rsl_rl's normaliser, with limited results."""

    def forward(self, x: Tensor) -> Tensor:
        """Return normalised observations, within `FURTHEST` of 0."""
        normalised: Tensor = super().forward(x)
        return normalised.clamp(-FURTHEST, FURTHEST)
