"""Contacts of soft tissue with two pads that pinch it: friction, creep, and that nothing passes through."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.physics.contact.node_balls import NodeBalls
from surgical_marl.physics.contact.part_detection import PartDetection, Scenery
from surgical_marl.physics.contact.shapes import Plate, Segments
from surgical_marl.physics.systems.brick import CORNERS
from surgical_marl.physics.systems.brick_solve import Nodes
from surgical_marl.physics.systems.system import Ends, Shapes
from surgical_marl.physics.systems.tissue import SKIN, Tissue, TissueState
from surgical_marl.robots.spec import PAD_GROUP
from surgical_marl.scenes.objects import Surface
from tests.helpers.block_kernels import DEVICES, run_block

CELLS, SIZE, DT = (6, 2, 1), (0.03, 0.01, 0.005), 2.5e-3
PADS = np.array([0.006, 0.02]), 0.0006
"""Half sides and radius of the pads, m: they are wider than the strip, and begin in the middle of a brick."""
MIDDLE = 0.0283
"""Where the middle of the pads is along x at the start, m. The strip's free edge is at 30 mm."""


def strip(sliding: float = 0.4, **settings: Any) -> Tissue:
    given: dict[str, Any] = {
        "size": SIZE, "present": (((True,),) * CELLS[1],) * CELLS[0], "young": 27040.0, "poisson": 0.4287,
        "density": 1000.0, "damping": 2e-3, "fixed": ("left",), "springs": (), "position": (0.0, 0.0, 0.0),
        "rotation": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        "surface": Surface(sliding, 0.0, 1e4),
    }  # fmt: skip
    return Tissue(**given | settings)


class Seen(NamedTuple):
    """The notes of each step."""

    friction: Any
    """Of both pads on the tissue, along x, N."""
    normal: Any
    """Of both together, N."""
    edge: Any
    """Where the middle of the free edge is, m, [3]."""
    place: Any
    """Where the pads are along x, m."""
    thinnest: Any
    """Least distance of upper and lower nodes along z, m."""


