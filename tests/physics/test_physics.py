"""All scenes, in all control modes: limits hold, nothing breaks, energy stays."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from docs.studies.energy import energy_drift
from surgical_marl import load_arm, load_scene
from surgical_marl.control.controller import Controller
from surgical_marl.physics.simulator import Simulator
from surgical_marl.robots.drives import CONTROL_MODES
from surgical_marl.scenes.placing import scenes_without_objects
from surgical_marl.scenes.scene import Scene
from surgical_marl.scenes.timing import DECIMATION, TIMESTEP
from tests.helpers.commands import commander
from tests.helpers.rollouts import read_state, roll_out

SCENES = scenes_without_objects()
SEVERAL = [name for name in SCENES if len(load_scene(name).agents) > 1]
STEPS, EPISODES = 10_000, 20


def play(scene: Scene, episodes: int, steps: int, seed: int = 0) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Play C MuJoCo from home under full actions one way and the other, each held until joints rest at their limits.

    Yields:
        qpos [episodes, DECIMATION, nq] and qvel [episodes, DECIMATION, nv] of the physics steps of each control step.
    """
    model, simulator, rng = scene.model, Simulator(scene), np.random.default_rng(seed)
    data = mujoco.MjData(model)
    data.qpos[:] = scene.home
    states = np.tile(read_state(model, data), (episodes, 1))

    def sides() -> np.ndarray:
        holds = rng.integers(20, 250, steps // 20)
        return np.repeat(rng.choice([-1.0, 1.0], len(holds)), holds)[:steps]

    joints = {agent: len(mount.arm.actuated) for agent, mount in scene.mounts.items()}
    actions = {
        agent: np.float32([[sides() for _ in range(count)] for _ in range(episodes)]) for agent, count in joints.items()
    }
    of_one = commander(simulator)
    command = jax.jit(jax.vmap(lambda physics, qpos, action: of_one(physics.with_arms(qpos=qpos), action)))
    physics = jax.tree.map(lambda part: jnp.tile(part, (episodes, 1)), simulator.home)
    qpos = np.tile(scene.home, (episodes, 1, 1))
    for step in range(steps):
        now = {agent: action[..., step] for agent, action in actions.items()}
        physics = command(physics, np.float32(qpos[:, -1]), now)
        held = np.repeat(np.asarray(physics.ctrl, float)[:, None], DECIMATION, axis=1)
        path, qpos, qvel = roll_out(model, data, states, held)
        states = path[:, -1]
        yield qpos, qvel


@pytest.mark.parametrize(
    ("name", "control"),
    [
        pytest.param(name, control, marks=[pytest.mark.slow] * (name in SEVERAL and control != "position"))
        for name in SCENES
        for control in CONTROL_MODES
    ],
)
def test_limits_hold_at_full_effort(name: str, control: str) -> None:
    """10,000 control steps without NaN or warning; joints come to their stops, and in no physics step does one pass a
    limit of the URDF by 1 % of its range."""
    scene = load_scene(name, control)
    model, (low, high) = scene.model, scene.model.jnt_range.T
    lowest, highest = high.copy(), low.copy()
    for qpos, qvel in play(scene, EPISODES, STEPS // EPISODES):
        assert np.isfinite(qpos).all() and np.isfinite(qvel).all()
        lowest, highest = np.minimum(lowest, qpos.min((0, 1))), np.maximum(highest, qpos.max((0, 1)))
    names = [model.joint(i).name for i in range(model.njnt)]
    margins = {f"{agent}/{j.name}": j.drive.margin for agent, mount in scene.mounts.items() for j in mount.arm.joints}
    margin = np.array([margins[name] for name in names])
    passed = (np.maximum(highest - high, low - lowest) - margin) / (high - low)
    assert (passed < 0.01).all(), dict(zip(names, passed.round(4), strict=True))
    if len(scene.agents) == 1:  # several arms keep each other from some limits
        near = np.maximum(lowest - low, high - highest) / (high - low)
        jaws = np.array(["jaw" in name for name in names])  # these stop where they are told to
        assert near[~jaws].max() < 0.02, dict(zip(names, near.round(4), strict=True))


@pytest.mark.parametrize("name", SCENES)
def test_no_joint_is_faster_than_its_limit(name: str) -> None:
    """Without contacts, within the overshoot of the dVRK's gains: commands and the leads of targets are bounded, and
    under torque no effort is left at full speed."""
    for control in CONTROL_MODES:
        scene = load_scene(name, control)
        scene.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        limit = np.concatenate([[j.velocity for j in mount.arm.joints] for mount in scene.mounts.values()])
        fastest = np.max([np.abs(qvel).max((0, 1)) for _, qvel in play(scene, 4, 125, seed=1)], axis=0)
        assert (fastest <= 1.15 * limit).all(), dict(enumerate((fastest / limit).round(3)))


@pytest.mark.parametrize("name", SCENES)
def test_energy_stays(name: str) -> None:
    """Kinetic energy of arms that coast without actuators, friction and limits drifts by less than 1 % in 2 s."""
    _, drift = energy_drift(load_scene(name))
    assert 0 < np.abs(drift).max() < 0.01


@pytest.mark.parametrize("name", ["psm", "ecm", "star"])
def test_a_commanded_velocity_is_reached_and_held(name: str) -> None:
    scene = load_scene(name, "velocity")
    agent, arm = scene.agents[0], scene.mounts[scene.agents[0]].arm
    simulator = Simulator(scene)
    damping = -scene.model.actuator_biasprm[:, 2]
    yields = np.linalg.inv(scene.moment.T * damping @ scene.moment)
    command, physics = jax.jit(commander(simulator)), simulator.home
    for i, joint in enumerate(arm.actuated):
        if arm.jaw and joint.name == arm.jaw.joint:
            continue
        data = mujoco.MjData(scene.model)
        data.qpos[:] = scene.home
        action = np.zeros(len(arm.actuated), np.float32)
        action[i] = 0.5
        data.ctrl[:] = command(physics, {agent: action}).ctrl
        mujoco.mj_step(scene.model, data, round(0.3 / TIMESTEP))
        speed = float(data.joint(f"{agent}/{joint.name}").qvel[0])
        # the law is proportional: friction costs some of the speed
        own = scene.model.joint(f"{agent}/{joint.name}").dofadr[0]
        lost = (joint.coulomb + joint.viscous * 0.5 * joint.drive.speed) * yields[own, own]
        assert 0.5 * joint.drive.speed - 1.3 * lost - 0.002 < speed < 0.52 * joint.drive.speed, joint.name


@pytest.mark.parametrize("name", ["psm", "ecm", "star"])
def test_a_commanded_torque_accelerates_as_newton_says(name: str) -> None:
    scene = load_scene(name, "torque")
    model, agent, arm = scene.model, scene.agents[0], scene.mounts[scene.agents[0]].arm
    simulator = Simulator(scene)
    model.dof_frictionloss[:] = 0
    for i, joint in enumerate(arm.actuated):
        if arm.jaw and joint.name == arm.jaw.joint:
            continue
        data = mujoco.MjData(model)
        data.qpos[:] = scene.home
        action = np.zeros(len(arm.actuated), np.float32)
        action[i] = -0.3
        data.ctrl[:] = commander(simulator)(simulator.home, {agent: action}).ctrl
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        force = mass @ data.qacc
        own = model.joint(f"{agent}/{joint.name}").dofadr[0]
        assert force[own] == pytest.approx(-0.3 * joint.effort, rel=1e-5)


@pytest.mark.parametrize("name", SCENES)
def test_shafts_stay_in_their_remote_centers(name: str) -> None:
    """At every step of a random rollout: 1e-6 m between the shaft's axis and the remote center, in C MuJoCo's poses."""
    scene = load_scene(name)
    data = mujoco.MjData(scene.model)
    path = np.concatenate([qpos.reshape(-1, scene.model.nq) for qpos, _ in play(scene, 3, 100, seed=2)])
    for qpos in path:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(scene.model, data)
        for agent, mount in scene.mounts.items():
            if mount.arm.remote_center is not None:
                shaft = data.body(f"{agent}/{mount.arm.remote_center}")
                off = np.cross(shaft.xmat.reshape(3, 3)[:, 2], shaft.xpos - mount.position)
                assert np.linalg.norm(off) < 1e-6
                assert mount.arm.remote_center_error(data.qpos[scene.qpos_index(agent)]) < 1e-6


def test_a_urdf_may_list_its_joints_in_any_order(tmp_path: Path) -> None:
    """The PSM with its joints listed backwards moves as the PSM does."""
    folder = tmp_path / "backwards"
    shutil.copytree(load_arm("psm").folder, folder)
    tree = ElementTree.parse(folder / "psm.urdf")
    joints = tree.getroot().findall("joint")
    for joint in joints:
        tree.getroot().remove(joint)
    tree.getroot().extend(joints[::-1])
    tree.write(folder / "psm.urdf")
    (tmp_path / "one.yaml").write_text("arms: {backwards_0: {arm: backwards}}")
    action = {"yaw": 1.0, "insertion": -0.5, "roll": 0.7, "jaw_left": 1.0}
    tips = []
    for source in ("psm", tmp_path / "one.yaml"):
        scene = load_scene(source)
        agent, arm = scene.agents[0], scene.mounts[scene.agents[0]].arm
        simulator, data = Simulator(scene), mujoco.MjData(scene.model)
        data.qpos[:] = scene.home
        physics = simulator.home
        np.testing.assert_allclose(arm.home[[j.name for j in arm.actuated].index("insertion")], 0.1)
        for _ in range(20):
            order = np.concatenate([term.joints for term in Controller(scene, dt=0.02).terms[agent].values()])
            values = np.array([action.get(arm.actuated[joint].name, 0.0) for joint in order], np.float32)
            physics = commander(simulator)(physics.with_arms(qpos=jnp.asarray(data.qpos, jnp.float32)), {agent: values})
            data.ctrl[:] = physics.ctrl
            mujoco.mj_step(scene.model, data, DECIMATION)
        mujoco.mj_kinematics(scene.model, data)
        tips.append(data.site(f"{agent}/tool_tip").xpos - scene.mounts[agent].position)
    np.testing.assert_allclose(tips[0], tips[1], atol=1e-6)
    assert np.linalg.norm(tips[0]) > 0.05
