"""Pictures show free objects where the physics has them: the endoscope's, as observations too, and those of films."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
import torch

import surgical_marl as sm
from surgical_marl import BatchedEnv
from surgical_marl.envs.free_objects import FreeObjects
from surgical_marl.policies.policy import zero_policy
from surgical_marl.robots.rotation import matrix_of
from surgical_marl.scenes.poses import Poses, frames
from surgical_marl.scenes.scene import Scene
from surgical_marl.view import record
from surgical_marl.view.camera import best_view, task_places
from surgical_marl.vision.endoscope import CHANNELS, Endoscope
from tests.helpers.devices import DEVICES, skip_where_warp_lacks
from tests.vision.test_endoscope import cast

POSES, ENVS, STEPS = 8, 2, 4
SCENE = """
description: an endoscope over a pad, onto which a stick and a blue ball fall
arms:
  ecm_0: {arm: ecm, position: [0.0, 0.0, 0.3]}
objects:
  pad: {object: pad, position: [0.0, 0.0, 0.06]}
  stick: {object: stick.yaml, position: [-0.02, 0.01, 0.12], tilt: [30.0, 0.0, 0.0]}
  ball: {object: ball.yaml, position: [0.03, 0.0, 0.12], colour: [0.05, 0.1, 0.9]}
