"""Conversions between rotation matrices, quaternions (w, x, y, z) and angles, by MuJoCo's functions.

SciPy's `Rotation` does the same, but its import takes 0.3 s of CPU time, as long as the rest of loading a scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np


def quaternion(matrix: np.ndarray) -> np.ndarray:
    """Return the quaternion [4] of a rotation matrix [3, 3]."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(matrix, dtype=float).ravel())
    return quat


def matrix_of(quat: np.ndarray) -> np.ndarray:
    """Return the rotation matrix [3, 3] of a quaternion [4]."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def turned(degrees: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the rotation matrix [3, 3] of turns by [3] degrees about the fixed axes x, then y, then z."""
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, np.radians(degrees), "XYZ")
    return matrix_of(quat)
