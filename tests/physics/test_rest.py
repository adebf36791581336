"""Objects that have come to rest stay as they are, and wake as soon as anything comes."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from surgical_marl.physics.contact.broadphase import Ball, Placed
from surgical_marl.physics.contact.shapes import Segments
from surgical_marl.physics.systems import sleeping
from surgical_marl.physics.systems.sleeping import Company, company
from tests.helpers.falling import Falling, Trace, random_turns, thrown, wide_pad


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> Falling:
    """Three blocks 20 mm above a pad so wide that nothing rolls off it, 30 mm from each other."""
    folder = tmp_path_factory.mktemp("rest")
    places = {name: {"object": "block", "position": [0.03 * k, 0.0, 0.02]} for k, name in enumerate("abc")}
    return Falling(folder, {"pad": wide_pad(folder), **places})


def second(blocks: Falling, objects: Any, slow: float = sleeping.SLOW) -> tuple[Any, Trace]:
    """What eight environments do in a second: one number and one time, so that one step is compiled."""
    return blocks.play(objects, 1.0, slow=slow)


def at_rest(objects: Any) -> np.ndarray:
    bodies = objects.bodies
    return np.asarray((bodies.velocity == 0).all(-1) & (bodies.acceleration == 0).all(-1))


def test_what_was_thrown_comes_to_rest_and_stays_there_to_the_bit(blocks: Falling) -> None:
    """And lies where it would lie if nothing were ever at rest."""
    start = blocks.begin(8)
    start = thrown(start, quaternion=random_turns(np.random.default_rng(3), 8, 3))
    assert not at_rest(start).any()
    (after, path), (other, moved) = second(blocks, start), second(blocks, start, slow=0.0)
    assert at_rest(after).all() and not at_rest(other).any()
    assert np.abs(path.position - moved.position).max() < 1e-4
    later, _ = second(blocks, after)
    for name in after.bodies._fields:
        assert np.array_equal(getattr(later.bodies, name), getattr(after.bodies, name)), name


def test_a_struck_object_moves_and_so_does_what_lies_behind_it(blocks: Falling) -> None:
    """Blocks a, b and c lie in a row, b and c against each other: what slides against b moves both."""
    rested, _ = second(blocks, blocks.begin(8))
    assert at_rest(rested).all()
    velocity, place = np.zeros((8, 3, 6)), np.array(rested.bodies.position)
    place[:, 1, 0] = place[:, 2, 0] - 2 * blocks.bodies.tables.bound[0]
    place[:, 0, 0] = place[:, 1, 0] - 2 * blocks.bodies.tables.bound[0] - 0.001
    velocity[:, 0, 0] = np.linspace(0.6, 1.3, 8)
    struck = thrown(rested, velocity=velocity, position=place)
    (_, path), (_, moved) = second(blocks, struck), second(blocks, struck, slow=0.0)
    ways = np.ptp(path.position[..., 0], 1)  # [E, k]
    assert (ways[:, :2] > 1e-3).all() and (ways[-1] > 1e-3).all(), ways
    assert np.abs(path.position - moved.position).max() < 2e-4
    assert (np.diff(ways.sum(1)) > 0).all(), "the faster the first one, the farther all slide: no impact is cut short"


def test_what_turns_back_or_tips_over_is_not_at_rest(blocks: Falling) -> None:
    """A block that flies up slowly has no speed at its highest place, and one that stands on an edge tips slowly."""
    start = blocks.begin(8)
    velocity, turns = np.zeros((8, 3, 6)), np.tile([1.0, 0.0, 0.0, 0.0], (8, 3, 1))
    velocity[:4, :, 2] = np.array([0.00002, 0.0001, 0.0245, 0.1])[:, None]
    for k, angle in enumerate([0.5, 0.7, 0.785, 0.79]):  # about an edge: near where it would stand
        turns[4 + k, :] = [np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0]
    start = thrown(start, velocity=velocity, quaternion=turns)
    (after, path), (_, moved) = second(blocks, start), second(blocks, start, slow=0.0)
    assert at_rest(after).all()
    assert np.abs(path.position[:, -1] - moved.position[:, -1]).max() < 2e-4
    assert (path.position[:4, 0, :, 2] - path.position[:4, -1, :, 2] > 0.01).all()


def test_an_arm_that_comes_near_wakes_an_object_and_its_neighbours() -> None:
    """Two objects side by side and one apart; an arm's pad at a distance, or coming fast; a long shaft above all."""
    centres = np.array([[0.0, 0, 0], [0.015, 0, 0], [0.1, 0, 0]], np.float32)
    reach = lambda *balls: 3e-4 + sum(ball.moves for ball in balls)  # noqa: E731

    def near(pad: float, moves: float = 0.0, shaft: float = 0.1, sinks: float = 0.0) -> Company:
        objects = Ball(jnp.asarray(centres), jnp.full(3, 0.008), jnp.zeros(3))
        arm = Ball(jnp.array([[pad, 0.0, 0.0]]), jnp.array([0.004]), jnp.array([moves]))
        ends = jnp.array([[[0.05, 0.0, shaft]], [[0.55, 0.0, shaft]]])
        balls = {"objects": objects, "pads": arm, "links": Ball(ends.mean(0), jnp.full(1, 0.254), jnp.array([sinks]))}
        links: Any = Segments(*ends, jnp.full(1, 0.004))
        unread: Any = None
        return company(Placed(unread, unread, unread, links, {}, balls), np.array([0]), reach)

    still = jnp.zeros(3, bool)
    assert not np.asarray(near(-0.02).spread(still)).any()
    assert np.asarray(near(-0.011).spread(still)).tolist() == [True, True, False]
    assert np.asarray(near(-0.02, 0.009).spread(still)).tolist() == [True, True, False]
    assert np.asarray(near(0.1).spread(still)).tolist() == [False, False, True]
    assert np.asarray(near(0.5).spread(jnp.array([False, True, False]))).tolist() == [True, True, False]
    assert np.asarray(near(-0.5, shaft=0.012).spread(still)).tolist() == [False, False, True]
    assert np.asarray(near(-0.5, shaft=0.02, sinks=0.009).spread(still)).tolist() == [False, False, True]
