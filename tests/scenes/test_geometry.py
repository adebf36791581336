"""Distances of capsules and spheres, in numpy and in JAX, against C MuJoCo's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl.scenes.geometry import Capsule, capsule_distance, link_capsule

SEEDS = st.integers(0, 2**32 - 1)
SHAPES = st.sampled_from(["capsule", "sphere"])
compiled_distance = jax.jit(capsule_distance)


def model_of(kinds: tuple[str, str], seed: int) -> tuple[mujoco.MjModel, mujoco.MjData, np.random.Generator]:
    """Two shapes of random sizes that are anywhere within 0.3 m, turned at random."""
    rng = np.random.default_rng(seed)
    bodies = "".join(
        f'<body mocap="true"><geom type="{kind}" size="{rng.uniform(0.001, 0.05)} {rng.uniform(0.001, 0.2)}"/></body>'
        for kind in kinds
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    data.mocap_pos[:], data.mocap_quat[:] = rng.uniform(-0.15, 0.15, (2, 3)), rng.normal(size=(2, 4))
    data.mocap_quat[:] /= np.linalg.norm(data.mocap_quat, axis=1, keepdims=True)
    return model, data, rng


def capsules(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Capsule, Capsule]:
    mujoco.mj_kinematics(model, data)
    one, other = (
        link_capsule(model, geom).placed(data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]) for geom in range(2)
    )
    return one, other


def check(model: mujoco.MjModel, data: mujoco.MjData, single: float, over: float = 0.0) -> None:
    """That numpy and, to `single` m, JAX give C MuJoCo's distance; whichever comes first.

    Args:
        over: by how much C MuJoCo's may be longer than the least one, m.
    """
    one, other = capsules(model, data)
    expected = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)
    for found in (float(capsule_distance(one, other)), float(capsule_distance(other, one))):
        assert expected - over - 1e-9 <= found <= expected + 1e-9
    pair = [Capsule(*(jnp.asarray(part, jnp.float32) for part in shape)) for shape in (one, other)]
    assert float(compiled_distance(*pair)) == pytest.approx(expected, abs=single)


@settings(max_examples=200, deadline=None)
@given(SEEDS, SHAPES, SHAPES)
def test_distances_are_c_mujocos(seed: int, one: str, other: str) -> None:
    model, data, _ = model_of((one, other), seed)
    check(model, data, single=5e-6)


@settings(max_examples=200, deadline=None)
@given(SEEDS, st.sampled_from([0.0, 1e-9, 1e-7, 1e-5, 1e-3]), st.booleans())
def test_distances_of_parallel_capsules_are_c_mujocos(seed: int, angle: float, ahead: bool) -> None:
    """Side by side or one ahead of the other. Where nearly parallel ones cross can't be told in float32.

    C MuJoCo takes those within about 2e-4 rad for parallel, and the end of one for the closest point even where they
    cross: that is at most the angle times a segment's length farther.
    """
    model, data, rng = model_of(("capsule", "capsule"), seed)
    turn = np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0])
    mujoco.mju_mulQuat(data.mocap_quat[1], data.mocap_quat[0], turn)
    if ahead:
        mujoco.mj_kinematics(model, data)
        data.mocap_pos[1] = data.mocap_pos[0] + rng.uniform(-0.5, 0.5) * data.geom_xmat[0].reshape(3, 3)[:, 2]
    check(model, data, single=1e-4, over=2 * model.geom_size[:, 1].max() * angle if angle < 2e-4 else 0.0)


def test_shapes_in_one_place_overlap_by_both_radii() -> None:
    for kinds in (("capsule", "capsule"), ("sphere", "capsule"), ("sphere", "sphere")):
        model, data, _ = model_of(kinds, 0)
        data.mocap_pos[1], data.mocap_quat[1] = data.mocap_pos[0], data.mocap_quat[0]
        radii = model.geom_size[:, 0].sum()
        assert float(capsule_distance(*capsules(model, data))) == pytest.approx(-radii, abs=1e-12)


@settings(max_examples=100, deadline=None)
@given(SEEDS)
def test_a_distance_is_the_least_over_points(seed: int) -> None:
    one, other = capsules(*model_of(("capsule", "capsule"), seed)[:2])
    shares = np.linspace(-1, 1, 201)[:, None]
    points = [capsule.centre + shares * capsule.half * capsule.axis for capsule in (one, other)]
    sampled = np.linalg.norm(points[0][:, None] - points[1], axis=-1).min() - one.radius - other.radius
    exact = float(capsule_distance(one, other))
    assert exact <= sampled + 1e-9
    assert sampled - exact <= (one.half + other.half) / 200


def test_batches_broadcast() -> None:
    rng = np.random.default_rng(0)
    axis = rng.normal(size=(5, 1, 3))
    one = Capsule(rng.normal(size=(5, 1, 3)), axis / np.linalg.norm(axis, axis=-1, keepdims=True), 0.1, 0.01)
    other = Capsule(rng.normal(size=(4, 3)), np.array([0.0, 0.0, 1.0]), np.full(4, 0.2), np.full(4, 0.02))
    found = capsule_distance(one, other)
    assert found.shape == (5, 4)
    single = capsule_distance(Capsule(one.centre[3, 0], one.axis[3, 0], 0.1, 0.01), Capsule(
        other.centre[2], other.axis, 0.2, 0.02))  # fmt: skip
    assert found[3, 2] == pytest.approx(single, abs=1e-12)
