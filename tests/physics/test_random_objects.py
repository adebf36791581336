"""Properties of the physics of objects in random small scenes: free objects of capsules and spheres over fixed ones."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl.robots.rotation import matrix_of
from surgical_marl.scenes.mjcf import mjcf
from tests.helpers.falling import DOWN, DT, Falling, random_turns, thrown
from tests.helpers.object_parity import Beside

COUNT, STEPS = 16, 10
SEEDS = st.integers(0, 2**32 - 1)
SCENES = [pytest.param(seed, marks=pytest.mark.slow) for seed in range(12)]
"""Each is compiled, which takes seconds; hypothesis draws states in it."""


def random_part(rng: np.random.Generator) -> dict[str, Any]:
    """A capsule or a sphere within 10 mm of the origin."""
    radius, ends = float(rng.uniform(5e-4, 3e-3)), rng.uniform(-0.008, 0.008, (2, 3)).tolist()
    if rng.random() < 0.3:
        return {"sphere": {"radius": radius, "position": ends[0]}}
    return {"capsule": {"radius": radius, "from": ends[0], "to": ends[1]}}


def random_objects(folder: Path, seed: int) -> dict[str, dict[str, Any]]:
    """Write one or two free objects and a fixed one; return where a scene has them: free ones above and apart."""
    rng, placed = np.random.default_rng(seed), {}

    def write(name: str, position: list[float], shapes: list[Any], **rest: Any) -> None:
        friction = {"sliding": float(rng.uniform(0.1, 1.0)), "torsion": float(rng.uniform(0, 0.002))}
        about = {"friction": friction, "stiffness": float(10 ** rng.uniform(4.5, 6)), "shapes": shapes, **rest}
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(about))
        placed[name] = {"object": f"{name}.yaml", "position": position}

    size = [*rng.uniform(0.05, 0.1, 2).tolist(), float(rng.uniform(0.004, 0.01))]
    box = {"box": {"size": size, "tilt": [*rng.uniform(-20, 20, 2).tolist(), 0.0]}}
    write("fixed", [0.0, 0.0, 0.0], [box, random_part(rng)], free=False)
    for k in range(1 + seed % 2):
        parts = [random_part(rng) for _ in range(rng.integers(1, 4))]
        write(f"free_{k}", [0.2, 0.1 * k, 0.1], parts, free=True, density=float(rng.uniform(1000, 8000)))
    return placed


@functools.cache
def falling(seed: int) -> Falling:
    with tempfile.TemporaryDirectory() as folder:
        return Falling(Path(folder), random_objects(Path(folder), seed))


def states(scene: Falling, rng: np.random.Generator, low: float, high: float) -> Any:
    """Objects anywhere over what is fixed, that move by up to 0.5 m/s and turn by up to 20 rad/s."""
    k = len(scene.names)
    position = rng.uniform([-0.02, -0.02, low], [0.02, 0.02, high], (COUNT, k, 3))
    velocity = rng.uniform(-1, 1, (COUNT, k, 6)) * ([0.3] * 3 + [12.0] * 3)
    turns = random_turns(rng, COUNT, k)
    return thrown(scene.begin(COUNT), position=position, quaternion=turns, velocity=velocity)


@pytest.mark.parametrize("scene", SCENES)
@settings(max_examples=10, deadline=None, derandomize=True)
@given(seed=SEEDS)
def test_what_moves_without_arms_gains_no_energy(scene: int, seed: int) -> None:
    """In none of ten steps, from states in which nothing overlaps; and everything stays finite, also where it does."""
    space = falling(scene)
    start = states(space, np.random.default_rng(seed), 0.0, 0.02)
    _, path = space.play(start, STEPS * DT)
    assert all(np.isfinite(part).all() for part in path)
    apart = np.asarray(space.depths(start)) < 0
    begin = jax.tree.map(lambda x: np.asarray(x, float)[:, None], start.bodies)
    before = space.energy(begin)  # type: ignore[arg-type]
    energy = np.concatenate([before, space.energy(path)], 1).sum(-1)[apart]
    scale = np.maximum(energy[:, :1] - 9.81 * -0.01 * space.masses.mass.sum(), 1e-9)
    assert (np.diff(energy, axis=1) <= 1e-3 * scale).all()


@pytest.mark.parametrize("scene", SCENES)
def test_what_touches_nothing_flies_as_in_c_mujoco(scene: int) -> None:
    """Ten steps, here of 2.5 ms and there of 0.25 ms: to 10 um, which is what gravity's steps differ by, and one
    degree."""
    space = falling(scene)
    objects = states(space, np.random.default_rng(scene), 0.5, 0.5)
    apart = 0.2 * np.arange(len(space.names))[:, None] * np.array([1.0, 0.0, 0.0])
    objects = thrown(objects, position=objects.bodies.position + jnp.asarray(apart, jnp.float32))
    _, path = space.play(objects, STEPS * DT)
    model, first = mujoco.MjModel.from_xml_string(mjcf(space.scene, timestep=DT / 10)), objects.bodies
    for e in range(4):
        data = mujoco.MjData(model)
        for k, name in enumerate(space.names):
            turn = np.array(first.quaternion[e, k], float)
            axes, velocity = matrix_of(turn), np.array(first.velocity[e, k], float)
            lever = axes @ space.scene.objects[name].object.center
            data.joint(name).qpos[:] = [*(np.array(first.position[e, k], float) - lever), *turn]
            data.joint(name).qvel[:] = [*(velocity[:3] - np.cross(velocity[3:], lever)), *(velocity[3:] @ axes)]
        mujoco.mj_step(model, data, 10 * STEPS)
        mujoco.mj_kinematics(model, data)
        for k, name in enumerate(space.names):
            body = data.body(name)
            late = np.abs(DOWN).sum() * DT * STEPS * DT * 0.45  # a longer step of gravity falls further
            off = body.xipos - path.position[e, -1, k]
            assert np.abs(off - [0, 0, late]).max() < 1e-5
            angle = (np.trace(matrix_of(path.quaternion[e, -1, k]).T @ body.xmat.reshape(3, 3)) - 1) / 2
            assert np.degrees(np.arccos(np.clip(angle, -1, 1))) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_fused_engine_steps_random_scenes_as_the_reference_does(seed: int, tmp_path: Path) -> None:
    """An arm anywhere near, and objects beside its jaw and over what is fixed: one step, and ten."""
    objects, rng = random_objects(tmp_path, seed), np.random.default_rng(seed)
    objects["fixed"]["position"] = [0.0, 0.0, 0.015]
    arm = {"arm": "psm", "position": [0.0, 0.0, 0.15], "workspace": [0.0, 0.0, -0.09]}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({"arms": {"psm_0": arm}, "objects": objects}, sort_keys=False))
    both = Beside(str(tmp_path / "scene.yaml"), COUNT)
    mount, scene = both.env.scene.mounts["psm_0"], both.env.scene
    q = mount.arm.home + rng.uniform(-0.2, 0.2, (COUNT, 7)) * (mount.arm.upper - mount.arm.lower) * 0.5
    now = jax.vmap(both.simulator.at)(
        scene.full_qpos({"psm_0": np.clip(q, mount.arm.lower, mount.arm.upper)}).astype("f")
    )
    k = len(scene.free_objects)
    near = np.array([0.0, 0.0, 0.04]) + rng.uniform(-0.02, 0.02, (COUNT, k, 3))
    bodies = now.rigid_bodies.bodies._replace(
        position=near.astype(np.float32),
        quaternion=random_turns(rng, COUNT, k).astype(np.float32),
        velocity=(rng.uniform(-1, 1, (COUNT, k, 6)) * ([0.3] * 3 + [12.0] * 3)).astype(np.float32),
    )
    now, falls = now.with_systems(rigid_bodies=now.rigid_bodies._replace(bodies=bodies)), bodies.velocity[..., :3]
    for step in range(10):
        now = both.step(now, compared=step in (0, 9))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(now))
    pushed = now.rigid_bodies.bodies.velocity[..., :3] - falls - 10 * DT * DOWN
    assert (np.abs(pushed).max((1, 2)) > 0.01).sum() >= 2, "hardly anything touched"
