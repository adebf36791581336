"""Where free objects begin: the poses that a task draws, those of the scene, and their randomisation."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.object_contacts import RESTING, distance, distances
from surgical_marl.scenes.poses import Pose
from surgical_marl.tasks.base.task import Start, Task
from surgical_marl.tasks.base.world import World

BALL = """
free: true
density: 2000.0
friction: {sliding: 0.8, torsion: 0.002}
stiffness: 1.0e+5
shapes: [{sphere: {radius: 0.004, position: [0.001, 0.0, 0.0]}}]
"""
SCENE = """
arms: {ecm_0: {arm: ecm, position: [0.0, 0.0, 0.3]}}
objects:
  pad: {object: pad}
  ball: {object: ball.yaml, position: [0.0, 0.0, 0.004]}
  other: {object: ball.yaml, position: [0.03, 0.0, 0.004]}
"""
STEPS = 4


class Steps(NamedTuple):
    count: Any
    highest: Any


class Scatter(Task):
    """Scatter: one ball begins anywhere on a line, and the greatest height that it had is kept."""

    weights = {"clearance": 0.0, "collision": 0.0}  # noqa: RUF012
    max_steps = STEPS
    name = "ball"

    def start(self, key: Any) -> Start:
        y = jax.random.uniform(key, (), minval=-0.05, maxval=0.05)
        pose = Pose(jnp.stack([0.0, y, 0.004]), jnp.float32([0.6, 0.0, 0.0, 0.8]))
        return Start(Steps(jnp.int32(0), jnp.float32(-1.0)), poses={self.name: pose})

    def remember(self, world: World) -> Steps:
        height = world.objects["ball"].position[2]
        return Steps(world.goal.count + 1, jnp.maximum(world.goal.highest, height))

    def success(self, world: World) -> dict[str, Any]:
        return {agent: jnp.bool_(False) for agent in world.arms}


class Astray(Scatter):
    """Scatter, but of an object that is not there."""

    name = "bell"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("balls")
    (folder / "ball.yaml").write_text(BALL)
    (folder / "balls.yaml").write_text(SCENE)
    return str(folder / "balls.yaml")


@pytest.fixture(scope="module", autouse=True)
def tasks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TASKS, "_registered", {"scatter": Scatter, "astray": Astray})
        yield


@pytest.fixture(scope="module")
def played(scene: str) -> dict[str, list[Any]]:
    """Poses and goals over an episode and its end, by engine; before that those of a seed and of a masked reset."""
    found: dict[str, list[Any]] = {}
    for engine in ("fused", "mjx"):
        env = BatchedEnv("scatter", scene, num_envs=5, engine=engine, device="cpu")
        moments = []
        look = lambda env=env, moments=moments: moments.append((env.object_poses, env.goal))  # noqa: E731
        env.reset(3), look()
        env.reset(mask=np.arange(5) < 2), look()
        for _ in range(STEPS):
            env.step({"ecm_0": np.zeros((5, 4), np.float32)}), look()
        found[engine] = moments
    return found


def test_an_episode_begins_where_its_key_says(scene: str) -> None:
    """And the objects that the task leaves alone are where the scene has them."""
    env = Env("scatter", scene)
    keys = jnp.tile(jnp.stack([jax.random.PRNGKey(seed) for seed in (3, 4)]), (2, 1))
    carry = jax.jit(jax.vmap(lambda key, n: env.reset(key, n).carry))(keys, jnp.arange(4) // 2)
    views = jax.vmap(env.simulator.objects)(carry.physics)
    y = views["ball"].position[:, 1]
    assert len(np.unique(y.round(4))) == 4 and (np.abs(y) < 0.05).all()
    for (key, episode), found in zip(zip(keys, (0, 0, 1, 1), strict=True), y, strict=True):
        drawn = env.task.start(jax.random.fold_in(key, episode)).poses["ball"].position
        np.testing.assert_allclose(found, drawn[1], atol=1e-7)
    turn = np.array([[-0.28, -0.96, 0], [0.96, -0.28, 0], [0, 0, 1]])  # of the quaternion above
    np.testing.assert_allclose(views["ball"].rotation, np.tile(turn, (4, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(views["ball"].position[:, ::2], np.tile([0.0, 0.004], (4, 1)), atol=1e-7)
    np.testing.assert_allclose(views["other"].position, np.tile([0.03, 0.0, 0.004], (4, 1)), atol=1e-7)
    centre = turn @ [0.001, 0, 0] + np.array(views["ball"].position)
    np.testing.assert_allclose(carry.physics.rigid_bodies.bodies.position[:, 0], centre, atol=1e-7)


@pytest.mark.slow
def test_a_task_places_an_object_anew_in_each_episode_of_each_environment(played: dict[str, list[Any]]) -> None:
    for poses, _ in played["fused"]:
        assert len(np.unique(poses.origin[:, 0, 1].round(4))) == 5 and (np.abs(poses.origin[:, 0, 1]) < 0.05).all()
        np.testing.assert_allclose(poses.origin[:, 0, ::2], np.tile([0.0, 0.004], (5, 1)), atol=1e-5)
        np.testing.assert_allclose(poses.quaternion[:, 0], np.tile([0.6, 0.0, 0.0, 0.8], (5, 1)), atol=1e-3)
        np.testing.assert_allclose(poses.origin[:, 1], np.tile([0.03, 0.0, 0.004], (5, 1)), atol=1e-5)  # the scene's
    before, masked, *going, after = (poses.origin[:, 0, 1] for poses, _ in played["fused"])
    assert (np.abs(masked - before)[:2] > 1e-4).all() and (masked[2:] == before[2:]).all()
    np.testing.assert_allclose(going, np.tile(masked, (STEPS - 1, 1)), atol=1e-5)  # it lies where it was put
    assert (np.abs(after - masked) > 1e-4).all()


@pytest.mark.slow
def test_both_engines_begin_alike(played: dict[str, list[Any]]) -> None:
    for (one, goal), (other, its) in zip(played["fused"], played["mjx"], strict=True):
        np.testing.assert_allclose(one.origin, other.origin, atol=1e-6)
        np.testing.assert_allclose(one.quaternion, other.quaternion, atol=1e-6)
        np.testing.assert_array_equal(goal.count, its.count)


@pytest.mark.slow
def test_a_task_remembers_each_step_and_the_start(played: dict[str, list[Any]]) -> None:
    counts = [goal.count.tolist() for _, goal in played["fused"]]
    assert counts == [[1] * 5, [1] * 5, *([k] * 5 for k in range(2, STEPS + 1)), [1] * 5]
    for _, goal in played["fused"]:
        np.testing.assert_allclose(goal.highest, 0.004, atol=1e-5)


def test_an_object_that_is_not_there_is_named(scene: str) -> None:
    with pytest.raises(ValueError, match="unknown free object of scene 'balls' 'bell', did you mean 'ball'"):
        Env("astray", scene).reset(jax.random.PRNGKey(0))


def randomised(scene: str, ranges: str) -> str:
    path = Path(scene).with_name(f"randomised_{abs(hash(ranges))}.yaml")
    path.write_text(SCENE + f"\nrandomisation: {ranges}\n")
    return str(path)


def test_randomised_places_fill_their_ranges(scene: str) -> None:
    env = Env("reach", randomised(scene, "{object_shift: 0.01, object_turn: 0.5}"))
    keys = jax.vmap(jax.random.PRNGKey)(jnp.arange(500))
    poses = jax.jit(jax.vmap(lambda key: env.plant.place(key, {})))(keys)
    for name, place in env.scene.free_objects.items():
        shift, turn = poses[name].position - place.position, 2 * np.arctan2(*poses[name].quaternion[:, [3, 0]].T)
        np.testing.assert_allclose([shift[:, :2].min(0), shift[:, :2].max(0)], [[-0.01] * 2, [0.01] * 2], atol=5e-4)
        np.testing.assert_allclose([turn.min(), turn.max()], [-0.5, 0.5], atol=0.02)
        np.testing.assert_allclose(shift[:, 2], 0.0, atol=1e-7)
    assert np.abs(np.corrcoef(poses["ball"].position[:, 0], poses["other"].position[:, 0])[0, 1]) < 0.15


def test_places_that_may_overlap_are_named(scene: str) -> None:
    with pytest.raises(ValueError, match=r"'ball/0' and 'other/0' overlap at the start by .* randomise its place less"):
        load_scene(randomised(scene, "{object_shift: 0.03}"))


def test_distances_are_those_of_spheres_and_planes(scene: str) -> None:
    """Against the formula for a sphere of 4 mm whose centre is 1 mm beside the frame's origin."""
    places = np.array([[0.0, 0.0, 0.004], [0.0, 0.0, 0.006], [0.028, 0.0, 0.0035]])
    found = distances(load_scene(scene), {"ball": Pose(places, np.tile([1.0, 0, 0, 0], (3, 1)))})
    on_pad = places[:, 2] - 0.004
    to_other = np.linalg.norm(places - [0.03, 0.0, 0.004], axis=1) - 0.008
    np.testing.assert_allclose(found.min(1), np.minimum(np.minimum(on_pad, to_other), 0.0), atol=1e-6)
    assert (found.min(1) < -RESTING).tolist() == [False, False, True]


