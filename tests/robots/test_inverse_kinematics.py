"""Inverse kinematics against forward kinematics, for every arm that ships."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from surgical_marl import list_arms, load_arm
from surgical_marl.robots.arm import Arm
from surgical_marl.robots.inverse_kinematics import inverse_kinematics

PSM = load_arm("psm")


def reachable(arm: Arm, count: int, seed: int = 0) -> np.ndarray:
    """Poses of the tool tip at joint positions drawn evenly within the limits."""
    draws = np.random.default_rng(seed).uniform(arm.lower, arm.upper, (count, len(arm.actuated)))
    return arm.forward_kinematics(draws)


def misses(arm: Arm, q: Any, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far tips are from poses: m, degrees."""
    tips = arm.forward_kinematics(np.asarray(q, dtype=float))
    chord = np.linalg.norm(tips[..., :3, :3] - poses[..., :3, :3], axis=(-2, -1))
    angle = np.degrees(2 * np.arcsin(np.clip(chord / np.sqrt(8), 0, 1)))
    return np.linalg.norm(tips[..., :3, 3] - poses[..., :3, 3], axis=-1), angle


def share_reached(arm: Arm, q: Any, poses: np.ndarray) -> float:
    """Share of poses reached to 0.1 mm and 0.1 degrees."""
    position, angle = misses(arm, q, poses)
    return float(np.mean((position < 1e-4) & (angle < 0.1)))


def within_limits(arm: Arm, q: Any) -> bool:
    q = np.asarray(q)
    return bool((q >= arm.lower.astype(q.dtype)).all() and (q <= arm.upper.astype(q.dtype)).all())


@pytest.mark.parametrize("name", list_arms())
def test_reaches_99_percent_of_reachable_poses(name: str) -> None:
    arm = load_arm(name)
    poses = reachable(arm, 1000)
    q = inverse_kinematics(arm, poses)
    assert share_reached(arm, q, poses) >= 0.99
    assert within_limits(arm, q)


@pytest.mark.parametrize("name", list_arms())
def test_reaches_99_percent_in_float32_under_jit(name: str) -> None:
    arm = load_arm(name)
    poses = reachable(arm, 256, seed=1)
    q = jax.jit(lambda targets: inverse_kinematics(arm, targets))(jnp.asarray(poses, jnp.float32))
    assert q.dtype == jnp.float32
    assert share_reached(arm, q, poses) >= 0.99
    assert within_limits(arm, q)


@pytest.mark.parametrize("name", list_arms())
@pytest.mark.parametrize(("starts", "least"), [(1, 0.97), (8, 0.99)])
def test_reaches_positions(name: str, starts: int, least: float) -> None:
    arm = load_arm(name)
    poses = reachable(arm, 500)
    q = inverse_kinematics(arm, poses[:, :3, 3], starts=starts)
    assert np.mean(misses(arm, q, poses)[0] < 1e-4) >= least
    assert within_limits(arm, q)


@pytest.mark.parametrize("name", list_arms())
def test_targets_out_of_reach_end_near(name: str) -> None:
    """Far positions are missed hardly more than the nearest of many configurations misses them; poses end finite."""
    arm = load_arm(name)
    draws = np.random.default_rng(0).uniform(arm.lower, arm.upper, (20_000, len(arm.actuated)))
    tips = arm.forward_kinematics(draws)[:, :3, 3]
    targets = tips.mean(axis=0) + 3 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    nearest = np.linalg.norm(targets[:, None] - tips, axis=-1).min(axis=1)
    q = inverse_kinematics(arm, targets, starts=16, iterations=40)
    missed = np.linalg.norm(arm.forward_kinematics(q)[:, :3, 3] - targets, axis=-1)
    assert (missed < 1.15 * nearest).all()
    poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (len(targets), 1, 1))
    poses[:, :3, 3] = targets
    q = inverse_kinematics(arm, poses)
    assert np.isfinite(q).all() and within_limits(arm, q)


