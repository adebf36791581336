"""Videos of episodes: how long they are, and how they are made."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
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


def test_a_video_is_made_with_a_bar_and_one_thread_of_torch(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    env: Any = FakeEnv({"psm": 1}, {"psm": 3}, 1, max_steps=10)
    env.control_dt = 0.02
    threads: list[int] = []

    def frames(*_: Any) -> Iterator[np.ndarray]:
        for _ in range(10):
            threads.append(torch.get_num_threads())
            yield np.zeros((48, 64, 3), np.uint8)

    monkeypatch.setattr(record, "frames", frames)
    usual = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        path = record.record(env, lambda _: {}, tmp_path / "video.gif")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(usual)
    assert path.is_file() and set(threads) == {1}
    assert capsys.readouterr().err.splitlines()[-1].startswith("filming: 10 of 10 frames")
