"""A scene written as MJCF steps in plain MuJoCo as it does here."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from surgical_marl import load_scene
from surgical_marl.cli.main import main
from surgical_marl.robots.drives import CONTROL_MODES
from surgical_marl.robots.spec import COLLISION_GROUP
from surgical_marl.scenes.mjcf import mjcf
from surgical_marl.scenes.placing import scenes_without_objects
from surgical_marl.scenes.scene import Scene

STEPS = 500
FREE = scenes_without_objects()
"""`tests/scenes/test_object_mjcf.py` has the others."""
CROSSED = {"bimanual_psm": [0.03, 0.02, 0.16], "trimanual_psm_ecm": [0.03, 0.02, 0.16]}
"""First joints of psm_0, at which it touches psm_1 with its own turned the other way."""


def written(scene: Scene) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(mjcf(scene))


def start(scene: Scene) -> np.ndarray:
    """`qpos` at home; two PSMs that are crossed instead."""
    q = {agent: mount.arm.home for agent, mount in scene.mounts.items()}
    if scene.name in CROSSED:
        yaw, pitch, insertion = CROSSED[scene.name]
        q["psm_0"][:3], q["psm_1"][:3] = (yaw, pitch, insertion), (-yaw, 0.0, insertion)
    return scene.full_qpos(q)


@pytest.mark.parametrize("control", CONTROL_MODES)
@pytest.mark.parametrize("name", FREE)
def test_it_steps_as_the_scene_does(name: str, control: str) -> None:
    """500 steps of random commands, qpos to 1e-9; with crossed arms they begin in contact."""
    scene = load_scene(name, control)
    pairs = [(model, mujoco.MjData(model)) for model in (scene.model, written(scene))]
    rng, touched = np.random.default_rng(0), 0
    low, high = scene.model.actuator_ctrlrange.T
    for _, data in pairs:
        data.qpos[:] = start(scene)
    for step in range(STEPS):
        if step % 25 == 0:
            ctrl = rng.uniform(low, high)
            if control == "position" and name in CROSSED and step < 250:  # pressed against each other
                ctrl = scene.moment @ start(scene) + 0.02 * rng.uniform(low, high)
        for model, data in pairs:
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data)
        (_, ours), (_, theirs) = pairs
        assert np.abs(ours.qpos - theirs.qpos).max() < 1e-9
        touched += ours.ncon
    if control == "position" and name in CROSSED:
        assert touched > 50


@pytest.mark.parametrize("name", FREE)
def test_it_is_the_same_model(name: str) -> None:
    scene = load_scene(name)
    ours, theirs = scene.model, written(scene)
    for count in ("nq", "nv", "nu", "njnt", "ngeom", "nsite", "ncam", "nlight", "npair", "ntendon", "nmesh"):
        assert getattr(ours, count) == getattr(theirs, count)
    for field in dir(ours.opt):
        if not field.startswith("_"):
            assert np.array_equal(getattr(ours.opt, field), getattr(theirs.opt, field)), field
    for part, count in (("joint", ours.njnt), ("actuator", ours.nu), ("site", ours.nsite), ("camera", ours.ncam)):
        assert [getattr(ours, part)(i).name for i in range(count)] == [
            getattr(theirs, part)(i).name for i in range(count)
        ]
    for geom in np.flatnonzero(ours.geom_group == COLLISION_GROUP):
        other = theirs.geom(ours.geom(geom).name).id
        weights = (m.body_invweight0[m.geom_bodyid[i], 0] for m, i in ((ours, geom), (theirs, other)))
        assert next(weights) == pytest.approx(next(weights), rel=1e-12)


@pytest.mark.parametrize("control", CONTROL_MODES)
def test_it_begins_at_home(control: str) -> None:
    scene = load_scene("psm", control)
    model = written(scene)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_step(model, data, 100)
    np.testing.assert_allclose(data.qpos, scene.home, atol=1e-12)


def test_the_command_writes_a_file_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", "scene", "psm", "--format", "mjcf", "--control", "torque"]) == 0
    assert capsys.readouterr().out == "psm.xml\n"
    assert Path("psm.xml").read_text() == mjcf(load_scene("psm", "torque"))
    assert main(["export", "scene", "psm"]) == 2
    assert "psm.xml exists already: name another file with --out" in capsys.readouterr().err
    assert main(["export", "scene", "psm", "--out", "other.xml"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other.xml", "psm.xml"]
