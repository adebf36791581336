"""Files of threads: what they may say, how a thread begins, what its ends are tied to, and where pictures have it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.physics.systems.system import Tie
from surgical_marl.scenes.mjcf import mjcf
from surgical_marl.scenes.poses import along

GOOD: dict[str, Any] = {
    "kind": "thread", "length": 0.1, "diameter": 2e-4, "material": "silk", "friction": {"sliding": 0.3, "torsion": 0.0}
}  # fmt: skip


def thread_file(folder: Path, **settings: Any) -> Path:
    path = folder / "suture.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in (GOOD | settings).items() if value is not None}))
    return path


def scene_with(folder: Path, entry: dict[str, Any], **settings: Any) -> Any:
    arms = {"psm_0": {"arm": "psm", "position": [0.0, 0.0, 0.15], "workspace": [0.0, 0.0, -0.11]}}
    thread = {"object": str(thread_file(folder, **settings))} | entry
    objects = {"needle": {"object": "needle_sh", "position": [0.1, 0.0, 0.1]}, "thread": thread}
    path = folder / "with_thread.yaml"
    path.write_text(yaml.safe_dump({"arms": arms, "objects": objects}))
    return sm.load_scene(path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "rope"}, "kind must be thread"),
        ({"length": 5.0}, r"length must be a number from 0\.001 to 2 \(m\), not 5"),
        ({"length": None}, "lacks length"),
        ({"nodes": 2}, "nodes must be a whole number from 3 to 200, not 2"),
        ({"nodes": 200, "length": 0.02}, "nodes must be at most 101, so that edges are longer than thick, not 200"),
        ({"material": "wool"}, "material must be one of nylon, silk, not 'wool'"),
        ({"material": None}, "needs its material"),
        ({"material": None, "young": 1e9}, "needs its material"),
        ({"density": 1000.0}, "a thread of silk has its density from there"),
        ({"strength": 0.0}, r"strength must be a number from 0\.001 to 1,000 \(N\), not 0"),
        ({"coil": {"radius": 0.002, "pitch": 0.001}}, "a coil of this radius and pitch holds"),
        ({"coil": {"pitch": 0.00015}}, "must be at least the diameter"),
        ({"knots": 1}, "unknown key 'knots'"),
    ],
)
def test_a_bad_value_is_one_sentence(tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        sm.load_object(thread_file(tmp_path, **settings))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("tied", "message"),
    [({"first": "nothing"}, "choose from world, needle"), ({"second": "world"}, "unknown key 'second'")],
)
def test_a_bad_tie_is_one_sentence(tmp_path: Path, tied: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        scene_with(tmp_path, {"tied": tied})


def test_what_is_no_thread_is_not_tied(tmp_path: Path) -> None:
    path = tmp_path / "tied_block.yaml"
    arms = {"psm_0": {"arm": "psm", "position": [0.0, 0.0, 0.15], "workspace": [0.0, 0.0, -0.11]}}
    path.write_text(yaml.safe_dump({"arms": arms, "objects": {"one": {"object": "block", "tied": {"first": "world"}}}}))
    with pytest.raises(ValueError, match="only the ends of a thread are tied, and block is none"):
        sm.load_scene(path)


@pytest.mark.parametrize("coil", [None, {"radius": 0.012, "pitch": 0.001}])
def test_edges_begin_unstretched(tmp_path: Path, coil: dict[str, float] | None) -> None:
    thread = scene_with(tmp_path, {"position": [0.0, 0.1, 0.2], "tilt": [0.0, 0.0, 90.0]}, coil=coil).systems["thread"]
    path = np.array(thread.path)
    np.testing.assert_allclose(path[0], [0.0, 0.1, 0.2], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(np.diff(path, axis=0), axis=1), thread.rod.length, rtol=1e-9)
    if not coil:
        np.testing.assert_allclose(path[-1], [0.0, 0.2, 0.2], atol=1e-12)


def test_an_end_is_tied_to_the_tail_of_a_needle_or_to_where_it_is(tmp_path: Path) -> None:
    scene = scene_with(tmp_path, {"position": [0.0, 0.0, 0.1], "tied": {"first": "needle", "last": "world"}})
    first, last = scene.systems["thread"].ties
    assert first == Tie(0, 0.0, "needle", tuple(scene.objects["needle"].object.sites["tail"][0].tolist()))
    assert (last.part, last.share, last.body) == (38, 1.0, None)
    np.testing.assert_allclose(last.place, [0.1, 0.0, 0.1])


def test_a_scene_paints_it(tmp_path: Path) -> None:
    scene = scene_with(tmp_path, {"position": [0.0, 0.0, 0.1], "colour": [1.0, 0.5, 0.25]})
    geom = scene.model.body("thread/3").geomadr[0]
    np.testing.assert_allclose(scene.model.geom_rgba[geom], [1.0, 0.5, 0.25, 1.0])


def test_mass_and_stiffness_are_those_of_its_material() -> None:
    item, thread = sm.load_object("thread_3_0"), sm.load_scene("bimanual_psm_thread_alone").systems["thread"]
    area = np.pi * 0.00011**2
    np.testing.assert_allclose([item.mass, thread.rod.mass.sum()], 1140 * area * 0.1, rtol=1e-6)
    np.testing.assert_allclose([thread.rod.axial, thread.rod.bending], [2e9 * area, 2e9 * area * 0.00011**2 / 4])


def test_pictures_have_a_capsule_for_each_edge_and_mjcf_has_none() -> None:
    scene = sm.load_scene("bimanual_psm_thread_alone")
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    path = np.array(scene.systems["thread"].path)
    for number in range(len(path) - 1):
        body = scene.model.body(f"thread/{number}")
        geom = scene.model.geom(body.geomadr[0])
        np.testing.assert_allclose(data.xpos[body.id], path[number : number + 2].mean(0), atol=1e-9)
        end = data.xpos[body.id] + geom.size[1] * data.xmat[body.id].reshape(3, 3)[:, 2]
        np.testing.assert_allclose(end, path[number + 1], atol=1e-9)


def test_an_exported_scene_says_what_it_lacks() -> None:
    text = mjcf(sm.load_scene("bimanual_star_suture"))
    assert "<!-- left out: wound (tissue), thread (thread), grip (attachment) -->" in text
    assert "thread/" not in text and "wound/" not in text
    assert "left out" not in mjcf(sm.load_scene("bimanual_psm_needle"))


def test_a_line_turns_z_along_itself() -> None:
    ways = np.concatenate([np.random.default_rng(0).normal(0, 1, (50, 3)), np.eye(3), -np.eye(3)])
    middle, turn = along(np.zeros_like(ways), ways)
    np.testing.assert_allclose(middle, ways / 2)
    for way, quaternion in zip(ways, turn, strict=True):
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, quaternion)
        np.testing.assert_allclose(axes.reshape(3, 3)[:, 2], way / np.linalg.norm(way), atol=1e-6)
