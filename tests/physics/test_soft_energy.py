"""Energy of thread and tissue that touch: it never grows without work."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
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
