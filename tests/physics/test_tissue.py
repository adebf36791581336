"""Soft tissue by itself: the element against algebra, a sheet against closed forms and other solvers."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import eigsh, spsolve

from docs.studies.tissue_mesh import PATCH, PRESS, REFERENCE, SIZE
from surgical_marl.physics.systems.brick import CORNERS, Brick, polar_rotation, stiffness
from surgical_marl.physics.systems.brick_grid import BrickGrid
from surgical_marl.physics.systems.brick_solve import BrickSolver, Nodes, Support
from surgical_marl.physics.systems.system import Springs
from tests.helpers.fused_kernels import run

YOUNG, POISSON, DENSITY = 27040.0, 0.4287, 1000.0
BRICK = Brick(np.array([0.005, 0.004, 0.003]), YOUNG, POISSON)
CORNER = CORNERS * BRICK.size
RIM = ("left", "right", "front", "back")


def sheet(
    cells: tuple[int, int, int] = (12, 8, 1), held: tuple[str, ...] = RIM, density: float = DENSITY, **options: Any
) -> BrickSolver:
    grid = BrickGrid(SIZE, np.ones(cells, bool), density)
    fixed = np.zeros(grid.nodes, bool)
    for side in held:
        fixed |= grid.side(side)
    support = Support(fixed, np.zeros(grid.nodes, np.float32), grid.rest)
    return BrickSolver(grid, Brick(grid.cell, YOUNG, POISSON), support, **{"damping": 2e-3, "iterations": 60} | options)


def pushed(solver: BrickSolver, force: np.ndarray) -> Springs:
    """Springs that do nothing but push nodes with a force [n, 3], N."""
    (nodes,) = np.nonzero(np.abs(force).sum(1))
    four = np.repeat(nodes[:, None], 4, 1).astype(np.int32)
    none = np.zeros((len(nodes), 6), np.float32)
    weights = np.tile(np.float32([1.0, 0.0, 0.0, 0.0]), (len(nodes), 1))
    parts = four, weights, force[nodes].astype(np.float32), none
    return Springs(*map(jnp.asarray, parts), jnp.int32(len(nodes)))


def settled(solver: BrickSolver, *springs: Springs, dt: float = 0.05, steps: int = 12) -> np.ndarray:
    """Displacements at rest, m, [n, 3], after long implicit steps."""
    start = Nodes(jnp.asarray(solver.grid.rest), jnp.zeros((solver.grid.nodes, 3)))
    step = jax.jit(lambda now: jax.lax.fori_loop(0, steps, lambda _, now: solver.step(now, dt, springs), now))
    final = step(start)
    assert np.abs(final.velocity).max() < 1e-5
    return np.asarray(final.position, float) - solver.grid.rest


def matrix_of(solver: BrickSolver) -> Any:
    """The stiffness matrix of the mesh at rest, sparse, float64, [3 n, 3 n]."""
    grid = solver.grid
    places = (3 * (grid.first[:, None] + grid.offsets)[:, :, None] + np.arange(3)).reshape(-1, 24)
    own = stiffness(grid.cell, YOUNG, POISSON)
    where = np.repeat(places, 24, 1).ravel(), np.tile(places, (1, 24)).ravel()
    return sparse.coo_matrix((np.tile(own.ravel(), len(places)), where)).tocsc()


def linear(solver: BrickSolver, force: np.ndarray) -> np.ndarray:
    """Displacements of linear elasticity on this mesh, m, [n, 3], solved exactly."""
    free = np.flatnonzero(np.repeat(solver.free, 3))
    found = np.zeros(force.size)
    found[free] = spsolve(matrix_of(solver)[free][:, free], force.ravel()[free])
    return found.reshape(-1, 3)


# -- the element


def turned(seed: int, stretch: float, noise: float) -> np.ndarray:
    """Nodes [8, 3] of the brick: turned, stretched and shaken, m."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    return (CORNER * [stretch, 1.0, 1.0] + noise * rng.normal(size=(8, 3))) @ turn.T


def test_at_rest_it_is_the_linear_element() -> None:
    matrix = stiffness(BRICK.size, YOUNG, POISSON)
    u = 1e-6 * np.random.default_rng(0).normal(size=(8, 3))
    cell, forces = jax.jit(BRICK.deformed)(jnp.asarray(CORNER, jnp.float32))
    assert np.abs(forces).max() == 0
    expected = (matrix @ u.ravel()).reshape(8, 3)
    found = jax.jit(BRICK.product)(cell, jnp.asarray(u, jnp.float32))
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_its_own_modes_leave_six_free_motions() -> None:
    values = np.linalg.eigvalsh(stiffness(BRICK.size, YOUNG, POISSON))
    assert (np.abs(values) < 1e-9 * values[-1]).sum() == 6


