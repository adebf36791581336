"""Energy of thread and tissue that touch: it never grows without work."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from surgical_marl.physics.contact.part_detection import PartDetection, Scenery
from surgical_marl.physics.contact.shapes import Plate, Segments
from tests.helpers.thread_bench import Bench, Told, axis_plate, suture
from tests.physics.test_tissue_contact import strip

DT, G = 2.5e-3, 9.81


def assert_no_gain(mass: np.ndarray, position: np.ndarray, velocity: np.ndarray, bounces: float) -> None:
    """Raise AssertionError if kinetic energy and that of height ever exceed those of the first step.

    At the start nothing is stretched and nothing touches. Energy of stretching, bending and contacts is never negative,
    so it can only make these less.

    Args:
        mass: of n nodes, kg, [n].
        position: in each step, m, [t, n, 3].
        velocity: likewise, m/s.
        bounces: share of the energy, above that of rest, that contacts leave at most at the end.
    """
    kinetic = 0.5 * np.einsum("n,tni,tni->t", mass, velocity, velocity)
    whole = kinetic + G * np.einsum("n,tn->t", mass, position[..., 2])
    assert (whole < whole[0] + 1e-3 * kinetic[0]).all()
    assert kinetic[-20:].max() < bounces * kinetic[0]


def test_a_thread_that_is_thrown_at_a_peg_and_a_board_gains_no_energy() -> None:
    n = 24
    path = np.stack([np.linspace(-0.03, 0.03, n), np.zeros(n), np.full(n, 0.01)], 1)
    thread = suture(path, drag=0.0)
    board, peg = axis_plate([0, 0, -1e-3], [0.1, 0.1], 1e-3), ([0.004, 0.006, 0.0], [0.004, 0.006, 0.03], 0.0015)
    bench = Bench(thread, plates=[board], rods=[peg], mu=0.3)
    start = bench.start()
    thrown = start.chain._replace(velocity=jnp.zeros((n, 3)).at[:, 1].set(0.4).at[:, 2].set(-0.2))
    _, seen = bench.run(start._replace(chain=thrown), 800, lambda k: Told())
    places = np.concatenate([path[None], np.asarray(seen.position, float)])
    velocity = np.concatenate([np.asarray(thrown.velocity)[None], np.diff(places, axis=0) / DT])
    assert float(np.asarray(seen.normal).max()) > 1e-5  # it did touch
    assert_no_gain(thread.rod.mass, places, velocity, 0.01)


def test_tissue_that_is_thrown_at_a_board_gains_no_energy() -> None:
    tissue = strip(0.4)
    counts = {"pads": 0, "links": 0, "objects": 0, "plates": 1, "rods": 0}
    detection = PartDetection(counts, [tissue.surface], tissue.contacts)
    board = Plate(jnp.array([[0.02, 0.005, -3e-3]]), jnp.eye(3)[None], jnp.array([[0.015, 0.01]]), jnp.array([1e-3]))
    none = Segments(jnp.zeros((0, 3)), jnp.zeros((0, 3)), jnp.zeros(0))

    def step(state: Any, _: None) -> tuple[Any, tuple[Array, ...]]:
        ends = detection.find(Scenery(board, none, jnp.zeros(1)), tissue.shapes(state), [], [], DT)
        response = tissue.respond(state, tissue.free_motion(state, DT), ends, DT)
        state = tissue.apply(state, response, ends, jnp.zeros((tissue.contacts, 3)), DT)
        return state, (*state.nodes, state.force)

    start = tissue.start(jnp.zeros((0, 3)))
    thrown = jnp.zeros_like(start.nodes.position).at[:, 2].set(-0.3) * tissue.solver.free[:, None]
    begun = start._replace(nodes=start.nodes._replace(velocity=thrown))
    _, seen = jax.jit(lambda state: jax.lax.scan(step, state, None, length=400))(begun)
    position, velocity, force = (np.asarray(part, float) for part in seen)
    assert force.max() > 0.02  # it did touch
    first = (np.asarray(part, float)[None] for part in (begun.nodes.position, begun.nodes.velocity))
    both = (np.concatenate(pair) for pair in zip(first, (position, velocity), strict=True))
    assert_no_gain(tissue.grid.mass * tissue.solver.free, *both, 1e-3)


def no_plates() -> Plate:
    return Plate(jnp.zeros((0, 3)), jnp.zeros((0, 3, 3)), jnp.zeros((0, 2)), jnp.zeros(0))


def total(mass: np.ndarray, position: Any, velocity: Any) -> np.ndarray:
    """Linear and angular momentum of nodes about the origin, kg m/s and kg m2/s, [6]."""
    momentum = mass[:, None] * np.asarray(velocity, float)
    return np.concatenate([momentum.sum(0), np.cross(np.asarray(position, float), momentum).sum(0)])


def test_tissue_that_nothing_holds_keeps_its_momentum() -> None:
    """Thrown, turning and shaken: after a step to rounding, after 100 within a thousandth."""
    tissue, rng = strip(fixed=()), np.random.default_rng(0)
    tissue.solver.gravity = np.zeros(3, np.float32)
    begun, mass = tissue.start(jnp.zeros((0, 3))), tissue.grid.mass
    off = tissue.rest - mass @ tissue.rest / mass.sum()
    thrown = np.array([0.02, -0.01, 0.03]) + np.cross([3.0, -5.0, 8.0], off) + 0.02 * rng.normal(size=off.shape)
    state = begun._replace(nodes=begun.nodes._replace(velocity=jnp.asarray(thrown, jnp.float32)))
    detection = PartDetection(dict.fromkeys(("pads", "links", "objects", "plates", "rods"), 0), [], tissue.contacts)
    scenery = Scenery(no_plates(), Segments(jnp.zeros((0, 3)), jnp.zeros((0, 3)), jnp.zeros(0)), jnp.zeros(0))
    none = detection.find(scenery, tissue.shapes(state), [], [], DT)

    def step(state: Any, _: None) -> tuple[Any, tuple[Array, Array]]:
        response = tissue.respond(state, (), none, DT)
        state = tissue.apply(state, response, none, jnp.zeros((tissue.contacts, 3)), DT)
        return state, (state.nodes.position, state.nodes.velocity)

    position, velocity = jax.jit(lambda state: jax.lax.scan(step, state, None, length=100)[1])(state)
    first = total(mass, *state.nodes)
    for steps, share in ((1, 1e-5), (100, 1e-3)):
        off = total(mass, position[steps - 1], velocity[steps - 1]) - first
        for part in (slice(3), slice(3, 6)):
            assert np.linalg.norm(off[part]) < share * np.linalg.norm(first[part]), steps


@pytest.mark.parametrize("fixed", [("left", "right"), ()], ids=["held", "loose"])
def test_a_light_rod_on_tissue_gains_no_energy(fixed: tuple[str, ...]) -> None:
    """A rod of a needle's mass, which can not turn, falls on it; or flies at it, where nothing holds that."""
    tissue, mass, counts = strip(0.4, fixed=fixed), 4e-4, {"pads": 0, "links": 0, "objects": 1, "plates": 0, "rods": 0}
    weight = G if fixed else 0.0
    tissue.solver.gravity = np.array([0, 0, -weight], np.float32)
    detection = PartDetection(counts, [tissue.surface], tissue.contacts)
    along, radius = jnp.array([[8e-3, 0.0, 0.0]]), jnp.array([5e-4])

    def step(found: Any, _: None) -> tuple[Any, tuple[Array, ...]]:
        state, place, v, last = found
        centre = place + jnp.zeros((1, 3))
        rods = Segments(centre - along, centre + along, radius)
        ends = detection.find(Scenery(no_plates(), rods, jnp.full(1, 2e-3)), tissue.shapes(state), [], [], DT)
        expected = jnp.broadcast_to(DT * (v + DT * last), (tissue.contacts, 3))
        ends = ends._replace(rows=ends.rows._replace(shift=expected))
        response = tissue.respond(state, tissue.free_motion(state, DT), ends, DT)
        real = (jnp.arange(tissue.contacts) < ends.moving)[:, None]

        def yields(unit: Array) -> Array:
            return jnp.sum(real * tissue.yielding(response, ends, real * unit, DT), 0)

        block = jax.vmap(yields)(jnp.eye(3))
        force = jnp.array([0, 0, -mass * weight]) + jnp.sum(real * response.force, 0) + block @ last
        now = jnp.linalg.solve(mass * jnp.eye(3) + block, force)
        state = tissue.apply(state, response, ends, real * (now - last), DT)
        place, v = place + DT * (v + DT * now), v + DT * now
        return (state, place, v, now), (*state.nodes, place, v, jnp.abs(response.force[:, 2] * real[:, 0]).max())

    begun = tissue.start(jnp.zeros((0, 3)))
    state = begun, jnp.array([0.015, 0.005, 0.0058]), jnp.array([0.02, 0.0, -0.05]), jnp.array([0, 0, -weight])
    seen = jax.jit(lambda state: jax.lax.scan(step, state, None, length=400)[1])(state)
    position, velocity, place, speed, force = (np.asarray(part, float) for part in seen)
    assert force.max() > 1e-3  # it did touch
    masses = np.append(tissue.grid.mass * tissue.solver.free, mass)
    positions, velocities = (
        np.concatenate([np.concatenate([np.asarray(one, float)[None], np.asarray(other, float)[None, None]], 1),
                        np.concatenate([nodes, rod[:, None]], 1)])
        for one, other, nodes, rod in ((begun.nodes.position, state[1], position, place),
                                       (begun.nodes.velocity, state[2], velocity, speed))
    )  # fmt: skip
    kinetic = 0.5 * np.einsum("n,tni,tni->t", masses, velocities, velocities)
    whole = kinetic + weight * np.einsum("n,tn->t", masses, positions[..., 2])
    assert (whole < whole[0] + 1e-3 * kinetic[0]).all()
    if not fixed:
        momentum = np.einsum("n,tni->ti", masses, velocities)
        np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), atol=1e-3 * 0.05 * mass)
