"""Rotations of free bodies against matrices in float64."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl.physics.systems.rigid_motion import carried, turn
from surgical_marl.robots.rotation import matrix_of

NUMBERS = st.floats(-1.0, 1.0, width=32)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS)


@settings(deadline=None)
@given(VECTORS, VECTORS, st.sampled_from([3.0, 0.1, 1e-4]), st.sampled_from([1.0, -1.0]))
def test_a_turn_has_moved_what_is_at_a_place_from_where_it_was(
    axis: tuple[float, ...], place: tuple[float, ...], size: float, sign: float
) -> None:
    """To float32's precision of the way itself, also where that is ten thousand times shorter than the place is far."""
    angle, there = size * np.array(axis), np.array(place)
    quaternion = sign * turn(jnp.asarray(angle, jnp.float32))
    exact = matrix_of(np.asarray(quaternion, float) / np.linalg.norm(np.asarray(quaternion, float)))
    way = there - exact.T @ there
    found = np.asarray(carried(quaternion, jnp.asarray(there, jnp.float32)))
    np.testing.assert_allclose(found, way, atol=1e-6 * np.linalg.norm(angle) * np.linalg.norm(there) + 1e-12)
