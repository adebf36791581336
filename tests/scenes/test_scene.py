"""Scenes: where arms stand, what can touch, and files that are wrong."""

from __future__ import annotations

import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl import list_scenes, load_scene
from surgical_marl.content import content_dir
from surgical_marl.scenes.scene import Scene

BIMANUAL = load_scene("bimanual_psm")
LIVER = "arms: {psm_0: {arm: psm}}\ntissue: {liver: {"


def least_distance(scene: Scene, qpos: np.ndarray) -> float:
    """C MuJoCo's least distance over all contact pairs."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    pairs = zip(scene.model.pair_geom1, scene.model.pair_geom2, strict=True)
    return min(mujoco.mj_geomDistance(scene.model, data, a, b, 10.0, None) for a, b in pairs)


def test_the_remote_centers_stand_as_measured() -> None:
    """0.171 m apart, shafts 68.5 degrees to each other, meeting in front (jhu-daVinci-Si, suj-fixed.json)."""
    one, other = BIMANUAL.mounts.values()
    assert np.linalg.norm(one.position - other.position) == pytest.approx(0.171)
    shafts = [mount.rotation @ mount.arm.forward_kinematics(mount.arm.home)[:3, 2] for mount in (one, other)]
    assert np.degrees(np.arccos(shafts[0] @ shafts[1])) == pytest.approx(68.5)
    ahead = [mount.position + 0.1 * shaft for mount, shaft in zip((one, other), shafts, strict=True)]
    assert np.linalg.norm(ahead[0] - ahead[1]) < 0.171


def test_every_moving_part_can_meet_every_part_of_the_other_arm() -> None:
    model = BIMANUAL.model
    pairs = {
        tuple(model.geom(int(g)).name for g in pair) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True)
    }
    parts = ("shaft", "wrist", "jaw_left", "jaw_right", "column")
    assert len(pairs) == model.npair
    for a in parts:
        for b in parts:
            assert any(x.startswith(f"psm_0/{a}") and y.startswith(f"psm_1/{b}") for x, y in pairs), (a, b)


@pytest.mark.parametrize("name", list_scenes())
def test_home_is_free_and_lies_within_limits(name: str) -> None:
    scene = load_scene(name)
    low, high = scene.model.jnt_range.T
    assert ((scene.home >= low) & (scene.home <= high)).all()
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    mujoco.mj_forward(scene.model, data)
    assert data.ncon == 0
    if len(scene.agents) > 1:
        assert least_distance(scene, scene.home) > 0.02


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(0, 1), min_size=14, max_size=14))
def test_clearance_equals_mujocos_distance(shares: list[float]) -> None:
    arm = BIMANUAL.mounts["psm_0"].arm
    q = arm.lower + np.reshape(shares, (2, 7)) * (arm.upper - arm.lower)
    joints = dict(zip(BIMANUAL.agents, q, strict=True))
    expected = least_distance(BIMANUAL, BIMANUAL.full_qpos(joints))
    clearance = float(BIMANUAL.clearance(joints))
    # where axes cross, MuJoCo's depth is by a rule of its own; before that the two are the same number
    assert clearance == pytest.approx(expected, abs=1e-6) or (clearance < 0 and expected < 0)


def test_a_scene_of_ones_own_is_a_file_anywhere(tmp_path: Path) -> None:
    path = tmp_path / "apart.yaml"
    path.write_text("arms:\n  psm_0: {arm: psm}\n  psm_1: {arm: psm, position: [0.5, 0, 0]}\n")
    scene = load_scene(path)
    assert (scene.name, scene.agents) == ("apart", ("psm_0", "psm_1"))
    assert float(scene.clearance({agent: scene.mounts[agent].arm.home for agent in scene.agents})) > 0.4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[1, 2", "apart.yaml"),
        ("arms: 3", "arms must be a mapping of names to arms, not 3"),
        ("arms: {}", "arms must hold one or more arms"),
        ("arms: {psm_0: {arm: psm}}\nfriction: 1", "'friction'"),
        ("arms: {psm_0: {arm: psn}}", "line 1: arms.psm_0: unknown arm 'psn', did you mean 'psm'"),
        ("arms: {psm_0: {position: [0, 0, 0]}}", "line 1: arms.psm_0 lacks arm"),
        ("arms: {psm_0: {arm: psm, positon: [0, 0, 0]}}", "'positon'"),
        ("arms: {psm_0: {arm: psm, position: [0, 0]}}", "three finite numbers"),
        ("arms: {psm_0: {arm: psm, tilt: [0, .nan, 0]}}", "three finite numbers"),
        ("arms: {left: {arm: psm}}", "called psm_0, psm_1"),
        ("arms: {psm_0: {arm: psm}}\ntissue: [liver]", "must be a mapping"),
        (
            f"{LIVER} shape: cone, size: [1], colour: [1, 0, 0]}}}}",
            "shape must be one of ellipsoid, box, capsule, not 'cone'",
        ),
        (f"{LIVER} shape: box, color: 1}}}}", "unknown key 'color'"),
        (
            f"{LIVER} shape: capsule, size: [0.1, 0.1, 0.1], colour: [1, 0, 0]}}}}",
            "must be radius and half length along z in m",
        ),
        (f"{LIVER} shape: box, size: [0.1, 0, 0.1], colour: [1, 0, 0]}}}}", "size.1 must be a number from 1e-06"),
        (
            f"{LIVER} shape: box, size: [0.1, 0.1, 0.1], colour: [2, 0, 0]}}}}",
            "tissue.liver.colour .* each from 0 to 1, not",
        ),
    ],
)
def test_a_wrong_file_is_one_sentence(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "apart.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=words) as caught:
        load_scene(path)
    assert "\n" not in str(caught.value)


def test_a_change_of_what_a_joint_mimics_changes_the_fingerprint(tmp_path: Path) -> None:
    """Or else target tables and contact pairs of the old arm would come from the cache."""
    folder, path = tmp_path / "psm", tmp_path / "one.yaml"
    shutil.copytree(load_scene("psm").mounts["psm_0"].arm.folder, folder)
    path.write_text("arms: {psm_0: {arm: psm}}")
    before = load_scene(path).fingerprint
    assert load_scene(path).fingerprint == before
    text = (folder / "psm.urdf").read_text()
    assert 'multiplier="1"' in text
    (folder / "psm.urdf").write_text(text.replace('multiplier="1"', 'multiplier="0.5"'))
    assert load_scene(path).fingerprint != before


@pytest.mark.parametrize("name", ["ecm", "trimanual_psm_ecm"])
def test_tissue_is_for_the_eye_alone(name: str, tmp_path: Path) -> None:
    """Without it everything that moves or touches is the same, to the bit, over 100 physics steps."""
    whole = load_scene(name)
    text = (content_dir("scenes") / f"{name}.yaml").read_text()
    (tmp_path / f"{name}.yaml").write_text(text[: text.index("tissue:")])
    bare = load_scene(tmp_path / f"{name}.yaml")
    pieces = [i for i in range(whole.model.ngeom) if whole.model.geom(i).name.startswith("tissue/")]
    assert len(pieces) == whole.model.ngeom - bare.model.ngeom > 5
    assert not whole.model.geom_contype[pieces].any() and not whole.model.geom_conaffinity[pieces].any()
    assert not whole.model.geom_bodyid[pieces].any()
    assert whole.pairs == bare.pairs
    ends = []
    for scene in (whole, bare):
        data = mujoco.MjData(scene.model)
        data.qpos[:] = scene.home
        data.ctrl[:] = np.random.default_rng(0).uniform(*scene.model.actuator_ctrlrange.T)
        mujoco.mj_step(scene.model, data, 100)
        ends.append(np.concatenate([data.qpos, data.qvel, scene.model.body_invweight0.ravel()]))
    np.testing.assert_array_equal(*ends)
