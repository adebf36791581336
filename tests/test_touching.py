"""What touches objects and fixed things is found, whatever the search for it passes by."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from surgical_marl.physics.collision import Pairs
from surgical_marl.physics.dynamics import Dynamics
from surgical_marl.physics.simulator import Physics, Simulator
from surgical_marl.physics.together import Together
from surgical_marl.physics.touching import NEAR
from surgical_marl.scenes.load import load_scene
from tests.helpers.falling import random_turns

STATES = 512


class Thrown(NamedTuple):
    """Two arms at postures over a board, and blocks among their tips, the pegs and the wall."""

    together: Together
    states: Physics
    """[STATES, ...]; nothing moves."""
    dt: float
    """Of a physics step, s."""


@pytest.fixture(scope="module")
def thrown() -> Thrown:
    scene, rng = load_scene("bimanual_psm_pegs"), np.random.default_rng(0)
    dynamics, home = Dynamics(scene.model), Simulator(scene).home
    together = Together(scene, dynamics, Pairs(scene.model), ())
    qpos = np.asarray(home.qpos) + rng.uniform(-0.5, 0.5, (STATES, len(home.qpos)))
    depth = np.flatnonzero(together.tables.slides.any(0))[0] + np.array([0, len(home.qpos) // 2])
    qpos[:, depth] = np.asarray(home.qpos)[depth] + rng.uniform(-0.02, 0.1, (STATES, 2))
    board = scene.objects["board"].position
    places = board + rng.uniform([-0.1, -0.05, 0.0], [0.1, 0.05, 0.1], (STATES, 2, 3))
    pegs = board + [[x, y, 0.01] for x in (-0.08, -0.06, 0.04, 0.06) for y in (-0.03, 0.0, 0.03)]
    near = rng.random((STATES, 2)) < 0.7
    places[near] = rng.choice(pegs, near.sum()) + rng.normal(size=(near.sum(), 3)) * 0.005
    fingers = jax.vmap(dynamics.pose)(jnp.asarray(qpos, jnp.float32)).geom_xpos[:, together.tables.pad_geoms[::2]]
    held = rng.random((STATES, 2)) < 0.3
    places[held] = np.asarray(fingers)[held] + rng.normal(size=(held.sum(), 3)) * 0.005
    one = jax.tree.map(lambda x: jnp.repeat(x[None], STATES, 0), home)
    bodies = one.objects.bodies._replace(
        position=jnp.asarray(places, jnp.float32),
        quaternion=jnp.asarray(random_turns(rng, STATES, 2), jnp.float32),
    )
    states = one._replace(qpos=jnp.asarray(qpos, jnp.float32), objects=one.objects._replace(bodies=bodies))
    return Thrown(together, states, float(dynamics.dt))


def test_every_pair_that_overlaps_is_found_and_none_that_is_far(thrown: Thrown) -> None:
    together, states, _ = thrown
    depths = np.asarray(jax.jit(jax.vmap(together.depths))(states))
    slots = jax.jit(jax.vmap(together.find))(states)
    kinds = np.repeat(np.arange(len(together.tables.meetings)), [len(m.one) for m in together.tables.meetings])
    met: set[int] = set()
    for own, numbers, total in zip(depths, np.asarray(slots.number), np.asarray(slots.total), strict=True):
        found = set(numbers[:total].tolist())
        assert all(own[number] > -2 * NEAR for number in found)
        assert len(found) == min(total, len(numbers))  # none twice
        if total <= len(numbers):
            overlaps = set(np.flatnonzero(own > 1e-5).tolist())
            assert overlaps <= found
            met |= set(kinds[list(overlaps)].tolist())
    assert met >= {k for k, meeting in enumerate(together.tables.meetings) if meeting.second != "objects"}


def test_what_will_overlap_after_a_step_is_found_before_it(thrown: Thrown) -> None:
    """Convex shapes that fly straight are at no time nearer than where they were says, with how fast they come."""
    together, states, dt = thrown
    objects, rng = states.objects, np.random.default_rng(1)
    flies = np.zeros((STATES, 2, 6), np.float32)
    flies[..., :3] = rng.normal(size=(STATES, 2, 3)) * 0.8  # 2 mm in a step, 9 at most: within AHEAD
    bodies = objects.bodies._replace(velocity=jnp.asarray(flies))
    after = bodies._replace(position=bodies.position + dt * flies[..., :3])
    slots = jax.jit(jax.vmap(together.find))(states._replace(objects=objects._replace(bodies=bodies)))
    depths = jax.jit(jax.vmap(together.depths))
    before, then = (
        np.asarray(depths(states._replace(objects=objects._replace(bodies=each)))) for each in (bodies, after)
    )
    come = 0
    for own, were, numbers, total in zip(then, before, np.asarray(slots.number), np.asarray(slots.total), strict=True):
        if total <= len(numbers):
            overlaps = set(np.flatnonzero(own > 1e-5).tolist())
            assert overlaps <= set(numbers[:total].tolist())
            come += sum(were[number] < -2 * NEAR for number in overlaps)
    assert come > 50
