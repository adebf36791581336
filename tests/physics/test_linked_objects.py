"""Objects that touch each other: they are eliminated together, and light ones in stiff contacts leave no NaN."""

from __future__ import annotations

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from surgical_marl.physics.contact.friction_cone import between, curvature
from surgical_marl.physics.solver import schur
from surgical_marl.physics.solver.cholesky import cholesky, packed
from tests.helpers.falling import DT, Falling, random_turns, thrown
from tests.physics.test_random_objects import random_objects
from tests.physics.test_search import drawn, forces

OBJECTS, ARMS, JOINTS = 4, 2, 3


def test_the_factor_is_finite_where_rounding_leaves_a_matrix_indefinite() -> None:
    """A body of 1 mg that is pressed along one direction, 20 million times as hard as it resists elsewhere."""
    rng = np.random.default_rng(0)
    way = rng.standard_normal((20, 1, 6))
    matrices = 1e-6 * np.eye(6) + 20 * np.swapaxes(way, 1, 2) @ way
    assert not np.isfinite(np.asarray(jnp.linalg.cholesky(jnp.asarray(matrices, jnp.float32)))).all(), "too easy"
    found = np.asarray(jax.vmap(cholesky)(jnp.asarray(matrices, jnp.float32)), float)
    largest = matrices.max((1, 2), keepdims=True)
    assert (np.abs(found @ np.swapaxes(found, 1, 2) - matrices) <= 3e-5 * largest).all()
    assert (np.triu(found, 1) == 0).all()


