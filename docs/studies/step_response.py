"""Each joint's response to a small step of its target, beside that of the identified linear model.

Run: python -m docs.studies.step_response --results docs; it writes docs/step_response.png.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import rollout

from docs.studies.command import results_folder
from surgical_marl import load_scene
from surgical_marl.robots.arm import Joint
from surgical_marl.scenes.timing import TIMESTEP

SHARE = 0.5
"""Size of the step as a share of the one that needs full effort; below that the controller is linear."""
SECONDS = 0.4
STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS

# The identified Classic PSM at insertion 0.12 m, kg m2 and kg (dvrk_dynamics_identification).
INERTIA = {"yaw": 0.210, "pitch": 0.208, "insertion": 0.713}
# From the motor discs to roll, wrist pitch, wrist yaw and jaw (dVRK, tool/LARGE_NEEDLE_DRIVER_400006.json).
COUPLING = [[-1.5632, 0, 0, 0], [0, 1.0186, 0, 0], [0, -0.8306, 0.6089, 0.6089], [0, 0, -1.2177, 1.2177]]
DISC_STIFFNESS, DISC_DAMPING, DISC_INERTIA = 6.0, 0.09, 3.3e-6 * 11.71**2
WRIST = ("roll", "wrist_pitch", "wrist_yaw")


class Linear(NamedTuple):
    """Inertia x'' + damping x' + stiffness (x - target) = 0 of joints that belong together, [n, n] each."""

    joints: tuple[str, ...]
    inertia: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray

    def modes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return natural frequency in rad/s and damping ratio of each joint if the others stood still, [n]."""
        inertia, damping, stiffness = (np.diag(part) for part in self[1:])
        return np.sqrt(stiffness / inertia), damping / (2 * np.sqrt(stiffness * inertia))

    def response(self, time: np.ndarray, joint: str) -> np.ndarray:
        """Return the movements of the joints [T, n] when the target of one goes from 0 to 1."""
        n = len(self.joints)
        inverse, target = np.linalg.inv(self.inertia), np.eye(n)[self.joints.index(joint)]
        system = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ self.stiffness, -inverse @ self.damping]])
        rates, shapes = np.linalg.eig(system)
        weights = np.linalg.solve(shapes, np.concatenate([-target, np.zeros(n)]))
        return target + np.real(np.exp(np.outer(time, rates)) * weights @ shapes.T)[:, :n]


def identified(joint: Joint) -> Linear:
    """Return the linear model of the identified arm with the dVRK's gains, for a joint.

    A joint of the wrist is modelled together with the others of the wrist. There the gains act on the motors, and the
    cable coupling passes them on to the joints.
    """
    if joint.name in INERTIA:
        parts = INERTIA[joint.name], joint.drive.damping + joint.viscous, joint.drive.stiffness
        return Linear((joint.name,), *(np.array([[part]]) for part in parts))
    wrist = load_scene("psm").mounts["psm_0"].arm.actuated[3:6]
    discs = np.linalg.inv(COUPLING)[:, :3]
    share = discs.T @ discs
    friction = np.diag([joint.viscous for joint in wrist])
    return Linear(WRIST, DISC_INERTIA * share, DISC_DAMPING * share + friction, DISC_STIFFNESS * share)


def simulated_response(joint: Joint, timestep: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Simulate a step of the target of one PSM joint.

    Returns:
        Time [T] in s, and the movements [T, n] of that joint and of the joints coupled to it, as shares of the step.
    """
    scene, linear = load_scene("psm"), identified(joint)
    model, data = scene.model, mujoco.MjData(scene.model)
    model.opt.timestep = timestep or model.opt.timestep
    data.qpos[:] = scene.home
    data.joint("psm_0/insertion").qpos = 0.12
    start, target = data.qpos.copy(), data.qpos.copy()
    address = [model.joint(f"psm_0/{name}").qposadr[0] for name in linear.joints]
    own = linear.joints.index(joint.name)
    step = SHARE * joint.effort / linear.stiffness[own, own]
    target[address[own]] += step
    steps = round(SECONDS / model.opt.timestep)
    initial, control = np.zeros(mujoco.mj_stateSize(model, STATE)), np.tile(scene.moment @ target, (steps, 1))
    mujoco.mj_getState(model, data, initial, STATE)
    states, _ = rollout.rollout(model, data, initial, control)
    qpos = states[0, :, 1 : 1 + model.nq]  # after the time
    return model.opt.timestep * (1 + np.arange(steps)), (qpos - start)[:, address] / step


def main(argv: list[str] | None = None) -> None:
    folder = results_folder(__doc__, argv)
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    joints = load_scene("psm").mounts["psm_0"].arm.actuated[:6]
    figure, axes = plt.subplots(2, 3, figsize=(12, 6), constrained_layout=True)
    for axis, joint in zip(axes.flat, joints, strict=True):
        time, ways = simulated_response(joint)
        fine, linear = np.linspace(0, SECONDS, 400), identified(joint)
        natural, damping = (mode[linear.joints.index(joint.name)] for mode in linear.modes())
        source = "identified" if joint.name in INERTIA else "motors and cables"
        answers = linear.response(fine, joint.name)
        for name, answer, way in zip(linear.joints, answers.T, ways.T, strict=True):
            if name == joint.name:
                axis.plot(fine, answer, "k--", label=f"{source}: {natural:.0f} rad/s, {damping:.2f}")
                axis.plot(time, way, color="#1b7a8c", label=f"simulated, {1000 * TIMESTEP:g} ms")
            elif "roll" not in (name, joint.name):
                axis.plot(fine, answer, "k:")
                axis.plot(time, way, color="#c8792b", label=f"meanwhile {name}")
        axis.set(title=joint.name, xlabel="time (s)", ylabel="share of the step")
        axis.legend(loc="center right")
    path = folder / "step_response.png"
    figure.savefig(path, dpi=110)
    print(path)


if __name__ == "__main__":
    main()
