"""Sweeps of docs/physics.md: how large a physics step may be.

Run: python -m docs.studies.stability
"""

from __future__ import annotations

import mujoco
import numpy as np

from docs.studies.command import make_parser
from surgical_marl import load_scene
from surgical_marl.scenes.scene import Scene

CONTROL = 0.02
SECONDS = 10.0
INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}


def prepared(scene: Scene, timestep: float, integrator: str = "implicitfast", gain: float = 1.0) -> mujoco.MjModel:
    """Return the scene's model with a given physics step and integrator, and all controller gains scaled by `gain`."""
    model = load_scene(scene.name).model
    model.opt.timestep = timestep
    model.opt.integrator = INTEGRATORS[integrator]
    model.actuator_gainprm[:, 0] *= gain
    model.actuator_biasprm[:, 1:3] *= gain
    return model


def targets(scene: Scene, seed: int = 0) -> np.ndarray:
    """Return random walks of all position targets at full speed, and minutes pressed against limits, [steps, nu]."""
    rng = np.random.default_rng(seed)
    speed = np.array([j.drive.speed for mount in scene.mounts.values() for j in mount.arm.joints])
    low, high = scene.model.jnt_range.T
    now, walk = scene.home.copy(), []
    for step in range(round(SECONDS / CONTROL)):
        if step % 25 == 0:  # half a second in one direction, so that limits are reached
            way = rng.uniform(-1, 1, len(speed))
        now = np.clip(now + way * speed * CONTROL, low, high)
        walk.append(scene.moment @ now)
    return np.array(walk)


def rollout(model: mujoco.MjModel, scene: Scene, ctrl: np.ndarray) -> tuple[np.ndarray, float]:
    """Return qpos at each control step, and the greatest share of a joint's range by which it passed a limit."""
    data = mujoco.MjData(model)
    data.qpos[:] = scene.home
    low, high = model.jnt_range.T
    found: list[np.ndarray] = []
    passed = 0.0
    for target in ctrl:
        data.ctrl[:] = target
        for _ in range(round(CONTROL / model.opt.timestep)):
            mujoco.mj_step(model, data)
            passed = max(passed, float(np.max(np.maximum(data.qpos - high, low - data.qpos) / (high - low))))
        if data.warning.number.any():  # MuJoCo resets unstable states
            return np.array(found), np.inf
        found.append(data.qpos.copy())
    return np.array(found), passed


def main(argv: list[str] | None = None) -> None:
    make_parser(__doc__).parse_args(argv)
    scene = load_scene("bimanual_psm")
    ctrl = targets(scene)
    reference, _ = rollout(prepared(scene, 0.0005), scene, ctrl)
    weights = np.where(scene.model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE, 1000.0, np.degrees(1.0))
    print("| physics step | integrator | gains | limit passed by | off the 0.5 ms path (95 %): slides | hinges |")
    print("|---|---|---|---|---|---|")
    for timestep in (0.02, 0.01, 0.005, 0.0025):
        for integrator in INTEGRATORS:
            for gain in (1.0, 2.0, 4.0):
                path, passed = rollout(prepared(scene, timestep, integrator, gain), scene, ctrl)
                row = f"| {1000 * timestep:g} ms | {integrator} | x{gain:g} "
                if not np.isfinite(passed):
                    print(row + f"| unstable after {len(path) * CONTROL:.2f} s | | |")
                    continue
                off = "| | |"
                if gain == 1.0:
                    error = np.abs(path - reference) * weights
                    slides = scene.model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
                    millimetres, degrees = (np.percentile(error[:, of], 95) for of in (slides, ~slides))
                    off = f"| {millimetres:.2f} mm | {degrees:.2f}° |"
                print(row + f"| {passed:.2%} " + off)


if __name__ == "__main__":
    main()
