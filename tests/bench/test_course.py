"""The course that benchmarks follow: where environments begin, and what arms do from there."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import rollout

from surgical_marl.bench import engines
from surgical_marl.bench.course import HOLD, LAPS, full_state, make_course
from surgical_marl.bench.physics import PhysicsAlone
from surgical_marl.bench.starts import NOISE, grasps, played
from surgical_marl.bench.workload import DISTINCT, Workload
from surgical_marl.engines.choose import make_engine
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.robots.rotation import matrix_of
from surgical_marl.scenes.load import load_scene


def test_what_is_timed_is_what_c_mujoco_steps() -> None:
    """Half a lap of a course, from a state in motion: the fused engine's physics alone ends where C MuJoCo does."""
    scene, course = load_scene("ecm"), make_course(Workload(scene="ecm"))
    assert np.abs(course.qvel).max() > 0.1, "nothing moves at the start"
    assert 0 <= course.touching <= 1
    rows, steps = 8, HOLD * LAPS // 2
    engine = make_engine(PhysicsAlone(Env("reach", "ecm")), rows, "fused", "cpu")
    engine.reset(0)
    engine.write(".physics.arms.qpos", course.qpos[:rows])
    engine.write(".physics.arms.qvel", course.qvel[:rows])
    step = engines._along(engine, [command[:rows] for command in course.commands])
    for _ in range(steps):
        step()
    control = course.commands[:, :rows].astype(float).repeat(HOLD, 0).swapaxes(0, 1)[:, :steps]
    state = full_state(course.qpos[:rows], course.qvel[:rows])
    found, _ = rollout.rollout(scene.model, mujoco.MjData(scene.model), state, control)
    np.testing.assert_allclose(
        engine.read(".physics.arms.qpos", "numpy"), found[:, -1, 1 : 1 + scene.model.nq], atol=1e-5
    )
    assert np.abs(found[:, -1, 1 : 1 + scene.model.nq] - course.qpos[:rows]).max() > 1e-2, "nothing moved"