def test_batches_of_any_shape_agree() -> None:
    """Alone, in a batch and under vmap a pose has the same solution."""
    poses = reachable(PSM, 6).reshape(2, 3, 4, 4)
    q = inverse_kinematics(PSM, poses)
    assert q.shape == (2, 3, 7)
    np.testing.assert_allclose(inverse_kinematics(PSM, poses[1, 2].tolist()), q[1, 2], atol=1e-9)
    flat = jnp.asarray(poses.reshape(6, 4, 4), jnp.float32)
    mapped = jax.jit(jax.vmap(lambda target: inverse_kinematics(PSM, target)))(flat)
    assert share_reached(PSM, mapped, poses.reshape(6, 4, 4)) == 1
    np.testing.assert_allclose(mapped, q.reshape(6, 7), atol=1e-3)


def test_positions_stay_near_the_start_and_the_jaw_stays_where_it_was() -> None:
    start = PSM.home + np.array([0.3, -0.2, 0.02, 1.0, 0.5, -0.5, 0.4])
    tip = PSM.forward_kinematics(start)[:3, 3]
    np.testing.assert_allclose(inverse_kinematics(PSM, tip, start), start, atol=1e-9)
    moved = inverse_kinematics(PSM, tip + np.array([0.005, 0.0, 0.0]), start)
    assert moved[6] == pytest.approx(start[6])
    assert np.abs((moved - start) / (PSM.upper - PSM.lower)).max() < 0.05
    np.testing.assert_allclose(inverse_kinematics(PSM, reachable(PSM, 50), start)[:, 6], start[6])


def test_a_start_for_each_target_follows_a_path() -> None:
    """With one start a target a short way off needs no jump to another branch, in numpy and with a JAX start."""
    rng = np.random.default_rng(0)
    q = rng.uniform(PSM.lower, PSM.upper, (200, 7)) * 0.7
    moved = q + rng.uniform(-0.03, 0.03, q.shape) * [1, 1, 0.1, 1, 1, 1, 0]
    moved[:, 2], q[:, 2] = np.clip(moved[:, 2], 0.02, 0.2), np.clip(q[:, 2], 0.02, 0.2)
    poses = PSM.forward_kinematics(moved)
    found = inverse_kinematics(PSM, poses, q, starts=1, iterations=8)
    assert share_reached(PSM, found, poses) == 1
    assert np.abs(found - q).max() < 0.2
    follow = jax.jit(lambda start: inverse_kinematics(PSM, poses, start, starts=1, iterations=8))
    assert share_reached(PSM, follow(jnp.asarray(q, jnp.float32)), poses) == 1


@pytest.mark.parametrize("starts", [1, 8])
def test_half_a_turn_away(starts: int) -> None:
    """Where a rotation error has no sine, the search still starts."""
    start = PSM.home
    target = start + np.pi * np.eye(7)[3]
    pose = PSM.forward_kinematics(target)
    assert share_reached(PSM, inverse_kinematics(PSM, pose, start, starts=starts), pose) == 1


@pytest.mark.parametrize("shape", [(), (2,), (5, 4), (3, 4), (4, 3, 3, 4)])
def test_targets_of_a_wrong_shape_are_one_sentence(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="targets must be positions") as error:
        inverse_kinematics(PSM, np.zeros(shape))
    assert "\n" not in str(error.value)


def test_other_wrong_arguments_are_one_sentence() -> None:
    pose = PSM.forward_kinematics(PSM.home)
    with pytest.raises(ValueError, match=r"start of shape \(6,\) does not fit the 7 joints of arm 'psm'"):
        inverse_kinematics(PSM, pose, PSM.home[:6])
    with pytest.raises(ValueError, match="start of shape"):
        inverse_kinematics(PSM, jnp.asarray(pose), jnp.zeros((3, 7)))
    with pytest.raises(ValueError, match="starts must be at least 1, not 0"):
        inverse_kinematics(PSM, pose, starts=0)
