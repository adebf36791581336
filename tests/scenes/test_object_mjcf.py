"""Exported scenes with objects: plain MuJoCo steps them, and things come to rest."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.robots.rotation import matrix_of
from surgical_marl.scenes.check import check
from surgical_marl.scenes.mjcf import mjcf
from surgical_marl.scenes.object_contacts import touches
from surgical_marl.scenes.objects import JAW
from surgical_marl.scenes.placing import scenes_without_objects
from surgical_marl.scenes.scene import Scene
from tests.helpers.samples import ARM, SPHERES

WITH_OBJECTS = sorted({*sm.list_scenes()} - {*scenes_without_objects()})


def written(scene: Scene) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(mjcf(scene))


@pytest.mark.parametrize("name", WITH_OBJECTS)
def test_an_exported_scene_begins_at_rest(name: str) -> None:
    """Objects lie where they are: 1 s in plain MuJoCo moves them by less than 0.01 mm, and the arms not at all."""
    scene = sm.load_scene(name)
    model = written(scene)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    free = [body for body, place in scene.objects.items() if place.object.free]
    assert [model.joint(model.njnt - len(free) + i).name for i in range(len(free))] == free
    for body in free:
        place, joint = scene.objects[body], model.joint(body)
        assert joint.type[0] == mujoco.mjtJoint.mjJNT_FREE
        assert model.body(body).mass[0] == pytest.approx(place.object.mass)
        axes = matrix_of(model.body(body).iquat)
        tensor = axes @ np.diag(model.body(body).inertia) @ axes.T
        np.testing.assert_allclose(tensor, place.object.inertia, atol=1e-4 * tensor.max())
        np.testing.assert_allclose(data.joint(body).qpos[:3], place.position)
    before = data.qpos.copy()
    for _ in range(400):
        mujoco.mj_step(model, data)
    moved = data.qpos - before
    held = {entry.body for entry in scene.attachments.values()}  # the file lacks attachments, so these fall
    assert np.abs(moved[: scene.model.nq]).max() < 1e-7 and (held or np.abs(moved).max() < 1e-3)
    for body in {*free} - held:
        start = model.jnt_qposadr[model.joint(body).id]
        assert np.abs(moved[start : start + 3]).max() < 1e-5


def test_arms_move_in_an_exported_scene_as_here() -> None:
    """Gravity does not act on them: small random commands in the air, qpos to 1e-9."""
    scene = sm.load_scene("bimanual_psm_needle")
    pairs = [(model, mujoco.MjData(model)) for model in (scene.model, written(scene))]
    rng, n = np.random.default_rng(0), scene.model.nq
    for model, data in pairs:
        if model.nkey:
            mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[:n] = scene.home
    for step in range(200):
        if step % 25 == 0:
            ctrl = scene.moment @ scene.home + 0.02 * rng.uniform(*scene.model.actuator_ctrlrange.T)
        for model, data in pairs:
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data)
    (_, ours), (_, theirs) = pairs
    assert np.abs(ours.qpos - scene.home).max() > 1e-3
    assert np.abs(ours.qpos - theirs.qpos[:n]).max() < 1e-9


@pytest.mark.parametrize("timestep", [0.0025, 0.0005])
def test_a_dropped_needle_comes_to_rest_on_the_pad(timestep: float) -> None:
    scene = sm.load_scene("bimanual_psm_needle")
    model = written(scene)
    model.opt.timestep = timestep
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    place = data.joint("needle").qpos
    place[:3] += [0.0, 0.0, 0.02]
    place[3:] = np.array([0.95, 0.2, 0.2, 0.1]) / np.linalg.norm([0.95, 0.2, 0.2, 0.1])
    for _ in range(round(3 / timestep)):
        mujoco.mj_step(model, data)
    rest = data.joint("needle").qpos.copy()
    for _ in range(round(0.5 / timestep)):
        mujoco.mj_step(model, data)
    now = data.joint("needle").qpos
    assert np.linalg.norm(now[:3] - rest[:3]) < 1e-4 and abs(now[2] - scene.objects["needle"].position[2]) < 1e-4


def test_a_contact_is_as_stiff_as_asked(tmp_path: Path) -> None:
    """A ball pressed on a plate with 1 N goes in by 1 N over the stiffness of two springs in series."""
    ball = {"free": True, "mass": 0.01, "friction": {"sliding": 1, "torsion": 0}, "stiffness": 3e4,
            "shapes": [{"sphere": {"radius": 0.005}}]}  # fmt: skip
    (tmp_path / "ball.yaml").write_text(yaml.safe_dump(ball))
    path = tmp_path / "pressed.yaml"
    path.write_text("arms: {psm_0: {arm: psm, position: [0, 0, 0.3]}}\nobjects: {plate: {object: pad}, "
                    "ball: {object: ball.yaml, position: [0, 0, 0.005]}}")  # fmt: skip
    model = written(sm.load_scene(path))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.xfrc_applied[model.body("ball").id, 2] = -(1.0 - 0.01 * 9.81)
    for _ in range(800):
        mujoco.mj_step(model, data)
    assert 0.005 - data.joint("ball").qpos[2] == pytest.approx(1 / 3e4 + 1 / 2e4, rel=0.01)


def test_a_light_needle_has_its_full_stiffness_at_a_short_step() -> None:
    """At 2.5 ms a contact with the jaw is softer than asked for, at 0.5 ms and less it is not."""
    found = {}
    for timestep in (0.0025, 0.0005, 0.00025):
        model = mujoco.MjModel.from_xml_string(mjcf(scene := sm.load_scene("psm_needle"), timestep))
        assert model.opt.timestep == timestep
        contact = {model.geom("needle/0").id, model.geom("psm_0/jaw_left_link/pad").id}
        ids = zip(model.pair_geom1, model.pair_geom2, strict=True)
        (pair,) = (number for number, geoms in enumerate(ids) if set(map(int, geoms)) == contact)
        bodies = (model.body_invweight0[model.geom_bodyid[geom], 0] for geom in contact)
        share = 1 - model.pair_solimp[pair, 0]
        found[timestep] = -model.pair_solref[pair, 0] / (share * sum(bodies))
    asked = scene.objects["needle"].object.surface.against(JAW).stiffness
    assert found[0.0005] == pytest.approx(asked, rel=1e-6) and found[0.00025] == pytest.approx(asked, rel=1e-6)
    assert found[0.0025] < 0.2 * asked


def test_a_scene_without_objects_exports_none() -> None:
    text = mjcf(sm.load_scene("bimanual_psm"))
    assert not any(word in text for word in ("freejoint", "gravcomp", "cone", "/pad"))
    assert 'gravity="0.0 0.0 0.0"' in text


def test_a_base_stands_beside_what_is_fixed(tmp_path: Path) -> None:
    """It has no weight in a contact, and neither has a fixed object or another base, so that such two are no pair."""
    shape = '<collision><geometry><sphere radius="0.145"/></geometry></collision>'
    (tmp_path / "two").mkdir()
    (tmp_path / "two/two.urdf").write_text(SPHERES.replace('<link name="base">', f'<link name="base">{shape}'))
    (tmp_path / "two/arm.yaml").write_text(ARM)
    arms = "arms: {two_0: {arm: two}, two_1: {arm: two, position: [0.295, 0, 0]}}\n"
    objects = (
        "objects: {pad: {object: pad, position: [0, 0, -0.14]}, needle: {object: needle_sh, position: [0, 3, 0]}}\n"
    )
    (tmp_path / "scene.yaml").write_text(arms + objects)
    scene = sm.load_scene(tmp_path / "scene.yaml")
    pairs = {frozenset((touch.one, touch.other)) for touch in touches(scene)} | set(map(frozenset, scene.pairs))
    assert frozenset(("two_0/base_0", "needle/0")) in pairs and frozenset(("two_0/lower_1", "pad/0")) in pairs
    assert not any(pair <= {"two_0/base_0", "two_1/base_0", "pad/0"} for pair in pairs)
    assert written(scene).npair == len(pairs)
    assert not any("overlap" in finding for finding in check(tmp_path / "scene.yaml"))
