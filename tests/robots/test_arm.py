"""The PSMs, Classic and Si, against their published numbers, against yourdfpy and against MuJoCo."""

from __future__ import annotations

import runpy
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yourdfpy
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl import list_arms, load_arm
from surgical_marl.robots.arm import Arm
from surgical_marl.robots.spec import GEAR, build_spec
from surgical_marl.scenes.timing import TIMESTEP
from tests.helpers import ROOT

PSM = load_arm("psm")
HALF = np.pi / 2
# d3 and d4 of the DH tables: dVRK PSM.json with LARGE_NEEDLE_DRIVER_400006.json, PSM_Si.json with ..._420006.json
LENGTHS = {"psm": (-0.4318, 0.4162), "psm_si": (-0.4826, 0.4670)}
TIP = np.array([[0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])


def published_tip(name: str, q: np.ndarray) -> np.ndarray:
    """Tool tip from the table alone, moved to the jaw control point 10.2 mm past the wrist yaw axis."""
    offset, shaft = LENGTHS[name]
    # modified (Craig) convention: alpha, a, theta offset, d, slides
    table = [(HALF, 0, HALF, 0, 0), (-HALF, 0, -HALF, 0, 0), (HALF, 0, 0, offset, 1),
             (0, 0, 0, shaft, 0), (-HALF, 0, -HALF, 0, 0), (-HALF, 0.0091, -HALF, 0, 0)]  # fmt: skip
    pose = np.eye(4)
    for (alpha, a, theta, d, slides), value in zip(table, q, strict=True):
        theta, d = (theta, d + value) if slides else (theta + value, d)
        ca, sa, ct, stheta = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
        pose = pose @ np.array([[ct, -stheta, 0, a], [stheta * ca, ct * ca, -sa, -sa * d],
                                [stheta * sa, ct * sa, ca, ca * d], [0, 0, 0, 1]])  # fmt: skip
    pose = pose @ TIP
    pose[:3, 3] += 0.0102 * pose[:3, 2]
    return pose


def configurations(count: int, arm: Arm = PSM) -> np.ndarray:
    return np.random.default_rng(0).uniform(arm.lower, arm.upper, (count, len(arm.actuated)))


@pytest.mark.parametrize("name", LENGTHS)
def test_tip_equals_published_kinematics(name: str) -> None:
    arm = load_arm(name)
    q = configurations(1000, arm)
    expected = np.stack([published_tip(name, row[:6]) for row in q])
    assert np.abs(arm.forward_kinematics(q) - expected).max() < 1e-12


@pytest.mark.parametrize("name", LENGTHS)
def test_tip_equals_yourdfpy_and_mujoco(name: str) -> None:
    arm = load_arm(name)
    urdf = yourdfpy.URDF.load(str(arm.folder / f"{name}.urdf"), load_meshes=False)
    model = build_spec(arm).compile()
    data = mujoco.MjData(model)
    names = [joint.name for joint in arm.actuated]
    for q in configurations(50, arm):
        urdf.update_cfg(dict(zip(names, q, strict=True)))
        for name, value in zip(names, q, strict=True):
            data.joint(name).qpos = value
        mujoco.mj_kinematics(model, data)
        pose = arm.forward_kinematics(q)
        assert np.abs(urdf.get_transform("tool_tip", "remote_center") - pose).max() < 1e-9
        assert np.abs(data.site("tool_tip").xpos - pose[:3, 3]).max() < 1e-9


@pytest.mark.parametrize("name", LENGTHS)
@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0, 1), min_size=7, max_size=7))
def test_shaft_passes_through_the_remote_center(name: str, shares: list[float]) -> None:
    """The remote center is on the shaft's axis wherever the arm is."""
    arm = load_arm(name)
    q = arm.lower + np.array(shares) * (arm.upper - arm.lower)
    assert arm.remote_center_error(q) < 1e-12


