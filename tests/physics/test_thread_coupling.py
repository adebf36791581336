"""A thread with arms and needles: in each step they feel minus what it feels, and both engines move all alike."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.systems.coupling import APART, TIE
from surgical_marl.scenes.objects import JAW

THREAD = {
    "kind": "thread", "length": 0.05, "diameter": 0.00022, "material": "nylon", "nodes": 20, "drag": 0.0,
    "friction": {"sliding": 0.3, "torsion": 0.0},
}  # fmt: skip


def scene_file(folder: Path, arm: str, objects: dict[str, Any]) -> str:
    (folder / "suture.yaml").write_text(yaml.safe_dump(THREAD))
    path = folder / "with_thread.yaml"
    arms = {f"{arm}_0": {"arm": arm, "position": [0.0, 0.0, 0.15], "workspace": [0.0, 0.0, -0.11]}}
    path.write_text(yaml.safe_dump({"arms": arms, "objects": objects}))
    return str(path)


def growth(masses: tuple[float, float], stiffness: float, dt: float = 2.5e-3) -> float:
    """Return by what factor two masses on a spring move more in each step, if each knows the other's last acceleration.

    Place and velocity of both, and the accelerations of the last step, are the unknowns.
    """

    def step(state: np.ndarray) -> np.ndarray:
        x, v, a = state.reshape(3, 2)
        ahead = x + dt * v + dt * dt * a
        force = stiffness * (ahead[1] - ahead[0]) * np.array([1.0, -1.0])
        a = (force + stiffness * dt * dt * a) / (np.array(masses) + stiffness * dt * dt)
        v = v + dt * a
        return np.concatenate([x + dt * v, v, a])

    return float(np.abs(np.linalg.eigvals(np.array([step(row) for row in np.eye(6)]).T)).max())


def test_no_thread_is_stiff_enough_to_make_two_owners_unstable() -> None:
    """A PSM's jaw is no lighter than 0.71 kg in any direction, and takes hold of five edges with both pads."""
    jaw, needle = 0.71, 7e-5
    grip = 10 * JAW.against(sm.load_scene("bimanual_psm_thread_alone").systems["thread"].surface).stiffness
    assert growth((jaw, needle), 1 / (1 / TIE + 1 / grip)) < 1 + 1e-6
    assert growth((jaw, jaw), grip / 2) < 1 + 1e-6
    assert growth((jaw, needle), 1.5 * TIE) > 1.01


@pytest.mark.parametrize("bending", [False, True])
def test_no_thread_is_stiff_enough_to_make_a_skin_unstable(bending: bool) -> None:
    """Points of a skin hang on a chain: each knows its expected motion, and how stiff the chain is if it moves alone.

    Place and velocity of all points are the unknowns.
    """
    n, dt, mass = 20, 2.5e-3, 1e-6
    between = np.diff(np.eye(n), n=1 + bending, axis=0)
    stiffness = 1e4 * between.T @ between

    def growth(factor: float) -> float:
        def step(state: np.ndarray) -> np.ndarray:
            x, v = state.reshape(2, n)
            v = v - dt * (stiffness @ (x + dt * v)) / (mass + factor * np.diag(stiffness) * dt * dt)
            return np.concatenate([x + dt * v, v])

        return float(np.abs(np.linalg.eigvals(np.array([step(row) for row in np.eye(2 * n)]).T)).max())

    assert growth(APART) < 1 + 1e-6 and growth(1.0) > 1.5


@pytest.mark.slow
def test_a_needle_and_its_thread_keep_their_momentum(tmp_path: Path) -> None:
    """The thread is thrown away along itself; together both fall as weight says, however they pull at each other."""
    objects = {
        "needle": {"object": "needle_sh", "position": [0.3, 0.0, 0.3]},
        "thread": {"object": str(tmp_path / "suture.yaml"), "tied": {"first": "needle"}},
    }
    simulator, steps = Simulator(sm.load_scene(scene_file(tmp_path, "ecm", objects))), 60
    mass = simulator.scene.systems["thread"].rod.mass
    weight = float(simulator.step.bodies.tables.masses.mass[0])  # type: ignore[union-attr]
    start = simulator.home
    chain = start.systems["thread"].chain
    thrown = chain._replace(velocity=chain.velocity.at[:, 0].set(1.0))
    start = start.with_systems(thread=start.systems["thread"]._replace(chain=thrown))

    @jax.jit
    def run(physics: Any) -> Any:
        def step(physics: Any, _: None) -> Any:
            physics, _ = simulator.step(physics, simulator.untouched)
            thread = physics.systems["thread"].chain
            return physics, (thread.velocity, physics.rigid_bodies.bodies.velocity[0, :3], thread.tension)

        return jax.lax.scan(step, physics, None, length=steps)[1]

    thread, needle, tension = (np.asarray(part, float) for part in run(start))
    momentum = np.einsum("n,knj->kj", mass, thread) + weight * needle
    begun = np.array([1.0 * mass.sum(), 0.0, 0.0])
    falls = -9.81 * (mass.sum() + weight) * 2.5e-3 * np.arange(1, steps + 1)[:, None] * [0, 0, 1]
    assert tension.max() > 1e-4 and needle[:, 0].max() > 0.01  # the thread pulls the needle along
    np.testing.assert_allclose(momentum, begun + falls, atol=0.01 * begun[0])


