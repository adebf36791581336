"""The ECM with its three scopes against its published kinematics, against yourdfpy and against MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import yourdfpy
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl import load_arm
from surgical_marl.robots.arm import Arm
from surgical_marl.robots.spec import build_spec
from surgical_marl.scenes.build import set_physics
from surgical_marl.scenes.timing import TIMESTEP
from tests.helpers.rollouts import read_state, roll_out

HALF = np.pi / 2
# dVRK ECM.json, modified (Craig) convention: alpha, a, theta offset, d, slides
DH = [(HALF, 0, HALF, 0, 0), (-HALF, 0, -HALF, 0, 0), (HALF, 0, 0, -0.3822, 1), (0, 0, 0, 0.3829, 0)]
TOOL = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
# dVRK mtsIntuitiveResearchKitECM.cpp: degrees about x of the tip frame
SCOPES = {"ecm": 0.0, "ecm_30_up": -30.0, "ecm_30_down": 30.0}


def published_tip(q: np.ndarray, degrees: float) -> np.ndarray:
    """Tip of the scope from the table alone."""
    pose = np.eye(4)
    for (alpha, a, theta, d, slides), value in zip(DH, q, strict=True):
        theta, d = (theta, d + value) if slides else (theta + value, d)
        ca, sa, ct, stheta = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
        pose = pose @ np.array([[ct, -stheta, 0, a], [stheta * ca, ct * ca, -sa, -sa * d],
                                [stheta * sa, ct * sa, ca, ca * d], [0, 0, 0, 1]])  # fmt: skip
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    pose[:3, :3] = pose[:3, :3] @ TOOL @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return pose


def configurations(arm: Arm, count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(arm.lower, arm.upper, (count, 4))


def state(arm: Arm, q: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A MuJoCo model of the arm at q, under the physics of a scene."""
    spec = build_spec(arm)
    set_physics(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize(("name", "degrees"), SCOPES.items())
def test_tip_equals_published_kinematics(name: str, degrees: float) -> None:
    arm = load_arm(name)
    assert [joint.name for joint in arm.actuated] == ["yaw", "pitch", "insertion", "roll"]
    q = configurations(arm, 1000)
    expected = np.stack([published_tip(row, degrees) for row in q])
    assert np.abs(arm.forward_kinematics(q) - expected).max() < 1e-8


@pytest.mark.parametrize("name", SCOPES)
def test_tip_and_camera_equal_yourdfpy_and_mujoco(name: str) -> None:
    arm = load_arm(name)
    urdf = yourdfpy.URDF.load(str(arm.folder / f"{name}.urdf"), load_meshes=False)
    model, data = state(arm, arm.home)
    for q in configurations(arm, 50):
        urdf.update_cfg(dict(zip([joint.name for joint in arm.actuated], q, strict=True)))
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for link, pose in arm.link_poses(q, ("tool_tip", "camera")).items():
            assert np.abs(urdf.get_transform(link, "remote_center") - pose).max() < 1e-9
            assert np.abs(data.body(link).xpos - pose[:3, 3]).max() < 1e-9
            assert np.abs(data.body(link).xmat.reshape(3, 3) - pose[:3, :3]).max() < 1e-9


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0, 1), min_size=4, max_size=4))
def test_scope_passes_through_the_remote_center(shares: list[float]) -> None:
    arm = load_arm("ecm")
    q = arm.lower + np.array(shares) * (arm.upper - arm.lower)
    assert arm.remote_center_error(q) < 1e-12


@pytest.mark.parametrize(("name", "degrees"), SCOPES.items())
def test_camera_looks_along_the_scope_or_30_degrees_off(name: str, degrees: float) -> None:
    """At zero the tube points along -z of the base, and the picture's top lies towards the arm's own base, -y."""
    arm = load_arm(name)
    poses = arm.link_poses(np.zeros(4), ("camera", "tool_tip"))
    camera, tip = poses["camera"], poses["tool_tip"]
    up = np.radians(-degrees)
    assert -camera[:3, 2] == pytest.approx([0, -np.sin(up), -np.cos(up)], abs=1e-12)
    assert camera[:3, 0] == pytest.approx([-1, 0, 0], abs=1e-12)
    # One view in two conventions: the tip frame has x to the left and z along the view, both y up.
    assert camera[:3, :3] @ np.diag([-1, 1, -1]) == pytest.approx(tip[:3, :3], abs=1e-12)
    assert camera[:3, 3] == pytest.approx(tip[:3, 3], abs=1e-12)