# dVRK PSM.json, PSM_Si.json, the tools' files and pid/; wrist and jaw are the same tool but for the motor's D.
TOOL = [(-4.53786, 4.53786, 0.22), (-1.39626, 1.39626, 0.25), (-1.39626, 1.39626, 0.20), (0, 0.69813, 0.16)]
LIMITS = {
    "psm": [(-1.588, 1.588, 3.316101), (-0.925025, 0.925025, 3.316101), (0, 0.24, 9.877926), *TOOL],
    "psm_si": [(-2.964, 2.964, 17.0845), (-1.265, 1.301, 17.0845), (0, 0.29, 40.9063), *TOOL],
}
GAINS = {"psm": [(120, 6), (120, 5), (6000, 200)], "psm_si": [(600, 30), (600, 30), (6000, 200)]}
DISC_GAINS = {"psm": (6, 0.09), "psm_si": (6, 0.08)}
COUPLING = [[-1.5632, 0, 0, 0], [0, 1.0186, 0, 0], [0, -0.8306, 0.6089, 0.6089], [0, 0, -1.2177, 1.2177]]
SHARE = np.linalg.inv(COUPLING).T @ np.linalg.inv(COUPLING)
"""A^-T A^-1: what equal motor discs are at roll, wrist pitch, wrist yaw and jaw."""
DISC_INERTIA = {"psm": 3.3e-6 * 11.71**2, "psm_si": 3.3e-6 * 13.813**2}


@pytest.mark.parametrize("name", LENGTHS)
def test_limits_gains_and_friction_are_the_published_ones(name: str) -> None:
    """Wrist gains are the motor discs' through the cable coupling, a finger's twice the jaw's, and so its friction."""
    joints = load_arm(name).actuated
    margins = [joint.drive.margin for joint in joints]
    assert margins == [0] * 6 + [0.02]
    limits = [(joint.lower - m, joint.upper + m, joint.effort) for joint, m in zip(joints, margins, strict=True)]
    np.testing.assert_allclose(limits, LIMITS[name], rtol=0, atol=1e-15)
    assert [(joint.drive.stiffness, joint.drive.damping) for joint in joints[:3]] == GAINS[name]
    cables = {joint.name: load_arm(name).cables if "wrist" in joint.name else () for joint in joints}
    for joint, part in zip(joints[3:], np.diag(SHARE) * [1, 1, 1, 2], strict=True):
        stiffness, damping = np.array(DISC_GAINS[name]) * part
        drives = [joint.drive, *cables[joint.name]]
        assert sum(drive.stiffness for drive in drives) == pytest.approx(stiffness, rel=2e-3)
        assert sum(drive.damping for drive in drives) == pytest.approx(damping, rel=2e-2)
    assert [joint.coulomb for joint in joints] == [0.05, 0.0668, 0.4476, 0.00247, 0.0070, 0.0008, 2 * 0.0022]
    assert [joint.viscous for joint in joints] == [0.0905, 0.2181, 1.2036, 0.00111, 0.0122, 0.0020, 2 * 0.0022]


