"""Long motions of C MuJoCo, without a step of Python between its steps."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco import rollout

FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


def read_state(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the full physics state: the time, qpos and qvel, as one vector."""
    state = np.zeros(mujoco.mj_stateSize(model, FULL))
    mujoco.mj_getState(model, data, state, FULL)
    return state


def roll_out(
    model: mujoco.MjModel, data: mujoco.MjData, states: np.ndarray, controls: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Step from states [E, s] under controls [E, T, nu].

    Returns:
        Full states [E, T, s], and their qpos [E, T, nq] and qvel [E, T, nv].

    Raises:
        AssertionError: MuJoCo warned; a motion that became unstable would have been cut off.
    """
    found, _ = rollout.rollout(model, data, states, controls)
    seconds = found[:, -1, 0] - states[:, 0]
    np.testing.assert_allclose(seconds, controls.shape[1] * model.opt.timestep, err_msg="unstable")
    assert not [str(mujoco.mjtWarning(i)) for i, warning in enumerate(data.warning) if warning.number]
    return found, found[..., 1 : 1 + model.nq], found[..., 1 + model.nq : 1 + model.nq + model.nv]
