"""STAR against the published kinematics of the KUKA LWR 4+, and against what its README claims."""

from __future__ import annotations

import re
from itertools import combinations

import mujoco
import numpy as np
import pytest
import yourdfpy

from surgical_marl import load_arm
from surgical_marl.robots.spec import build_spec
from surgical_marl.scenes.build import set_physics
from surgical_marl.scenes.timing import TIMESTEP

STAR = load_arm("star")
README = (STAR.folder / "README.md").read_text(encoding="utf-8")
HALF = np.pi / 2
# LWR 4+ of CentroEPiaggio in the standard convention: alpha, d (a is zero throughout); range, velocity, effort
DH = [(HALF, 0.3105), (-HALF, 0), (-HALF, 0.400), (HALF, 0), (HALF, 0.390), (-HALF, 0), (0, 0.078)]
LIMITS = [(170, 110, 176), (120, 110, 176), (170, 128, 100), (120, 128, 100), (170, 204, 100), (120, 184, 38),
          (170, 184, 38)]  # fmt: skip
CHAIN = [*(f"link_{i}" for i in range(1, 8)), "tool_body", "tool_shaft", "needle"]


def published_flange(q: np.ndarray) -> np.ndarray:
    """The flange from the table alone: Rz(theta) Tz(d) Rx(alpha) for each joint."""
    pose = np.eye(4)
    for (alpha, d), theta in zip(DH, q, strict=True):
        ca, sa, ct, stheta = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
        pose = pose @ np.array([[ct, -stheta * ca, stheta * sa, 0], [stheta, ct * ca, -ct * sa, 0],
                                [0, sa, ca, d], [0, 0, 0, 1]])  # fmt: skip
    return pose


