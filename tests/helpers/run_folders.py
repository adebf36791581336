"""Run folders that nobody trained: config, metrics and evaluation as a training leaves them."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from surgical_marl.evaluation.command import FILM, RESULT
from surgical_marl.evaluation.evaluate import EPISODES, Played, summarise, write_played
from surgical_marl.runs.folder import CHECKPOINT, CONFIG, METRICS, write_metrics
from surgical_marl.runs.settings import Settings, config_text

NOTES = {
    "versions": {"python": "3.11.7", "torch": "2.12.0"},
    "origin": {"device": "a GPU", "commit": "0123456789ab", "started": "2026-01-01T00:00:00+0000"},
}
COLUMNS = ("iteration", "env_steps", "seconds", "steps_per_s", "reward", "reward_distance", "reward_idle",
           "tip_error_mm", "success_rate", "collision_rate", "entropy")  # fmt: skip


def make_run(folder: Path, *, rows: int = 6, success: float = 0.5, **settings: Any) -> Path:
    """A folder with config and metrics; `success` is that of all iterations."""
    folder.mkdir(parents=True)
    chosen = Settings(**{"task": "reach", "scene": "psm", "iterations": 6, "num_envs": 64, **settings})
    (folder / CONFIG).write_text(config_text(chosen, NOTES))
    (folder / CHECKPOINT).write_bytes(b"")
    found = [
        {
            **dict.fromkeys(COLUMNS, 0.0),
            "iteration": i,
            "env_steps": 1000 * i,
            "seconds": 2.0,
            "steps_per_s": 500.0,
            "reward": i / 10,
            "reward_distance": -1.0 / i,
            "tip_error_mm": 10.0 / i,
            "success_rate": success,
        }
        for i in range(1, rows + 1)
    ]
    if rows:
        write_metrics(folder, COLUMNS, found)
    assert (folder / METRICS).is_file() == bool(rows)
    return folder


def played(agents: tuple[str, ...] = ("psm_0",), stages: tuple[str, ...] = (), seed: int = 0) -> Played:
    """20 episodes whose errors are between 0.1 and 10 mm."""
    rng = np.random.default_rng(seed)
    shape = 20, len(agents)
    error = 1e-3 * np.geomspace(0.1, 10, 20 * len(agents)).reshape(shape)
    measures = {
        **{
            name: rng.random(shape) for name in ("distance", "center", "path", "time", "contact_force", "action_change")
        },
        **{f"stage_{name}": (rng.random(shape) < 0.5).astype(float) for name in stages},
        "smoothness": -rng.random(shape),
        "error": error,
        "held": error,
        "squared": error**2,
        "success": (error < 2e-3).astype(float),
        "collided": np.zeros(shape),
        "reward_distance": -rng.random(shape),
    }
    about = {"task": "reach", "scene": "psm", "control": "position", "difficulty": "default", "goals": "held_out"}
    about |= {"start": "home", "episodes": 20, "max_steps": 100, "control_dt": 0.02, "protocol": 2, "seed": 0}
    return Played({**about, "goal_set": "0" * 64}, list(agents), measures, False, stages)


def evaluate(folder: Path, episodes: Played | None = None, *, iteration: int = 6, clip: bytes = b"\0" * 100) -> Path:
    """Give a run what the end of a training does: a result, its episodes, and a clip."""
    write_played(folder / EPISODES, episodes or played())
    result = summarise([episodes]) if episodes else standard()
    (folder / RESULT).write_text(json.dumps({**result, "iteration": iteration}))
    (folder / FILM).write_bytes(clip)
    return folder


@cache
def standard() -> dict[str, Any]:
    """The result of `played()`."""
    return summarise([played()])
