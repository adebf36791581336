"""The grasps of `shaking.py` in C MuJoCo, at a tenth of the step and with an elliptic friction cone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from docs.studies.shaking import Grasps, in_jaws
from surgical_marl.robots.rotation import matrix_of
from surgical_marl.scenes.mjcf import mjcf
from surgical_marl.scenes.timing import DECIMATION

FINE = 10
"""Steps of C MuJoCo in one of ours."""
IMPRATIO = 1e4
"""Stiffness of friction relative to that of the normal direction: the more, the less what is held creeps."""
TOLERANCE = 1e-14
"""At which C MuJoCo's solver stops. Its default of 1e-8 is too early for this `IMPRATIO`: of two starts that differ by
a ten millionth, half of the needles end up more than 0.06 mm apart after a handover, and one of 120 more than 1 mm.
With this tolerance half stay within a nanometre, and the steps take no longer."""


def play(
    grasps: Grasps,
    begin: Any,
    command: np.ndarray,
    held: np.ndarray,
    look: Callable[[mujoco.MjData, str], Any] = lambda data, name: data.body(name).xipos,
) -> np.ndarray:
    """Return what is seen after each control step: where held objects are, m, [E, steps, 3], if no `look` is given.

    Args:
        grasps: arms and objects.
        begin: our states [E] at the start.
        command: of all actuators in each control step, [E, steps, nu].
        held: number of the object, [E].
        look: what to return, from the data and the name of the object.
    """
    scene, bodies = grasps.scene, begin.rigid_bodies.bodies
    model, nq = mujoco.MjModel.from_xml_string(mjcf(scene, timestep=scene.model.opt.timestep / FINE)), scene.model.nq
    model.opt.impratio, model.opt.tolerance = IMPRATIO, TOLERANCE
    found: list[Any] = []
    for e, o in enumerate(held):
        data = mujoco.MjData(model)
        for k, name in enumerate(grasps.names):
            turn = np.array(bodies.quaternion[e, k], float)
            origin = np.array(bodies.position[e, k], float) - matrix_of(turn) @ scene.objects[name].object.center
            data.joint(name).qpos[:] = [*origin, *turn]
        data.qpos[:nq], data.qvel[:nq] = begin.qpos[e], begin.qvel[e]
        for t in range(command.shape[1]):
            data.ctrl[:] = command[e, t]
            mujoco.mj_step(model, data, FINE * DECIMATION)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            found.append(np.array(look(data, grasps.names[o])))
    return np.array(found).reshape(*command.shape[:2], *found[0].shape)


def play_in_jaws(grasps: Grasps, begin: Any, command: np.ndarray, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where held objects are in the frames of all jaws: centres of mass, m, [E, steps, a, 3], and axes.

    Arguments are as for `play`. Frames are those of `Seen.position`, axes [E, steps, a, 3, 3] as in `Seen.rotation`.
    """

    def look(data: mujoco.MjData, name: str) -> np.ndarray:
        position, rotation = (
            np.array([[getattr(data.body(finger), of) for finger in jaw] for jaw in grasps.fingers])
            for of in ("xpos", "xmat")
        )
        body = data.body(name)
        frames, place = in_jaws(np, position, rotation.reshape(*position.shape, 3), body.xipos)
        return np.concatenate([place[..., None], frames @ body.xmat.reshape(3, 3)], -1)

    found = play(grasps, begin, command, held, look)
    return found[..., 0], found[..., 1:]