def test_the_factor_is_cholesky_s_elsewhere() -> None:
    root = np.random.default_rng(0).standard_normal((20, 6, 6))
    matrices = root @ np.swapaxes(root, 1, 2) + np.eye(6)
    found = jax.vmap(cholesky)(jnp.asarray(matrices, jnp.float32))
    np.testing.assert_allclose(found, np.linalg.cholesky(matrices), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("linked", [[], [(0, 2)], [(2, 3), (0, 2)], [(0, 1), (1, 2), (2, 3), (0, 3)]])
def test_objects_are_eliminated_as_from_a_dense_matrix(linked: list[tuple[int, int]]) -> None:
    rng, size = np.random.default_rng(len(linked)), 6 * OBJECTS
    blocks = np.zeros((OBJECTS, OBJECTS, 6, 6))
    for o in range(OBJECTS):
        root = rng.standard_normal((6, 6))
        blocks[o, o] = root @ root.T + np.eye(6)
    for pair in linked:
        left, right = rng.standard_normal((2, 6, 3))
        for (one, its), (other, others) in product(zip(pair, (left, -right), strict=True), repeat=2):
            blocks[one, other] += its @ others.T
    force, coupling = rng.standard_normal((OBJECTS, 6)), rng.standard_normal((OBJECTS, ARMS, 6, JOINTS))
    touched = rng.random((OBJECTS, ARMS)) < 0.6
    touched[0], touched[1] = True, False
    coupling[~touched] = 0
    arms = rng.standard_normal((ARMS, JOINTS))

    dense = blocks.transpose(0, 2, 1, 3).reshape(size, size)
    wide = coupling.transpose(0, 2, 1, 3).reshape(size, -1)
    ways = np.linalg.solve(dense, force.ravel() - wide @ arms.ravel()).reshape(OBJECTS, 6)
    single = lambda array: jnp.asarray(array, jnp.float32)  # noqa: E731

    def compared(found: schur.Eliminated, back: Array, joined: bool) -> None:
        np.testing.assert_allclose(back, ways, rtol=2e-3, atol=2e-3)
        left = np.asarray(found.coupling)[: OBJECTS * ARMS].reshape(OBJECTS, ARMS, 6, JOINTS)
        if not joined:
            left = np.where(touched[..., None, None], left, 0.0)
        half, divided = np.asarray(found.force).ravel(), np.moveaxis(left, 2, 1).reshape(size, -1)
        np.testing.assert_allclose(divided.T @ half, wide.T @ np.linalg.solve(dense, force.ravel()), atol=5e-3)
        np.testing.assert_allclose(divided.T @ divided, wide.T @ np.linalg.solve(dense, wide), atol=5e-3)

    own = single(blocks[np.arange(OBJECTS), np.arange(OBJECTS)][:, *np.tril_indices(6)])
    cross = np.where(np.triu(np.ones((OBJECTS, OBJECTS)), 1)[..., None, None], blocks, np.nan)
    met = np.full(((OBJECTS + 1) * ARMS, 6, JOINTS), np.nan)
    met[: OBJECTS * ARMS][touched.ravel()] = coupling[touched]
    given = own, single(cross.ravel()), single(force), single(met), jnp.asarray(touched)
    for joined in {True, bool(linked)}:
        found = schur.eliminate(*given, jnp.bool_(joined))
        compared(found, schur.back_substitute(found, single(arms), jnp.bool_(joined)), joined)


def test_the_curvature_between_two_bodies_is_how_the_force_on_one_falls_with_the_other_s_acceleration() -> None:
    rng, slipping = np.random.default_rng(0), set()
    moved = jax.jit(lambda cone, shift: cone._replace(normal=cone.normal @ shift, along=cone.along @ shift))
    of_both = jax.jit(lambda cone, other, felt: (between(cone, cone, felt), between(cone, other, felt)))
    for _ in range(50):
        cone, stuck = drawn(rng)
        at, shift = (jnp.asarray(rng.standard_normal(shape), jnp.float32) for shape in ((6,), (6, 6)))
        felt = forces(cone, stuck, at)
        slipping.add((bool(felt.slips), bool((felt.normal > 0).any())))
        whole = curvature(cone, felt)[packed(6)]
        itself, other = of_both(cone, moved(cone, shift), felt)
        np.testing.assert_allclose(itself, whole, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(other, whole @ shift, rtol=1e-3, atol=1e-3)
    assert slipping == {(False, True), (True, True), (True, False)}


COUNT, STEPS = 16, 10
"""Of all plays, so that one is compiled."""


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Falling:
    """Objects of 3 g and 0.15 g over a fixed one."""
    folder = tmp_path_factory.mktemp("two")
    return Falling(folder, random_objects(folder, 1))


def test_a_light_object_that_strikes_a_heavy_one_leaves_the_sum_of_momentum(two: Falling) -> None:
    """And no NaN: its mass is a millionth of the contact's stiffness by the square of a step."""
    position = [[[0.00740794, 0.00939682, 0.01944777], [0.01575755, 0.00491731, 0.01326777]]]
    turns = [[[0.20157066, 0.7280144, 0.2499021, 0.60573363], [-0.46010393, -0.15962128, 0.00338563, 0.8733922]]]
    velocity = [
        [
            [-0.24051571, 0.07714931, 0.21508813, 10.225027, 9.881212, 3.6174934],
            [-0.11420292, 0.06757019, -0.22336657, -0.6129833, -5.54218, -7.6091914],
        ]
    ]
    each = {"position": position, "quaternion": turns, "velocity": velocity}
    start = thrown(two.begin(COUNT), **{name: np.repeat(value, COUNT, 0) for name, value in each.items()})
    _, path = two.play(start, STEPS * DT)
    assert all(np.isfinite(part).all() for part in path)
    pushed = path.velocity[0, 0, :, :3] - np.array(velocity)[0, :, :3] - DT * np.array([0, 0, -9.81])
    given = two.masses.mass[:, None] * pushed
    assert np.linalg.norm(pushed[1]) > 0.02, "they do not touch"
    assert np.linalg.norm(given.sum(0)) < 0.02 * np.linalg.norm(given[1])


def test_what_one_object_loses_another_gains(two: Falling) -> None:
    """Thrown at each other at random, far from anything else."""
    rng = np.random.default_rng(1)
    position = np.full((COUNT, 2, 3), 0.5)
    away = rng.standard_normal((COUNT, 3))
    position[:, 1] += 0.009 * away / np.linalg.norm(away, axis=-1, keepdims=True)
    velocity = rng.uniform(-1, 1, (COUNT, 2, 6)) * ([0.3] * 3 + [12.0] * 3)
    start = thrown(two.begin(COUNT), position=position, quaternion=random_turns(rng, COUNT, 2), velocity=velocity)
    _, path = two.play(start, STEPS * DT)
    mass, t = two.masses.mass[:, None], DT * np.arange(1, STEPS + 1)[:, None]
    momentum = (mass * path.velocity[..., :3]).sum(2) - (mass * velocity[:, None, :, :3]).sum(2)
    momentum -= mass.sum() * np.array([0, 0, -9.81]) * t
    pushed = path.velocity[:, -1, :, :3] - velocity[..., :3] - DT * STEPS * np.array([0, 0, -9.81])
    struck = np.abs(pushed[:, 1]).max(-1) > 0.02
    assert struck.sum() >= 4
    assert np.abs(momentum[struck]).max() < 0.01 * np.abs(mass[1] * pushed[struck, 1]).max()
