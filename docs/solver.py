"""How many solver iterations a physics step needs: one step of `Simulator`, against C MuJoCo's converged one.

Run: python docs/solver.py
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl import load_scene, physics, solver
from surgical_marl.physics import Physics, Simulator
from surgical_marl.scene import DECIMATION, Scene

STEPS, SAMPLES = 5000, 2000
SETTINGS = ((2, 4), (3, 4), (4, 4), (5, 4), (6, 4), (10, 20))
"""Newton steps and line search steps, for arms that touch."""
ALONE, SWEEPS = ((0, 0), (1, 1), (2, 2), (4, 4)), (0, 3, 6, 9)
"""The same for an arm that touches nothing, and sweeps before them."""


def states_in_contact(scene: Scene) -> tuple[Physics, np.ndarray, np.ndarray]:
    """States of two arms driven into each other, and C MuJoCo's next velocity [S, nv] and contact forces [S, P]."""
    model, data, rng = scene.model, mujoco.MjData(scene.model), np.random.default_rng(0)
    pairs = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    index = {frozenset(pair): i for i, pair in enumerate(pairs)}
    simulator = Simulator(scene)
    command, now = jax.jit(simulator.command), simulator.home
    data.qpos[:] = scene.home
    before, velocities, forces, wrench = [], [], [], np.zeros(6)
    for step in range(STEPS):
        if step % 40 == 0:
            actions = {agent: np.float32(rng.choice([-1, 1], len(m.arm.actuated))) for agent, m in scene.mounts.items()}
        now = command(now._replace(qpos=data.qpos), actions)
        data.ctrl[:] = now.ctrl
        for _ in range(DECIMATION):
            state = Physics(*(np.array(a) for a in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl)))
            mujoco.mj_step(model, data)
            if data.ncon:
                force = np.zeros(model.npair)
                for i, contact in enumerate(data.contact):
                    mujoco.mj_contactForce(model, data, i, wrench)
                    force[index[frozenset(contact.geom.tolist())]] = wrench[0]
                before.append(state)
                velocities.append(data.qvel.copy())
                forces.append(force)
    picked = rng.choice(len(before), min(SAMPLES, len(before)), replace=False)
    return _batch([before[i] for i in picked]), np.array(velocities)[picked], np.array(forces)[picked]


def random_states(scene: Scene) -> tuple[Physics, np.ndarray]:
    """States of arms that touch nothing: anywhere, a third of the joints past a limit, a third at rest, any command,
    and no acceleration to start from; and C MuJoCo's next velocity [S, nv]."""
    model, rng = scene.model, np.random.default_rng(0)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    low, high = model.jnt_range.T
    before, velocities = [], []
    for _ in range(SAMPLES):
        data = mujoco.MjData(model)
        past = np.where(rng.random(model.nv) < 0.5, low - 0.005 * (high - low), high + 0.005 * (high - low))
        data.qpos[:] = np.where(rng.random(model.nv) < 1 / 3, past, rng.uniform(low, high))
        data.qvel[:] = rng.uniform(-0.5, 0.5, model.nv) * _speeds(scene) * (rng.random(model.nv) > 1 / 3)
        data.ctrl[:] = rng.uniform(*model.actuator_ctrlrange.T)
        before.append(Physics(*(np.array(a) for a in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl))))
        mujoco.mj_step(model, data)
        velocities.append(data.qvel.copy())
    return _batch(before), np.array(velocities)


def _batch(states: list[Physics]) -> Physics:
    return Physics(*(jnp.asarray(np.stack(part), jnp.float32) for part in zip(*states, strict=True)))


def _speeds(scene: Scene) -> np.ndarray:
    """Velocity limit of every joint, [nv]."""
    return np.concatenate([[joint.velocity for joint in m.arm.joints] for m in scene.mounts.values()])


def step(scene: Scene, states: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Velocity [S, nv] and contact forces [S, P] of one physics step here."""
    simulator = Simulator(scene)

    def one(now: Physics) -> tuple[Array, Array]:
        after, force = simulator._step(now, simulator._look(now.qpos)[1])
        return after.qvel, force

    velocity, force = jax.jit(jax.vmap(one))(states)
    return np.asarray(velocity), np.asarray(force)


def shares(off: np.ndarray) -> str:
    return f"{np.percentile(off, 99):.2%} | {off.max():.2%}"


def touching() -> None:
    scene = load_scene("bimanual_psm")
    states, velocities, forces = states_in_contact(scene)
    print("| iterations | line search | velocity off: 99 % | worst | largest force off: 99 % | worst |")
    print("|---|---|---|---|---|---|")
    for setting in SETTINGS:
        physics.TOUCHING_ITERATIONS = setting
        velocity, force = step(scene, states)
        off = (np.abs(velocity - velocities) / _speeds(scene)).max(1)
        force_off = np.abs(force - forces).max(1) / np.maximum(forces.max(1), 1.0)
        print(f"| {setting[0]} | {setting[1]} | {shares(off)} | {shares(force_off)} |")


def alone() -> None:
    print("| arm | sweeps | iterations | line search | velocity off: 99 % | worst | more than 1 % |")
    print("|---|---|---|---|---|---|---|")
    for name in ("psm", "star", "ecm"):
        scene = load_scene(name)
        states, velocities = random_states(scene)
        for solver.SWEEPS in SWEEPS:
            for physics.ARM_ITERATIONS in ALONE:
                velocity, _ = step(scene, states)
                off = (np.abs(velocity - velocities) / _speeds(scene)).max(1)
                iterations, line_search = physics.ARM_ITERATIONS
                row = f"| {name} | {solver.SWEEPS} | {iterations} | {line_search} |"
                print(row, f"{shares(off)} | {(off > 0.01).mean():.2%} |")


def main() -> None:
    touching()
    print()
    alone()


if __name__ == "__main__":
    main()
