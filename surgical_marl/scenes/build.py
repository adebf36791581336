"""Builds a MuJoCo model from mounted arms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.rotation import quaternion
from surgical_marl.robots.spec import COLLISION_GROUP, build_spec
from surgical_marl.scenes.scene import Mount, Randomisation, Scene, payload_body
from surgical_marl.scenes.timing import TIMESTEP


def set_physics(spec: mujoco.MjSpec) -> None:
    """Set the physics options that every scene has."""
    option = spec.option
    option.timestep = TIMESTEP
    # Implicit in velocity: the stiff wrist controllers stay stable even at 5 ms. docs/physics.md compares.
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # dVRK arms are balanced by counterweights (identified gravity torque under 0.4 N m), so gravity is off.
    option.gravity = [0.0, 0.0, 0.0]


def build_scene(
    name: str, mounts: dict[str, Mount], control: str, randomisation: Randomisation, pads: bool = False
) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.compiler.degree = False
    spec.copy_during_attach = True
    set_physics(spec)
    for agent, mount in mounts.items():
        frame = spec.worldbody.add_frame(pos=mount.position, quat=quaternion(mount.rotation))
        spec.attach(build_spec(mount.arm, control, pads), prefix=f"{agent}/", frame=frame)
        if randomisation.payload:
            spec.body(f"{agent}/{mount.arm.tool_tip}").add_body(name=payload_body(agent, mount.arm))
    return spec


def compile_scene(spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"scene {spec.modelname!r} does not compile: {' '.join(str(error).split())}") from None


def weigh_shapes(model: mujoco.MjModel, home: np.ndarray) -> mujoco.MjModel:
    """Set the inverse weight of a body in a contact (`body_invweight0`, 1/kg) to its value where its shapes are.

    MuJoCo takes the value at the centre of mass. A balanced link has its centre of mass at the pivot, where no force
    can move it. Its contacts would be infinitely stiff, and throw the arms about.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = home
    mujoco.mj_forward(model, data)
    for body in np.unique(model.geom_bodyid[model.geom_group == COLLISION_GROUP]):
        weights = []
        for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_group == COLLISION_GROUP)):
            jacobian, moved = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[geom], body)
            mujoco.mj_solveM(model, data, moved, jacobian)
            weights.append(np.sum(jacobian * moved) / 3)
        model.body_invweight0[body, 0] = np.mean(weights)
    return model


def alone(scene: Scene, agent: str) -> mujoco.MjModel:
    """Return the model of one arm of a scene, with its base frame at the origin."""
    mount = replace(scene.mounts[agent], position=np.zeros(3), rotation=np.eye(3))

    def compute() -> mujoco.MjModel:
        return compile_scene(build_scene(scene.name, {agent: mount}, scene.control, scene.randomisation))

    about = repr((scene.name, agent, scene.control, scene.randomisation))
    return cached_model(compute, about, *mount.arm.content)


def cached_model(compute: Callable[[], mujoco.MjModel], *content: str | bytes) -> mujoco.MjModel:
    """Return the model that `compute` returns, from disk if it was compiled before from the same content and code."""

    def saved() -> np.ndarray:
        model = compute()
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        return buffer

    name = "model.mjb"
    binary = cached("models", saved, *content).tobytes()
    return mujoco.MjModel.from_binary_path(name, {name: binary})