def in_float64(function: Callable[[], Any]) -> Any:
    """Return the results of a function in a process of its own, where JAX has met no other type before."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function).result()


def gradients() -> tuple[np.ndarray, ...]:
    """Return random shapes of a brick [50, 8, 3], its forces, their derivative and the model of it, in float64."""

    def one(x: Any) -> tuple[Any, Any, Any]:
        forces = lambda x: BRICK.deformed(x)[1]  # noqa: E731
        cell = BRICK.deformed(x)[0]
        model = jax.vmap(lambda u: BRICK.product(cell, u))(jnp.eye(24).reshape(24, 8, 3))
        return forces(x), -jax.jacobian(forces)(x).reshape(24, 24), model.reshape(24, 24)

    shapes = np.random.default_rng(0).uniform(0.4, 2.0, (50, 2)) * [1, 2e-4]
    with jax.enable_x64(True):
        x = np.stack([turned(k, stretch, noise) for k, (stretch, noise) in enumerate(shapes)])
        return x, *(np.asarray(part) for part in jax.jit(jax.vmap(one))(jnp.asarray(x)))


def test_its_forces_are_a_gradient_and_conjugate_gradients_can_use_its_derivative() -> None:
    """On random shapes: no net force, no torque; the derivative is symmetric, its model too and positive."""
    x, forces, falls, model = in_float64(gradients)
    largest = np.abs(falls).max((1, 2), keepdims=True)
    assert forces.dtype == np.float64
    assert np.abs(forces.sum(1)).max() < 1e-12 and np.abs(np.cross(x, forces).sum(1)).max() < 1e-12
    assert np.abs((falls - falls.swapaxes(1, 2)) / largest).max() < 1e-6
    assert np.abs((model - model.swapaxes(1, 2)) / largest).max() < 1e-9
    assert (np.linalg.eigvalsh(model)[:, 0] > -1e-9 * largest[:, 0, 0]).all()


def derivative() -> tuple[np.ndarray, np.ndarray]:
    """Return the model's derivative along a direction, and the exact one, both in float64."""
    with jax.enable_x64(True):
        x, u = jnp.asarray(turned(0, 1.5, 0.0)), jnp.asarray(np.random.default_rng(1).normal(size=(8, 3)))
        exact = -jax.jit(lambda x, u: jax.jvp(lambda x: BRICK.deformed(x)[1], (x,), (u,))[1])(x, u)
        found = jax.jit(lambda x, u: BRICK.product(BRICK.deformed(x)[0], u))(x, u)
        return np.asarray(found), np.asarray(exact)


def test_its_derivative_is_exact_when_stretched() -> None:
    found, exact = in_float64(derivative)
    np.testing.assert_allclose(found, exact, atol=1e-6 * np.abs(exact).max())


def test_a_rotation_is_the_nearest_one_also_inside_out() -> None:
    turns = np.stack([(turned(k, 1.0, 0.0) - turned(k, 1.0, 0.0)[0])[[4, 2, 1]].T / BRICK.size for k in range(20)])
    stretches = np.stack([np.diag([1.0, 1.2, thick]) for thick in np.linspace(-0.5, 2.0, 20)])
    found = jax.jit(jax.vmap(polar_rotation))(jnp.asarray(turns @ stretches, jnp.float32))
    np.testing.assert_allclose(found, turns, atol=2e-6)


def test_a_rotation_is_the_nearest_one_of_bricks_that_are_drawn_out_and_flattened() -> None:
    """Sides have ratios of up to 100, so edges are nearly parallel; and one that was met under a tool."""
    rng = np.random.default_rng(0)
    turns = np.linalg.qr(rng.normal(size=(2, 2000, 3, 3)))[0]
    stretch = np.exp(rng.uniform(np.log(0.05), np.log(5), (2000, 1, 3)))
    met = np.array([[1.304, 1.5666, -0.0046], [-1.2026, -1.0681, -0.0274], [1.3389, 2.0791, 0.3517]])
    drawn = turns[0] * stretch @ turns[1]
    drawn *= np.sign(np.linalg.det(drawn))[:, None, None]
    drawn[0] = met
    u, _, v = np.linalg.svd(drawn)
    found = jax.jit(jax.vmap(polar_rotation))(jnp.asarray(drawn, jnp.float32))
    np.testing.assert_allclose(found, u @ v, atol=1e-5)


def test_a_crushed_brick_pushes_back_much_harder() -> None:
    def pressure(share: float) -> float:
        x = jnp.asarray(CORNER * [1, 1, share], jnp.float32)
        return float(jax.jit(BRICK.deformed)(x)[1][CORNERS[:, 2] == 1, 2].sum()) / np.prod(BRICK.size[:2]) / YOUNG

    law = (1 - POISSON) / (1 + POISSON) / (1 - 2 * POISSON)
    assert pressure(0.6) == pytest.approx(0.4 * law, rel=1e-4)
    assert pressure(0.2) > 1.2 * 0.8 * law and pressure(0.05) > 40


# -- a sheet


