"""How many solver iterations MJX needs: one physics step from states in contact, against C MuJoCo's converged one.

Run: python docs/solver.py
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from surgical_marl import load_scene, physics
from surgical_marl.physics import Physics, Simulator
from surgical_marl.scene import DECIMATION, Scene

STEPS, SAMPLES = 5000, 2000


def states_in_contact(scene: Scene) -> tuple[list[Physics], np.ndarray, np.ndarray]:
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
    return [before[i] for i in picked], np.array(velocities)[picked], np.array(forces)[picked]


def main() -> None:
    scene = load_scene("bimanual_psm")
    limits = np.concatenate([[joint.velocity for joint in m.arm.joints] for m in scene.mounts.values()])
    states, velocities, forces = states_in_contact(scene)
    batch = Physics(*(jnp.asarray(np.stack(part), jnp.float32) for part in zip(*states, strict=True)))
    print("| iterations | line search | velocity off: 99 % | worst | largest force off: 99 % | worst |")
    print("|---|---|---|---|---|---|")
    for iterations, line_search in ((1, 4), (2, 4), (3, 4), (4, 4), (3, 8), (10, 20)):
        physics.SOLVER_ITERATIONS, physics.LINE_SEARCH_ITERATIONS = iterations, line_search
        simulator = Simulator(scene)

        def step(now: Physics, simulator: Simulator = simulator) -> tuple[jax.Array, jax.Array]:
            data = simulator._forward(simulator._data.replace(**now._asdict()))
            return simulator._integrate(data).qvel, simulator._forces(data)

        velocity, force = jax.jit(jax.vmap(step))(batch)
        off = (np.abs(velocity - velocities) / limits).max(1)
        force_off = np.abs(force - forces).max(1) / np.maximum(forces.max(1), 1.0)
        shares = [np.percentile(off, 99), off.max(), np.percentile(force_off, 99), force_off.max()]
        print(f"| {iterations} | {line_search} | " + " | ".join(f"{share:.2%}" for share in shares) + " |")


if __name__ == "__main__":
    main()