def configurations(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(STAR.lower, STAR.upper, (count, len(STAR.actuated)))


def at_home() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The arm alone, as a scene steps it."""
    spec = build_spec(STAR)
    set_physics(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = STAR.home
    mujoco.mj_forward(model, data)
    return model, data


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    return mass


def least_distance(model: mujoco.MjModel, data: mujoco.MjData, one: str, other: str) -> float:
    return mujoco.mj_geomDistance(model, data, model.geom(one).id, model.geom(other).id, 2.0, None)


def test_flange_equals_published_kinematics() -> None:
    q = configurations(1000)
    expected = np.stack([published_flange(row[:7]) for row in q])
    assert np.abs(STAR.link_poses(q, ("flange",))["flange"] - expected).max() < 1e-8


def test_tip_equals_yourdfpy_and_mujoco() -> None:
    urdf = yourdfpy.URDF.load(str(STAR.folder / "star.urdf"), load_meshes=False)
    model, data = at_home()
    names = [joint.name for joint in STAR.actuated]
    for q in configurations(50):
        urdf.update_cfg(dict(zip(names, q, strict=True)))
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        pose = STAR.forward_kinematics(q)
        assert np.abs(urdf.get_transform("tool_tip", "base") - pose).max() < 1e-9
        assert np.abs(data.site("tool_tip").xpos - pose[:3, 3]).max() < 1e-9
        assert np.abs(data.site("tool_tip").xmat.reshape(3, 3) - pose[:3, :3]).max() < 1e-9


def test_tool_lies_on_the_flange_axis_and_only_its_head_turns() -> None:
    q = configurations(20)
    q[:, 7] = 0
    flange, tip = STAR.link_poses(q, ("flange", "tool_tip")).values()
    offset = np.linalg.inv(flange) @ tip
    assert offset == pytest.approx(np.broadcast_to(offset[0], offset.shape))
    assert offset[0, :3, 3] == pytest.approx([0, 0, 0.613]) and offset[0, :3, :3] == pytest.approx(np.eye(3))
    q[:, 7] = 0.5
    bent = np.linalg.inv(flange) @ STAR.forward_kinematics(q)
    assert bent[0, :3, 3] == pytest.approx([0.04725 * np.sin(0.5), 0, 0.613 - 0.04725 * (1 - np.cos(0.5))])


def test_limits_are_the_published_ones() -> None:
    assert [joint.name for joint in STAR.joints] == ["a1", "a2", "e1", "a3", "a4", "a5", "a6", "needle"]
    for joint, (reach, velocity, effort) in zip(STAR.joints, LIMITS, strict=False):
        assert (joint.lower, joint.upper) == pytest.approx((-np.radians(reach), np.radians(reach)))
        assert (joint.velocity, joint.effort) == pytest.approx((np.radians(velocity), effort))
        assert joint.drive.speed <= joint.velocity


def test_mass_is_that_of_the_source_and_the_tool() -> None:
    model, _ = at_home()
    arm = [model.body(name).mass[0] for name in ("base", *CHAIN[:7])]
    assert arm == pytest.approx([1.6, 2.7, 2.7, 2.7, 2.7, 1.7, 1.6, 0.3])
    assert sum(arm) == pytest.approx(16.0)
    assert model.body_mass.sum() == pytest.approx(17.13)


def test_readme_tells_how_each_joint_answers() -> None:
    model, data = at_home()
    inertia = np.diag(mass_matrix(model, data))
    rows = re.findall(r"^\| (\w+) \|((?: [\d.]+[^|]*\|){7})$", README.partition("## Controllers")[2], re.MULTILINE)
    claims = {name: [float(cell.split()[0]) for cell in cells.strip("|").split("|")] for name, cells in rows}
    assert list(claims) == [joint.name for joint in STAR.joints]
    for joint, actual in zip(STAR.joints, inertia, strict=True):
        drive = joint.drive
        frequency = np.sqrt(drive.stiffness / actual)
        ratio = (drive.damping + joint.viscous) / (2 * np.sqrt(drive.stiffness * actual))
        settings = [drive.stiffness, drive.damping, drive.armature]
        assert claims[joint.name] == pytest.approx([*settings, actual, frequency, ratio, drive.speed], rel=6e-3)
        assert 0.7 <= ratio <= 1.2


def test_joints_are_well_damped_together() -> None:
    """Eigenvalues of the closed loop at home, with all couplings of the mass matrix."""
    model, data = at_home()
    inverse = np.linalg.inv(mass_matrix(model, data))
    stiffness = np.diag([joint.drive.stiffness for joint in STAR.joints])
    damping = np.diag([joint.drive.damping + joint.viscous for joint in STAR.joints])
    zero, one = np.zeros_like(inverse), np.eye(len(inverse))
    modes = np.linalg.eigvals(np.block([[zero, one], [-inverse @ stiffness, -inverse @ damping]]))
    assert (-modes.real / np.abs(modes)).min() == pytest.approx(0.86, abs=0.005)  # as the README says


def test_stays_stable_with_efforts_at_their_limits() -> None:
    """Targets that jump anywhere within the limits, twice a second."""
    model, data = at_home()
    rng = np.random.default_rng(0)
    low, high = model.actuator_ctrlrange.T
    saturated = np.zeros(model.nu, dtype=bool)
    for _ in range(10):
        data.ctrl[:] = rng.uniform(low, high)
        for _ in range(round(0.5 / TIMESTEP)):
            mujoco.mj_step(model, data)
            saturated |= np.abs(data.actuator_force) >= 0.999 * model.actuator_forcerange[:, 1]
            assert (data.qpos > low - 0.05 * (high - low)).all() and (data.qpos < high + 0.05 * (high - low)).all()
    assert saturated.all() and not data.warning.number.any()
    data.ctrl[:] = STAR.home
    mujoco.mj_step(model, data, round(3 / TIMESTEP))
    # Coulomb friction holds a joint up to friction / stiffness away; it is a little soft, so the joint creeps
    left = np.array([joint.coulomb / joint.drive.stiffness for joint in STAR.joints])
    assert (np.abs(data.qpos - STAR.home) < 1.01 * left).all() and np.abs(data.qvel).max() < 1e-4


def test_home_is_where_the_readme_says_and_away_from_limits() -> None:
    place = re.search(r"tip stands at \(([-\d., ]+)\) m", README)
    assert place is not None
    tip = STAR.forward_kinematics(STAR.home)
    assert tip[:3, 3] == pytest.approx([float(x) for x in place[1].split(",")], abs=6e-5)
    assert tip[:3, 2] == pytest.approx([0, 0, -1])  # the tool points down
    assert np.minimum(STAR.home - STAR.lower, STAR.upper - STAR.home).min() > np.radians(19.9)
    assert np.linalg.svd(STAR.jacobian(STAR.home), compute_uv=False)[-1] > 0.2


def test_capsules_are_clear_of_each_other() -> None:
    """At home all that are two or more apart in the chain; anywhere, those that only two joints part."""
    model, data = at_home()
    assert [geom for geom in CHAIN if model.geom(geom).group[0] != 3] == []
    for (i, one), (j, other) in combinations(enumerate(CHAIN), 2):
        if j - i > 1:
            assert least_distance(model, data, one, other) > 0.002, (one, other)
    for q in configurations(200):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for one, other in zip(CHAIN, CHAIN[2:], strict=False):
            assert least_distance(model, data, one, other) > 0.002, (one, other)
