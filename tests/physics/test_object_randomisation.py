"""Objects whose size, mass and friction are drawn anew in each episode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from surgical_marl.bench.starts import grasps
from surgical_marl.content import find
from surgical_marl.control.controller import Controller
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.physics.contact.contact_pairs import ContactPairs
from surgical_marl.physics.plant import Hidden, Plant
from surgical_marl.physics.randomisation import Factors, varied
from surgical_marl.physics.simulator import Simulator
from surgical_marl.scenes.load import load_scene
from tests.helpers.falling import Falling
from tests.helpers.object_parity import Beside

COUNT = 16


def scene_file(folder: Path, randomisation: str) -> str:
    """`psm_needle` with a randomisation of its own."""
    path = folder / "psm_needle.yaml"
    path.write_text(find("scenes", "psm_needle").read_text() + f"\nrandomisation: {randomisation}\n")
    return str(path)


def drawn(folder: Path, randomisation: str, count: int = 500) -> tuple[Plant, Hidden]:
    simulator = Simulator(load_scene(scene_file(folder, randomisation)))
    plant = Plant(simulator, Controller(simulator.scene, dt=simulator.control_dt))
    return plant, jax.jit(jax.vmap(plant.start))(jax.vmap(jax.random.PRNGKey)(jnp.arange(count)))


def test_draws_fill_their_ranges(tmp_path: Path) -> None:
    _, hidden = drawn(tmp_path, "{object_size: 0.1, object_mass: 0.3, object_friction: 0.5}")
    assert hidden.objects is not None
    for values, share in zip(hidden.objects, (0.1, 0.3, 0.5), strict=True):
        assert values.shape == (500, 1)
        np.testing.assert_allclose([np.min(values), np.max(values)], [1 - share, 1 + share], rtol=0.02)
    assert np.abs(np.corrcoef(np.concatenate(hidden.objects, 1).T) - np.eye(3)).max() < 0.2  # each its own


def test_what_is_not_named_stays_but_mass_that_grows_with_size(tmp_path: Path) -> None:
    _, hidden = drawn(tmp_path, "{object_size: 0.1, stiffness: 0.1}", 20)
    assert hidden.objects is not None and (hidden.objects.friction == 1).all()
    np.testing.assert_allclose(hidden.objects.mass, hidden.objects.size**3, rtol=1e-6)
    _, hidden = drawn(tmp_path, "{stiffness: 0.1}", 20)
    assert hidden.objects is None


def test_other_draws_of_a_seed_stay_the_same(tmp_path: Path) -> None:
    (_, one), (_, other) = (
        drawn(tmp_path, text, 3) for text in ("{stiffness: 0.1}", "{stiffness: 0.1, object_mass: 0.1}")
    )
    np.testing.assert_array_equal(one.stiffness, other.stiffness)


def test_a_varied_object_is_one_whose_file_says_so(tmp_path: Path) -> None:
    """A ring with other numbers in its file, of which MuJoCo computes mass and inertia; and a block beside it."""
    ring = yaml.safe_load(find("objects", "ring").read_text())
    size, friction = 1.2, 0.6
    arc = ring["shapes"][0]["arc"]
    rough = {**ring["friction"], "sliding": friction * ring["friction"]["sliding"]}
    grown = {"arc": {**arc, "radius": size * arc["radius"], "wire": size * arc["wire"]}}
    larger = {**ring, "friction": rough, "shapes": [grown]}
    (tmp_path / "larger.yaml").write_text(yaml.safe_dump(larger))
    found = {}
    for name in ("ring", "larger.yaml"):
        path = tmp_path / "scene.yaml"
        places = ((name, 0.1), ("block", 0.2))
        objects = {f"thing_{i}": {"object": what, "position": [0, y, 0]} for i, (what, y) in enumerate(places)}
        path.write_text(yaml.safe_dump({"arms": {"psm_0": {"arm": "psm"}}, "objects": objects}, sort_keys=False))
        found[name] = ContactPairs(load_scene(path))
    other = lambda value: jnp.array([value, 1.0])  # noqa: E731
    ours, truth = varied(found["ring"], Factors(other(size), other(size**3), other(friction))), found["larger.yaml"]
    for field, expected in vars(truth).items():
        if isinstance(expected, np.ndarray):
            np.testing.assert_allclose(getattr(ours, field), expected, rtol=1e-5, atol=1e-7, err_msg=field)
    for ours_, truth_ in zip(ours.masses, truth.masses, strict=True):
        np.testing.assert_allclose(ours_, truth_, rtol=1e-5, atol=1e-5 * np.abs(truth_).max())


def test_what_lies_on_something_lies_there_whatever_its_size(tmp_path: Path) -> None:
    """It neither overlaps with the pad nor floats above it, and the task sees it where it is."""
    plant, hidden = drawn(tmp_path, "{object_size: 0.3}", COUNT)

    def look(hidden: Hidden) -> Any:
        physics = plant.at_rest(hidden)
        return plant.actual(hidden).step.depths(physics).max(), plant.actual(hidden).objects(physics)["needle"]

    depth, needle = jax.jit(jax.vmap(look))(hidden)
    assert np.abs(depth).max() < 1e-7
    place = plant._simulator.scene.objects["needle"]
    np.testing.assert_array_equal(needle.size, hidden.objects.size[:, 0])  # type: ignore[union-attr]
    np.testing.assert_allclose(needle.position[:, :2], np.tile(place.position[:2], (COUNT, 1)), atol=1e-7)
    wire = place.object.shapes[0].size[0]
    height = place.position[2] + (needle.size - 1) * wire
    np.testing.assert_allclose(needle.position[:, 2], height, atol=1e-7)


@pytest.mark.slow
def test_a_varied_object_slides_where_coulomb_says(tmp_path: Path) -> None:
    """Sleds on a plane that slopes by 0.5: those with less friction than that move as fast as Coulomb says."""
    feet = [{"sphere": {"radius": 0.001, "position": [x, y, 0]}} for x, y in ((0.01, 0), (-0.01, 0.01), (-0.01, -0.01))]
    sled = {
        "stiffness": 1e6,
        "free": True,
        "mass": 0.001,
        "friction": {"sliding": 0.25, "torsion": 0.0},
        "shapes": feet,
    }
    floor = {"free": False, "stiffness": 1e6, "friction": {"sliding": 1.0, "torsion": 0.0}, "shapes": [{"plane": {}}]}
    for name, settings in (("sled", sled), ("floor", floor)):
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(settings))
    places = {f"sled_{i}": {"object": "sled.yaml", "position": [0, 0.1 * i, 0.001]} for i in range(4)}
    scene, factors = Falling(tmp_path, {"floor": {"object": "floor.yaml"}, **places}), np.array([0.5, 0.9, 1.1, 1.5])
    drawn = Factors(*(jnp.asarray(x, jnp.float32) for x in ([1.0, 1.2, 0.8, 1.0], [1.0, 3.0, 0.5, 1.0], factors)))
    scene.step = scene.step.varied(scene.step.arms, scene.bodies.randomise(drawn), {})
    tilt = np.arctan(0.5)
    _, path = scene.play(scene.begin(1), 0.5, 9.81 * np.array([np.sin(tilt), 0, -np.cos(tilt)]))
    way = path.position[0, -1, :, 0] - path.position[0, 0, :, 0]
    pulled = 9.81 * (np.sin(tilt) - np.cos(tilt) * 0.5 * np.sqrt(factors)) * 0.5**2 / 2
    np.testing.assert_allclose(way[:2], pulled[:2], atol=0.01)  # less than 1 % of gravity
    assert pulled[1] > 0.02 and np.abs(way[2:]).max() < 1e-3


@pytest.mark.slow
def test_both_engines_step_varied_objects_alike(tmp_path: Path) -> None:
    """From grasps of a needle with the size of the file, around which jaws close."""
    both = Beside(scene_file(tmp_path, "{object_size: 0.1, object_mass: 0.3, object_friction: 0.5}"), COUNT)
    simulator, starts = both.simulator, grasps(both.env.scene, COUNT, np.random.default_rng(0))
    qpos, position, quaternion = (x.astype(np.float32) for x in starts[:3])
    now = jax.vmap(simulator.at)(qpos)
    bodies = now.rigid_bodies.bodies._replace(position=position, quaternion=quaternion)
    now = now.with_systems(rigid_bodies=now.rigid_bodies._replace(bodies=bodies))
    now = now.with_arms(ctrl=np.array(now.ctrl) - 0.03)
    for k in range(16):
        now = both.step(now, compared=k % 5 == 0)
    assert (now.rigid_bodies.grips.force.max((1, 2)) > 1.0).mean() > 0.25


@pytest.mark.parametrize(
    "wrong, words",
    [
        ("{object_size: 1.0}", "object_size must be a number from 0 to 0.999, not 1"),
        ("{object_mass: -0.1}", "object_mass must be a number from 0 to 0.999, not -0.1"),
        ("{object_friction: .nan}", "object_friction must be a number from 0 to 0.999, not nan"),
        ("{object_shape: 0.1}", "unknown key 'object_shape'"),
    ],
)
def test_a_wrong_range_is_one_sentence(tmp_path: Path, wrong: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as error:
        load_scene(scene_file(tmp_path, wrong))
    assert "\n" not in str(error.value)


def test_poses_of_environments_are_those_of_objects_of_their_size(tmp_path: Path) -> None:
    """`object_poses` is where the frames of needles are that lie on the pad, whatever their centres of mass."""
    env = BatchedEnv("reach", scene_file(tmp_path, "{object_size: 0.3}"), num_envs=4, engine="mjx")
    env.reset(0)
    size, place = env.carry()[".hidden.objects.size"][:, 0], env.scene.objects["needle"]
    height = place.position[2] + (size - 1) * place.object.shapes[0].size[0]
    expected = np.stack([*np.tile(place.position[:2, None], (1, 4)), height], 1)
    assert np.ptp(size) > 0.01
    np.testing.assert_allclose(env.object_poses.origin[:, 0], expected, atol=1e-6)
