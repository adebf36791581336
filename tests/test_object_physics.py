"""The physics of objects: they are held, fall, rest, slide and spin as they should."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surgical_marl.studies.grasping import OBJECTS, Grasps, Held, judge
from tests.helpers.falling import Falling, random_turns, thrown

# -- what a jaw holds


@pytest.fixture(scope="module")
def grasps() -> Grasps:
    """One scene with all objects: most of the time goes into tracing its step."""
    return Grasps(list(OBJECTS))


@pytest.fixture(scope="module")
def held(grasps: Grasps) -> Held:
    """Four grasps of each object, shaken for 1 s."""
    return judge(grasps.shake(np.repeat(np.arange(3), 4), 1.0, seed=0))


@pytest.mark.parametrize("number", range(3), ids=list(OBJECTS))
def test_a_jaw_holds_an_object_through_motion_at_full_speed(held: Held, number: int) -> None:
    which = slice(4 * number, 4 * number + 4)
    assert not held.dropped[which].any()
    assert held.slip[which].max() < 2e-4 and np.degrees(held.turn[which].max()) < 1
    assert held.overlap[which].max() < 1.5e-4


# -- what falls


@pytest.fixture(scope="module")
def falling(tmp_path_factory: pytest.TempPathFactory) -> Falling:
    """A needle, a block and a ring 50 mm above a pad."""
    places = {name: {"object": name, "position": [0, y, 0.05]} for name, y in
              (("needle_sh", -0.05), ("block", 0.0), ("ring", 0.05))}  # fmt: skip
    return Falling(tmp_path_factory.mktemp("falling"), {"pad": {"object": "pad"}, **places})


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_what_falls_on_a_pad_comes_to_rest_there(falling: Falling, speed: float) -> None:
    """Within 2 s, whatever way it is turned; then it drifts by less than 0.1 mm in 10 s."""
    rng = np.random.default_rng(0)
    down = np.broadcast_to([0, 0, -speed, 0, 0, 0], (8, 3, 6))
    objects, path = falling.play(thrown(falling.begin(8), quaternion=random_turns(rng, 8, 3), velocity=down), 2.0)
    assert path.position[..., 2].min() > 0, "something fell through"
    assert path.depth.max() < 3e-4 and path.depth[:, -1].max() < 1e-5
    assert np.abs(path.velocity[:, -1, :, :3]).max() < 1e-3
    _, later = falling.play(objects, 2.0)
    assert 5 * np.linalg.norm(later.position[:, -1] - path.position[:, -1], axis=-1).max() < 1e-4
