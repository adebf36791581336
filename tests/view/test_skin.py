"""Tissue in pictures for people and in the viewer: a smooth surface that follows its nodes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl.scenes.scene import Scene
from surgical_marl.view.moment import Moment
from surgical_marl.view.render import Renderer, View
from surgical_marl.view.skin import Skin, skins
from surgical_marl.view.stage import paint, stage

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
