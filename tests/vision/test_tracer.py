"""Every shape that a scene may have, from all sides and from inside: as C MuJoCo's rays and MuJoCo Warp's colours."""

from __future__ import annotations

from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from surgical_marl.runtime import prepare_jax, prepare_warp

prepare_jax()
wp = prepare_warp()
from mujoco.mjx.third_party import mujoco_warp  # noqa: E402

from surgical_marl.vision.raycaster import RayCaster  # noqa: E402

WIDTH, HEIGHT = 44, 36  # no multiple of a tile
RING = 6
SHAPES = """
  <geom name="ball" type="sphere" size="0.05" pos="0.1 0 0" rgba="0.9 0.2 0.2 1"/>
  <geom name="egg" type="ellipsoid" size="0.12 0.05 0.03" pos="-0.1 0.05 0" euler="20 30 40" rgba="0.2 0.9 0.2 1"/>
  <geom name="pill" type="capsule" size="0.02 0.09" pos="0 -0.1 0.05" euler="70 10 0" rgba="0.2 0.2 0.9 1"/>
  <geom name="can" type="cylinder" size="0.04 0.06" pos="0 0.12 -0.05" euler="10 50 0" rgba="0.9 0.9 0.2 1"/>
  <geom name="brick" type="box" size="0.06 0.04 0.02" pos="0 0 0.14" euler="15 25 35" rgba="0.9 0.2 0.9 1"/>
  <geom name="stone" type="mesh" mesh="stone" pos="0 0 -0.14" euler="5 15 25" rgba="0.5 0.6 0.7 1"/>
  <geom name="hidden" type="sphere" size="0.5" group="3"/>
  <geom name="clear" type="sphere" size="0.5" rgba="1 1 1 0"/>
"""


@cache
def model() -> Any:
    """The shapes among cameras that stand around and in them, with meshes and a lamp as in a scene."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3))
    points *= 0.06 / np.linalg.norm(points, axis=1, keepdims=True)
    vertices = " ".join(f"{value:.5f}" for value in points.ravel())
    angles = np.arange(RING) * 2 * np.pi / RING
    places = [*np.stack([0.45 * np.cos(angles), 0.45 * np.sin(angles), 0.3 * np.sin(2 * angles)], axis=1)]
    places += [np.array([-0.1, 0.05, 0.0]), np.array([0.0, 0.12, -0.05]), np.array([0.0, 0.0, -0.14])]
    cameras = "".join(
        f'<body name="to{i}" pos="{0.01 * i} 0 {-0.01 * i}"/>'
        f'<camera pos="{x} {y} {z}" fovy="60" mode="targetbody" target="to{i}"/>'
        for i, (x, y, z) in enumerate(places)
    )
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><mesh name="stone" vertex="{vertices}"/></asset><worldbody>
        <light pos="0.2 0.4 0.9" dir="-0.2 -0.4 -0.9"/>{SHAPES}{cameras}
        <body><freejoint/><geom size="0.01" pos="0 0 3"/></body></worldbody></mujoco>"""
    )


@cache
def drawn() -> tuple[NDArray[Any], ...]:
    cameras = list(range(model().ncam))
    with wp.ScopedDevice("cpu"):
        data = mujoco_warp.make_data(model(), 1)
        tracer = RayCaster(model(), cameras, 1, WIDTH, HEIGHT, (0.05, 0.02, 0.02))
        place(data)
        shape = len(cameras), HEIGHT, WIDTH
        rgb = torch.empty((*shape, 3), dtype=torch.uint8)
        depth, geoms = torch.empty(shape), torch.empty(shape, dtype=torch.int32)
        tracer.draw(data, rgb, depth, geoms)
    return rgb.numpy(), depth.numpy(), geoms.numpy()


def place(data: Any) -> None:
    found = mujoco_warp.put_model(model())
    mujoco_warp.kinematics(found, data)
    mujoco_warp.camlight(found, data)


@pytest.mark.parametrize("camera", range(RING + 3))
def test_every_shape_is_where_c_mujoco_finds_it(camera: int) -> None:
    _, depth, geoms = drawn()
    data = mujoco.MjData(model())
    mujoco.mj_forward(model(), data)
    pixel = 2 * np.tan(np.radians(60) / 2) / HEIGHT
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].reshape(2, -1) + 0.5
    rays = np.stack([(columns - WIDTH / 2) * pixel, (HEIGHT / 2 - rows) * pixel, -np.ones(rows.size)], axis=1)
    along = 1 / np.linalg.norm(rays, axis=1)
    rays = (rays * along[:, None]) @ data.cam_xmat[camera].reshape(3, 3).T
    geom, distance = np.empty(rows.size, np.int32), np.empty(rows.size)
    groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
    mujoco.mj_multiRay(model(), data, data.cam_xpos[camera], rays.ravel(), groups, True, -1, geom, distance, None,
                       rows.size, 1e10)  # fmt: skip
    same = geoms[camera].ravel() == geom
    assert same.mean() > 0.99
    assert np.abs(depth[camera].ravel() - np.where(geom >= 0, distance * along, 0.0))[same].max() < 1e-4
    assert len(np.unique(geom)) > 3 or camera >= RING  # in there it sees what it is in
    assert geom.max() < model().geom("hidden").id


def test_colours_are_those_of_mujoco_warp() -> None:
    """Where both see the same geom, to one of 256 levels."""
    rgb, _, geoms = drawn()
    with wp.ScopedDevice("cpu"):
        data, on_device = mujoco_warp.make_data(model(), 1), mujoco_warp.put_model(model())
        context = mujoco_warp.create_render_context(
            model(), 1, (WIDTH, HEIGHT), render_rgb=True, render_depth=False, render_seg=True, use_textures=False,
            background_color=(0.05, 0.02, 0.02, 1.0), enable_backface_culling=False,
        )  # fmt: skip
        place(data)
        mujoco_warp.refit_bvh(on_device, data, context)
        mujoco_warp.render(on_device, data, context)
    packed = context.rgb_data.numpy().view(np.uint8).reshape(*geoms.shape, 4)[..., 2::-1]
    same = context.seg_data.numpy()[..., 0].reshape(geoms.shape) == geoms
    assert same.mean() > 0.99
    apart = np.abs(packed.astype(int) - rgb)[same]
    assert (apart <= 1).mean() > 0.999 and len(np.unique(rgb)) > 100
    stone = geoms[same] == model().geom("stone").id
    assert stone.any() and (apart[stone] <= 1).mean() > 0.99
