"""The endoscope's pictures against C MuJoCo's ray caster, and what geometry says about them."""

from __future__ import annotations

from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from surgical_marl import load_scene
from surgical_marl.scenes.scene import Scene
from surgical_marl.vision.endoscope import CHANNELS, EYES, SIZE, Endoscope, View
from tests.helpers.devices import DEVICES, needs_cuda, skip_where_warp_lacks

SCENES = ("ecm", "trimanual_psm_ecm")
POSES = 16
VISIBLE = np.array([1, 1, 1, 0, 0, 0], np.uint8)
Numbers = NDArray[np.float64]


def poses(scene: Scene, count: int = POSES, seed: int = 0) -> Numbers:
    """Home, then postures [count, nq]: half anywhere, half within 0.2 of the range about home, where much is seen."""
    rng = np.random.default_rng(seed)
    q = {}
    for agent, mount in scene.mounts.items():
        arm = mount.arm
        anywhere = rng.uniform(arm.lower, arm.upper, (count, len(arm.home)))
        near = arm.home + 0.2 * (anywhere - arm.home)
        q[agent] = np.where(np.arange(count)[:, None] % 2, anywhere, near)
        q[agent][0] = arm.home
    return scene.full_qpos(q)


@cache
def seen(name: str, device: str = "cpu") -> tuple[Scene, Numbers, View]:
    skip_where_warp_lacks(device)
    scene = load_scene(name)
    qpos = poses(scene)
    return scene, qpos, Endoscope(scene, POSES, device, stereo=True, channels=CHANNELS).render(qpos)


def cast(
    scene: Scene, qpos: Numbers, eye: str, origin: Any = None, quaternion: Any = None
) -> tuple[NDArray[np.int32], Numbers]:
    """Geom and depth of every pixel, [SIZE, SIZE] each, by C MuJoCo: a ray through the middle of each.

    Free objects are at an origin [k, 3] and a quaternion [k, 4], if any are given.
    """
    data = mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    if origin is not None:
        data.mocap_pos[:], data.mocap_quat[:] = origin, quaternion
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_camlight(scene.model, data)
    camera = data.cam(f"ecm_0/{eye}")
    scale = 2 * np.tan(np.radians(scene.model.camera(f"ecm_0/{eye}").fovy[0]) / 2) / SIZE
    rows, columns = np.mgrid[:SIZE, :SIZE].reshape(2, -1) + 0.5
    rays = np.stack([(columns - SIZE / 2) * scale, (SIZE / 2 - rows) * scale, -np.ones(SIZE**2)], axis=1)
    along = 1 / np.linalg.norm(rays, axis=1)
    rays = (rays * along[:, None]) @ camera.xmat.reshape(3, 3).T
    geom, distance = np.empty(SIZE**2, np.int32), np.empty(SIZE**2)
    mujoco.mj_multiRay(scene.model, data, camera.xpos, rays.ravel(), VISIBLE, True, -1, geom, distance, None,
                       SIZE**2, 1e10)  # fmt: skip
    return geom.reshape(SIZE, SIZE), np.where(geom >= 0, distance * along, 0.0).reshape(SIZE, SIZE)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("name", SCENES)
def test_pictures_agree_with_the_rays_of_c_mujoco(name: str, eye: str, device: str) -> None:
    """The same geom in at least 99 % of pixels; where it is the same, depth to 0.1 mm: one is float32, one float64."""
    scene, qpos, view = seen(name, device)
    index = EYES.index(eye)
    geoms, depths = map(np.array, zip(*(cast(scene, q, eye) for q in qpos), strict=True))
    same = view.segmentation[:, index] == geoms
    assert same.mean() > 0.99
    assert np.abs(view.depth[:, index] - depths)[same].max() < 1e-4
    assert len(np.unique(geoms)) > 8  # there is much to see


@pytest.mark.parametrize("name", SCENES)
def test_pictures_are_the_same_each_time_and_differ_from_pose_to_pose(name: str) -> None:
    scene, qpos, view = seen(name)
    again = Endoscope(scene, POSES, stereo=True).render(qpos)
    np.testing.assert_array_equal(again.rgb, view.rgb)
    assert again.depth is None and again.segmentation is None
    near = view.rgb[::2, 0].astype(float)
    apart = [np.abs(one - other).mean() for i, one in enumerate(near) for other in near[:i]]
    assert min(apart) > 2  # grey levels


@pytest.mark.parametrize("name", SCENES)
def test_each_of_many_sees_what_it_sees_alone(name: str) -> None:
    scene, qpos, view = seen(name)
    alone = Endoscope(scene, stereo=True, channels=CHANNELS)
    for i in (0, 3, POSES - 1):
        one = alone.render(qpos[i : i + 1])
        for channel in CHANNELS:
            np.testing.assert_array_equal(getattr(one, channel)[0], getattr(view, channel)[i])