view: {position: [0.0, 0.3, 0.25], target: [0.0, 0.0, 0.1]}
"""
OBJECT = "{free: true, density: 2000.0, friction: {sliding: 0.5, torsion: 0.001}, stiffness: 1.0e+5, shapes: [%s]}"
SHAPES = {
    "stick": "capsule: {radius: 0.003, from: [0.0, 0.0, 0.0], to: [0.03, 0.0, 0.0]}",  # its origin is an end
    "ball": "sphere: {radius: 0.006}",
}
STILL = {"ecm_0": np.zeros((ENVS, 4), np.float32)}


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> BatchedEnv:
    path = tmp_path_factory.mktemp("scenes") / "falling.yaml"
    path.write_text(SCENE)
    for name, shape in SHAPES.items():
        path.with_name(f"{name}.yaml").write_text(OBJECT % f"{{{shape}}}")
    terms = ["qpos", "image", "ecm_0/depth"]
    return BatchedEnv("reach", str(path), num_envs=ENVS, max_steps=STEPS, observe={"ecm_0": terms}, engine="mjx")


@pytest.mark.parametrize("each", [(), (5,)], ids=["the same size", "sizes of their own"])
def test_frames_are_about_centres_of_mass_in_both_libraries(each: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    position, centers = rng.normal(size=(5, 2, 3)), rng.normal(size=(*each, 2, 3))
    quaternion = rng.normal(size=(5, 2, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    found = frames(position, quaternion, centers)
    turns = np.array([[matrix_of(one) for one in row] for row in quaternion])
    expected = position - (turns @ np.broadcast_to(centers, position.shape)[..., None])[..., 0]
    np.testing.assert_allclose(found.origin, expected, atol=1e-12)
    tensors = frames(*map(torch.from_numpy, (position, quaternion, centers)))
    np.testing.assert_allclose(tensors.origin.numpy(), expected, atol=1e-12)


@pytest.mark.slow
def test_poses_are_of_the_frames_of_falling_objects(env: BatchedEnv) -> None:
    """They turn about their centres of mass, which is not where the stick has its origin."""
    env.reset(seed=0)
    places = env.scene.free_objects.values()
    assert list(env.scene.free_objects) == ["stick", "ball"]
    for name in env.scene.free_objects:
        assert env.scene.model.body(name).mocapid[0] == list(env.scene.free_objects).index(name)
    np.testing.assert_allclose(env.object_poses.origin[1], [place.position for place in places], atol=1e-7)
    carry = env.carry()
    carry[".physics.rigid_bodies.bodies.velocity"][0, 0, 3:] = [30, 20, 10]  # rad/s
    env.set_carry(carry)
    env.step(STILL)
    env.step(STILL)
    found, bodies = env.object_poses, env.carry()
    for i, place in enumerate(places):
        turn = matrix_of(found.quaternion[0, i].astype(float))
        center = bodies[".physics.rigid_bodies.bodies.position"][0, i]
        np.testing.assert_allclose(found.origin[0, i] + turn @ place.object.center, center, atol=1e-7)
    parts = [bodies[f".physics.rigid_bodies.bodies.{part}"] for part in ("position", "quaternion")]
    centers = np.array([place.object.center for place in places], np.float32)
    tensors = frames(*map(torch.from_numpy, [*parts, centers]))
    np.testing.assert_allclose(tensors.origin.numpy(), found.origin, atol=1e-8)
    np.testing.assert_array_equal(tensors.quaternion.numpy(), found.quaternion)
    fallen = 9.81 * 0.0025**2 * 16 * 17 / 2  # 16 physics steps, each with the velocity at its end
    np.testing.assert_allclose(found.origin[1, :, 2], 0.12 - fallen, atol=1e-6)
    assert (
        np.linalg.norm(found.origin[0, 0] - found.origin[1, 0]) > 1e-3 and np.ptp(found.quaternion[:, 0], 0).max() > 0.1
    )


def test_a_scene_without_free_objects_has_no_poses() -> None:
    env = BatchedEnv("reach", "psm", num_envs=3)
    with pytest.raises(ValueError, match="no episode yet"):
        _ = env.object_poses
    env.reset(seed=0)
    assert env.object_poses.origin.shape == (3, 0, 3) and env.object_poses.quaternion.shape == (3, 0, 4)


def anywhere(scene: Scene, seed: int = 0) -> Poses:
    """Free objects at random about the middle of where the scene places them."""
    rng, places = np.random.default_rng(seed), scene.free_objects.values()
    middle = np.mean([place.position for place in places], axis=0)
    origin = middle + rng.uniform(-0.04, 0.04, (POSES, len(places), 3))
    turns = rng.normal(size=(POSES, len(places), 4))
    quaternion = turns / np.linalg.norm(turns, axis=-1, keepdims=True)
    return Poses(origin.astype(np.float32), quaternion.astype(np.float32))


@pytest.mark.parametrize("device", DEVICES)
def test_the_endoscope_agrees_with_the_rays_of_c_mujoco_at_any_poses(device: str) -> None:
    skip_where_warp_lacks(device)
    scene = sm.load_scene("trimanual_psm_ecm_pegs")
    poses, qpos = anywhere(scene), np.repeat(scene.home[None], POSES, 0)
    endoscope = Endoscope(scene, POSES, device, channels=CHANNELS)
    drawn = endoscope.render(qpos, poses)
    rays = [cast(scene, scene.home, "left", *pose) for pose in zip(poses.origin, poses.quaternion, strict=True)]
    geoms, depths = map(np.array, zip(*rays, strict=True))
    same = drawn.segmentation[:, 0] == geoms
    assert same.mean() > 0.99 and np.abs(drawn.depth[:, 0] - depths)[same].max() < 1e-4
    labels = endoscope.labels[drawn.segmentation]
    for name, place in scene.free_objects.items():
        seen = drawn.rgb[labels == endoscope.label_names.index(name)]
        colour = np.array(place.object.shapes[0].colour)
        assert len(seen) > 100 and seen.mean(0).argmax() == colour.argmax()

    given = Poses(*(torch.from_numpy(part).to(device) for part in vars(poses).values()))
    tensors = endoscope.render(torch.from_numpy(qpos).to(device), given)
    np.testing.assert_array_equal(tensors.rgb.cpu().numpy(), drawn.rgb)
    # without poses, objects are where the scene places them, whatever was drawn before
    placed = mujoco.MjData(scene.model)
    home = Poses(*(np.repeat(part[None], POSES, 0) for part in (placed.mocap_pos, placed.mocap_quat)))
    again = endoscope.render(qpos).segmentation
    assert (again == endoscope.render(qpos, home).segmentation).mean() > 0.999
    assert not np.array_equal(again, drawn.segmentation)


def test_observed_pictures_follow_objects_over_the_end_of_an_episode(env: BatchedEnv) -> None:
    eye = Endoscope(env.scene, ENVS, env.device, channels=CHANNELS)
    found, *_ = env.reset(seed=0)
    first = found["ecm_0"]
    before = first["image"]
    for step in range(2 * STEPS):
        outcome = env.step(STILL)
        seen, final = outcome.observations["ecm_0"], outcome.final_observations["ecm_0"]
        view = eye.render(env.qpos, env.object_poses)
        np.testing.assert_array_equal(seen["image"], view.rgb[:, 0])
        np.testing.assert_array_equal(seen["ecm_0/depth"], view.depth[:, 0, ..., None])
        ended = (step + 1) % STEPS == 0
        assert outcome.truncated.all() == outcome.truncated.any() == ended
        assert np.array_equal(final["image"], seen["image"]) != ended
        assert (final["image"] != before).any()
        if ended:  # the objects are back where they began
            for name in ("image", "ecm_0/depth"):
                np.testing.assert_array_equal(seen[name], first[name])
        before = seen["image"]


def bluest(env: BatchedEnv, picture: np.ndarray, poses: Poses) -> bool:
    """Whether a picture is blue where the ball is."""
    height, width, _ = picture.shape
    view = best_view(env.scene, task_places(env.task), width / height)
    eye, axes = view.pose()
    right, up, back = axes.T @ (poses.origin[0, 1] - eye)
    focal = height / 2 / np.tan(np.radians(view.fovy) / 2)
    row, column = int(height / 2 + focal * up / back), int(width / 2 - focal * right / back)
    red, green, blue = picture[row, column].astype(int)
    return bool(blue > 2 * max(red, green))


def test_films_show_objects_where_they_are(env: BatchedEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    """A control step is half of a picture's time."""
    monkeypatch.setattr(record, "GOAL_RADIUS", 1e-6)
    monkeypatch.setattr(record, "LEAST", 1e-6)
    still = zero_policy(env)
    film: list[Any] = list(record.frames(env, still, episodes=2, seed=0))
    env.reset(seed=0)
    env.autoreset = False
    poses = []
    for step in range(1, 2 * STEPS + 1):
        env.step(STILL)
        if step % 2 == 0:
            poses.append(env.object_poses)
        if step == STEPS:
            env.reset()
    env.autoreset = True
    assert len(film) == len(poses) == STEPS
    assert all(bluest(env, *pair) for pair in zip(film, poses, strict=True))
    np.testing.assert_array_equal(film[0], film[STEPS // 2])  # the next episode begins
    assert not np.array_equal(film[0], film[1])
    assert not bluest(env, film[0], Poses(poses[0].origin + np.array([0, 0, 0.02]), poses[0].quaternion))


def test_poses_of_a_wrong_shape_are_named() -> None:
    scene = sm.load_scene("trimanual_psm_ecm_needle")
    with pytest.raises(ValueError, match=r"objects.origin of shape \(1, 2, 3\) must be \(1, 1, 3\)"):
        Endoscope(scene).render(scene.home[None], Poses(np.zeros((1, 2, 3)), np.zeros((1, 2, 4))))
    skip_where_warp_lacks("cpu")
    bare = sm.load_scene("ecm")
    none = Poses(np.zeros((1, 0, 3)), np.zeros((1, 0, 4)))
    np.testing.assert_array_equal(
        Endoscope(bare).render(bare.home[None], none).rgb, Endoscope(bare).render(bare.home[None]).rgb
    )


@pytest.mark.parametrize("library", ["numpy", "torch"])
def test_the_endoscope_sees_thread_and_tissue_where_their_nodes_are(library: str) -> None:
    """Colours, depth and segmentation of a wound that is lifted by 10 mm, and of a thread beside it."""
    scene = sm.load_scene("trimanual_psm_ecm_suture")
    endoscope = Endoscope(scene, 2, "cpu", channels=CHANNELS)
    needle, wound, thread = scene.objects["needle"], scene.systems["wound"].rest, scene.systems["thread"].path
    lifted = {
        "rigid_bodies.bodies.position": [[needle.position + needle.rotation @ needle.object.center]] * 2,
        "rigid_bodies.bodies.quaternion": [[needle.pose.quaternion]] * 2,
        "wound.nodes.position": wound + np.array([0.0, 0.01])[:, None, None] * [0, 0, 1],
        "thread.chain.position": [thread] * 2,
    }

    class Engine:
        carry_shapes: tuple[str, ...] = ()

        def read(self, part: str, library: str) -> Any:
            values = np.array(lifted[part.removeprefix(".physics.")], np.float32)
            return torch.from_numpy(values) if library == "torch" else values

    engine: Any = Engine()
    own, qpos = FreeObjects(scene), np.repeat(scene.home[None], 2, 0)
    poses, nodes = own.read_drawn(engine, 2, library), own.read_nodes(engine, library)
    seen = endoscope.render(torch.from_numpy(qpos) if library == "torch" else qpos, poses, nodes)
    labels = endoscope.labels[np.asarray(seen.segmentation)]
    for name, pixels in (("wound", 100), ("thread", 4), ("pad", 100)):  # a thread is thin
        assert (labels == endoscope.label_names.index(name)).sum() >= pixels, name
    both = (labels == endoscope.label_names.index("wound")).all(0)
    depth, rgb = np.asarray(seen.depth), np.asarray(seen.rgb)
    nearer = (depth[0] - depth[1])[both]
    assert 0.005 < np.median(nearer) < 0.02
    assert rgb[1][both].mean(0).argmax() == 0  # red
