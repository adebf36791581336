"""Kinetic energy of every scene's arms that coast without actuators, friction and limits: the error of the integrator.

Run: python -m docs.studies.energy --results docs; it writes docs/energy.png.
"""

from __future__ import annotations

import mujoco
import numpy as np

from docs.studies.command import results_folder
from surgical_marl import list_scenes, load_scene
from surgical_marl.scenes.scene import Scene
from surgical_marl.scenes.timing import TIMESTEP


def energy_drift(scene: Scene, seconds: float = 2.0, timestep: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return time [T] in s and the relative change of kinetic energy since the start, [T].

    The first three joints of every arm start at 15 % of their velocity limits.
    """
    model = scene.model
    model.opt.timestep = timestep or model.opt.timestep
    model.dof_damping[:], model.dof_frictionloss[:] = 0, 0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    data.qpos[:] = scene.home
    for agent, mount in scene.mounts.items():
        for joint in mount.arm.actuated[:3]:
            data.joint(f"{agent}/{joint.name}").qvel = 0.15 * joint.velocity
    mujoco.mj_forward(model, data)
    start, energy = data.energy[1], []
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        energy.append(data.energy[1])
    return model.opt.timestep * (1 + np.arange(len(energy))), np.array(energy) / start - 1


def main(argv: list[str] | None = None) -> None:
    folder = results_folder(__doc__, argv)
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(8, 4.5), constrained_layout=True)
    for name in list_scenes():
        time, drift = energy_drift(load_scene(name))
        axis.plot(time, 100 * drift, label=f"{name}: at most {100 * np.abs(drift).max():.2f} %")
    title = f"coasting, physics step {1000 * TIMESTEP:g} ms"
    axis.set(xlabel="time (s)", ylabel="change of kinetic energy (%)", title=title)
    axis.legend()
    path = folder / "energy.png"
    figure.savefig(path, dpi=110)
    print(path)


if __name__ == "__main__":
    main()