def in_the_jaw(folder: Path) -> tuple[str, np.ndarray]:
    """Write a scene of a PSM whose jaw is around a thread tied at both ends; return also the middle of the jaw, m."""
    arm = sm.load_arm("psm")
    pose = arm.forward_kinematics(arm.home)
    middle = pose[:3, 3] + [0.0, 0.0, 0.15] - 0.0044 * pose[:3, 2]
    thread = {"object": str(folder / "suture.yaml"), "position": (middle - 0.025 * pose[:3, 0]).tolist(),
              "tilt": [0.0, 0.0, 90.0], "tied": {"first": "world", "last": "world"}}  # fmt: skip
    return scene_file(folder, "psm", {"thread": thread}), middle


@pytest.mark.slow
def test_a_thread_may_begin_inside_a_finger(tmp_path: Path) -> None:
    """In any direction, up to 3 mm from the middle of a jaw that closes: a step returns, and finds numbers."""
    path, middle = in_the_jaw(tmp_path)
    env, place, inside = BatchedEnv("reach", path, num_envs=2, engine="fused", device="cpu"), ".physics.thread.chain", 0
    env.reset(seed=0)
    begun, rng, way = env.carry(), np.random.default_rng(0), np.linspace(-0.025, 0.025, THREAD["nodes"])
    action = np.zeros((2, 7), np.float32)
    action[:, -1] = -1.0
    for _ in range(40):
        off, along = rng.uniform(-3e-3, 3e-3, (2, 1, 3)), rng.normal(size=(2, 1, 3))
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        nodes = (middle + off + way[:, None] * along).astype(np.float32)
        env.set_carry(begun | {f"{place}.position": nodes})
        for _ in range(25):
            step = env.step({"psm_0": action})
            assert not step.terminated.any()  # a fault would end the episode
            inside += int((step.infos["psm_0"]["tension"] > 0.01).sum())
        assert np.isfinite(env.engine.read(f"{place}.position", "numpy")).all()
    assert inside > 100
    env.close()


@pytest.mark.slow
def test_both_engines_close_a_jaw_on_a_thread_and_lift_it_alike(tmp_path: Path) -> None:
    """It is tied to the world at both ends, runs through the open jaw, and is held by it."""
    (path, _), arm, found = in_the_jaw(tmp_path), sm.load_arm("psm"), []
    for engine in ("mjx", "fused"):
        env = BatchedEnv("reach", path, num_envs=2, engine=engine, device="cpu")
        env.reset(seed=0)
        action = np.zeros((2, len(arm.actuated)), np.float32)
        action[:, -1] = -1.0, 1.0  # one jaw closes, the other one opens
        for k in range(16):
            action[:, 2] = -0.2 if k >= 12 else 0.0
            step = env.step({"psm_0": action})
        parts = (".physics.thread.chain.position", ".physics.thread.chain.tension", ".physics.arms.qpos")
        found.append([env.engine.read(part, "numpy") for part in parts])
        tension = step.infos["psm_0"]["tension"]
        assert tension[0] > 0.1
        env.close()
    (place, pulls, qpos), (other_place, other_pulls, other_qpos) = found
    np.testing.assert_allclose(place, other_place, atol=2e-6)
    np.testing.assert_allclose(pulls, other_pulls, atol=0.02)
    np.testing.assert_allclose(qpos, other_qpos, atol=1e-5)


@pytest.mark.slow
def test_ten_minutes_of_random_arms_push_no_thread_through_its_pad() -> None:
    """All environments together. A thread that slid over the pad's rim falls, and is not looked at any more."""
    count, seconds, top, rim = 16, 600, 0.02, np.array([0.178, 0.0485])
    env = BatchedEnv(
        "reach", "bimanual_psm_thread_alone", num_envs=count, engine="fused", device="cpu", max_steps=10**6
    )
    env.reset(seed=1)
    rng, on_it, pulled = np.random.default_rng(1), np.ones(count, bool), 0.0
    for step in range(round(seconds / 0.02 / count)):
        if step % 25 == 0:
            sizes = {agent: (count, len(mount.arm.actuated)) for agent, mount in env.scene.mounts.items()}
            actions = {agent: rng.uniform(-1, 1, size).astype(np.float32) for agent, size in sizes.items()}
        env.step(actions)
        nodes = np.asarray(env.engine.read(".physics.thread.chain.position", "numpy"))
        assert np.isfinite(nodes).all(), step
        on_it &= (nodes[..., 2] > 0).all(1)
        over = (np.abs(nodes[..., :2]) < rim).all(-1) & on_it[:, None]
        assert nodes[over, 2].min() > top - 1.1e-3, step
        pulled = max(pulled, float(np.max(env.engine.read(".physics.thread.chain.tension", "numpy"))))
    assert on_it.sum() > count / 2 and pulled > 0.01  # arms did pull at it: its weight is 35 uN
    env.close()