@pytest.mark.parametrize("name", SCOPES)
def test_two_eyes_stand_a_baseline_apart_and_look_the_same_way(name: str) -> None:
    arm = load_arm(name)
    assert arm.camera is not None and arm.jaw is None
    model, data = state(arm, np.array([0.3, 0.2, 0.1, 0.5]))
    left, right = data.camera("left"), data.camera("right")
    axes = arm.link_poses(data.qpos, ("camera",))["camera"][:3, :3]
    # The eyes lie on x of the camera, the right one to the right, and fit into the 12 mm tube.
    assert axes.T @ (right.xpos - left.xpos) == pytest.approx([arm.camera.baseline, 0, 0], abs=1e-12)
    assert 0.004 <= arm.camera.baseline < 0.012
    for eye in (left, right):
        assert eye.xmat.reshape(3, 3) == pytest.approx(axes, abs=1e-12)
    assert np.all(model.cam_fovy == arm.camera.fovy)


def test_limits_and_gains_are_the_published_ones() -> None:
    """dVRK ECM.json, sawControllersPID-ECM.json, and 30 degrees/s and 60 mm/s of the code."""
    joints = load_arm("ecm").actuated
    assert [(joint.lower, joint.upper, joint.effort) for joint in joints] == [
        (-1.5708, 1.5708, 26.93208), (-0.76794, 1.1344, 26.93208), (0, 0.255, 80.6589483), (-1.552, 1.552, 0.87658808),
    ]  # fmt: skip
    gains = [(joint.drive.stiffness, joint.drive.damping) for joint in joints]
    assert gains == [(400, 30), (1000, 80), (10000, 1200), (20, 0.5)]
    speed = np.radians(30)
    assert [joint.velocity for joint in joints] == pytest.approx([speed, speed, 0.06, speed], rel=1e-6)
    assert [joint.drive.speed for joint in joints] == [joint.velocity for joint in joints]


def test_friction_has_the_psm_s_share_of_the_effort() -> None:
    for ours, measured in zip(load_arm("ecm").actuated, load_arm("psm").actuated, strict=False):
        assert ours.coulomb / ours.effort == pytest.approx(measured.coulomb / measured.effort, rel=2e-3)
        assert ours.viscous / ours.effort == pytest.approx(measured.viscous / measured.effort, rel=2e-3)


def test_joints_are_as_stiff_and_as_damped_as_the_readme_says() -> None:
    """Inertia at home, natural frequency and damping ratio under the dVRK's gains, friction left out."""
    arm = load_arm("ecm")
    model, data = state(arm, arm.home)
    mass = np.zeros((4, 4))
    mujoco.mj_fullM(model, data, mass)
    inertia = np.diag(mass)
    stiffness = np.array([joint.drive.stiffness for joint in arm.actuated])
    damping = np.array([joint.drive.damping for joint in arm.actuated])
    assert inertia == pytest.approx([0.957, 0.956, 9.28, 0.00319], rel=0.005)
    assert np.sqrt(stiffness / inertia) == pytest.approx([20.4, 32.3, 32.8, 79.1], rel=0.005)
    assert damping / 2 / np.sqrt(stiffness * inertia) == pytest.approx([0.77, 1.29, 1.97, 0.99], rel=0.01)


def test_step_response_settles_without_ringing() -> None:
    """From home to a near target within 2 s: no joint overshoots by more than a tenth, all stop where they should."""
    arm = load_arm("ecm")
    model, data = state(arm, arm.home)
    step = np.array([0.02, 0.02, 0.002, 0.02])
    targets = np.tile(arm.home + step, (1, round(2 / TIMESTEP), 1))
    _, qpos, _ = roll_out(model, data, read_state(model, data)[None], targets)
    path = (qpos[0] - arm.home) / step
    assert np.all(path.max(0) < 1.1)
    # Coulomb friction leaves an error: less than friction / stiffness.
    left = np.array([joint.coulomb / joint.drive.stiffness for joint in arm.actuated])
    assert np.all(np.abs(1 - path[-1]) * step <= 1.01 * left)


def test_column_stays_clear_of_scope_and_head() -> None:
    """The scope slides along the column and turns beside it; a contact there would be an error of ours."""
    arm = load_arm("ecm")
    model, data = state(arm, arm.home)
    names = {model.geom(int(i)).name for i in np.flatnonzero(model.geom_group == 3)}
    assert names == {"column", "shaft", "camera_head"}
    column = model.geom("column").id
    for q in configurations(arm, 200):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for other in ("shaft", "camera_head"):
            assert mujoco.mj_geomDistance(model, data, column, model.geom(other).id, 1.0, None) > 0.01
    assert all(len(link.visuals) <= 12 for link in arm.urdf.links)
