"""Rotations, steps of the inverse kinematics and poses in Warp, against scipy, numpy and C MuJoCo."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surgical_marl import load_arm, load_scene
from surgical_marl.robots import inverse_kinematics as inverse
from surgical_marl.robots.rotation import matrix_of, quaternion, turned
from surgical_marl.vision.kinematics import Kinematics, wp


def test_rotations_are_scipys() -> None:
    for turn in Rotation.random(20, rng=np.random.default_rng(0)):
        np.testing.assert_allclose(matrix_of(turn.as_quat(scalar_first=True)), turn.as_matrix(), atol=1e-12)
        assert abs(quaternion(turn.as_matrix()) @ turn.as_quat(scalar_first=True)) > 1 - 1e-12
        degrees = turn.as_euler("xyz", degrees=True)
        np.testing.assert_allclose(turned(degrees), turn.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("single", [False, True])
def test_rotation_vectors_are_scipys_from_tiny_angles_to_half_a_turn(single: bool) -> None:
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(60, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    vectors = axes * np.geomspace(1e-6 if not single else 1e-3, 3.1, 60)[:, None]
    turns = Rotation.from_rotvec(vectors).as_matrix()
    found = inverse.rotation_vector(jnp.asarray(turns, jnp.float32) if single else turns)
    np.testing.assert_allclose(found, vectors, rtol=2e-2 if single else 1e-4, atol=2e-3 if single else 2e-6)
    if not single:
        sharp = axes * np.linspace(0.1, 2.99, 60)[:, None]
        found = inverse.rotation_vector(Rotation.from_rotvec(sharp).as_matrix())
        np.testing.assert_allclose(found, sharp, atol=1e-9)
    half = Rotation.from_rotvec(np.pi * axes[:5]).as_matrix()
    np.testing.assert_allclose(np.linalg.norm(inverse.rotation_vector(half), axis=-1), np.pi, rtol=1e-3)


def test_a_step_is_damped_least_squares_of_the_joints_that_can_move() -> None:
    rng, seen = np.random.default_rng(2), set()
    for _ in range(60):
        n, m = 5, rng.choice([3, 6])
        share = np.where(rng.random(n) < 0.3, rng.integers(0, 2, n), rng.uniform(0.2, 0.8, n)).astype(float)
        jacobian, error = rng.normal(size=(m, n)), rng.normal(size=m) * 10.0 ** rng.uniform(-3, 0.5)
        pull = rng.normal(0, 0.02, n) * rng.integers(0, 2)
        slope = jacobian.T @ error
        free = ~(((share == 0) & (slope < 0)) | ((share == 1) & (slope > 0)))
        near = error * min(1, 0.5 / np.linalg.norm(error))
        open_ = np.where(free, jacobian, 0)
        damping = 1e-7 + n * np.finfo(float).eps * np.sum(open_**2) + near @ near / 2
        # the least of |J x - e|^2 + damping |x - pull|^2, by a general solver
        rows = np.vstack([open_, np.sqrt(damping) * np.eye(n)])
        change = np.linalg.lstsq(rows, np.concatenate([near, np.sqrt(damping) * pull]), rcond=None)[0]
        expected = np.clip(share + np.clip(change, -0.2, 0.2), 0, 1)
        np.testing.assert_allclose(inverse._step(share, error, jacobian, pull), expected, atol=1e-7)
        seen |= {bool(free.all()), bool(np.abs(change).max() > 0.2)}
    assert seen == {False, True}


def test_steps_of_many_searches_are_those_of_each() -> None:
    rng = np.random.default_rng(5)
    many = rng.random((4, 3, 5)), 10 * rng.normal(size=(4, 3, 3)), rng.normal(size=(4, 3, 3, 5)), np.zeros((4, 3, 5))
    found = inverse._step(*many)
    for place in np.ndindex(4, 3):
        np.testing.assert_allclose(found[place], inverse._step(*(part[place] for part in many)), atol=1e-12)


def test_a_step_in_single_precision_is_finite_where_only_one_way_is_open() -> None:
    """The damping grows with what single precision rounds off; a step then does nothing across the way."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        row, share = rng.normal(size=5), np.full(5, 0.5)
        jacobian = np.outer(rng.normal(size=3), 30 * row)
        error = 1e-3 * rng.normal(size=3)
        arrays = [jnp.asarray(x, jnp.float32) for x in (share, error, jacobian, np.zeros(5))]
        along = row / np.linalg.norm(row)
        step = np.asarray(inverse._step(*arrays), float) - share
        np.testing.assert_allclose(step, (step @ along) * along, atol=1e-5)
        expected = np.linalg.pinv(jacobian) @ error
        np.testing.assert_allclose(step, expected, atol=0.05 * np.abs(expected).max() + 1e-5)


