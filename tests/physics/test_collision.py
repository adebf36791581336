"""Distances, and which pairs become contacts, against C MuJoCo on random states."""

from __future__ import annotations

import functools
from types import SimpleNamespace
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl.physics.contact.arm_contacts import SLOTS, Pairs

SEEDS = st.integers(0, 2**32 - 1)
SHAPES = [("capsule", 0.010, 0.15), ("capsule", 0.004, 0.05), ("sphere", 0.02, 0.0), ("sphere", 0.005, 0.0)]


def shapes_model() -> mujoco.MjModel:
    """Four shapes that float, and all pairs of them."""
    bodies = "".join(
        f'<body><freejoint/><geom name="{i}" type="{kind}" size="{radius} {half}" mass="1"/></body>'
        for i, (kind, radius, half) in enumerate(SHAPES)
    )
    pairs = "".join(f'<pair geom1="{i}" geom2="{j}"/>' for i in range(4) for j in range(i))
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody><contact>{pairs}</contact></mujoco>")


MODEL = shapes_model()
PAIRS = Pairs(MODEL)
compiled_closest = jax.jit(lambda xpos, xmat: PAIRS.closest(xpos, xmat, np.arange(PAIRS.count)))


def check_closest(poses: np.ndarray, tolerance: float) -> None:
    """At poses [4, 7] of the shapes: distances as C MuJoCo's; a point and a normal that lead to both surfaces."""
    data = mujoco.MjData(MODEL)
    data.qpos[:] = poses.ravel()
    mujoco.mj_kinematics(MODEL, data)
    found = compiled_closest(np.float32(data.geom_xpos), np.float32(data.geom_xmat.reshape(-1, 3, 3)))
    distance, point, normal = (np.asarray(part, np.float64) for part in found)
    for pair, geoms in enumerate(zip(MODEL.pair_geom1, MODEL.pair_geom2, strict=True)):
        expected = mujoco.mj_geomDistance(MODEL, data, *geoms, 10.0, None)
        assert abs(distance[pair] - expected) < tolerance
        radii = MODEL.geom_size[list(geoms), 0]
        if distance[pair] + radii.sum() < 1e-4:
            continue  # axes that meet have no normal that float32 could tell
        assert np.linalg.norm(normal[pair]) == pytest.approx(1, abs=1e-5)
        for geom, radius, sign in zip(geoms, radii, (1, -1), strict=True):
            axis = data.geom_xmat[geom].reshape(3, 3)[:, 2]
            half = MODEL.geom_size[geom, 1] if MODEL.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
            inner = point[pair] - sign * (distance[pair] / 2 + radius) * normal[pair]  # on the axis
            along = np.clip((inner - data.geom_xpos[geom]) @ axis, -half, half)
            assert np.linalg.norm(data.geom_xpos[geom] + along * axis - inner) < tolerance + 1e-6


def random_poses(rng: np.random.Generator, spread: float) -> np.ndarray:
    poses = np.concatenate([rng.uniform(-spread, spread, (4, 3)), rng.normal(size=(4, 4))], axis=1)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return poses


@settings(max_examples=300, deadline=None)
@given(SEEDS, st.sampled_from([0.003, 0.03, 0.3]))
def test_distances_are_c_mujoco_s(seed: int, spread: float) -> None:
    """Wherever the shapes are, far apart or overlapping."""
    check_closest(random_poses(np.random.default_rng(seed), spread), 5e-6)


@settings(max_examples=300, deadline=None)
@given(SEEDS, st.sampled_from([0.0, 1e-6, 1e-5, 1e-4, 3e-4, 1e-3, 3e-3]))
def test_distances_of_parallel_capsules_are_c_mujoco_s(seed: int, angle: float) -> None:
    """And of nearly parallel ones. Where they come closest can't be told in float32, only how close they come."""
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, 0.1)
    turn = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array([0.6, 0.8, 0.0]))])
    mujoco.mju_mulQuat(poses[1, 3:], poses[0, 3:], turn)
    check_closest(poses, 1e-4 if angle else 5e-6)


@settings(max_examples=300, deadline=None)
@given(SEEDS, st.floats(0.0, 0.03))
def test_distances_of_crossing_capsules_are_c_mujoco_s(seed: int, gap: float) -> None:
    """Axes that cross at right angles or aslant, a gap apart, 0 included."""
    rng = np.random.default_rng(seed)
    poses, axes, matrix = random_poses(rng, 0.1), [], np.zeros(9)
    for pose in poses[:2]:
        mujoco.mju_quat2Mat(matrix, pose[3:])
        axes.append(matrix.reshape(3, 3)[:, 2].copy())
    across = np.cross(*axes)
    across /= np.linalg.norm(across)
    halves = [half for _, _, half in SHAPES[:2]]
    offsets = [rng.uniform(-half, half) * axis for half, axis in zip(halves, axes, strict=True)]
    poses[1, :3] = poses[0, :3] + offsets[0] + gap * across - offsets[1]
    check_closest(poses, 5e-6)


