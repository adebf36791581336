"""Tissue in pictures for agents and people and in the viewer: a smooth surface that follows its nodes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl.scenes.poses import Poses
from surgical_marl.scenes.scene import Scene
from surgical_marl.view.moment import Moment
from surgical_marl.view.render import Renderer, View
from surgical_marl.view.stage import paint, stage
from surgical_marl.vision.cameras import Cameras, find_pictures
from surgical_marl.vision.endoscope import CHANNELS, Endoscope
from surgical_marl.vision.skin import Skin, skins
from tests.helpers.devices import DEVICES, skip_where_warp_lacks

SIZE = 64
UP, ALONG = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return sm.load_scene("psm_suture")


@pytest.fixture(scope="module")
def skin(scene: Scene) -> Skin:
    (found,) = skins(scene.systems, scene.model)
    return found


def middles(skin: Skin) -> np.ndarray:
    return skin.rest[skin.triangles].mean(1)


def test_a_block_at_rest_is_flat_and_has_sharp_edges(skin: Skin) -> None:
    """Its normals point away from the block: up above, down below, and across at the sides and in the slit."""
    normals, level = skin.normals(skin.rest), middles(skin)[:, 2]
    assert np.abs(normals).max(-1) == pytest.approx(1.0)
    above = level > skin.rest[:, 2].max() - 1e-6
    below = level < skin.rest[:, 2].min() + 1e-6
    np.testing.assert_allclose(normals[above], np.broadcast_to(UP, normals[above].shape), atol=1e-9)
    np.testing.assert_allclose(normals[below], np.broadcast_to(-UP, normals[below].shape), atol=1e-9)
    assert not normals[~above & ~below][..., 2].any() and above.sum() == below.sum() > 200


def test_a_bent_block_is_smooth(skin: Skin) -> None:
    """The face above rises along x by a parabola, and its normals lean by the slope there."""
    x = skin.rest[:, 0] - skin.rest[:, 0].mean()
    bent = skin.rest + np.outer(10.0 * x**2, UP)
    above = middles(skin)[:, 2] > skin.rest[:, 2].max() - 1e-6
    inner = above & (np.abs(skin.rest[skin.triangles][..., 0] - skin.rest[:, 0].mean()).max(1) < 0.02)
    slopes = 20.0 * (skin.rest[skin.triangles][inner][..., 0] - skin.rest[:, 0].mean())
    normals = skin.normals(bent)[inner]
    np.testing.assert_allclose(-normals[..., 0] / normals[..., 2], slopes, atol=0.07)


def seen(scene: Scene, skin: Skin, nodes: list[np.ndarray] | None, moved: float = 0.0) -> np.ndarray:
    """Return a picture of the wound from above; its bars are elsewhere by `moved`, m."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    data.mocap_pos[scene.model.body_mocapid[scene.model.geom_bodyid[skin.geoms]], 2] += moved
    mujoco.mj_forward(scene.model, data)
    middle = skin.rest.mean(0)
    view = View(tuple(middle.tolist()), 0.09, 90.0, -60.0)
    drawn = Renderer(scene.model, SIZE, SIZE, stage(scene), paint(scene), [skin])
    return drawn.render(data, view, nodes=nodes).astype(int)


def test_pictures_show_the_surface_and_not_its_bars(scene: Scene, skin: Skin) -> None:
    rest = seen(scene, skin, None)
    np.testing.assert_array_equal(rest, seen(scene, skin, [skin.rest]))
    np.testing.assert_array_equal(rest, seen(scene, skin, None, moved=0.02))
    gone = seen(scene, skin, [skin.rest + 10.0 * ALONG])
    covered = np.abs(rest - gone).sum(-1) > 20
    assert 0.15 < covered.mean() < 0.9
    red = rest[covered]
    assert (red[:, 0] > 1.3 * red[:, 2]).mean() > 0.9
    raised = seen(scene, skin, [skin.rest + 0.01 * UP])
    rows = np.flatnonzero((np.abs(raised - gone).sum(-1) > 20).any(1))
    assert rows[0] < np.flatnonzero(covered.any(1))[0]  # nearer, so farther up in the picture


def test_the_page_moves_the_surface(scene: Scene, skin: Skin) -> None:
    pytest.importorskip("viser", reason="the viewer's page needs viser: pip install 'surgical-marl[view]'")
    from surgical_marl.view.browser.nodes import Nodes
    from surgical_marl.view.browser.server import close_server, open_server

    server, _ = open_server(0)
    try:
        nodes = np.stack([skin.rest, skin.rest + 0.01 * UP])
        session = still(scene, {skin.name: nodes, "thread": np.zeros((2, 40, 3))})
        page: Any = Nodes(server, session)
        handles = page._skins[skin.name]
        for handle, own in zip(handles, nodes, strict=True):
            np.testing.assert_allclose(handle.vertices, own, atol=1e-7)
        bodies = {int(scene.model.geom_bodyid[geom]) for geom in skin.geoms}
        assert not bodies & page._moving.keys() and page._moving
        nodes += 0.02 * ALONG
        page.draw()
        np.testing.assert_allclose(handles[1].vertices, nodes[1], atol=1e-7)
    finally:
        close_server(server)