def test_steps_made_at_once_are_those_made_one_by_one() -> None:
    """The same commands for as many physics steps, a launch for each step or for all of a control step."""
    rows, course, found = 8, make_course(Workload(scene="ecm")), []
    for steps in (1, HOLD):
        engine = make_engine(PhysicsAlone(Env("reach", "ecm"), steps), rows, "fused", "cpu")
        engine.reset(0)
        engine.write(".physics.arms.qpos", course.qpos[:rows])
        engine.write(".physics.arms.qvel", course.qvel[:rows])
        step = engines._along(engine, [command[:rows] for command in course.commands], HOLD // steps)
        for _ in range(2 * HOLD // steps):
            step()
        found.append(engine.read(".physics.arms.qpos", "numpy"))
    np.testing.assert_allclose(*found, atol=1e-6)
    assert np.abs(found[0] - course.qpos[:rows]).max() > 1e-3, "nothing moved"


@pytest.mark.parametrize("motion", ["random", "rough"])
def test_a_course_takes_back_what_it_did(motion: str) -> None:
    course = make_course(Workload(scene="ecm", motion=motion))
    total = sum(actions["ecm_0"] for actions in course.actions)
    np.testing.assert_allclose(total, 0, atol=1e-6)
    assert len(course.commands) == len(course.actions) == LAPS


def test_as_many_environments_differ_as_are_asked_for() -> None:
    qpos = make_course(Workload(scene="ecm", num_envs=300, distinct=280)).qpos
    assert len(np.unique(qpos, axis=0)) == len(qpos) == 280
    assert len(make_course(Workload(scene="ecm", num_envs=8, distinct=10**6)).qpos) == DISTINCT


def test_where_a_policy_plays_environments_are_anywhere_in_their_episodes() -> None:
    """The later in its episode, the nearer is a tip to its goal; and the policy goes on from there."""
    workload, count = Workload(scene="ecm", motion="policy", device="cpu"), 64
    paths = [".steps", ".physics.arms.qpos", ".goal.targets"]
    (steps, qpos, goals), actions = played("reach-ecm", workload, count, LAPS, paths, np.random.default_rng(0))
    most = BatchedEnv("reach", "ecm", num_envs=1, device="cpu").max_steps
    assert steps.min() < 0.1 * most and steps.max() > 0.8 * most and len(np.unique(steps)) > 20
    scene = load_scene("ecm")
    model, mount = scene.model, scene.mounts["ecm_0"]
    data, tips = mujoco.MjData(model), []
    for data.qpos[:] in qpos:
        mujoco.mj_kinematics(model, data)
        tips.append(data.site("ecm_0/tool_tip").xpos.copy())
    far = np.linalg.norm((np.array(tips) - mount.position) @ mount.rotation - goals[:, 0], axis=1)
    assert np.median(far[steps > most / 2]) < 0.005 < np.median(far[steps < 5])
    assert len(actions) == LAPS and all(lap["ecm_0"].shape == (count, 4) for lap in actions)
    assert np.std(actions[0]["ecm_0"][steps > most / 2] - actions[1]["ecm_0"][steps > most / 2]) > NOISE / 2
    course = make_course(workload)
    assert course.qpos.shape == (DISTINCT, 4) and course.commands.shape[:2] == (LAPS, DISTINCT)


def test_arms_that_grasp_are_not_in_the_wall() -> None:
    """A peg board has a wall between two arms that may stand anywhere. Of 48 such starts two used to be in it."""
    simulator = Env("peg_transfer", "bimanual_psm_pegs").simulator
    starts = grasps(simulator.scene, 48, np.random.default_rng(7))
    assert simulator.step.bodies and (starts.arms > 1).any()
    tables, begin = simulator.step.bodies.tables, jax.vmap(simulator.at)(jnp.float32(starts.qpos))
    placed = {"position": jnp.float32(starts.position), "quaternion": jnp.float32(starts.quaternion)}
    objects = begin.rigid_bodies._replace(bodies=begin.rigid_bodies.bodies._replace(**placed))
    depths = np.asarray(jax.jit(jax.vmap(simulator.step.depths))(begin.with_systems(rigid_bodies=objects)))
    assert depths[:, tables.owner < tables.arms].max() < 0


@pytest.mark.slow
def test_objects_are_carried_along_a_course() -> None:
    """Most needles are off the pad where a course starts, in environments that differ."""
    workload = Workload(
        task="needle_pick", scene="psm_needle", motion="grasp", device="cpu", num_envs=300, distinct=280
    )
    course = make_course(workload)
    assert len(np.unique(course.qpos, axis=0)) == len(course.qpos) == 280
    assert set(course.parts) >= {".physics.arms.qpos", ".physics.arms.ctrl", ".physics.rigid_bodies.bodies.position"}
    start, above = load_scene("psm_needle").objects["needle"].position, course.objects.bodies.position[..., 2]
    assert 0.4 < (np.abs(above - start[2]) > 2e-3).mean() < 0.9, "a quarter lies where the scene puts it"
    assert 0.4 < course.touching < 0.95


@pytest.mark.parametrize("name", ["psm_needle", "bimanual_psm_pegs"])
def test_a_grasp_begins_with_an_object_between_the_pads_of_a_jaw_or_of_two(name: str) -> None:
    """A gap away from both pads of as many arms as are said to grasp it, and the arms apart."""
    scene, count = load_scene(name), 24
    (held, place), model = next(iter(scene.free_objects.items())), scene.model
    data, body = mujoco.MjData(model), model.body(held)
    shapes = range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
    starts = grasps(scene, count, np.random.default_rng(0))
    for qpos, position, quaternion, arms in zip(*starts, strict=True):
        axes, mocap = matrix_of(quaternion[0]), body.mocapid[0]
        data.qpos[:], data.mocap_quat[mocap] = qpos, quaternion[0]
        data.mocap_pos[mocap] = position[0] - axes @ place.object.center
        mujoco.mj_kinematics(model, data)
        around = 0
        for agent in scene.agents:
            pads = [model.geom(f"{agent}/jaw_{side}_link/pad").id for side in ("left", "right")]
            gaps = [min(mujoco.mj_geomDistance(model, data, s, pad, 1.0, None) for s in shapes) for pad in pads]
            around += max(gaps) < 0.01
            assert min(gaps) > (1e-5 if max(gaps) < 0.01 else 0) and (max(gaps) < 1e-4 or min(gaps) > 1e-3)
        assert around == arms
        q = {agent: qpos[scene.qpos_index(agent)] for agent in scene.agents}
        assert scene.clearance(q) > 5e-4
    found = set(starts.arms.tolist())
    assert found == set(range(len(scene.agents) + 1))
