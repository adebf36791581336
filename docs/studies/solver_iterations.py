"""How many solver iterations a physics step needs: one step of `Simulator`, against C MuJoCo's converged one.

Run: python -m docs.studies.solver_iterations
"""

from __future__ import annotations

from typing import Any

import jax
import mujoco
import numpy as np

from docs.studies.command import make_parser
from surgical_marl import load_scene
from surgical_marl.control.controller import Controller
from surgical_marl.physics.outputs import Touch
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.solver import arm_solver, constraint_rows
from surgical_marl.physics.state import ArmState, Physics
from surgical_marl.physics.systems import arms
from surgical_marl.scenes.scene import Scene
from surgical_marl.scenes.timing import DECIMATION

STEPS, SAMPLES = 5000, 2000
TOUCHING = ((2, 6), (3, 6), (4, 6), (6, 4), (6, 6), (10, 20))
"""Newton steps and line search steps, for arms that touch."""
APART = ((0, (4, 4)), (0, (10, 10)), (3, (1, 1)), (4, (1, 1)), (6, (0, 0)), (6, (1, 1)), (8, (1, 1)))
"""Sweeps, then Newton steps and line search steps, for an arm that touches nothing."""


def states_in_contact(scene: Scene) -> tuple[Physics, np.ndarray, np.ndarray]:
    """Return states of two arms in contact, and C MuJoCo's next velocity [S, nv] and contact forces [S, P]."""
    model, data, rng = scene.model, mujoco.MjData(scene.model), np.random.default_rng(0)
    pairs = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    index = {frozenset(pair): i for i, pair in enumerate(pairs)}
    simulated = Simulator(scene)
    command, now = jax.jit(Controller(scene, dt=simulated.control_dt).apply), simulated.home
    data.qpos[:] = scene.home
    before, velocities, forces, wrench = [], [], [], np.zeros(6)
    for step in range(STEPS):
        if step % 40 == 0:
            actions = {agent: np.float32(rng.choice([-1, 1], len(m.arm.actuated))) for agent, m in scene.mounts.items()}
        now = command(now.with_arms(qpos=data.qpos), actions)
        data.ctrl[:] = now.ctrl
        for _ in range(DECIMATION):
            state = snapshot(data)
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
    return batch([before[i] for i in picked]), np.array(velocities)[picked], np.array(forces)[picked]


def random_states(scene: Scene) -> tuple[Physics, np.ndarray]:
    """Draw states of an arm that touches nothing, and compute C MuJoCo's next velocity for each, [S, nv].

    About a third of the joints are past a limit, and about a third are at rest. Any command may be set. The solver has
    no acceleration to start from.
    """
    model, rng = scene.model, np.random.default_rng(0)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    low, high = model.jnt_range.T
    before, velocities = [], []
    for _ in range(SAMPLES):
        data = mujoco.MjData(model)
        past = np.where(rng.random(model.nv) < 0.5, low - 0.005 * (high - low), high + 0.005 * (high - low))
        data.qpos[:] = np.where(rng.random(model.nv) < 1 / 3, past, rng.uniform(low, high))
        data.qvel[:] = 0.5 * rng.uniform(-1, 1, model.nv) * speeds(scene) * (rng.random(model.nv) > 1 / 3)
        data.ctrl[:] = rng.uniform(*model.actuator_ctrlrange.T)
        before.append(snapshot(data))
        mujoco.mj_step(model, data)
        velocities.append(data.qvel.copy())
    return batch(before), np.array(velocities)


def snapshot(data: mujoco.MjData) -> Physics:
    parts: Any = (np.float32(part) for part in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl))
    return Physics({"arms": ArmState(*parts)})


def batch(states: list[Physics]) -> Physics:
    return jax.tree.map(lambda *parts: np.stack(parts), *states)


def speeds(scene: Scene) -> np.ndarray:
    """Return the velocity limit of every joint, [nv]."""
    return np.concatenate([[joint.velocity for joint in m.arm.joints] for m in scene.mounts.values()])


def step(scene: Scene, states: Physics, touching: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return velocity [S, nv] and contact forces [S, P] after one physics step here."""
    simulated = Simulator(scene)

    def advance(state: Physics) -> tuple[Physics, Touch]:
        if not touching:
            return simulated.step._arms_apart(state, simulated.untouched)
        return simulated.step._arms_coupled(state, simulated.untouched)

    after, touch = jax.jit(jax.vmap(advance))(states)
    return np.asarray(after.qvel), np.asarray(touch.force)


def shares(off: np.ndarray) -> str:
    return f"{np.percentile(off, 99):.2%} | {off.max():.2%}"


def touching() -> None:
    scene = load_scene("bimanual_psm")
    states, velocities, forces = states_in_contact(scene)
    print("| iterations | line search | velocity off: 99 % | worst | largest force off: 99 % | worst |")
    print("|---|---|---|---|---|---|")
    for iterations, line_search in TOUCHING:
        arm_solver.ITERATIONS_WITH_ROWS = iterations, line_search
        velocity, force = step(scene, states, touching=True)
        off = (np.abs(velocity - velocities) / speeds(scene)).max(1)
        force_off = np.abs(force - forces).max(1) / np.maximum(forces.max(1), 1.0)
        print(f"| {iterations} | {line_search} | {shares(off)} | {shares(force_off)} |")


def apart() -> None:
    print("| arm | sweeps | iterations | line search | velocity off: 99 % | worst |")
    print("|---|---|---|---|---|---|")
    for name in ("psm", "star"):
        scene = load_scene(name)
        states, velocities = random_states(scene)
        for sweeps, (iterations, line_search) in APART:
            constraint_rows.SWEEPS, arms.ITERATIONS = sweeps, (iterations, line_search)
            velocity, _ = step(scene, states, touching=False)
            off = (np.abs(velocity - velocities) / speeds(scene)).max(1)
            print(f"| {name} | {sweeps} | {iterations} | {line_search} | {shares(off)} |")


def main(argv: list[str] | None = None) -> None:
    make_parser(__doc__).parse_args(argv)
    touching()
    print()
    apart()


if __name__ == "__main__":
    main()
