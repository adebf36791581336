"""Each joint's answer to a small step of its target, beside that of the identified second-order model.

Run: python docs/step_response.py; writes docs/step_response.png.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from surgical_marl import load_scene
from surgical_marl.arm import Joint

SHARE = 0.5
"""Of the step that takes full effort: below it the law is linear."""
SECONDS = 0.4

# Natural frequency in rad/s and damping ratio of the dVRK's gains on the identified Classic PSM at insertion 0.12 m
# (inertia 0.210 and 0.208 kg m2, 0.713 kg; dvrk_dynamics_identification).
IDENTIFIED = {"yaw": (23.9, 0.61), "pitch": (24.0, 0.52), "insertion": (91.7, 1.54)}


def model_response(time: np.ndarray, natural: float, damping: float) -> np.ndarray:
    """A second-order system's answer to a step from 0 to 1, [T]: natural frequency in rad/s, damping ratio."""
    roots = natural * (-damping + np.sqrt(complex(damping**2 - 1)) * np.array([1, -1]))
    if abs(roots[0] - roots[1]) < 1e-9:
        return 1 - (1 + natural * time) * np.exp(-natural * time)
    weights = np.array([roots[1], -roots[0]]) / (roots[0] - roots[1])
    return np.real(1 + weights @ np.exp(np.outer(roots, time)))


def simulated_response(joint: Joint, timestep: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Time [T] in s and the PSM joint's way to a new target, from 0 to 1, [T]."""
    scene = load_scene("psm")
    model, data = scene.model, mujoco.MjData(scene.model)
    model.opt.timestep = timestep or model.opt.timestep
    data.qpos[:], data.ctrl[:] = scene.home, scene.home
    for name, value in {"insertion": 0.12, "roll": 0.0}.items():
        data.joint(f"psm_0/{name}").qpos = value
        data.actuator(f"psm_0/{name}").ctrl = value
    start = data.joint(f"psm_0/{joint.name}").qpos[0]
    step = SHARE * joint.effort / joint.drive.stiffness
    data.actuator(f"psm_0/{joint.name}").ctrl = start + step
    way = []
    for _ in range(round(SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
        way.append((data.joint(f"psm_0/{joint.name}").qpos[0] - start) / step)
    return model.opt.timestep * (1 + np.arange(len(way))), np.array(way)


def expected(joint: Joint) -> tuple[float, float]:
    """Natural frequency and damping ratio: of the identified arm, or of the motors that the wrist's joints are."""
    if joint.name in IDENTIFIED:
        return IDENTIFIED[joint.name]
    natural = np.sqrt(joint.drive.stiffness / joint.drive.armature)
    return natural, (joint.drive.damping + joint.viscous) / (2 * joint.drive.armature * natural)


def main() -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    joints = load_scene("psm").mounts["psm_0"].arm.actuated[:6]
    figure, axes = plt.subplots(2, 3, figsize=(12, 6), constrained_layout=True)
    for axis, joint in zip(axes.flat, joints, strict=True):
        time, way = simulated_response(joint)
        fine = np.linspace(0, SECONDS, 400)
        natural, damping = expected(joint)
        source = "identified" if joint.name in IDENTIFIED else "motor alone"
        axis.plot(
            fine, model_response(fine, natural, damping), "k--", label=f"{source}: {natural:.0f} rad/s, {damping:.2f}"
        )
        axis.plot(time, way, color="#1b7a8c", label="simulated, 5 ms")
        axis.set(title=joint.name, xlabel="time (s)", ylabel="share of the step")
        axis.legend(loc="lower right")
    path = Path(__file__).with_suffix(".png")
    figure.savefig(path, dpi=110)
    print(path)


if __name__ == "__main__":
    main()