@pytest.mark.parametrize("name", LENGTHS)
def test_the_wrist_feels_its_motors_through_the_cables(name: str) -> None:
    """Stiffness and damping at roll, wrist pitch and wrist yaw, as differences of C MuJoCo's actuator forces, and the
    mass matrix, all with the entry that pitch and yaw share."""
    model = build_spec(load_arm(name)).compile()
    data = mujoco.MjData(model)
    dofs = [int(model.joint(joint).dofadr[0]) for joint in ("roll", "wrist_pitch", "wrist_yaw")]

    def force(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        data.qpos[dofs], data.qvel[dofs] = qpos, qvel
        mujoco.mj_forward(model, data)
        return data.qfrc_actuator[dofs].copy()

    small, still = 1e-4 * np.eye(3), np.zeros(3)
    stiffness, damping = DISC_GAINS[name]
    matrices = [
        (stiffness, np.array([force(-step, still) for step in small]) / 1e-4),
        (damping, np.array([force(still, -step) for step in small]) / 1e-4),
    ]
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    matrices.append((DISC_INERTIA[name], mass[np.ix_(dofs, dofs)]))
    for scale, matrix in matrices:
        assert np.abs(matrix - scale * SHARE[:3, :3]).max() < 0.01 * scale * SHARE.max()
        assert matrix[1, 2] == pytest.approx(scale * SHARE[1, 2], rel=0.01)


@pytest.mark.parametrize("name", LENGTHS)
def test_a_wrist_joint_never_carries_more_than_its_effort(name: str) -> None:
    """Its own actuator and the cable's together, though each alone may put as much on it."""
    arm = load_arm(name)
    model = build_spec(arm).compile()
    data = mujoco.MjData(model)
    for pitch, yaw in ((1, 1), (-1, -0.1), (-0.1, -1)):
        for joint, sign in (("wrist_pitch", pitch), ("wrist_yaw", yaw)):
            data.actuator(joint).ctrl = sign
        data.actuator("cable_0").ctrl = pitch + yaw
        mujoco.mj_forward(model, data)
        carried = [data.joint(joint).qfrc_actuator[0] for joint in ("wrist_pitch", "wrist_yaw")]
        assert carried == pytest.approx([0.25 * np.sign(pitch), 0.20 * np.sign(yaw)], rel=1e-9)


@pytest.mark.parametrize("name", LENGTHS)
def test_fingers_that_close_on_something_do_not_swing_aside(name: str) -> None:
    """Both press at full effort and are held open, so their drives are at their limits. A torque pushes them sideways:
    the gear between them gives way as its stiffness says, where nothing but friction would hold them without it."""
    arm, push = load_arm(name), 0.01
    spec = build_spec(arm)
    spec.option.integrator, spec.option.timestep = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, TIMESTEP
    model = spec.compile()
    data, fingers = mujoco.MjData(model), [model.joint(joint).id for joint in ("jaw_left", "jaw_right")]
    model.dof_frictionloss[:], model.dof_damping[fingers] = 0, 0.1  # so that they come to rest where forces balance
    data.qpos[fingers] = 0.2
    data.ctrl[:] = data.qpos[model.actuator_trnid[:, 0]] * (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
    effort = model.jnt_actfrcrange[fingers, 1]
    data.ctrl[[model.actuator(joint).id for joint in ("jaw_left", "jaw_right")]] = 0.02
    data.qfrc_applied[fingers] = effort + np.array([push, -push])
    for _ in range(400):
        mujoco.mj_step(model, data)
    assert data.qfrc_actuator[fingers] == pytest.approx(-effort), "they do not press at full effort"
    left, right = data.qpos[fingers]
    assert (left - right) / 2 == pytest.approx(push / (2 * GEAR * arm.actuated[-1].drive.stiffness), rel=1e-3)


@pytest.mark.parametrize("name", LENGTHS)
def test_shaft_is_drawn_whole_and_clear_of_the_column(name: str) -> None:
    """The tube reaches d4 above the wrist; column, carriage, shaft, wrist and both fingers are there to collide."""
    arm = load_arm(name)
    tube = next(link for link in arm.urdf.links if link.name == "roll_link").visuals[0]
    low, high = tube.origin[2][3] + np.array([-0.5, 0.5]) * tube.size[1]
    assert low == pytest.approx(0) and high == pytest.approx(LENGTHS[name][1])
    assert all(len(link.visuals) <= 12 for link in arm.urdf.links)
    model = build_spec(arm).compile()
    names = {model.geom(int(i)).name for i in np.flatnonzero(model.geom_group == 3)}
    assert names == {"column", "carriage", "shaft", "wrist", "jaw_left", "jaw_right"}
    # The column stands beside the shaft on the side of the base, -y, and never so near that the two could be a pair.
    column, shaft = model.geom("column"), model.geom("shaft")
    assert 0.01 < -column.pos[1] - column.size[0] - shaft.size[0] < 0.03


def test_jacobian_equals_differences() -> None:
    step = 1e-6
    for q in configurations(10):
        jacobian = PSM.jacobian(q)
        pose = PSM.forward_kinematics(q)
        for i in range(len(q)):
            moved = q.copy()
            moved[i] += step
            other = PSM.forward_kinematics(moved)
            assert np.abs((other - pose)[:3, 3] / step - jacobian[:3, i]).max() < 1e-5
            spin = (other[:3, :3] @ pose[:3, :3].T - np.eye(3)) / step
            assert np.abs([spin[2, 1], spin[0, 2], spin[1, 0]] - jacobian[3:, i]).max() < 1e-5


def test_kinematics_in_jax_and_without_the_jaw() -> None:
    import jax.numpy as jnp

    q = configurations(8).reshape(2, 4, 7)
    assert (
        np.abs(np.asarray(PSM.forward_kinematics(jnp.asarray(q, jnp.float32))) - PSM.forward_kinematics(q)).max() < 1e-5
    )
    assert np.array_equal(PSM.forward_kinematics(q[..., :6]), PSM.forward_kinematics(q))
    with pytest.raises(ValueError, match="does not fit arm 'psm'"):
        PSM.forward_kinematics(q[..., :5])


def test_inertia_is_that_of_the_identified_arm() -> None:
    """M11 and M22 of the identified Classic PSM at several poses (within 5 %), and its insertion mass (within 2 %)."""
    model = build_spec(PSM).compile()
    data = mujoco.MjData(model)
    for pitch, insertion, yaw_inertia, pitch_inertia in [
        (0, 0.07, 0.226, 0.224), (0, 0.12, 0.210, 0.208), (0, 0.20, 0.192, 0.190),
        (0.5, 0.12, 0.203, 0.208), (-0.5, 0.12, 0.139, 0.208),
    ]:  # fmt: skip
        data.joint("pitch").qpos, data.joint("insertion").qpos = pitch, insertion
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        assert mass[0, 0] == pytest.approx(yaw_inertia, rel=0.05)
        assert mass[1, 1] == pytest.approx(pitch_inertia, rel=0.05)
        assert mass[2, 2] == pytest.approx(0.713, rel=0.02)


@pytest.mark.parametrize("name", list_arms())
def test_jaw_fingers_open_together_and_meet_at_the_tip(name: str) -> None:
    arm = load_arm(name)
    if arm.jaw is None:
        return
    fingers = [joint for joint in arm.joints if joint.leader == arm.jaw.joint]
    assert len(fingers) == 2
    poses = [arm.link_poses(np.array([*arm.home[:-1], arm.jaw.open]), (f"{finger.name}_link",)) for finger in fingers]
    left, right = (next(iter(pose.values()))[:3, :3] @ [0, 0, -0.0106] for pose in poses)
    assert left[0] == pytest.approx(-right[0]) and left[0] < -0.004


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<robot", "<robot <", "not a URDF"),
        ('<mimic joint="jaw_left"', '<mimic joint="nothing"', "'nothing', which is not a moving joint"),
        ('<limit lower="0" upper="0.24" velocity="0.2" effort="9.877926" />', "", "'insertion' needs a limit"),
        ('lower="0" upper="0.24"', 'lower="0.3" upper="0.24"', "not below upper"),
        ('name="tool_tip"', 'name="tip"', "tool_tip 'tool_tip' is not a link"),
    ],
)  # fmt: skip
def test_bad_urdf_is_one_sentence(tmp_path: Path, old: str, new: str, words: str) -> None:
    folder = tmp_path / "psm"
    shutil.copytree(PSM.folder, folder)
    text = (folder / "psm.urdf").read_text()
    assert old in text
    (folder / "psm.urdf").write_text(text.replace(old, new).replace('link="tool_tip"', 'link="tip"') if "tip" in new
                                     else text.replace(old, new))  # fmt: skip
    with pytest.raises(ValueError, match=words) as error:
        load_arm(folder)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("stiffness: 120.0", "stifness: 120.0", "unknown key 'stifness'"),
        (
            "stiffness: 120.0",
            "stiffness: .nan",
            "joints.yaw.stiffness must be a number from 0 to 1,000,000,000, not nan",
        ),
        ("  roll: ", "  rol: ", "unknown key 'rol'"),
        ("wrist_yaw: 1}", "wrist: 1}", "cables.0.joints: unknown key 'wrist'; the keys are yaw, pitch"),
        ("wrist_yaw: 1}", "jaw_left: 1}", "cables.0.joints: unknown key 'jaw_left'; the keys are"),
        ("wrist_yaw: 1}", "wrist_yaw: .inf}", "cables.0.joints.wrist_yaw must be a number from .*, not inf"),
        ("wrist_yaw: 1}", "wrist_yaw: one}", "cables.0.joints.wrist_yaw must be a number from .*, not 'one'"),
        ("wrist_yaw: 1}", "wrist_yaw: 0}", "cables.0: the coefficient of 'wrist_yaw' must not be 0"),
        (", wrist_yaw: 1}", "}", "cables.0.joints must hold two or more numbers, not {'wrist_pitch': 1}"),
        (
            "stiffness: 6.598",
            "stiffness: -6.598",
            "cables.0.stiffness must be a number from 0 to 1,000,000,000, not -6.598",
        ),
        ("effort: 0.20", "effort: 0", "cables.0.effort must be a number from 1e-12 to 1,000,000,000, not 0"),
        (", effort: 0.20", "", "cables.0 lacks effort"),
        ("margin: 0.02", "margin: -0.02", "joints.jaw_left.margin must be a number from 0 to 1,000,000,000, not -0.02"),
        ("margin: 0.02", "margin: 0.35", "joints.jaw_left: a margin of 0.35 leaves nothing of"),
        ("armature: 4.976e-4", "inertia: 4.976e-4", "cables.0: unknown key 'inertia'"),
        ("  - {joints", "  a: {joints", "cables must be a list"),
        ("urdf: psm.urdf", "urdf: other.urdf", "no URDF file"),
        ("  joint: jaw_left\n", "  joint: jaw_right\n", "jaw.joint 'jaw_right' is not one of"),
        ("joints:", "joints: [", "not valid YAML"),
    ],
)
def test_bad_arm_yaml_is_one_sentence(tmp_path: Path, old: str, new: str, words: str) -> None:
    folder = tmp_path / "psm"
    shutil.copytree(PSM.folder, folder)
    text = (folder / "arm.yaml").read_text()
    assert old in text
    (folder / "arm.yaml").write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=words) as error:
        load_arm(folder)
    assert "\n" not in str(error.value)


ARMS = ROOT / "arms"


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    """What the generator writes, run as `python arms/build` runs it, but without writing."""
    return runpy.run_path(str(ARMS / "build"), run_name="build")["texts"]()


def test_files_are_what_the_generator_writes(texts: dict[str, str]) -> None:
    assert sorted(texts) == sorted(path.relative_to(ARMS).as_posix() for path in ARMS.glob("*/*.urdf"))
    for name, text in texts.items():
        # Bytes, not text: a file with other line ends or another encoding is another file.
        assert (ARMS / name).read_bytes() == text.encode(), f"run `python arms/build`: {name} differs"


@pytest.mark.parametrize("name", list_arms())
def test_arm_loads_with_its_home_inside_the_limits(name: str) -> None:
    arm = load_arm(name)
    assert arm.urdf.name == name
    assert arm.description and (arm.folder / "README.md").is_file()
    assert np.all((arm.lower <= arm.home) & (arm.home <= arm.upper))
    # A target may not outrun the joint that follows it.
    assert all(0 < joint.drive.speed <= joint.velocity for joint in arm.joints)
    assert build_spec(arm).compile().nu == len(arm.joints) + len(arm.cables)
