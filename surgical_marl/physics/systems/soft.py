"""Systems that deform, thread and tissue: how their stiffness and friction differ from their files."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.systems.system import Ends, System


class Material(NamedTuple):
    """Numbers that belong to the material of a system: factors of its values, or ranges of these."""

    stiffness: Any
    """Of Young's modulus."""
    friction: Any
    """Of the coefficient of friction."""


EXACT, AS_IN_FILE = Material(0.0, 0.0), Material(1.0, 1.0)
"""Ranges and factors of what is not randomised."""


@dataclass(frozen=True)
class Soft(System):
    """A system of a material that domain randomisation varies."""

    _: KW_ONLY
    ranges: Material = EXACT
    """Shares of its values by which they may be off, from 0 to 1."""
    factors: Material = AS_IN_FILE
    """The factors of an episode."""

    def randomise(self, key: Array) -> Self:
        """Return the system with factors drawn uniformly within the ranges."""
        off = np.array(self.ranges, np.float32)
        draws = 1 + off * jax.random.uniform(key, off.shape, jnp.float32, -1.0, 1.0)
        drawn = (factor if share else 1.0 for factor, share in zip(draws, self.ranges, strict=True))
        return replace(self, factors=Material(*drawn))

    def rubbed(self, ends: Ends) -> Ends:
        """Return contacts with the friction of the episode: of two surfaces the geometric mean counts."""
        if not self.ranges.friction:
            return ends
        sliding = jnp.sqrt(self.factors.friction) * ends.rows.sliding
        sliding = jnp.where(ends.rows.bilateral, ends.rows.sliding, sliding)  # in a channel friction is a force
        return ends._replace(rows=ends.rows._replace(sliding=sliding))
