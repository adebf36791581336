"""The physics of objects: they are held, fall, rest, slide and spin as they should."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from docs.studies.grasping import Held, judge
from docs.studies.plain_mujoco import IMPRATIO, TOLERANCE
from docs.studies.shaking import CHUNK, OBJECTS, Grasps
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.physics.contact.contact_model import FASTEST
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.systems import rigid_bodies
from surgical_marl.physics.systems.rigid_bodies import RigidBodyState
from surgical_marl.physics.systems.rigid_motion import carried, turn
from surgical_marl.policies.oracle import oracle
from surgical_marl.robots.rotation import matrix_of, quaternion, turned
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.mjcf import mjcf
from tests.helpers.falling import DT, Falling, Trace, random_turns, thrown, wide_pad

INSERTION = 2
"""Number of that joint of a PSM."""

# -- what a jaw holds


def test_a_needle_that_was_picked_stays_in_the_jaw_until_that_opens() -> None:
    """Through 1.2 s of motion at full speed, up from where the oracle has carried it and back."""
    env = BatchedEnv("needle_pick", "psm_needle", num_envs=32, engine="fused", device="cpu")
    observations, *_ = env.reset(seed=0)
    act, rng = oracle(env), np.random.default_rng(0)
    for _ in range(150):
        step = env.step(act(observations))
        observations = step.observations
    for number in range(60):
        if number % 20 == 0:
            up = rng.uniform(-1, 1, (32, 7)).astype(np.float32)
            up[:, INSERTION] = -np.abs(up[:, INSERTION])
        action = up if number % 20 < 10 else -up
        action[:, -1] = -1  # closed
        step = env.step({"psm_0": action})
        found = step.infos["psm_0"]
        assert found["needle_holding"].all() and found["needle_slip"].max() < 2e-4 and found["needle_force"].min() > 10
    held = env.object_poses.origin[:, 0, 2].copy()
    for _ in range(12):
        step = env.step({"psm_0": np.eye(7, dtype=np.float32)[[-1] * 32]})  # opens
    found = step.infos["psm_0"]
    assert not found["needle_holding"].any() and not found["needle_force"].any()
    assert (held - env.object_poses.origin[:, 0, 2] > 0.005).all()


@pytest.fixture(scope="module")
def grasps() -> Grasps:
    """One scene with all objects: most of the time goes into tracing and compiling its step."""
    return Grasps(list(OBJECTS))


EACH = np.repeat(np.arange(len(OBJECTS)), 4)
"""Four grasps of each object."""


@pytest.mark.slow
def test_a_jaw_holds_objects_through_motion_at_full_speed(grasps: Grasps) -> None:
    held: Held = judge(grasps.shake(grasps.begin(EACH, seed=0), EACH, 1.0, seed=0))
    assert not held.dropped.any()
    assert held.moved.slip.max() < 2e-4 and np.degrees(held.moved.turn.max()) < 1
    assert held.overlap.max() < 1.5e-4


@pytest.mark.slow
def test_an_object_is_held_from_when_the_jaw_has_closed_until_it_opens(grasps: Grasps) -> None:
    physics, found = grasps.begin(EACH, seed=5), []
    for jaw in (-1, 1):
        actions = np.zeros((len(EACH), CHUNK, 1, 7), np.float32)
        actions[..., -1] = jaw
        physics, seen = grasps.play(physics, actions, EACH)
        found.append(seen)
    closed, opened = found
    assert not closed.holding[:, 0].any() and closed.holding[:, -1].all() and (closed.force[:, -1] > 10).all()
    assert closed.overlap.max() < 1.5e-4
    assert not opened.holding[:, -1].any() and (opened.force[:, -1] == 0).all()
    fallen = closed.place[:, -1, 2] - opened.place[:, -1, 2]
    assert (fallen > 0.005).all() and np.median(fallen) > 0.05


# -- what falls


SECONDS = 2.0
"""Of all plays of eight environments with these objects, so that one is compiled."""


@pytest.fixture(scope="module")
def falling(tmp_path_factory: pytest.TempPathFactory) -> Falling:
    """A needle, a block and a ring 50 mm above a pad so wide that nothing rolls off it."""
    folder = tmp_path_factory.mktemp("falling")
    places = {name: {"object": name, "position": [0, y, 0.05]} for name, y in
              (("needle_sh", -0.2), ("block", 0.0), ("ring", 0.2))}  # fmt: skip
    return Falling(folder, {"pad": wide_pad(folder), **places})


@pytest.mark.parametrize("speed", [*(pytest.param(speed, marks=pytest.mark.slow) for speed in (0.0, 1.0)), 3.0])
def test_what_falls_on_a_pad_comes_to_rest_there(falling: Falling, speed: float) -> None:
    """Within 2 s, whatever way it is turned; then it drifts by less than 0.1 mm in 10 s."""
    rng = np.random.default_rng(0)
    down = np.broadcast_to([0, 0, -speed, 0, 0, 0], (8, 3, 6))
    start = thrown(falling.begin(8), quaternion=random_turns(rng, 8, 3), velocity=down)
    path = comes_to_rest(falling, start)
    assert path.position[..., 2].min() > 0, "something fell through"
    assert path.depth.max() < 5e-4


@pytest.mark.slow
def test_what_is_put_down_on_a_blunt_edge_or_flat_comes_to_rest_there(falling: Falling) -> None:
    """A block on a corner, which is 4.5 mm wide, a needle and a ring on their sides, turned about the vertical.

    Each is supported by more points than a contact has.
    """
    corner = turned(np.array([0.0, 0.0, 30.0]))  # the post at -30 degrees comes to lie on x
    ways = {"needle_sh": np.eye(3), "block": turned(np.array([0.0, 90.0, 0.0])) @ corner, "ring": np.eye(3)}
    yaws = [turned(np.array([0.0, 0.0, angle])) for angle in np.arange(0.0, 360.0, 22.5) + 3.0]
    turns = [[quaternion(yaw @ ways[name]) for name in falling.names] for yaw in yaws]
    start = falling.begin(len(yaws))
    place = np.array(start.bodies.position)
    place[..., 2] = [2e-4 + falling.scene.objects[name].object.height(ways[name]) for name in falling.names]
    path = comes_to_rest(falling, thrown(start, position=place, quaternion=np.array(turns)))
    assert np.abs(path.position[:, -1, :, 2] - place[..., 2]).max() < 3e-4, "something rolled over"


def comes_to_rest(falling: Falling, start: RigidBodyState) -> Trace:
    """Return what objects do in 2 s; after that they lie still, and go on to do so."""
    objects, path = falling.play(start, SECONDS)
    assert path.depth[:, -1].max() < 1e-5 and np.abs(path.velocity[:, -1, :, :3]).max() < 1e-3
    _, later = falling.play(objects, SECONDS)
    assert 5 * np.linalg.norm(later.position[:, -1] - path.position[:, -1], axis=-1).max() < 1e-4
    return path


def test_a_spinning_body_keeps_its_angular_momentum(falling: Falling) -> None:
    """Without gravity and contacts, 50 mm above the pad: to 0.1 % in 1 s. It gains no energy, however fast it spins."""
    rng = np.random.default_rng(0)
    for speed in (10.0, 100.0):
        spins = np.concatenate([np.zeros((8, 3, 3)), rng.uniform(-speed, speed, (8, 3, 3))], -1)
        start = thrown(falling.begin(8), quaternion=random_turns(rng, 8, 3), velocity=spins)
        _, path = falling.play(start, SECONDS, np.zeros(3))
        assert path.depth.max() < 0
        momentum = falling.momentum(path)
        lost = np.linalg.norm(momentum - momentum[:, :1], axis=-1) / np.linalg.norm(momentum[:, :1], axis=-1)
        assert speed > 10 or lost[:, : round(1 / DT)].max() < 1e-3
        energy = falling.energy(path) - 9.81 * falling.masses.mass * path.position[..., 2]
        assert (energy / energy[:, :1]).max() < 1 + 1e-5


def sleds(folder: Path, feet: list[tuple[float, float]], frictions: list[tuple[float, float]]) -> Falling:
    """Return sleds of 1 g on feet at x and y, m, on a floor; each has a friction with it: sliding, and torsion, m."""
    floor = {"free": False, "stiffness": 1e6, "friction": {"sliding": 1.0, "torsion": 1.0}, "shapes": [{"plane": {}}]}
    shapes = [{"sphere": {"radius": 0.001, "position": [x, y, 0]}} for x, y in feet]
    own = {"stiffness": 1e6, "free": True, "mass": 0.001, "shapes": shapes}
    files = {f"sled_{i}": own | {"friction": {"sliding": sliding**2, "torsion": torsion**2}}
             for i, (sliding, torsion) in enumerate(frictions)} | {"floor": floor}  # fmt: skip
    for name, content in files.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    places = {f"sled_{i}": {"object": f"sled_{i}.yaml", "position": [0, 0.1 * i, 0.001]} for i in range(len(frictions))}
    return Falling(folder, {"floor": {"object": "floor.yaml"}, **places})


def test_an_object_slides_where_coulomb_says(tmp_path: Path) -> None:
    """Blocks of three frictions on a plane: gravity tilts by 5 % more or less than atan(mu); only more moves them."""
    frictions = (0.2, 0.5, 1.0)
    scene = sleds(tmp_path, [(0.01, 0.0), (-0.01, 0.01), (-0.01, -0.01)], [(mu, 0.0) for mu in frictions])
    slopes = np.array([mu * share for mu in frictions for share in (0.95, 1.05)])
    tilts = np.arctan(slopes)
    gravity = 9.81 * np.stack([np.sin(tilts), 0 * tilts, -np.cos(tilts)], 1)
    _, path = scene.play(scene.begin(6), 0.5, gravity)
    way = path.position[:, -1, :, 0] - path.position[:, 0, :, 0]
    pulled = 9.81 * (np.sin(tilts)[:, None] - np.cos(tilts)[:, None] * np.array(frictions)) * 0.5**2 / 2
    slides = pulled > 0
    np.testing.assert_allclose(way[slides], pulled[slides], atol=0.01 * 9.81 * 0.5**2 / 2)  # 1 % of gravity
    assert path.position[..., 2].max() < 0.0012, "what slides is not lifted"
    assert np.abs(way[~slides]).max() < 1e-3


def test_what_spins_on_a_floor_slows_as_in_plain_mujoco_and_as_coulomb_says(tmp_path: Path) -> None:
    """Sleds on three feet at a distance r from the middle, which resist a turn in place with a radius t.

    A foot slides at r times the spin and turns in place at once, so friction's torque is mu m g hypot(r, t). Of the
    four points of a patch one is in the middle of the feet, and bears a part of the weight: it is less here, most so
    without t. C MuJoCo needs a 400th of the step, as stiff feet that bear 3 mN hop in its contacts at longer ones.
    """
    r, mu, spin, seconds = 0.01, 0.2, 30.0, 0.05
    torsions = np.array([0.0, 0.005, 0.01, 0.02])
    angles = 2 * np.pi * np.arange(3) / 3
    feet = list(zip((r * np.cos(angles)).tolist(), (r * np.sin(angles)).tolist(), strict=True))
    scene = sleds(tmp_path, feet, [(mu, t) for t in torsions.tolist()])
    start = scene.begin(1)
    _, path = scene.play(thrown(start, velocity=np.tile([0, 0, 0, 0, 0, spin], (1, len(torsions), 1))), seconds)
    ours = spin - path.velocity[0, -1, :, 5]
    model = mujoco.MjModel.from_xml_string(mjcf(scene.scene, timestep=DT / 400))
    model.opt.impratio, model.opt.tolerance = IMPRATIO, TOLERANCE
    data = mujoco.MjData(model)
    for name in scene.names:
        data.joint(name).qvel[5] = spin
    mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
    theirs = spin - np.array([data.joint(name).qvel[5] for name in scene.names])
    coulomb = mu * 9.81 * scene.masses.mass * np.hypot(r, torsions) / scene.masses.inertia[:, 2, 2] * seconds
    assert (ours / coulomb > 0.8).all() and (ours / coulomb < 1.02).all(), (ours, coulomb)
    np.testing.assert_allclose(theirs, coulomb, rtol=0.02)


@pytest.mark.slow
def test_what_an_arm_slides_along_a_floor_stays_on_it(tmp_path: Path) -> None:
    """A sled is pushed as hard as friction resists, so it slides at the same speed all the time. If it counts as held,
    a step knows that. If not, it takes the sled to be slowed by friction, and its cone lifts it."""
    own = {"free": False, "stiffness": 1e6, "friction": {"sliding": 0.8, "torsion": 0.0}}
    feet = [{"sphere": {"radius": 0.001, "position": [x, y, 0]}} for x, y in ((0.01, 0), (-0.01, 0.01), (-0.01, -0.01))]
    sled = own | {"free": True, "mass": 0.001, "shapes": feet}
    for name, content in {"sled": sled, "floor": own | {"shapes": [{"plane": {}}]}}.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(content))
    objects = {"floor": {"object": "floor.yaml"}, "sled": {"object": "sled.yaml", "position": [0.3, 0, 0.001]}}
    arms = {"psm_0": {"arm": "psm", "position": [0.0, 0.0, 0.25]}}
    (tmp_path / "slide.yaml").write_text(yaml.safe_dump({"arms": arms, "objects": objects}))
    simulator, push = Simulator(load_scene(tmp_path / "slide.yaml")), np.float32([0.8 * 9.81, 0.0, -9.81])
    begin = thrown(simulator.home.rigid_bodies, velocity=simulator.home.rigid_bodies.bodies.velocity.at[0, 0].set(0.05))

    def slide(held: Any) -> Any:
        def step(physics: Any, _: None) -> Any:
            grips = physics.rigid_bodies.grips
            objects = physics.rigid_bodies._replace(grips=grips._replace(held=0 * grips.held + held))
            physics, _touch = simulator.step(physics.with_systems(rigid_bodies=objects), simulator.untouched)
            return physics, physics.rigid_bodies.bodies.position[0]

        with patch.object(rigid_bodies, "GRAVITY", push):
            return jax.lax.scan(step, simulator.home.with_systems(rigid_bodies=begin), None, length=200)[1]

    loose, held = np.asarray(jax.jit(jax.vmap(slide))(jnp.float32([0, 1])), float)
    for way in (loose, held):
        assert way[-1, 0] - way[0, 0] == pytest.approx(199 * 0.0025 * 0.05, rel=0.1)
    assert np.ptp(held[:, 2]) < 2e-6 < 2e-5 < np.ptp(loose[:, 2])


@pytest.mark.slow
def test_what_falls_on_a_board_and_on_pegs_comes_to_rest_there(tmp_path: Path) -> None:
    """Blocks around pegs, upright or aslant, and needles on top, from where nothing overlaps.

    Then they drift by less than 0.1 mm in 10 s. No step adds energy but by pushing out what an impact has left inside.
    """
    places = {
        "block": {"object": "block", "position": [-0.06, 0.0, 0.0076]},
        "aslant": {"object": "block", "position": [0.0615, 0.001, 0.012], "tilt": [12.0, 8.0, 0.0]},
        "needle": {"object": "needle_40", "position": [0.06, -0.035, 0.03], "tilt": [5.0, 0.0, 30.0]},
    }
    falling = Falling(tmp_path, {"board": {"object": "peg_board_icra2026"}, **places})
    rng, start = np.random.default_rng(0), falling.begin(32)
    shift = rng.uniform(-5e-4, 5e-4, (32, 3, 3)) * [1, 1, 0]
    start = thrown(start, position=np.array(start.bodies.position) + shift)
    apart = np.flatnonzero(np.asarray(falling.depths(start)) < 0)[:8]
    assert len(apart) == 8
    path = comes_to_rest(falling, jax.tree.map(lambda x: x[apart], start))
    assert path.position[..., 2].min() > 0
    energy = falling.energy(path).sum(-1)
    gained, pushed_out = np.diff(energy, axis=1), falling.masses.mass.sum() * FASTEST**2 / 2
    assert gained.max() <= pushed_out, np.unravel_index(gained.argmax(), gained.shape)


NUMBERS = st.floats(-1.0, 1.0, width=32)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS)


@settings(deadline=None)
@given(VECTORS, VECTORS, st.sampled_from([3.0, 0.1, 1e-4]), st.sampled_from([1.0, -1.0]))
def test_a_turn_has_moved_what_is_at_a_place_from_where_it_was(
    axis: tuple[float, ...], place: tuple[float, ...], size: float, sign: float
) -> None:
    """To float32's precision of the way itself, also where that is ten thousand times shorter than the place is far."""
    angle, there = size * np.array(axis), np.array(place)
    quaternion = sign * turn(jnp.asarray(angle, jnp.float32))
    exact = matrix_of(np.asarray(quaternion, float) / np.linalg.norm(np.asarray(quaternion, float)))
    way = there - exact.T @ there
    found = np.asarray(carried(quaternion, jnp.asarray(there, jnp.float32)))
    np.testing.assert_allclose(found, way, atol=1e-6 * np.linalg.norm(angle) * np.linalg.norm(there) + 1e-12)