def test_disparity_is_baseline_times_focal_length_over_depth() -> None:
    """A pixel of the left eye, moved by b f / z columns, is in the right eye the same geom at the same depth."""
    scene, _, view = seen("ecm")
    camera = scene.mounts["ecm_0"].arm.camera
    assert camera is not None
    focal = SIZE / 2 / np.tan(np.radians(camera.fovy) / 2)
    depth, geom = view.depth[0], view.segmentation[0]  # at home the tissue lies across the view
    rows, columns = np.nonzero(geom[0] >= 0)
    shifted = np.rint(columns - camera.baseline * focal / depth[0][rows, columns]).astype(int)
    kept = shifted >= 0
    rows, columns, shifted = rows[kept], columns[kept], shifted[kept]
    assert (columns - shifted).min() >= 3
    same = geom[0][rows, columns] == geom[1][rows, shifted]
    assert same.mean() > 0.95  # what one eye sees and the other does not is the rest
    assert np.abs(depth[0][rows, columns] - depth[1][rows, shifted])[same].max() < 4e-3


def test_labels_say_whose_a_pixel_is() -> None:
    scene, _, view = seen("trimanual_psm_ecm")
    endoscope = Endoscope(scene)
    labels = endoscope.labels[view.segmentation]
    assert endoscope.label_names == ("nothing", "tissue", "psm_0", "psm_1", "ecm_0")
    for geom in np.unique(view.segmentation):
        name = "nothing" if geom < 0 else scene.model.geom(int(geom)).name
        body = "world" if geom < 0 else scene.model.body(scene.model.geom_bodyid[geom]).name
        label = endoscope.label_names[labels[view.segmentation == geom][0]]
        assert label == ("nothing" if name == "nothing" else "tissue" if body == "world" else body.split("/")[0])
    assert {1, 2, 3} <= set(np.unique(labels))


def test_torch_in_torch_out_and_any_size() -> None:
    scene, qpos, view = seen("ecm")
    drawn = Endoscope(scene, POSES, stereo=True, channels=CHANNELS).render(torch.from_numpy(qpos))
    for channel in CHANNELS:
        np.testing.assert_array_equal(getattr(drawn, channel).numpy(), getattr(view, channel))
    wide = Endoscope(scene, POSES, width=48, height=32, channels=("rgb", "depth")).render(qpos)
    assert wide.rgb.shape == (POSES, 1, 32, 48, 3) and wide.rgb.dtype == np.uint8
    assert wide.depth.shape == (POSES, 1, 32, 48) and wide.depth.dtype == np.float32


@needs_cuda
@pytest.mark.parametrize("name", SCENES)
def test_a_cuda_graph_draws_what_is_drawn_without_one(name: str) -> None:
    """Captured at home and replayed at other postures."""
    scene, qpos, view = seen(name, "cuda")
    endoscope = Endoscope(scene, POSES, "cuda", stereo=True, channels=CHANNELS)
    wanted = torch.from_numpy(qpos).float().cuda()
    endoscope.render(wanted)  # loads the kernels
    given = torch.from_numpy(scene.home).float().cuda().repeat(POSES, 1)
    torch.cuda.synchronize()
    graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
    with torch.cuda.graph(graph, stream=stream):
        drawn = endoscope.render(given)
    given.copy_(wanted)
    graph.replay()
    for channel in CHANNELS:
        np.testing.assert_array_equal(getattr(drawn, channel).cpu().numpy(), getattr(view, channel))


@needs_cuda
@pytest.mark.parametrize("name", SCENES)
def test_a_gpu_draws_the_colours_that_a_cpu_draws(name: str) -> None:
    """C MuJoCo's rays have none to compare with."""
    (_, _, view), (_, _, drawn) = seen(name), seen(name, "cuda")
    same = drawn.segmentation == view.segmentation
    assert same.mean() > 0.99
    assert (np.abs(drawn.rgb.astype(int) - view.rgb)[same] <= 1).mean() > 0.999


@pytest.mark.parametrize(
    ("scene", "options", "words"),
    [
        ("ecm", {"width": 0}, "width must be a whole number of at least 1, not 0"),
        ("ecm", {"height": 2.5}, "height must be a whole number of at least 1, not 2.5"),
        ("ecm", {"num_envs": 0}, "num_envs must be"),
        ("ecm", {"channels": ("colour",)}, "unknown channel 'colour'"),
        ("ecm", {"device": "tpu"}, "device 'tpu' is not there"),
        ("bimanual_psm", {}, "scene 'bimanual_psm' has no endoscope"),
        ("trimanual_psm_ecm", {"agent": "psm_0"}, "unknown agent with a camera 'psm_0'"),
    ],
)
def test_bad_options_are_one_sentence(scene: str, options: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        Endoscope(load_scene(scene), **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_joint_positions_of_a_wrong_shape_are_named() -> None:
    with pytest.raises(ValueError, match=r"qpos of shape \(2, 4\) must be \(1, 4\)"):
        Endoscope(load_scene("ecm")).render(np.zeros((2, 4)))