def pinch(tissue: Tissue, opening: np.ndarray, move: np.ndarray, dt: float = DT) -> Seen:
    """Return what is seen as two pads have an opening [t] and have moved [t, 3], m, at each step."""
    counts = {"pads": 2, "links": 0, "objects": 0, "plates": 0, "rods": 0}
    detection = PartDetection(counts, [tissue.surface] * 2, tissue.contacts)
    none = Segments(jnp.zeros((0, 3)), jnp.zeros((0, 3)), jnp.zeros(0))
    top = tissue.grid.places[:, 2] == tissue.grid.cells[2]
    edge = int(np.flatnonzero((tissue.grid.places == [CELLS[0], CELLS[1] // 2, 0]).all(1))[0])

    def pads(now: Any) -> jax.Array:
        gap, moved = now
        centre = jnp.array([MIDDLE, SIZE[1] / 2, SIZE[2] / 2]) + moved
        up = jnp.array([0.0, 0.0, 1.0]) * (gap / 2 + PADS[1])
        return jnp.stack([centre + up, centre - up])

    def step(state: TissueState, rows: Any) -> tuple[TissueState, Seen]:
        now, after = rows
        at = pads(now)
        plates = Plate(at, jnp.broadcast_to(jnp.eye(3), (2, 3, 3)), jnp.tile(PADS[0], (2, 1)), jnp.full(2, PADS[1]))
        ends = detection.find(Scenery(plates, none, jnp.full(2, 1e-4)), tissue.shapes(state), [], [], dt)
        shift = (pads(after) - at)[ends.rows.shape]
        ends = ends._replace(rows=ends.rows._replace(shift=shift))
        response = tissue.respond(state, tissue.free_motion(state, dt), ends, dt)
        state = tissue.apply(state, response, ends, jnp.zeros_like(shift), dt)
        on = -response.force
        along = jnp.sum(on * ends.rows.normal, -1, keepdims=True)
        x = state.nodes.position
        seen = Seen(
            (on - along * ends.rows.normal)[:, 0].sum(), along.sum(), x[edge], at[0, 0], (x[top] - x[~top])[:, 2].min()
        )
        return state, seen

    tissue.solver.gravity = np.zeros(3, np.float32)
    steps = jnp.asarray(opening, jnp.float32), jnp.asarray(move, jnp.float32)
    rows = tuple(x[:-1] for x in steps), tuple(x[1:] for x in steps)
    _, seen = jax.jit(lambda state: jax.lax.scan(step, state, rows))(tissue.start(jnp.zeros((0, 3))))
    return Seen(*(np.asarray(x, float) for x in seen))


def test_what_pads_hold_slips_at_mu_times_the_normal_force() -> None:
    mu, t = 0.1, np.arange(0, 1.2, DT)
    opening = SIZE[2] - 5e-4 * np.clip(t / 0.2, 0, 1)
    seen = pinch(strip(mu), opening, 0.005 * np.maximum(t - 0.3, 0)[:, None] * [1, 0, 0])
    slides = np.arange(len(t) - 1) > 0.75 * len(t)
    assert (seen.friction[slides] / seen.normal[slides]).mean() == pytest.approx(mu, rel=0.02)
    settled = t[:-1] > 0.3
    assert (seen.friction[settled] < 1.2 * mu * seen.normal[settled]).all()  # as single points give way
    assert seen.place[-1] - seen.place[0] > 2 * (seen.edge[-1, 0] - seen.edge[0, 0])


def test_what_pads_hold_does_not_creep() -> None:
    """For ten seconds at half of what friction bears."""
    dt = 4 * DT
    t = np.arange(0, 12.0, dt)
    opening = SIZE[2] - 1e-3 * np.clip(t / 0.2, 0, 1)
    seen = pinch(strip(0.4), opening, 4e-3 * np.clip(t - 0.3, 0, 0.5)[:, None] * [1, 0, 0], dt)
    late = t[:-1] > 2.0
    assert 0.02 < seen.friction[late].mean() < 0.5 * 0.4 * seen.normal[late].mean()
    assert np.ptp(seen.edge[late], 0).max() < 1e-5


def test_pads_that_close_crush_tissue_but_do_not_pass_through_it() -> None:
    t = np.arange(0, 1.0, DT)
    seen = pinch(strip(0.4), SIZE[2] - 3.6e-3 * np.clip(t / 0.5, 0, 1), np.zeros((len(t), 3)))
    assert 3e-4 < seen.thinnest[-1] < 1.2e-3
    assert seen.normal[-1] / 2 > 5  # on each pad, N: harder than a jaw holds a needle


def bent(tissue: Tissue, rng: np.random.Generator) -> tuple[Scenery, Shapes]:
    """A sheet that is bent over a plate and a capsule."""
    noise = rng.normal(size=(2, *tissue.rest.shape)).astype(np.float32)
    nodes = Nodes(jnp.asarray(tissue.rest + 1e-3 * noise[0]), jnp.asarray(0.1 * noise[1]))
    shapes = tissue.shapes(tissue.start(jnp.zeros((0, 3)))._replace(nodes=nodes))
    at = jnp.asarray(rng.uniform(0, SIZE, (2, 3)) + 0.004 * np.eye(3)[2], jnp.float32)
    plates = Plate(at[:1], jnp.eye(3)[None], jnp.full((1, 2), 0.003), jnp.full(1, 0.001))
    rods = Segments(at[1:], at[1:] + 0.01, jnp.full(1, 0.001))
    return Scenery(plates, rods, jnp.full(2, 2e-4)), shapes


COUNTS = {"pads": 1, "links": 1, "objects": 0, "plates": 0, "rods": 0}


def test_clusters_leave_out_no_point_that_is_near() -> None:
    tissue, rng, found = strip(fixed=()), np.random.default_rng(0), 0
    detection = PartDetection(COUNTS, [tissue.surface] * 2, tissue.contacts)
    for _ in range(4):
        scenery, shapes = bent(tissue, rng)
        one, other = (detection.find(scenery, own, [], [], DT) for own in (shapes, shapes._replace(clusters=None)))
        assert one.total == other.total and one.left_out == other.left_out
        for x, y in zip(*map(jax.tree.leaves, (one.rows, other.rows)), strict=True):
            np.testing.assert_allclose(x[: one.total], y[: one.total], atol=1e-6)
        found += int(one.total)
    assert found > 20


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kinds", [("links", "plates"), ("pads", "rods")])
def test_a_block_of_threads_finds_the_same(kinds: tuple[str, str], device: str) -> None:
    """Of shapes that move and that do not, with room for all of them and for some."""
    tissue, rng, found = strip(fixed=()), np.random.default_rng(0), 0
    counts = {name: int(name in kinds) for name in COUNTS}
    for room in (tissue.contacts, 5) if "pads" in kinds else (tissue.contacts,):
        detection = PartDetection(counts, [replace(tissue.surface, stiffness=k) for k in (1e3, 2e3)], room)

        def find(scenery: Scenery, nodes: Nodes, detection: PartDetection = detection) -> Ends:
            balls = NodeBalls(*nodes, tissue.points, SKIN, SKIN * SIZE[2])
            return detection._find_by_block(scenery, balls, DT)

        reference = jax.jit(find)
        for _ in range(3):
            scenery, shapes = bent(tissue, rng)
            assert shapes.clusters
            nodes = Nodes(*shapes.clusters.nodes[:2])
            of, expected = run_block(device, find, scenery, nodes), reference(scenery, nodes)
            total = int(expected.total)
            assert [of[name] for name in ("moving", "total", "left_out")] == [expected.moving, total, expected.left_out]
            for name, values in expected.rows._asdict().items():
                if values is not None:
                    atol = 2e-5 if name == "normal" else 2e-8
                    np.testing.assert_allclose(of[f"rows.{name}"][:total], values[:total], rtol=1e-5, atol=atol)
            found += total
    assert found > 20


# -- in a scene


def scene_file(folder: Path, **settings: Any) -> str:
    """Write a scene of a PSM over a sheet of tissue, 3 mm below its tool tip."""
    tissue = {
        "kind": "tissue", "size": [0.03, 0.02, 0.005], "cells": [6, 4, 1], "young": 27040.0, "fixed": ["left", "right"],
        "friction": {"sliding": 0.8, "torsion": 0.0},
    }  # fmt: skip
    arm = {"arm": "psm", "position": [0.0, 0.0, 0.15], "workspace": [0.0, 0.0, -0.11]}
    placed = {"object": "sheet.yaml", "position": [-0.015, -0.01, 0.0315]}
    (folder / "sheet.yaml").write_text(yaml.safe_dump(tissue | settings))
    path = folder / "over_tissue.yaml"
    drawn = {"tissue_stiffness": 0.3, "tissue_friction": 0.3}
    path.write_text(yaml.safe_dump({"arms": {"psm_0": arm}, "objects": {"sheet": placed}, "randomisation": drawn}))
    return str(path)


@pytest.mark.slow
def test_both_engines_push_it_alike_and_a_reset_forgets(tmp_path: Path) -> None:
    path, found, count = scene_file(tmp_path), [], 2
    for engine in ("mjx", "fused"):
        env = BatchedEnv("reach", path, num_envs=count, engine=engine, device="cpu")
        read = lambda part: np.array(env.engine.read(f".physics.{part}", "numpy"))  # noqa: B023, E731
        names = [f"sheet.{part}" for part in ("nodes.position", "nodes.velocity", "stretches.stretch", "force", "torn")]
        env.reset(seed=0)
        fresh = [read(name) for name in names]
        action = np.zeros((count, len(env.scene.mounts["psm_0"].arm.actuated)), np.float32)
        action[0, 2] = 1.0  # into the tissue
        for _ in range(10):
            step = env.step({"psm_0": action})
        force = np.array(step.infos["psm_0"]["tissue_force"])
        found.append([read("sheet.nodes.position"), read("arms.qpos"), force])
        env.reset(seed=0)
        for name, before in zip(names, fresh, strict=True):
            np.testing.assert_array_equal(read(name), before, err_msg=name)
        env.close()
    position, _, force = found[0]
    assert force[0] > 0.05 and force[1] == 0
    assert position[0, :, 2].min() < position[1, :, 2].min() - 1e-3
    for one, other, close in zip(*found, (1e-5, 1e-5, 5e-3), strict=True):
        np.testing.assert_allclose(one, other, atol=close)


def beside_pads(scene: Any, qpos: np.ndarray, points: np.ndarray) -> float:
    """Return the least distance of points [n, 3] from the plates of a jaw, m; below 0 in a plate."""
    data, least = mujoco.MjData(scene.model), np.inf
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    for pad in np.flatnonzero(scene.model.geom_group == PAD_GROUP):
        off = np.abs((points - data.geom_xpos[pad]) @ data.geom_xmat[pad].reshape(3, 3)) - scene.model.geom_size[pad]
        outside = np.linalg.norm(np.maximum(off, 0.0), axis=1)
        least = min(least, float((outside + np.minimum(off.max(1), 0.0)).min()))
    return least


@pytest.mark.slow
def test_a_jaw_gathers_tissue_lifts_it_and_holds_it_for_ten_seconds(tmp_path: Path) -> None:
    """An open jaw presses the sheet down, closes on a fold of it, and goes up until it is 5 mm above the sheet."""
    env = BatchedEnv("reach", scene_file(tmp_path), num_envs=2, engine="fused", device="cpu", max_steps=10**6)
    env.reset(seed=0)
    tissue: Any = env.scene.systems["sheet"]
    top, nearest = tissue.grid.places[:, 2] == 1, np.inf

    def read(part: str) -> np.ndarray:
        return np.array(env.engine.read(f".physics.{part}", "numpy"), float)

    def go(steps: int, insertion: float, jaw: float, force: float = np.inf) -> None:
        nonlocal nearest
        action = np.zeros((2, len(env.scene.mounts["psm_0"].arm.actuated)), np.float32)
        action[:, 2], action[:, -1] = insertion, jaw
        for _ in range(steps):
            env.step({"psm_0": action})
            x = read("sheet.nodes.position")[0]
            under = (1 - SKIN) * x[top] + SKIN * x[~top]  # the balls that pads touch
            nearest = min(nearest, beside_pads(env.scene, read("arms.qpos")[0], under))
            if read("sheet.force")[0] > force:
                return

    go(12, 0.0, 1.0)
    go(60, 0.25, 1.0, force=0.25)
    go(60, 0.0, -1.0)
    go(14, -0.2, -1.0)
    go(100, 0.0, -1.0)
    held, height = read("sheet.nodes.position")[0], tissue.rest[:, 2].max()
    go(500, 0.0, -1.0)
    after = read("sheet.nodes.position")[0]
    assert after[:, 2].max() > height + 3e-3 and read("sheet.force")[0] > 1.0
    assert read("arms.qpos")[0, -1] > 0.022  # something is between its fingers, which would close to 0.020 rad
    assert np.abs(after - held).max() < 1e-4
    assert nearest > 0, nearest  # no ball has gone into a plate with its middle
    env.close()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "tisue"}, "must be thread or tissue, not 'tisue'"),
        ({"cells": [6, 4.5, 1]}, "three whole numbers"),
        ({"cells": [60, 40, 1]}, "at most 1,000 bricks"),
        ({"grid": ["......"] * 4}, "grid must have a brick"),
        ({"grid": ["###"] * 4}, "4 rows of 6 characters"),
        ({"poisson": 0.5}, "from 0 to 0.49"),
        ({"fixed": ["top"]}, "must be one of left, right, front, back, bottom, not 'top'"),
        ({"fixed": []}, "must be held"),
        ({"springs": {"left": 1e6}}, "left is fixed and on springs"),
        ({"springs": {"up": 1e6}}, "must name borders"),
        ({"tears": 0.5}, "from 1.01 to 10"),
        ({"length": 0.1}, "unknown key 'length'"),
    ],
)
def test_a_bad_value_is_one_sentence(tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        sm.load_scene(scene_file(tmp_path, **settings))
    assert "\n" not in str(caught.value)


def test_bricks_are_cut_out_of_a_grid(tmp_path: Path) -> None:
    """Rows are seen from above: the first one is at the back."""
    settings = {"grid": ["######", "##..##", "##..##", "##..##"], "springs": {"front": 1e6}, "fixed": ["left"]}
    tissue: Any = sm.load_scene(scene_file(tmp_path, **settings)).systems["sheet"]
    assert len(tissue.grid.first) == 18
    present = np.array(tissue.present)[:, :, 0]
    assert not present[2:4, :3].any() and present[2:4, 3].all()
    held = tissue.solver.support.stiffness
    assert held.sum() == pytest.approx(1e6 * 4 * 0.005 * 0.005) and held[tissue.grid.places[:, 1] > 0].sum() == 0
    drawn = tissue.bars.start[tissue.bars.ends].mean((1, 2)) - tissue.position
    bricks = np.argwhere(present)
    np.testing.assert_allclose(drawn[:, :2], (bricks + 0.5) * 0.005, atol=1e-6)
    parts = tissue.points.nodes[tissue.points.weights > 0]
    assert (tissue.grid.mass[parts] > 0).all()
    np.testing.assert_allclose(tissue.points.weights.sum(1), 1.0)


def test_tissue_that_is_stretched_past_its_limit_is_torn() -> None:
    tissue = strip(tears=1.5)
    for stretch, torn in ((1.45, False), (1.55, True)):
        turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        position = jnp.asarray(tissue.rest * [1.0, stretch, 1.0] @ turned.T, jnp.float32)
        assert bool(tissue.solver.stretched(position, 1.5)) == torn


@pytest.mark.slow
def test_ten_minutes_of_random_arms_turn_no_brick_inside_out_and_stop_no_tissue() -> None:
    """All environments together; arms go down into the tissue and close their jaws at random."""
    count, seconds = 32, 600
    env = BatchedEnv("reach", "bimanual_psm_tissue", num_envs=count, engine="fused", device="cpu")
    env.reset(seed=0)
    grid, rng, pressed = env.scene.systems["flap"].grid, np.random.default_rng(0), 0
    slope, last = (2 * CORNERS - 1) / (4 * grid.cell), np.zeros((count, grid.nodes, 3))
    for step in range(round(seconds / 0.02 / count)):
        if step % 25 == 0:
            actions = {}
            for agent, mount in env.scene.mounts.items():
                actions[agent] = rng.uniform(-1, 1, (count, len(mount.arm.actuated))).astype(np.float32)
                actions[agent][:, 2] = np.abs(actions[agent][:, 2])  # insertion
                actions[agent][:, -1] = rng.choice([-1.0, 1.0], count)
        env.step(actions)
        x = np.array(env.engine.read(".physics.flap.nodes.position", "numpy"), float)
        assert np.isfinite(x).all(), step
        gradient = np.einsum("neai,aj->neij", x[:, grid.first[:, None] + grid.offsets], slope)
        volume = np.linalg.det(gradient)
        assert volume.min() > 0, step
        force = np.array(env.engine.read(".physics.flap.force", "numpy"))
        crushed = (volume.min(1) < 0.1) & (force > 0.5)
        assert (np.abs(x - last).max((1, 2))[crushed] > 1e-7).all() and force.max() < 100, step
        pressed, last = pressed + int((force > 0.1).sum()), x
    assert pressed > 500  # the arms did press it
    env.close()
