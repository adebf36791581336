"""Grasps, handovers and releases against C MuJoCo at a tenth of the step, with an elliptic cone that does not creep."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from surgical_marl.robots.rotation import matrix_of
from surgical_marl.scenes.mjcf import mjcf
from surgical_marl.scenes.timing import DECIMATION
from surgical_marl.studies.shaking import CHUNK, CLOSING, OBJECTS, Grasps, Seen

DT = 0.0025
FINE = 10
"""Steps of C MuJoCo in one of ours."""
SPEED = 0.5
"""Share of full speed at which arms move: at full speed steps of 2.5 ms alone put an arm 0.3 mm elsewhere."""
NEAR = 3e-4
"""Most by which an object may be elsewhere, m."""


def in_mujoco(grasps: Grasps, begin: Any, command: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return where the held objects are in C MuJoCo, m, [E, steps, 3].

    Args:
        grasps: arms and objects.
        begin: our states [E] at the start.
        command: of all actuators in each control step, [E, steps, nu].
        held: number of the object, [E].
    """
    scene, bodies = grasps.scene, begin.objects.bodies
    model, nq = mujoco.MjModel.from_xml_string(mjcf(scene, timestep=DT / FINE)), scene.model.nq
    model.opt.impratio = 1e4
    found = np.zeros((*command.shape[:2], 3))
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
            found[e, t] = data.body(grasps.names[o]).xipos
    return found


def played(grasps: Grasps, begin: Any, chunks: list[np.ndarray], held: np.ndarray) -> tuple[Any, Seen]:
    """Return states after chunks of actions [a, n], and what was seen."""
    actions = np.concatenate([np.broadcast_to(chunk, (len(held), CHUNK, *chunk.shape)) for chunk in chunks], 1)
    return grasps.play(begin, actions, held)


@pytest.mark.slow
def test_a_grasped_object_is_lifted_swung_and_let_go_as_in_plain_mujoco() -> None:
    """From a closed grasp, by the same commands, until the fingers press with half of their force as the jaw opens."""
    grasps, held = Grasps(list(OBJECTS)), np.array([0, 0, 1, 1, 2, 2] * 2)
    begin, _ = grasps.play(grasps.begin(held, seed=5), grasps.still(len(held)), held)
    ways = ([0, 0, -1], [1, 0, -1], [0, 1, 0], [-1, -1, 0])
    chunks = [np.array([[*(SPEED * np.array(way)), 0, 0, 0, -1]], np.float32) for way in ways]
    _, seen = played(grasps, begin, [*chunks, np.array([[0, 0, 0, 0, 0, 0, 1]], np.float32)], held)
    off = np.linalg.norm(in_mujoco(grasps, begin, seen.command, held) - seen.place, axis=-1)
    force = seen.force.min((2, 3))
    grips = force > force[:, 4 * CHUNK - 1, None] / 2
    assert grips[:, : 4 * CHUNK].all() and grips[:, 4 * CHUNK :].any() and (force[:, -1] == 0).all()
    assert off[grips].max() < NEAR


@pytest.mark.slow
def test_an_object_is_handed_over_as_in_plain_mujoco() -> None:
    """Two arms hold a needle; the first opens its jaw and draws back, and the second carries the needle away.

    As a jaw opens, what it held may slip in the other one. C MuJoCo with half its step is then up to 0.4 mm away from
    itself, and the open finger may strike the needle as it leaves.
    """
    grasps, held = Grasps(["needle_sh"], arms=2), np.zeros(12, int)
    begin, _ = grasps.play(grasps.begin(held, seed=5), grasps.still(len(held), CLOSING), held)
    still, back, away = (np.array([*way, 0, 0, 0]) for way in ((0, 0, 0), (0, 0, -SPEED), (SPEED, 0, -SPEED)))
    moves = ((still, still, -1), (still, still, 1), (back, still, 1), (back, still, 1), (still, away, 1))
    chunks = [np.array([[*first, jaw], [*second, -1]], np.float32) for first, second, jaw in moves]
    _, seen = played(grasps, begin, chunks, held)
    off = np.linalg.norm(in_mujoco(grasps, begin, seen.command, held) - seen.place, axis=-1)
    assert seen.holding[:, CHUNK - 1].all() and (seen.holding[:, -1] == [False, True]).all()
    assert off[:, :CHUNK].max() < NEAR, "while both hold it"
    assert np.median(off[:, : 4 * CHUNK].max(1)) < NEAR and off[:, : 4 * CHUNK].max() < 8e-4
    assert np.median(off.max(1)) < 2 * NEAR and off.max() < 2e-3
