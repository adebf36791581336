"""A thread that touches tissue: each bears the other, with friction, in the same step."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.physics.contact.skin_detection import _balls, nearest
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.systems.brick_grid import BrickGrid
from surgical_marl.physics.systems.system import Skin
from tests.helpers.sewing_bench import pulled

MU, DT = 0.3, 2.5e-3
THREAD = {
    "kind": "thread", "length": 0.012, "diameter": 0.0005, "material": "nylon", "nodes": 6, "drag": 0.0,
    "friction": {"sliding": MU, "torsion": 0.0},
}  # fmt: skip
SHEET = {
    "kind": "tissue", "size": [0.03, 0.02, 0.005], "cells": [3, 2, 1], "young": 27040.0, "fixed": ["bottom"],
    "friction": {"sliding": MU, "torsion": 0.0},
}  # fmt: skip


class Seen(NamedTuple):
    """The notes of each step."""

    place: Any
    """Of the thread's nodes, m, [n, 3]."""
    velocity: Any
    nodes: Any
    """Of the tissue, m, [n, 3]."""
    moves: Any
    """Their velocities, m/s."""
    load: Any
    """Force on the tissue, N, [3]."""


class Scene:
    """A thread on a block of tissue, far from the only arm."""

    def __init__(self, folder: Path) -> None:
        (folder / "suture.yaml").write_text(yaml.safe_dump(THREAD))
        (folder / "sheet.yaml").write_text(yaml.safe_dump(SHEET))
        arms = {"ecm_0": {"arm": "ecm", "position": [0.3, 0.0, 0.35], "workspace": [0.0, 0.0, -0.11]}}
        objects = {
            "sheet": {"object": "sheet.yaml", "position": [0.0, 0.0, 0.0]},
            "thread": {"object": "suture.yaml", "position": [0.0035, 0.0085, 0.00525], "tilt": [0.0, 0.0, 13.0]},
        }
        self.path = folder / "on_tissue.yaml"
        self.path.write_text(yaml.safe_dump({"arms": arms, "objects": objects}))
        simulator = Simulator(sm.load_scene(self.path))
        self.home, self.step, systems = simulator.home, simulator.step, simulator.scene.systems
        self.mass, self.of_nodes = systems["thread"].rod.mass.astype(float), systems["sheet"].grid.mass.astype(float)
        self.weight = 9.81 * self.mass.sum()
        self.run = jax.jit(self._run, static_argnums=1)

    def _run(self, physics: Any, steps: int) -> Any:
        return jax.lax.scan(self._once, physics, None, length=steps)

    def _once(self, physics: Any, _: None) -> tuple[Any, Seen]:
        """Step all systems as `Step` does, but without the arm, which stays."""
        step = self.step
        found = step.find(physics, step.arms.dynamics.pose(physics.qpos))
        meetings = step._meetings(physics, found)
        (load,) = step._loads("sheet", meetings)["loads"]
        after = step._systems_moved(physics, physics, found, meetings)
        chain, nodes = after.systems["thread"].chain, after.systems["sheet"].nodes
        force = pulled(load, DT * nodes.velocity)
        return after, Seen(chain.position, chain.velocity, *nodes, force)

    def thrown(self, physics: Any, velocity: list[float], lifted: float = 0.0) -> Any:
        thread = physics.systems["thread"]
        chain = thread.chain._replace(
            position=thread.chain.position + jnp.array([0.0, 0.0, lifted]),
            velocity=thread.chain.velocity + jnp.array(velocity),
        )
        return physics.with_systems(thread=thread._replace(chain=chain))

    def on_thread(self, seen: Seen, begun: list[float]) -> np.ndarray:
        """Return the force of the tissue on the thread, N, [t, 3], by its momentum."""
        momentum = np.einsum("n,tni->ti", self.mass, np.asarray(seen.velocity, float))
        before = np.concatenate([[self.mass.sum() * np.array(begun)], momentum[:-1]])
        found: np.ndarray = (momentum - before) / DT + np.array([0.0, 0.0, self.weight])
        return found


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return Scene(tmp_path_factory.mktemp("weave"))