def still(scene: Scene, nodes: dict[str, np.ndarray]) -> Any:
    """Return what a page reads of a session of two environments that stand still."""
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    twice = [np.repeat(part[None], 2, 0) for part in (data.xpos, data.xquat)]
    count, none = len(scene.agents), np.zeros((2, 0, 3))
    held = np.zeros((2, 1, count), bool)
    moment = Moment(*twice, np.zeros((2, count, 3)), none, held, none, [None] * 2, [[], []], [[], []], nodes)
    task = SimpleNamespace(has_targets=False)
    env = SimpleNamespace(scene=scene, num_envs=2, agents=scene.agents, task=task, max_steps=1, control_dt=0.02)
    return SimpleNamespace(env=env, moment=lambda: moment, steps=0)


@pytest.mark.parametrize("device", DEVICES)
def test_an_endoscope_shows_the_surface(device: str) -> None:
    """Bent in the second environment: where plain rays meet its triangles, nearest, and as smooth as they are."""
    skip_where_warp_lacks(device)
    scene = sm.load_scene("trimanual_psm_ecm_suture")
    (skin,) = skins(scene.systems, scene.model)
    bent = skin.rest + np.outer(8.0 * (skin.rest[:, 0] - skin.rest[:, 0].mean()) ** 2, UP)
    places = np.stack([skin.rest, bent]).astype(np.float32)
    endoscope = Endoscope(scene, 2, device, width=SIZE, height=SIZE, channels=CHANNELS)
    qpos = np.repeat(scene.home[None], 2, 0)
    view = endoscope.render(qpos, nodes={skin.name: places, "thread": np.zeros((2, 40, 3))})
    shown = view.segmentation[:, 0]
    for nodes, geoms, depth in zip(places, shown, view.depth[:, 0], strict=True):
        found = rays_depth(scene, nodes[skin.triangles].astype(float))
        covered = np.isin(geoms, skin.geoms)
        assert covered.mean() > 0.03
        np.testing.assert_allclose(depth[covered], found[covered], atol=1e-5)
        assert (found[~covered] > depth[~covered] - 1e-5).mean() > 0.999
    surfaces = endoscope._caster.surfaces
    normals = np.asarray(surfaces.normals.numpy()).reshape(2, -1, 4, 3)
    for nodes, own in zip(places, normals, strict=True):
        one, other = np.moveaxis(skin.normals(nodes.astype(float)).reshape(-1, 2, 3, 3), 1, 0)
        expected = np.concatenate([one, other[:, -1:]], 1)[np.argsort(skin.owners, kind="stable")]
        np.testing.assert_allclose(own, expected, atol=1e-4)
    still = endoscope.render(qpos)
    np.testing.assert_array_equal(still.rgb[:, 0], np.repeat(view.rgb[:1, 0], 2, 0))


def rays_depth(scene: Scene, triangles: np.ndarray) -> np.ndarray:
    """Return the depth at which the ray of each pixel of the left eye first meets triangles [t, 3, 3]; else inf."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_camlight(scene.model, data)
    camera = data.cam("ecm_0/left")
    scale = 2 * np.tan(np.radians(scene.model.camera("ecm_0/left").fovy[0]) / 2) / SIZE
    rows, columns = np.mgrid[:SIZE, :SIZE].reshape(2, -1) + 0.5
    rays = np.stack([(columns - SIZE / 2) * scale, (SIZE / 2 - rows) * scale, -np.ones(SIZE**2)], 1)
    corners = (triangles - camera.xpos) @ camera.xmat.reshape(3, 3)  # in the camera's frame
    found = np.full(SIZE**2, np.inf)
    for corner in corners:  # x a + y b + z c = t ray, with x, y, z >= 0
        if abs(np.linalg.det(corner)) > 1e-15:
            shares = rays @ np.linalg.inv(corner)
            depth = 1 / np.where(shares.sum(1) == 0, np.inf, shares.sum(1))
            found = np.where((shares >= -1e-9).all(1) & (depth > 0) & (depth < found), depth, found)
    return found.reshape(SIZE, SIZE)


def test_pictures_of_a_data_set_show_the_surface() -> None:
    """As it was in each row of a recording."""
    scene = sm.load_scene("trimanual_psm_ecm_suture")
    (skin,) = skins(scene.systems, scene.model)
    poses = np.zeros((2, scene.model.nmocap, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (2, scene.model.nmocap, 1))
    nodes = np.stack([skin.rest, skin.rest + 0.01 * UP]).astype(np.float32)
    seen = {"qpos": np.repeat(scene.home[None], 2, 0), "origin": poses[0], "quaternion": poses[1], "nodes/wound": nodes}
    cameras = Cameras(scene, find_pictures(("endoscope", "outside_segmentation"), scene), (SIZE, SIZE))
    (drawn,) = cameras.draw(seen)
    wound = cameras.labels.index("wound")
    assert all((found == wound).mean() > 1e-3 for found in drawn["outside_segmentation"])
    assert (drawn["endoscope"][0] != drawn["endoscope"][1]).mean() > 0.01


@pytest.mark.parametrize(
    ("nodes", "words"),
    [
        (None, "come without the nodes of wound: pass env.drawn_nodes"),
        ({}, r"nodes\['wound'\] must be .*there are none"),
        ({"wound": np.zeros((1, 3, 3))}, r"not \(1, 3, 3\)"),
    ],
)
def test_nodes_that_do_not_fit_are_one_sentence(nodes: dict[str, Any] | None, words: str) -> None:
    scene = sm.load_scene("trimanual_psm_ecm_suture")
    count = scene.model.nmocap
    poses = Poses(np.zeros((1, count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (1, count, 1)))
    with pytest.raises(ValueError, match=words):
        Endoscope(scene, width=8, height=8).render(scene.home[None], poses, nodes)