def test_candidates_are_halton_points_and_seeds_the_nearest_of_them() -> None:
    def inverted(number: int, base: int) -> float:
        """The digits of a number behind the point."""
        found, share = 0.0, 1.0
        while number:
            number, digit = divmod(number, base)
            share /= base
            found += digit * share
        return found

    points = inverse._halton(40, 3)
    expected = [[inverted(k, base) for base in (2, 3, 5)] for k in range(1, 41)]
    np.testing.assert_allclose(points, expected, atol=1e-12)
    arm = load_arm("psm")
    shares, positions, rotations = inverse._candidates(arm)
    poses = arm.forward_kinematics(arm.lower + shares * (arm.upper - arm.lower))
    np.testing.assert_allclose(positions, poses[:, :3, 3])
    target = arm.forward_kinematics(arm.home + 0.1)
    begin, length = np.full(len(arm.actuated), 0.4), 0.05
    off = {
        "position": np.linalg.norm(positions - target[:3, 3], axis=1) ** 2,
        "pose": np.linalg.norm(positions - target[:3, 3], axis=1) ** 2
        + length**2 * np.linalg.norm(rotations - target[:3, :3].ravel(), axis=1) ** 2,
    }
    for kind, wanted in (("position", target[:3, 3]), ("pose", target)):
        seeds = inverse._seeds(arm, wanted, begin, 5, length)
        assert seeds.shape == (5, len(begin))
        np.testing.assert_array_equal(seeds[0], begin)
        best = shares[np.argsort(off[kind])[:4]]
        np.testing.assert_allclose(seeds[1:, :6], best[:, :6])
        np.testing.assert_array_equal(seeds[1:, 6], 0.4)  # the jaw moves no tip
        np.testing.assert_array_equal(inverse._seeds(arm, wanted, begin, 1, length), begin[None])


def test_poses_in_warp_are_c_mujocos() -> None:
    """Of bodies of three arms, of a needle that has been moved, of shapes and of cameras, in two environments."""
    model = load_scene("trimanual_psm_ecm_needle").model
    rng, data = np.random.default_rng(3), mujoco.MjData(model)
    with wp.ScopedDevice("cpu"):
        known = Kinematics(model, 2)
        low, high = model.jnt_range.T
        qpos = rng.uniform(low, high, (2, model.nq))
        places, turns = rng.normal(0, 0.1, (2, model.nmocap, 3)), rng.normal(size=(2, model.nmocap, 4))
        known.qpos.assign(qpos.astype(np.float32))
        for moved in (False, True):
            if moved:
                known.origins.assign(places.astype(np.float32))
                known.turns.assign(turns.astype(np.float32))
            known.update(moved)
            for env in range(2):
                mujoco.mj_resetData(model, data)
                data.qpos[:] = qpos[env]
                if moved:
                    data.mocap_pos[:] = places[env]
                    data.mocap_quat[:] = turns[env] / np.linalg.norm(turns[env], axis=1, keepdims=True)
                mujoco.mj_kinematics(model, data)
                mujoco.mj_camlight(model, data)
                for name in ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat"):
                    mine = getattr(known, name).numpy()[env]
                    np.testing.assert_allclose(
                        mine.reshape(len(mine), -1), getattr(data, name), atol=2e-5, err_msg=name
                    )
    text = """<mujoco><worldbody><body pos="0.1 0.2 0.3" euler="20 30 40"><joint axis="1 2 3" pos="0.05 -0.1 0.2"/>
        <joint type="slide" axis="0 1 1"/><geom size="1" pos="0.3 0 0.1" euler="10 0 50"/>
        <body pos="0.2 0 0"><joint pos="0 0.3 0.1" axis="0 1 0" ref="20"/><geom type="capsule" size="0.1 0.2"/></body>
        </body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)  # joints beside the origins of their bodies, two in one of them
    data = mujoco.MjData(model)
    with wp.ScopedDevice("cpu"):
        known = Kinematics(model, 1)
        known.qpos.assign(np.float32([[0.7, -0.2, 1.1]]))
        known.update()
        data.qpos[:] = [0.7, -0.2, 1.1]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(known.geom_xpos.numpy()[0], data.geom_xpos, atol=1e-6)
        np.testing.assert_allclose(known.geom_xmat.numpy()[0].reshape(-1, 9), data.geom_xmat, atol=1e-6)
    for other in ('<joint type="ball"/>', '<camera mode="track"/>'):
        text = f'<mujoco><worldbody><body>{other}<geom size="1"/></body></worldbody></mujoco>'
        with pytest.raises(ValueError, match="hinges and slides"):
            Kinematics(mujoco.MjModel.from_xml_string(text), 1)