def test_uniaxial_stretch_is_exact_on_any_mesh() -> None:
    for cells in ((4, 3, 1), (4, 3, 2)):
        solver = sheet(cells, held=(), density=1e-3)
        solver.gravity = np.zeros(3, np.float32)
        faint = np.full(solver.grid.nodes, 1e-3, np.float32)  # holds the whole, against rounding
        solver.support = solver.support._replace(stiffness=faint)
        areas = solver.grid.areas("right") - solver.grid.areas("left")
        pull = 0.3
        force = np.zeros((solver.grid.nodes, 3))
        force[:, 0] = pull * areas / SIZE[1:].prod()
        u = settled(solver, pushed(solver, force))
        sides = [u[solver.grid.side(name), 0].mean() for name in ("left", "right")]
        exact = pull * SIZE[0] / (YOUNG * SIZE[1] * SIZE[2])
        assert sides[1] - sides[0] == pytest.approx(exact, rel=1e-4), cells


def test_it_droops_as_its_mesh_and_nearly_as_a_converged_one() -> None:
    share = 0.1  # of its weight, so that it is linear
    solver = sheet(density=share * DENSITY)
    middle = int(np.flatnonzero((solver.grid.places == [6, 4, 1]).all(1))[0])
    force = solver.grid.mass[:, None] * np.array([0.0, 0.0, -9.81])
    found, exact = (-1e3 / share * u[middle, 2] for u in (settled(solver), linear(solver, force)))
    assert found == pytest.approx(exact, rel=1e-3)
    assert found == pytest.approx(REFERENCE[POISSON].droop, rel=0.05)


def test_it_is_indented_as_its_mesh_and_nearly_as_a_converged_one() -> None:
    share = 0.02
    solver = sheet(density=1e-3)
    place = np.abs(solver.grid.rest - [*SIZE[:2] / 2, SIZE[2]])
    weight = ((place[:, :2] < PATCH + 1e-6).all(1) & (place[:, 2] < 1e-6)) / 4.0
    weight *= np.where(place[:, :2] > PATCH / 2, 0.5, 1.0).prod(1)
    force = np.outer(weight, [0.0, 0.0, -share * PRESS])
    found, lifted, exact = (
        -1e3 / share * (weight @ u[:, 2])
        for u in (
            settled(solver, pushed(solver, force)),
            settled(solver, pushed(solver, -force)),
            linear(solver, force),
        )
    )
    found = (found - lifted) / 2  # a sheet that is pressed is a little softer than one that is pulled
    assert weight.sum() == pytest.approx(1.0)
    assert found == pytest.approx(exact, rel=1e-3)
    assert found == pytest.approx(REFERENCE[POISSON].pressed, rel=0.1)


def test_it_swings_at_its_frequency_with_the_damping_that_is_stated() -> None:
    """Implicit Euler damps like a damping of dt more."""
    dt, damping, steps = 5e-4, 1e-3, 400
    solver = sheet((6, 4, 1), damping=damping, iterations=10)
    solver.gravity = 0.0 * solver.gravity
    free = np.flatnonzero(np.repeat(solver.free, 3))
    inertia = sparse.diags(np.repeat(solver.grid.mass, 3)[free].astype(float))
    values, modes = eigsh(matrix_of(solver)[free][:, free], 1, inertia, sigma=0.0)
    mode, omega = np.zeros(3 * solver.grid.nodes), float(np.sqrt(values[0]))
    mode[free] = modes[:, 0] / np.abs(modes).max()
    velocity = jnp.asarray(0.02 * mode.reshape(-1, 3), jnp.float32)

    def step(now: Nodes, _: Any) -> tuple[Nodes, jax.Array]:
        after = solver.step(now, dt)
        return after, jnp.sum((after.position - solver.grid.rest) * velocity)

    _, swing = jax.lax.scan(step, Nodes(jnp.asarray(solver.grid.rest), velocity), None, length=steps)
    swing = np.asarray(swing, float)
    zeros = np.flatnonzero(np.diff(np.sign(swing)) != 0)
    zeros = zeros + swing[zeros] / (swing[zeros] - swing[zeros + 1])
    assert np.pi / (np.diff(zeros).mean() * dt) == pytest.approx(omega, rel=0.05)
    peaks = np.array([np.abs(swing[int(a) : int(b) + 1]).max() for a, b in pairwise(zeros)])
    decay = -np.polyfit(np.arange(len(peaks)) * np.pi / omega, np.log(peaks), 1)[0]
    assert decay == pytest.approx(omega**2 * (damping + dt) / 2, rel=0.05)


def test_a_kernel_steps_it_as_jax_does() -> None:
    solver = sheet((3, 2, 2), held=("left",), iterations=4)
    rng = np.random.default_rng(0)
    x = solver.grid.rest + rng.uniform(-3e-4, 3e-4, (2, solver.grid.nodes, 3)).astype(np.float32)
    state = Nodes(x, rng.uniform(-0.05, 0.05, x.shape).astype(np.float32))
    found = run(lambda state: solver.step(state, 2.5e-3), state)
    expected = jax.vmap(lambda state: solver.step(state, 2.5e-3))(state)
    np.testing.assert_allclose(found.position, expected.position, atol=1e-7)
    np.testing.assert_allclose(found.velocity, expected.velocity, atol=5e-5)
