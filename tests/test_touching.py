"""What touches objects and fixed things is found, whatever the search for it passes by."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from surgical_marl.physics.collision import Pairs
from surgical_marl.physics.dynamics import Dynamics
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.together import Together
from surgical_marl.physics.touching import NEAR
from surgical_marl.scenes.load import load_scene
from tests.helpers.falling import random_turns

STATES = 512


def test_every_pair_that_overlaps_is_found_and_none_that_is_far() -> None:
    """Two arms at postures over the board, and blocks thrown among their tips, the pegs and the wall."""
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
    depths = np.asarray(jax.jit(jax.vmap(together.depths))(states))
    slots = jax.jit(jax.vmap(together.find))(states)
    kinds = np.repeat(np.arange(len(together.tables.meetings)), [len(m.one) for m in together.tables.meetings])
    met: set[int] = set()
    for own, numbers, total in zip(depths, np.asarray(slots.number), np.asarray(slots.total), strict=True):
        found = set(numbers[:total].tolist())
        assert all(own[number] > -2 * NEAR for number in found)
        if total <= len(numbers):
            overlaps = set(np.flatnonzero(own > 1e-5).tolist())
            assert overlaps <= found
            met |= set(kinds[list(overlaps)].tolist())
    assert met >= {k for k, meeting in enumerate(together.tables.meetings) if meeting.second != "objects"}
