"""Normalised observations, as networks see them."""

from __future__ import annotations

from rsl_rl.modules import EmpiricalNormalization
from torch import Tensor

FURTHEST = 10.0
"""Standard deviations to which normalised observations are limited. A needle that is flung away spins at a thousand of
them: a network's answer to that would outweigh all it should learn."""


class LimitedNormaliser(EmpiricalNormalization):
    """rsl_rl's normaliser, with limited results."""

    def forward(self, x: Tensor) -> Tensor:
        """Return normalised observations, within `FURTHEST` of 0."""
        normalised: Tensor = super().forward(x)
        return normalised.clamp(-FURTHEST, FURTHEST)
