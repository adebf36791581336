"""Videos of episodes: how long they are."""

from __future__ import annotations

from typing import Any, cast

import pytest
import torch

from surgical_marl.view import record
from tests.helpers.fake_env import FakeEnv


class Picture:
    """Counts the pictures that are drawn."""

    def pose(self) -> int:
        return 0


@pytest.mark.parametrize(("max_steps", "seconds"), [(10, 0.4), (600, 24.0), (9000, record.LONGEST)])
def test_a_video_is_of_two_episodes_but_not_of_a_long_trial(max_steps: int, seconds: float) -> None:
    env: Any = FakeEnv({"psm": 1}, {"psm": 3}, 1, max_steps=max_steps)
    env.control_dt, picture = 0.02, cast(Any, Picture())
    still = {agent: torch.zeros((1, 3)) for agent in env.agents}
    poses = list(record._poses(env, lambda _: still, picture, 2, 0))
    assert len(poses) == round(seconds * record.FPS)
