"""A chain of nodes against closed forms: catenary, elastica, stretch; its energy and its momentum."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

from surgical_marl.physics.systems.chain import ChainState, Loaded, Rod, free_forces, search, solve

NYLON, DENSITY, DIAMETER = 2e9, 1140.0, 0.22e-3
HOLD = 1e5
"""Stiffness of the springs that hold nodes in these tests, N/m."""


def rod(nodes: int, length: float, **more: Any) -> Rod:
    area, inertia = np.pi * DIAMETER**2 / 4, np.pi * DIAMETER**4 / 64
    return Rod(nodes, length / (nodes - 1), DENSITY * area, NYLON * area, NYLON * inertia)._replace(**more)


def play(rod: Rod, place: np.ndarray, steps: int, dt: float, held: Any = (), pull: Any = 0.0) -> tuple[ChainState, Any]:
    """Return the chain after some steps with some nodes held, and all positions and velocities on the way."""
    n, at = rod.nodes, jnp.asarray(place, jnp.float32)
    stiff = np.zeros((n, 1), np.float32)
    stiff[list(held)] = HOLD
    own = jnp.asarray(stiff * [1, 0, 1, 0, 0, 1], jnp.float32)
    holds = np.append(np.ones(n - 1), 0.0).astype(np.float32)

    def step(state: ChainState, _: None) -> tuple[ChainState, Any]:
        def load(u: Array, _: Array) -> Loaded:
            return Loaded(-stiff * (u + (state.position - at)) + pull, own, jnp.zeros((n, 6)))

        found = search(rod, state, free_forces(rod, state, dt), load, dt, 4, holds)
        u, tension = found.shift + found.change[:, :3], found.tension + found.change[:, 3]
        state = ChainState(state.position + u, u / dt, tension)
        return state, (state.position, state.velocity)

    still = jnp.zeros((n, 3), jnp.float32)
    run = jax.jit(lambda state: jax.lax.scan(step, state, None, length=steps))
    final, path = run(ChainState(at, still, still[:, 0]))
    return final, path


def line(nodes: int, length: float, start: float = 0.0, axis: int = 0) -> np.ndarray:
    place = np.zeros((nodes, 3))
    place[:, axis] = start + np.linspace(0.0, length, nodes)
    return place


def test_it_hangs_as_a_catenary() -> None:
    """A chain of straight edges, without stiffness to bending: each bears the weight of the nodes below it."""
    n, whole, span = 60, 0.3, 0.2
    chain, s = rod(n, whole, drag=4.0, bending=0.0), np.linspace(-whole / 2, whole / 2, n)
    place = line(n, span, -span / 2)
    place[:, 2] = -np.sqrt(whole**2 - span**2) / 2 * (1 - np.abs(s) / (whole / 2))  # begins as a tent
    final, _ = play(chain, place, 300, 0.02, held=(0, n - 1))

    def edges(level: float) -> tuple[np.ndarray, np.ndarray]:
        upright = chain.density * 9.81 * chain.length * (np.arange(n - 1) - (n - 2) / 2)
        return level / np.hypot(level, upright), upright / np.hypot(level, upright)

    level = brentq(lambda level: chain.length * edges(level)[0].sum() - span, 1e-7, 1e-2)
    sag = -chain.length * edges(level)[1][: n // 2].sum()
    np.testing.assert_allclose(-np.asarray(final.position)[n // 2 - 1 : n // 2 + 1, 2].mean(), sag, rtol=1e-3)
    np.testing.assert_allclose(final.tension[n // 2 - 1], level, rtol=1e-3)


def test_it_bends_as_the_elastica() -> None:
    """The clamp is in the middle of the edge between the two nodes that are held."""
    n, free = 40, 0.08
    length = free / (n - 1.5)
    chain = rod(n, length * (n - 1), drag=10.0)
    final, _ = play(chain, line(n, length * (n - 1), -length / 2), 100, 0.05, held=(0, 1))

    def ode(s: np.ndarray, y: np.ndarray) -> np.ndarray:  # angle, its slope, x, z
        turn = chain.density * 9.81 * (free - s) * np.cos(y[0]) / chain.bending
        return np.stack([y[1], turn, np.cos(y[0]), np.sin(y[0])])

    s = np.linspace(0, free, 200)
    guess = np.stack([0 * s, 0 * s, s, 0 * s])
    found = solve_bvp(ode, lambda a, b: np.array([a[0], b[1], a[2], a[3]]), s, guess, tol=1e-7, max_nodes=20000)
    np.testing.assert_allclose(-final.position[-1, 2], abs(found.y[3, -1]), rtol=2e-3)


def test_it_stretches_by_its_stiffness() -> None:
    n, length, load = 40, 0.2, 1.0
    chain, pull = rod(n, length, drag=10.0), np.zeros((n, 3), np.float32)
    pull[-1, 2] = -load
    final, _ = play(chain, -line(n, length, axis=2), 60, 0.05, held=(0,), pull=pull)
    strain = float(final.position[0, 2] - final.position[-1, 2]) / length - 1
    np.testing.assert_allclose(strain, (load + chain.density * 9.81 * length / 2) / chain.axial, rtol=1e-4)
    np.testing.assert_allclose(final.tension[0], load + chain.mass[1:].sum() * 9.81, rtol=1e-4)


def test_it_falls_freely_and_keeps_its_momentum() -> None:
    """A bent chain unbends as it falls, and its centre of mass does not notice."""
    n, dt, steps = 20, 2.5e-3, 80
    angle = np.linspace(0, 2.0, n)
    chain = rod(n, 0.02 * 2 * (n - 1) * np.sin(1.0 / (n - 1)))
    place = 0.02 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    final, _ = play(chain, place, steps, dt)
    share = chain.mass / chain.mass.sum()
    velocity, way = share @ np.asarray(final.velocity), share @ (np.asarray(final.position) - place)
    np.testing.assert_allclose(velocity, [0, 0, -9.81 * steps * dt], atol=2e-4)
    np.testing.assert_allclose(way, [0, 0, -9.81 * dt**2 * steps * (steps + 1) / 2], atol=1e-5)
    assert np.abs(np.asarray(final.velocity) - velocity).max() < 0.5


def test_its_energy_never_grows() -> None:
    """It swings, held at one end, and whips: energy of motion, height, bending and stretch in one sum."""
    n, dt = 30, 2.5e-3
    chain = rod(n, 0.1)
    _, (position, velocity) = play(chain, line(n, 0.1), 600, dt, held=(0,))
    x, v = np.asarray(position, float), np.asarray(velocity, float)
    edges = np.diff(x, axis=1)
    stretch = np.linalg.norm(edges, axis=-1) - chain.length
    bend = np.diff(edges, axis=1)
    energy = (
        chain.mass / 2 @ (v**2).sum(-1).T + 9.81 * x[..., 2] @ chain.mass
        + chain.axial / chain.length / 2 * (stretch**2).sum(-1)
        + chain.bending / chain.length**3 / 2 * (bend**2).sum((-1, -2)) + HOLD / 2 * (x[:, 0] ** 2).sum(-1)
    )  # fmt: skip
    scale = 9.81 * 0.05 * chain.mass.sum()
    assert np.diff(energy).max() < 2e-3 * scale
    assert energy[-1] < energy[0]


def test_the_factors_solve_the_step_s_own_matrix() -> None:
    """Forces beside those of the step move the nodes as the whole matrix says, whatever holds them."""
    n, rng = 7, np.random.default_rng(0)
    chain = rod(n, 0.02)
    holds = np.append(np.ones(n - 1), 0.0).astype(np.float32)
    place = line(n, 0.0202) + rng.normal(0, 2e-5, (n, 3))  # all edges are stretched
    state = ChainState(jnp.asarray(place, jnp.float32), jnp.zeros((n, 3)), jnp.zeros(n))
    shapes = rng.normal(0, 30.0, (n, 3, 3))
    own = shapes @ np.swapaxes(shapes, 1, 2)
    falls = jnp.asarray(own[:, np.tril_indices(3)[0], np.tril_indices(3)[1]], jnp.float32)

    def load(u: Array, _: Array) -> Loaded:
        return Loaded(-jnp.einsum("nij,nj->ni", jnp.asarray(own, jnp.float32), u), falls, jnp.zeros((n, 6)))

    def steady(pull: Array) -> Any:
        return search(chain, state, pull, load, 2.5e-3, 12, holds)

    base = free_forces(chain, state, 2.5e-3)
    push = jnp.asarray(rng.normal(0, 1e-3, (n, 3)), jnp.float32)
    one, other = (jax.jit(steady)(base + way * push) for way in (-0.5, 0.5))
    change = solve(chain, jax.jit(steady)(base).factors, push, holds)
    np.testing.assert_allclose(change[:, :3], other.shift - one.shift, atol=3e-2 * float(jnp.abs(change[:, :3]).max()))
