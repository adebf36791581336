"""Data sets that lerobot itself reads: `pytest tests/data/test_lerobot_reader.py -m slow` where it is installed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surgical_marl.data.export import export
from surgical_marl.data.request import Request
from surgical_marl.runs.settings import Settings

pytestmark = pytest.mark.slow
lerobot = pytest.importorskip("lerobot")
SETTINGS = Settings(task="reach", scene="psm", seed=3, max_steps=12, device="cpu")
RATE = 25


def test_lerobot_reads_what_was_exported(tmp_path: Path) -> None:
    import pyarrow.parquet as pq
    from lerobot.datasets.lerobot_dataset import CODEBASE_VERSION, LeRobotDataset

    name = {"v3.0": "lerobot", "v2.1": "lerobot-2.1"}[CODEBASE_VERSION]
    asked = Request(
        name, policy="random", settings=SETTINGS, episodes=3, pictures=("outside",), size=(64, 48), rate=RATE
    )
    out = export(asked, tmp_path / "set")
    table = pq.read_table(sorted((out / "data").rglob("*.parquet")))
    deltas = {"action": [0.0, 1 / RATE, 2 / RATE]}
    dataset = LeRobotDataset("local/set", root=out, delta_timestamps=deltas, video_backend="pyav")
    assert dataset.num_episodes == 3 and dataset.num_frames == len(table) == 18 and dataset.fps == RATE
    actions = np.array(table["action"].to_pylist(), np.float32)
    for row in range(len(table)):
        item = dataset[row]
        for key in ("observation.state", "observation.environment_state", "next.reward", "timestamp"):
            assert np.array_equal(item[key].numpy(), np.float32(table[key][row].as_py())), key
        last = row // 6 * 6 + 5
        chunk = [min(row + step, last) for step in range(3)]
        assert np.array_equal(item["action"].numpy(), actions[chunk])
        assert item["action_is_pad"].tolist() == [row + step > last for step in range(3)]
        assert item["observation.images.outside"].shape == (3, 48, 64)
        assert item["task"].startswith("Every arm brings its tool tip")
    mean = np.ravel(dataset.meta.stats["action"]["mean"])
    np.testing.assert_allclose(mean, actions.mean(0), rtol=1e-5, atol=1e-6)
