"""Evaluation against numbers worked out by hand, on an environment that follows a script."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from surgical_marl import load_arm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.evaluation.evaluate import difference, evaluate, play, summarise
from surgical_marl.evaluation.report import format_table, number
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.policies.policy import random_policy
from surgical_marl.tasks.base.options import Options


class Shaft:
    """An arm of one joint, which slides the tip and is as far from its remote center as the joint is from 0."""

    remote_center: str | None = "shaft"

    def forward_kinematics(self, q: np.ndarray) -> np.ndarray:
        pose = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4)).copy()
        pose[..., 0, 3] = q[..., 0]
        return pose

    def remote_center_error(self, q: np.ndarray) -> np.ndarray:
        return np.abs(q[..., 0])


class Needle(Shaft):
    """An arm without a remote center."""

    remote_center = None


class Script:
    """Environment i plays an episode of `errors[agent][i]` (mm), again and again; NumPy arrays.

    Each arm has one joint, which stands at the error of the step to come; the distance to the other arms is that error
    plus 1 mm.
    """

    def __init__(self, errors: dict[str, list[list[float]]], hits: Any = (), task: str = "reach") -> None:
        self.errors, self.hits = errors, set(hits)
        self.agents = list(errors)
        self.lengths = np.array([len(episode) for episode in errors[self.agents[0]]])
        self.num_envs, self.max_steps = len(self.lengths), int(self.lengths.max())
        self.control_dt, self.control = 0.1, "position"  # success is judged over two steps
        self.env = SimpleNamespace(options=Options(task, "psm"))
        self.task = TASKS.load(task).__new__(TASKS.load(task))  # its functions of a goal need no scene
        self.task.tables = {"paths": np.arange(999.0)}
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
        self.goals = np.random.default_rng(seed).random((self.num_envs, len(self.agents), 3), np.float32)
        self.steps = np.zeros(self.num_envs, int)
        self.episode = np.zeros(self.num_envs, int)
        return self._observe(), np.zeros((self.num_envs, 4), np.float32)

    @property
    def goal(self) -> SimpleNamespace:
        return SimpleNamespace(targets=self.goals, row=np.zeros(self.num_envs, int))

    def step(self, actions: dict[str, np.ndarray]) -> Any:
        assert all(actions[agent].shape == (self.num_envs, 1) for agent in self.agents)
        infos = {}
        for agent in self.agents:
            # A second episode of an environment would be 1 m off: it must not be counted.
            error = [
                self.errors[agent][i][step] / 1000 if self.episode[i] == 0 else 1.0 for i, step in enumerate(self.steps)
            ]
            hit = [(agent, i, step) in self.hits or self.episode[i] > 0 for i, step in enumerate(self.steps)]
            tip_error = np.array(error, np.float32)
            infos[agent] = {
                "tip_error": tip_error,
                "success": tip_error < 0.002,
                "collision": np.array(hit),
                "min_distance": tip_error + 0.001,
            }
            infos[agent] |= {"reward_distance": -tip_error, "cost_near": tip_error < 0.002}
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
    about = {name: result[name] for name in ("task", "scene", "control", "episodes", "seed", "max_steps", "control_dt")}
    assert list(about.values()) == ["reach", "script", "position", 3, 11, 4, 0.1]
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
    # Psm_0 is below 2 mm from step 1 on in episode 1, from step 2 on in episode 2; psm_1 from step 1 on in episode 2.
    assert first["time_to_success_s"] == pytest.approx((0.1 + 0.2) / 2)
    assert second["time_to_success_s"] == pytest.approx(0.1)
    assert result["time_to_success_s"] == pytest.approx((0.1 + 0.2 + 0.1) / 3)
    assert result["team_success_2mm"] == pytest.approx(1 / 3)  # episode 2
    assert "team_success_2mm" not in first and "team_success_2mm" not in first["intervals"]
    # The way of the tip from the start of the first step to the start of the last.
    assert first["path_length_mm"] == pytest.approx((8.5 + 0.2 + 6.5) / 3, rel=1e-5)
    assert second["path_length_mm"] == pytest.approx((0 + 27 + 0.2) / 3, rel=1e-5)
    assert first["min_distance_mm"] == pytest.approx(1.4) and second["min_distance_mm"] == pytest.approx(1.1)
    assert result["min_distance_mm"] == second["min_distance_mm"]
    # Of the six last errors, between the fifth (3) and the sixth (4): at 4.75 of the 5 gaps.
    assert result["p95_error_mm"] == pytest.approx(3.75)
    # Means over the steps of each episode, then over the episodes.
    assert first["reward_distance"] == pytest.approx(-(27.5 / 4 + 1 / 2 + 11 / 3) / 3000)
    assert first["cost_near"] == pytest.approx((1 / 4 + 1 + 2 / 3) / 3)
    assert json.loads(json.dumps(result)) == result


def test_an_arm_without_a_remote_center_has_no_error_of_it() -> None:
    env: Any = Script({"psm_0": [[3, 4], [-6, 5]], "star_0": [[30, 3], [0.1, 0.2]]})
    result = evaluate(env, still, episodes=2, seed=0)
    assert result["remote_center_error_mm"] == result["agents"]["psm_0"]["remote_center_error_mm"] == pytest.approx(6)
    assert result["agents"]["star_0"]["remote_center_error_mm"] is None
    line = next(line for line in format_table(result).splitlines() if line.startswith("remote center error"))
    assert line.split()[-4:] == ["6.00", "-", "6.00", "-"]
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
    assert len(set(env.seeds)) == 2
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
    env: Any = Script({"psm_0": [[3, 4], [0, 10, 0, 0]]}, task="track")
    result = evaluate(env, still, episodes=2, seed=0)
    squares = [(9 + 16) / 2, 100 / 4]
    for found in (result, result["agents"]["psm_0"]):
        assert found["rmse_mm"] == pytest.approx(math.sqrt(sum(squares) / 2))
        assert found["mean_error_mm"] == pytest.approx((math.sqrt(squares[0]) + math.sqrt(squares[1])) / 2)
        assert found["success_5mm"] == 0.5  # back at the goal in the end is not enough
        assert found["time_to_success_s"] is None


def test_an_episode_without_end_is_an_error() -> None:
    env: Any = Script(ERRORS)
    env.max_steps = 3
    with pytest.raises(RuntimeError, match="1 episodes did not end within max_steps = 3"):
        evaluate(env, still, episodes=3, seed=0)


def test_the_table_shows_every_number() -> None:
    env: Any = Script(ERRORS, HITS)
    result = evaluate(env, still, episodes=3, seed=11)
    head, titles, *lines = format_table(result).splitlines()
    assert head.startswith(
        "reach in script, default, position control, training goals, home start: 3 episodes, seed 11, "
        f"goal set {result['goal_set'][:12]} (not a standard one)"
    )
    assert titles.split() == ["all", "95", "%", "interval", "psm_0", "psm_1"]
    assert len(lines) == len(result["intervals"]) and len({len(line) for line in lines}) == 1
    rows = {line[:26].strip(): line[26:].split() for line in lines}
    assert [row[-2] for row in rows.values()][:3] == ["0.60", "0.87", "1.41"]
    assert rows["success within 2 mm"][0] == "50.0%" and rows["success within 2 mm"][-2:] == ["66.7%", "33.3%"]
    assert rows["min distance (mm)"] == ["1.10", "-", "1.40", "1.10"]


def test_the_goal_set_is_what_was_played() -> None:
    """The same goals give the same hash; other ones, or other settings, another."""
    env: Any = Script(ERRORS)

    def hashed(episodes: int = 3, seed: int = 0) -> str:
        return str(evaluate(env, still, episodes=episodes, seed=seed)["goal_set"])

    hashes = {hashed(), hashed(episodes=2), hashed(episodes=5), hashed(seed=1)}
    for name, value in (("control_dt", 0.05), ("task_name", "track")):
        setattr(env, name, value)
        hashes.add(hashed())
    env.env.options = replace(env.env.options, control="torque")
    hashes.add(hashed())
    env.scene.name = "other"
    hashes.add(hashed())
    assert len(hashes) == 8 and all(len(found) == 64 for found in hashes)
    assert hashed() in hashes


def test_results_on_other_goals_are_refused() -> None:
    env: Any = Script(ERRORS)
    ours, same, other = (evaluate(env, still, episodes=3, seed=seed) for seed in (0, 0, 1))
    assert {value for value in difference(ours, same, "same.json").values() if value is not None} == {0.0}
    with pytest.raises(ValueError, match=r"old\.json is of goal set .* seed 1\), not .* seed 0\)"):
        difference(ours, other, "old.json")
    with pytest.raises(ValueError, match="run 2 is of goal set"):
        summarise([play(env, still, 3, seed=0), play(env, still, 3, seed=1)])


def test_several_runs_pool_their_episodes() -> None:
    """A metric of two runs is that of all their episodes, and its interval holds the spread between them."""
    good: Any = Script({"psm_0": [[0.5, 0.5], [0.7, 0.7], [0.9, 0.9]]})
    bad: Any = Script({"psm_0": [[9, 9], [1.5, 1.5], [7, 7]]})
    runs = [play(env, still, 3, seed=0) for env in (good, bad)]
    whole = summarise(runs)
    assert whole["success_1mm"] == pytest.approx(1 / 2) and whole["success_2mm"] == pytest.approx(4 / 6)
    assert whole["median_error_mm"] == pytest.approx((0.9 + 1.5) / 2)
    assert whole["intervals"]["success_1mm"] == [0, 1]  # a run that fails and one that does not say nothing
    assert summarise(runs[:1])["intervals"]["success_1mm"] == pytest.approx([0.025 ** (1 / 3), 1])
    assert summarise(runs[:1]) == evaluate(good, still, 3, seed=0)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0.0%"), (1.0, "100.0%"), (0.995, "99.5%"), (0.9996, "99.96%"), (0.99999, "99.999%"), (0.0001, "0.01%"),
     (1 - 1e-12, "100.0%"), (None, "-")],
)  # fmt: skip
def test_a_rate_looks_like_all_or_nothing_only_if_it_is(value: float | None, text: str) -> None:
    assert number("success_rate", value) == text