@pytest.mark.slow
def test_tissue_bears_the_weight_of_a_thread(scene: Scene) -> None:
    after, seen = scene.run(scene.home, 160)
    late = scene.on_thread(seen, [0.0, 0.0, 0.0])[80:]
    np.testing.assert_allclose(late.mean(0) / scene.weight, [0.0, 0.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(-np.asarray(seen.load)[80:].mean(0) / scene.weight, [0.0, 0.0, 1.0], atol=1e-3)
    assert np.abs(np.asarray(seen.velocity)[-1]).max() < 1e-4
    assert np.ptp(np.asarray(seen.place)[-1, :, 2]) < 2e-4  # it follows the tissue, which sags a little
    np.testing.assert_allclose(after.systems["thread"].side[:, 2], 1.0, atol=1e-3)
    pressed = scene.thrown(after, [0.0, 0.0, 0.0], lifted=-3.5e-3)  # the lower face is nearer now
    assert np.asarray(scene.run(pressed, 160)[1].place)[:, :, 2].min() > 4e-3


@pytest.mark.parametrize("way", [0, 1])
def test_a_thread_that_slides_on_tissue_stops_as_coulomb_says(scene: Scene, way: int) -> None:
    """Along itself and across, on faces that sag between the nodes. Each step goes on with the speed at its end."""
    speed, begun = 0.2, [0.2 * (k == way) for k in range(3)]
    rest, _ = scene.run(scene.home, 160)
    _, seen = scene.run(scene.thrown(rest, begun), 160)
    start, place = np.asarray(rest.systems["thread"].chain.position), np.asarray(seen.place)
    moved = scene.mass @ (place[-1] - start)[:, way] / scene.mass.sum()
    np.testing.assert_allclose(moved, speed * (speed - MU * 9.81 * DT) / (2 * MU * 9.81), rtol=0.02)


def test_forces_on_both_sum_to_zero_and_energy_does_not_grow(scene: Scene) -> None:
    """A thread falls from 3 mm, and slides. In the steps of the impact tissue gets less of it than the thread."""
    begun, steps = [0.1, 0.0, 0.0], 160
    thrown = scene.thrown(scene.home, begun, lifted=3e-3)
    _, seen = scene.run(thrown, steps)
    force, load = scene.on_thread(seen, begun), np.asarray(seen.load, float)
    assert force[:, 2].max() > 3 * scene.weight
    impact = force[:, 2] > 2 * scene.weight
    assert 1 <= impact.sum() <= 3
    assert (load[impact, 2] < 0).all() and (load[impact, 2] > -force[impact, 2]).all()
    np.testing.assert_allclose(load[~impact], -force[~impact], atol=4e-3 * np.abs(force).max())

    def energy(mass: np.ndarray, place: Any, velocity: Any) -> Any:
        place, velocity = np.asarray(place, float), np.asarray(velocity, float)
        return np.einsum("n,...n->...", mass, (velocity**2).sum(-1) / 2 + 9.81 * place[..., 2])

    start = thrown.systems
    first = energy(scene.mass, *start["thread"].chain[:2]) + energy(scene.of_nodes, *start["sheet"].nodes)
    total = energy(scene.mass, seen.place, seen.velocity) + energy(scene.of_nodes, seen.nodes, seen.moves)
    assert (total <= first + 1e-9).all()  # elastic energy is not in it, and never below 0
    thread = energy(scene.mass, seen.place, seen.velocity)
    assert thread[-1] < energy(scene.mass, *start["thread"].chain[:2])


@pytest.mark.slow
def test_both_engines_lay_a_thread_on_tissue_alike(scene: Scene) -> None:
    found = []
    for engine in ("mjx", "fused"):
        env = BatchedEnv("reach", str(scene.path), num_envs=1, engine=engine, device="cpu")
        env.reset(seed=0)
        for _ in range(4):
            env.step({"ecm_0": np.zeros((1, len(env.scene.mounts["ecm_0"].arm.actuated)), np.float32)})
        found.append(
            [env.engine.read(f".physics.{x}", "numpy") for x in ("thread.chain.position", "sheet.nodes.position")]
        )
        env.close()
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-7)
    assert np.isfinite(found[0][0]).all()


@pytest.mark.parametrize(
    ("point", "distance"),
    [([0.01, 0.01, 0.006], 0.001), ([0.01, 0.01, 0.004], 0.001), ([0.012, 0.021, 0.0025], 0.001),
     ([-0.0006, 0.005, 0.0058], 0.001), ([0.0, 0.0, 0.0], 0.0)],
)  # fmt: skip
def test_the_nearest_point_of_a_skin_is_found(point: list[float], distance: float) -> None:
    """Above a face, under it, beside it, and beyond an edge and a corner."""
    grid = BrickGrid(SHEET["size"], np.ones(SHEET["cells"], bool), 1000.0)
    faces = grid.faces()
    assert len(faces) == 2 * (3 * 2 + 2 + 3)
    corners = grid.rest[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
    assert (np.einsum("fi,fi->f", normal, corners.mean(1) - grid.rest.mean(0)) > 0).all()
    skin = Skin(jnp.asarray(grid.rest), jnp.zeros_like(jnp.asarray(grid.rest)))
    foot = nearest(skin, faces, _balls(skin, faces), jnp.array(point), jnp.zeros(3))
    np.testing.assert_allclose(np.sqrt(foot.square), distance, atol=1e-7)


@pytest.mark.parametrize(
    ("point", "side", "distance"),
    [(0.0012, [0.0, 0.0, 1.0], 0.0038), (0.0012, [0.0, 0.3, -1.0], 0.0012), (0.0052, [0.0, 0.0, -1.0], 0.0002)],
)
def test_what_has_come_through_a_face_belongs_on_its_other_side(
    point: float, side: list[float], distance: float
) -> None:  # fmt: skip
    """At a height in tissue that is 5 mm thick, and over it: there no face below has been passed."""
    grid = BrickGrid(SHEET["size"], np.ones(SHEET["cells"], bool), 1000.0)
    skin, faces = Skin(jnp.asarray(grid.rest), jnp.zeros_like(jnp.asarray(grid.rest))), grid.faces()
    foot = nearest(skin, faces, _balls(skin, faces), jnp.array([0.014, 0.008, point]), jnp.array(side))
    np.testing.assert_allclose(np.sqrt(foot.square), distance, atol=1e-7)
