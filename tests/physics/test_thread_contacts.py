"""Contacts of a thread that are passed over for speed could not have touched; a thread at rest sleeps and wakes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from surgical_marl.physics.contact.part_detection import NEAR, PartDetection, Scenery, on_face
from surgical_marl.physics.contact.shapes import Plate, Segments, between_segments
from surgical_marl.physics.systems import crossings
from surgical_marl.physics.systems.system import Shapes
from surgical_marl.scenes.objects import Surface
from tests.helpers.thread_bench import DT, Bench, Told, axis_plate, suture

NODES, EDGE, RADIUS, ROOM = 40, 2.56e-3, 0.11e-3, 300
COUNTS = {"pads": 3, "links": 2, "objects": 2, "plates": 2, "rods": 2}


def chains(rng: np.random.Generator, many: int) -> np.ndarray:
    """Return chains that turn by more and more from edge to edge, from nearly straight to tangled, m, [many, n, 3]."""
    ways = np.zeros((many, NODES - 1, 3))
    ways[:, 0, 0] = 1.0
    for k in range(1, NODES - 1):
        turn = np.geomspace(0.02, 2.0, many)[:, None] * rng.normal(size=(many, 3)) * [1.0, 1.0, 0.01]
        ways[:, k] = ways[:, k - 1] + turn
        ways[:, k] /= np.linalg.norm(ways[:, k], axis=-1, keepdims=True)
    edges = EDGE * rng.uniform(0.9, 1.1, (many, NODES - 1, 1)) * ways
    return np.concatenate([np.zeros((many, 1, 3)), np.cumsum(edges, 1)], 1).astype(np.float32)


def capsules(nodes: jax.Array, speed: float = 0.0) -> Shapes:
    return Shapes(nodes[:-1], nodes[1:], np.full(NODES - 1, RADIUS, np.float32), jnp.full(NODES - 1, speed))


def test_a_chain_finds_all_of_its_crossings() -> None:
    nodes = chains(np.random.default_rng(0), 200)

    def found(nodes: jax.Array) -> Any:
        ends = crossings.find(capsules(nodes), jnp.zeros_like(nodes), ROOM, 1e4, 0.3, DT)
        return ends.rows.shape, ends.rows.part, ends.total

    def depths(nodes: jax.Array) -> jax.Array:
        own = Segments(nodes[:-1], nodes[1:], jnp.full(NODES - 1, RADIUS))
        pair = jax.vmap(between_segments, (0, None))
        return jax.vmap(lambda k: pair(own, jax.tree.map(lambda x: x[k], own)).depth)(jnp.arange(NODES - 1))

    depth = np.asarray(jax.jit(jax.vmap(depths))(nodes))
    crossed = 0
    for first, second, total, own in zip(*jax.jit(jax.vmap(found))(nodes), depth, strict=True):
        listed = set(zip(np.asarray(first)[:total].tolist(), np.asarray(second)[:total].tolist(), strict=True))
        sure, may = (np.argwhere(np.triu(own > -NEAR + off, crossings.APART)) for off in (1e-7, -1e-7))
        assert set(map(tuple, sure.tolist())) <= listed <= set(map(tuple, may.tolist()))
        crossed += len(listed)
    assert crossed > 100


def test_a_chain_finds_all_shapes_that_it_touches() -> None:
    """Beside shapes that move, and some that do not."""
    rng, many = np.random.default_rng(1), 100
    turns = np.linalg.qr(rng.normal(size=(many, 5, 3, 3)))[0]
    place = rng.uniform(-0.03, 0.05, (many, 11, 3))
    plates = Plate(place[:, :5], turns, rng.uniform(1e-3, 0.03, (many, 5, 2)), rng.uniform(2e-4, 4e-3, (many, 5)))
    along = 0.02 * rng.normal(size=(many, 6, 3)) * (rng.uniform(size=(many, 6, 1)) > 0.2)  # one in five is a sphere
    rods = Segments(place[:, 5:], place[:, 5:] + along, rng.uniform(2e-4, 4e-3, (many, 6)))
    moves = rng.uniform(0.0, 3e-3, (many, 11))
    detection = PartDetection(COUNTS, [Surface(0.3, 0.0, 1e4)] * 11, ROOM)
    order = np.r_[0:3, 5:9, 3:5, 9:11]  # shapes by number: plates are 0 to 4, capsules 5 to 10

    def found(nodes: jax.Array, scenery: Scenery) -> Any:
        ends = detection.find(scenery, capsules(nodes), [], [], DT)
        return ends.rows.shape, ends.rows.part, ends.total, detection.visited(scenery, capsules(nodes), DT)

    def depths(nodes: jax.Array, scenery: Scenery) -> jax.Array:
        own = Segments(nodes[:-1], nodes[1:], jnp.full(NODES - 1, RADIUS))
        flat = jax.vmap(lambda x: jax.vmap(lambda y: on_face(y, x)[0].depth)(own))(scenery.plates)
        round_ = jax.vmap(lambda x: jax.vmap(lambda y: between_segments(y, x).depth)(own))(scenery.capsules)
        return jnp.concatenate([flat, round_])[order]

    given = chains(rng, many), jax.tree.map(np.float32, Scenery(plates, rods, moves))
    touched = 0
    for shape, part, total, visited, depth, moved in zip(
        *jax.jit(jax.vmap(found))(*given), jax.jit(jax.vmap(depths))(*given), moves, strict=True
    ):
        listed = set(zip(np.asarray(shape)[:total].tolist(), np.asarray(part)[:total].tolist(), strict=True))
        reach = -NEAR - moved[:, None]
        sure, may = (np.argwhere(np.asarray(depth) > reach + off) for off in (1e-6, -1e-6))
        assert set(map(tuple, sure.tolist())) <= listed <= set(map(tuple, may.tolist()))
        assert visited or not any(shape < 7 for shape, _ in listed)
        touched += len(listed)
    assert touched > 100


@pytest.mark.parametrize(
    ("place", "moves", "visited"), [(0.02, 1e-6, False), (0.02, 5e-3, False), (4e-4, 1e-6, True), (4e-4, 0.0, False)]
)
def test_what_moves_near_it_wakes_a_thread(place: float, moves: float, visited: bool) -> None:
    """A rod across it that is this high above it; one that lies still does not."""
    counts = {"pads": 0, "links": 1, "objects": 0, "plates": 1, "rods": 0}
    plates = Plate(*(jnp.asarray(x, jnp.float32)[None] for x in axis_plate((0.05, 0, -0.005), (0.1, 0.1), 5e-3)))
    rods = Segments(jnp.array([[0.05, -0.1, place]]), jnp.array([[0.05, 0.1, place]]), jnp.full(1, 1e-4))
    nodes = jnp.asarray(np.linspace([0.0, 0.0, RADIUS], [0.1, 0.0, RADIUS], NODES), jnp.float32)
    detection = PartDetection(counts, [Surface(0.3, 0.0, 1e4)] * 2, ROOM)
    found = detection.visited(Scenery(plates, rods, jnp.array([moves, 0.0])), capsules(nodes), DT)
    assert bool(found) == visited


def test_a_thread_sleeps_as_it_lies_still_and_not_as_it_turns_back() -> None:
    """It is thrown up from a board, and stands still in the air for a moment."""
    path = np.linspace([0.0, 0.0, RADIUS - 1e-8], [0.1, 0.0, RADIUS - 1e-8], NODES)
    bench = Bench(suture(path), plates=[axis_plate((0.05, 0.0, -0.005), (0.1, 0.1), 5e-3)])
    state = bench.start()
    awake = bench.thread.awake
    assert awake(state)
    step = jax.jit(lambda state: bench.step(state, Told(), 0.0)[0])
    thrown = state._replace(chain=state.chain._replace(velocity=state.chain.velocity.at[:, 2].set(0.1)))
    for _ in range(6):  # up, and down again after four steps
        thrown = step(thrown)
        assert awake(thrown)
    for _ in range(200):
        thrown = step(thrown)
    assert not awake(thrown) and abs(float(thrown.chain.position[20, 2]) - RADIUS) < 1e-6