def cluster(count: int) -> mujoco.MjModel:
    """Capsules close to each other, each on a slide and a hinge, and all pairs of them."""
    rng = np.random.default_rng(0)
    bodies = ""
    for i in range(count):
        place, axes = rng.uniform(-0.02, 0.02, 3), rng.normal(size=(2, 3))
        slide, hinge = (" ".join(map(str, axis)) for axis in axes)
        bodies += (
            f'<body pos="{place[0]} {place[1]} {place[2]}" euler="{37 * i} {61 * i} 0">'
            f'<joint type="slide" axis="{slide}"/><joint axis="{hinge}"/>'
            f'<geom name="{i % 3}/{i}" type="capsule" size="0.004 0.02" mass="{0.1 + 0.1 * i}"/></body>'
        )
    names = [f"{i % 3}/{i}" for i in range(count)]  # of three arms
    pairs = "".join(f'<pair geom1="{names[i]}" geom2="{names[j]}"/>' for i in range(count) for j in range(i))
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody><contact>{pairs}</contact></mujoco>")


@functools.cache
def clustered(count: int) -> tuple[mujoco.MjModel, Any]:
    """A cluster, and a compiled function of all that is asked of its pairs."""
    model = cluster(count)
    pairs = Pairs(model)

    def deepest(xpos: Any, xmat: Any, cdof: Any, com: Any) -> Any:
        distance, by_arms = pairs.distance(xpos, xmat), pairs.distance_by_arms(xpos, xmat)
        touching = pairs.deepest(SimpleNamespace(geom_xpos=xpos, geom_xmat=xmat, cdof=cdof, subtree_com=com), distance)
        forces = pairs.spread(touching.pair, np.arange(1, SLOTS + 1, dtype=np.float32))
        closest = pairs.closest(xpos, xmat, np.arange(pairs.count))
        return closest, by_arms, distance, touching, forces, pairs.overlap(xpos, xmat)

    return model, jax.jit(deepest)


@pytest.mark.parametrize("count", [8, 17])  # 28 pairs at once, 136 in a loop over pairs of arms
@settings(max_examples=50, deadline=None)
@given(seed=SEEDS)
def test_the_deepest_contacts_become_rows(count: int, seed: int) -> None:
    """The deepest of all pairs, each with the speed at which its two bodies part, and nothing where none touch."""
    model, compiled_deepest = clustered(count)
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    wide = rng.choice([0.03, 1.0])  # in each other's way, or mostly apart
    data.qpos[:] = rng.uniform(-1, 1, model.nq) * np.where(model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE, wide, 2.0)
    mujoco.mj_fwdPosition(model, data)
    arrays = data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3), data.cdof, data.subtree_com
    found = compiled_deepest(*(np.float32(array) for array in arrays))
    closest, by_arms, side_by_side, touching, forces, overlap = jax.tree.map(np.asarray, found)
    ids = zip(model.pair_geom1, model.pair_geom2, strict=True)
    distance = [mujoco.mj_geomDistance(model, data, a, b, 10.0, None) for a, b in ids]
    for one in (closest.distance, by_arms, side_by_side):
        np.testing.assert_allclose(one, distance, atol=1e-4)  # of parallel ones: see docs/physics.md
    assert overlap == (side_by_side < 0).any()
    assert len(set(touching.pair)) == SLOTS
    assert touching.left_out == max(0, (side_by_side < 0).sum() - SLOTS)
    np.testing.assert_array_equal(forces[touching.pair], np.arange(1, SLOTS + 1))
    assert np.count_nonzero(forces) == SLOTS
    np.testing.assert_array_equal(touching.distance, np.sort(side_by_side)[:SLOTS])
    np.testing.assert_array_equal(touching.distance, side_by_side[touching.pair])
    for slot, pair in enumerate(touching.pair):
        bodies = model.geom_bodyid[[model.pair_geom1[pair], model.pair_geom2[pair]]]
        assert touching.weight[slot] == pytest.approx(model.body_invweight0[bodies, 0].sum(), rel=1e-6)
        speeds = np.zeros((2, 3, model.nv))
        for speed, body in zip(speeds, bodies, strict=True):
            mujoco.mj_jac(model, data, speed, None, np.float64(closest.point[pair]), body)
        expected = closest.normal[pair] @ (speeds[1] - speeds[0]) * (touching.distance[slot] < 0)
        near = 1e-7 / max(touching.distance[slot] + 2 * 0.004, 1e-9)  # where axes cross, rounding turns the normal
        np.testing.assert_allclose(touching.jacobian[slot], expected, atol=1e-5 + near)