def test_a_capsule_overlaps_with_the_box_that_it_goes_through() -> None:
    """Against the least distance of 2,001 points of its axis. C MuJoCo alone says in some poses that they are apart."""
    box, capsule = np.array([0.0006, 0.0024, 0.0048]), (0.0009, 0.0049)
    shapes = f'type="box" size="{" ".join(map(str, box))}"', f'type="capsule" size="{capsule[0]} {capsule[1]}"'
    bodies = "".join(f'<body mocap="true"><geom {shape}/></body>' for shape in shapes)
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    data, rng, along = mujoco.MjData(model), np.random.default_rng(0), np.linspace(-1, 1, 2001)[:, None]
    through = 0
    for _ in range(1000):
        turn = rng.standard_normal(4)
        data.mocap_pos[1], data.mocap_quat[1] = rng.uniform(-0.004, 0.004, 3), turn / np.linalg.norm(turn)
        mujoco.mj_kinematics(model, data)
        points = data.geom_xpos[1] + capsule[1] * along * data.geom_xmat[1].reshape(3, 3)[:, 2]
        off = np.linalg.norm(np.maximum(np.abs(points) - box, 0), axis=1).min()
        if off == 0:
            through += mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None) > 0
            assert max(distance(model, data, 0, 1), distance(model, data, 1, 0)) <= -capsule[0]
        elif off > 1e-5:  # what the axis only just misses the points may miss too
            assert distance(model, data, 0, 1) == pytest.approx(off - capsule[0], abs=1e-5)
    assert through > 5, "C MuJoCo's distance is right: `distance` can be it alone"
