"""Evaluation against numbers worked out by hand, on an environment that follows a script."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from surgical_marl import load_arm
from surgical_marl.batch import BatchedEnv
from surgical_marl.evaluation import evaluate, format_table
from surgical_marl.learning.policy import random_policy


class Shaft:
    """An arm of one joint, which is as far from its remote center as the joint is from 0."""

    remote_center: str | None = "shaft"

    def remote_center_error(self, q: np.ndarray) -> np.ndarray:
        return np.abs(q[..., 0])


class Needle(Shaft):
    """An arm without a remote center."""

    remote_center = None


class Script:
    """Environment i plays an episode of `errors[agent][i]` (mm), again and again; NumPy arrays.

    Each arm has one joint, which stands at the error of the step to come.
    """

    def __init__(self, errors: dict[str, list[list[float]]], hits: Any = (), task: str = "reach") -> None:
        self.errors, self.hits = errors, set(hits)
        self.agents = list(errors)
        self.lengths = np.array([len(episode) for episode in errors[self.agents[0]]])
        self.num_envs, self.max_steps = len(self.lengths), int(self.lengths.max())
        self.control_dt, self.device = 0.1, "cpu"  # success is judged over two steps
        arms = {agent: Needle() if agent.startswith("star") else Shaft() for agent in self.agents}
        mounts = {agent: SimpleNamespace(arm=arm) for agent, arm in arms.items()}
        index = {agent: np.array([i]) for i, agent in enumerate(self.agents)}
        self.task_name, self.scene = task, SimpleNamespace(name="script", mounts=mounts, qpos_index=index.__getitem__)
        self.seeds: list[int] = []

    def _observe(self) -> dict[str, np.ndarray]:
        return {agent: np.zeros((self.num_envs, 2), np.float32) for agent in self.agents}

    @property
    def qpos(self) -> np.ndarray:
        """[N, agents] in m; 1 m off in a second episode."""
        rows = [
            [self.errors[agent][i][step] / 1000 if self.episode[i] == 0 else 1.0 for agent in self.agents]
            for i, step in enumerate(self.steps)
        ]
        return np.array(rows, np.float32)

    def reset(self, seed: int) -> Any:
        self.seeds.append(seed)
        self.steps = np.zeros(self.num_envs, int)
        self.episode = np.zeros(self.num_envs, int)
        return self._observe(), np.zeros((self.num_envs, 4), np.float32)

    def step(self, actions: dict[str, np.ndarray]) -> Any:
        assert all(actions[agent].shape == (self.num_envs, 1) for agent in self.agents)
        infos = {}
        for agent in self.agents:
            # A second episode of an environment would be 1 m off: it must not be counted.
            error = [
                self.errors[agent][i][step] / 1000 if self.episode[i] == 0 else 1.0 for i, step in enumerate(self.steps)
            ]
            hit = [(agent, i, step) in self.hits or self.episode[i] > 0 for i, step in enumerate(self.steps)]
            infos[agent] = {"tip_error": np.array(error, np.float32), "collision": np.array(hit)}
        self.steps = self.steps + 1
        done = self.steps == self.lengths
        self.episode, self.steps = self.episode + done, np.where(done, 0, self.steps)
        odd = np.arange(self.num_envs) % 2 == 1  # some end by success, some by time
        return SimpleNamespace(observations=self._observe(), terminated=done & odd, truncated=done & ~odd, infos=infos)


def still(observations: Mapping[str, Any]) -> dict[str, np.ndarray]:
    return {agent: np.zeros((*value.shape[:-1], 1), np.float32) for agent, value in observations.items()}


ERRORS: dict[str, list[list[float]]] = {
    "psm_0": [[9, 9, 9, 0.5], [0.4, 0.6], [8, 1.5, 1.5]],
    "psm_1": [[4, 4, 4, 4], [30, 3], [0.1, 0.2, 0.3]],
}
HITS = [("psm_0", 0, 0), ("psm_1", 0, 3), ("psm_1", 2, 1)]


def test_metrics_equal_hand_computed_numbers() -> None:
    env: Any = Script(ERRORS, HITS)
    result = evaluate(env, still, episodes=3, seed=11)
    first, second = result["agents"]["psm_0"], result["agents"]["psm_1"]
    assert list(result) == [
        *("task", "scene", "episodes", "seed", "median_error_mm", "mean_error_mm"),
        *("success_1mm", "success_2mm", "success_5mm", "collision_rate", "remote_center_error_mm", "agents"),
    ]
    about = [result[name] for name in ("task", "scene", "episodes", "seed")]
    assert about == ["reach", "script", 3, 11]
    assert env.seeds == [11]
    # Last errors: psm_0 0.5 0.6 1.5, psm_1 4 3 0.3.
    # Largest of the last two: psm_0 9 0.6 1.5, psm_1 4 30 0.3.
    assert first["median_error_mm"] == pytest.approx(0.6)
    assert first["mean_error_mm"] == pytest.approx(2.6 / 3)
    assert second["median_error_mm"] == pytest.approx(3.0)
    assert result["median_error_mm"] == pytest.approx((0.6 + 1.5) / 2)
    assert result["mean_error_mm"] == pytest.approx(9.9 / 6)
    assert [first[f"success_{k}mm"] for k in (1, 2, 5)] == pytest.approx([1 / 3, 2 / 3, 2 / 3])
    assert [second[f"success_{k}mm"] for k in (1, 2, 5)] == pytest.approx([1 / 3, 1 / 3, 2 / 3])
    assert [result[f"success_{k}mm"] for k in (1, 2, 5)] == pytest.approx([2 / 6, 3 / 6, 4 / 6])
    assert first["collision_rate"] == pytest.approx(1 / 3)
    assert second["collision_rate"] == pytest.approx(2 / 3)
    assert result["collision_rate"] == pytest.approx(2 / 3)  # in episode 0 both collided
    assert first["remote_center_error_mm"] == pytest.approx(9)
    assert second["remote_center_error_mm"] == result["remote_center_error_mm"] == pytest.approx(30)
    assert json.loads(json.dumps(result)) == result


def test_an_arm_without_a_remote_center_has_no_error_of_it() -> None:
    env: Any = Script({"psm_0": [[3, 4], [-6, 5]], "star_0": [[30, 3], [0.1, 0.2]]})
    result = evaluate(env, still, episodes=2, seed=0)
    assert result["remote_center_error_mm"] == result["agents"]["psm_0"]["remote_center_error_mm"] == pytest.approx(6)
    assert result["agents"]["star_0"]["remote_center_error_mm"] is None
    assert [line.split()[-1] for line in format_table(result).splitlines()[2:]] == ["6.00", "6.00", "-"]
    alone: Any = Script({"star_0": [[30, 3], [0.1, 0.2]]})
    assert evaluate(alone, still, episodes=2, seed=0)["remote_center_error_mm"] is None


def test_the_remote_center_is_that_of_the_arm(tmp_path: Path) -> None:
    """A PSM whose shaft is put 0.5 mm aside is that far off, in float64, wherever random actions bring it."""
    shutil.copytree(load_arm("psm").folder, tmp_path / "psm")
    urdf, place = tmp_path / "psm" / "psm.urdf", 'xyz="0 0 0.0156"'  # of the roll joint
    text = urdf.read_text()
    assert text.count(place) == 1
    urdf.write_text(text.replace(place, place.replace("0 0", "0.0005 0")))
    (tmp_path / "scene.yaml").write_text("arms: {psm_0: {arm: ./psm, workspace: [0, 0, -0.11]}}")
    env = BatchedEnv("reach", str(tmp_path / "scene.yaml"), num_envs=2, max_steps=10, arrays="torch")
    error = evaluate(env, random_policy(env), episodes=2, seed=0)["remote_center_error_mm"]
    assert error == pytest.approx(0.5, abs=1e-9)


def test_exactly_as_many_episodes_as_asked_for() -> None:
    env: Any = Script(ERRORS)
    five = evaluate(env, still, episodes=5, seed=4)  # all three, then the first two again
    assert five["agents"]["psm_0"]["mean_error_mm"] == pytest.approx((0.5 + 0.6 + 1.5 + 0.5 + 0.6) / 5)
    assert env.seeds[0] == 4 and len(set(env.seeds)) == 2
    two = evaluate(env, still, episodes=2, seed=4)
    assert two["agents"]["psm_0"]["mean_error_mm"] == pytest.approx((0.5 + 0.6) / 2)
    with pytest.raises(ValueError, match="episodes must be 1 or more, not 0"):
        evaluate(env, still, episodes=0, seed=4)


def test_batches_of_neighbouring_seeds_do_not_overlap() -> None:
    env: Any = Script(ERRORS)
    for seed in range(3):
        evaluate(env, still, episodes=9, seed=seed)
    assert len(set(env.seeds)) == 9


def test_following_tasks_report_the_error_of_every_step() -> None:
    env: Any = Script({"psm_0": [[3, 4], [0, 0, 0, 10]]}, task="track")
    result = evaluate(env, still, episodes=2, seed=0)
    expected = math.sqrt(((9 + 16) / 2 + 100 / 4) / 2)
    assert result["rmse_mm"] == pytest.approx(expected)
    assert result["agents"]["psm_0"]["rmse_mm"] == pytest.approx(expected)


def test_an_episode_without_end_is_an_error() -> None:
    env: Any = Script(ERRORS)
    env.max_steps = 3
    with pytest.raises(RuntimeError, match="1 episodes did not end within max_steps = 3"):
        evaluate(env, still, episodes=3, seed=0)


def test_the_table_shows_every_number() -> None:
    env: Any = Script(ERRORS, HITS)
    lines = format_table(evaluate(env, still, episodes=3, seed=11)).splitlines()
    assert lines[0] == "reach in script: 3 episodes, seed 11"
    assert lines[1].split("  ")[-1].strip() == "remote center error (mm)"
    assert [line.split()[0] for line in lines[2:]] == ["all", "psm_0", "psm_1"]
    assert lines[3].split()[1:] == ["0.60", "0.87", "33.3%", "66.7%", "66.7%", "33.3%", "9.00"]
    assert len({len(line) for line in lines[1:]}) == 1
