"""Frozen goal sets: the hash of the goals of an evaluation, and the hashes of the standard sets."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.untrusted.values import one_line
from surgical_marl.yaml_file import read_yaml

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

PROTOCOL = 2
"""Increased when goals are drawn or a metric is computed in another way; results of different protocols don't
compare."""
STANDARD_EPISODES, STANDARD_SEED = 200, 0
"""Number of episodes, and seed, of the standard goal sets."""
ROUNDING = 1e-6
"""Goals are hashed as whole multiples of this, m, without digits that may differ between machines."""
_FILE = Path(__file__).with_name("goal_sets.yaml")


def episode_seed(seed: int, block: int) -> int:
    """Return the environments' seed for one block of episodes.

    It differs from the seeds of other blocks, from those of other `seed`, and from those of training.
    """
    return int(np.random.SeedSequence([seed, block]).generate_state(1)[0] >> 1)


def describe_goals(env: BatchedEnv, episodes: int) -> dict[str, Any]:
    """Return the properties that a goal set depends on beside its goals; `control_dt` is in s."""
    return {
        "task": env.task_name,
        "scene": env.scene.name,
        "control": env.env.options.control_label,
        "difficulty": env.env.options.difficulty,
        "goals": env.env.options.goals,
        "start": env.env.options.start,
        "episodes": episodes,
        "max_steps": env.max_steps,
        "control_dt": round(float(env.control_dt), 9),
        "protocol": PROTOCOL,
    }


def read_goals(env: BatchedEnv, count: int) -> list[np.ndarray]:
    """Return the goals of the episodes that the first `count` environments have just begun, [count, ...] each.

    The task says what these are.
    """
    goal = {name: values[:count] for name, values in vars(env.goal).items()}
    return env.task.goal_content(SimpleNamespace(**goal))


def goal_hash(about: Mapping[str, Any], goals: Iterable[np.ndarray]) -> str:
    """Return the SHA-256 of `describe_goals` and of the goals of all episodes, in hexadecimal."""
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for part in goals:
        whole = np.rint(part.astype(np.float64) / ROUNDING).astype("<i8")
        digest.update(repr(part.shape).encode() + whole.tobytes())
    return digest.hexdigest()


def is_standard(result: Mapping[str, Any]) -> bool:
    """Return whether a result is of a goal set that this version publishes for its task, scene and start."""
    known = standard_hashes()
    kind = result["difficulty"] if result.get("difficulty") in known else result.get("start", "")
    scenes = known.get(kind, {}).get(result["task"], {})
    return bool(result["goal_set"] == scenes.get(result["scene"]))


@cache
def standard_hashes() -> dict[str, dict[str, dict[str, str]]]:
    """Return the hashes of the standard goal sets by start, task and scene; by difficulty at some levels.

    These are the goal sets that `surgical-marl eval` plays if no option chooses others, with `--start random`, and with
    `--difficulty` of a level that has policies of its own.
    """
    found: dict[str, dict[str, dict[str, str]]] = read_yaml(_FILE)
    return found


def check_same(result: Mapping[str, Any], other: Mapping[str, Any], name: str) -> None:
    """Raise ValueError unless both results are of the same goals.

    Args:
        name: name of the other result, for the message.
    """
    if other["goal_set"] != result["goal_set"]:
        raise ValueError(
            f"{name} is of goal set {_describe(other)}, not {_describe(result)}: only results on the same goals compare"
        )


def _describe(result: Mapping[str, Any]) -> str:
    words = "{task} in {scene}, {difficulty}, {control} control, {goals} goals, {start} start, {episodes} episodes"
    shown = {name: one_line(value) for name, value in result.items()}
    return f"{shown['goal_set']:.12} ({words.format(**shown)}, seed {shown['seed']})"
