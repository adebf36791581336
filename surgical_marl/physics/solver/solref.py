"""The response of a constraint to a violation: MuJoCo's `solref` and `solimp`, as its documentation defines them.

https://mujoco.readthedocs.io/en/stable/modeling.html#solver-parameters
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
from jax import Array


class Response(NamedTuple):
    """The reference acceleration is -damping * velocity - stiffness * impedance * violation."""

    stiffness: Array
    """1/s2, []."""
    damping: Array
    """1/s, []."""
    impedance: Array
    """Impedance from 0 to 1, a function of the violation."""


def response(solref: Any, solimp: Any, violation: Array, timestep: Any) -> Response:
    """Return the first three columns of MuJoCo's `efc_KBIP` for constraints of one kind.

    Args:
        solref: time constant in s and damping ratio, or both negative: minus stiffness and minus damping, [2].
        solimp: least and greatest impedance, the width over which it rises, and midpoint and power of the rise, [5].
        violation: distance less margin of each constraint, [...], m or rad.
        timestep: of the physics, s. A time constant is no shorter than two steps.
    """
    least, greatest = (jnp.clip(bound, mujoco.mjMINIMP, mujoco.mjMAXIMP) for bound in (solimp[0], solimp[1]))
    time, ratio = jnp.maximum(solref[0], 2 * timestep), solref[1]
    stiffness = jnp.where(solref[0] > 0, 1 / (greatest * greatest * time * time * ratio * ratio),
                          -solref[0] / (greatest * greatest))  # fmt: skip
    damping = jnp.where(solref[1] > 0, 2 / (greatest * time), -solref[1] / greatest)
    return Response(stiffness, damping, least + _rise(solimp, violation) * (greatest - least))


def _rise(solimp: Any, violation: Array) -> Array:
    """Return 0 without a violation, rising to 1 at `width`, [...]: two powers that meet at the midpoint."""
    width, power = jnp.maximum(solimp[2], mujoco.mjMINVAL), jnp.maximum(solimp[4], 1.0)
    middle = jnp.clip(solimp[3], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    x = jnp.minimum(jnp.abs(violation) / width, 1.0)
    early = (1 / jnp.power(middle, power - 1)) * jnp.power(x, power)
    late = 1 - (1 / jnp.power(1 - middle, power - 1)) * jnp.power(1 - x, power)
    return jnp.where(x < middle, early, late)
