"""Minari's format: episodes for offline reinforcement learning, with the spaces of the Gymnasium environment.

    data/metadata.json, data/main_data.hdf5

All arms are one agent (`surgical_marl/interfaces/joint.py`), as in `gymnasium.make` of the scene. With pictures an
observation is a dict of `proprioception` and the pictures.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from surgical_marl.data.card import card_of
from surgical_marl.data.dataset import Dataset, Episode
from surgical_marl.interfaces.joint import JointAgent
from surgical_marl.plugins.tasks import list_tasks


def write(dataset: Dataset, out: Path) -> None:
    """Write a data set into a new folder. `minari.MinariDataset(folder / "data")` reads it."""
    joint = JointAgent(dataset.env)
    pictures = {picture.name: _space(dataset, picture.channel) for picture in dataset.pictures}
    vector = joint.observation_space
    if isinstance(vector, spaces.Dict):  # pictures that agents observe are not kept
        vector = vector["proprioception"]
    observation = spaces.Dict({"proprioception": vector, **pictures}) if pictures else vector
    actions = joint.action_space if dataset.signals.form == "env" else _any(len(dataset.signals.action_names))
    storage = MinariStorage.new(
        out.resolve() / "data",
        env_spec=_spec(dataset),
        observation_space=observation,
        action_space=actions,
        jpeg_encoding=False,
    )
    storage.update_metadata({
        "dataset_id": f"surgical_marl/{dataset.env.task_name}/{dataset.env.scene.name}-v0",
        "minari_version": minari.__version__, "description": card_of(dataset),
        "algorithm_name": str(dataset.about.get("policy")), "rate": dataset.rate,
    })  # fmt: skip
    storage.update_episodes(_buffers(dataset, joint))


def _buffers(dataset: Dataset, joint: JointAgent) -> Iterator[EpisodeBuffer]:
    for episode in dataset:
        done = episode.recording.done
        yield EpisodeBuffer(
            id=episode.number,
            observations=_observations(joint, episode),
            actions=dataset.signals.action(episode.recording),
            rewards=episode.recording.reward,
            terminations=done["terminated"],
            truncations=done["truncated"],
            infos={"success": np.append(False, done["success"])},
        )


def _observations(joint: JointAgent, episode: Episode) -> Any:
    """Return the T + 1 observations of an episode."""
    seen = episode.recording.seen
    felt = joint.observation({arm: seen[f"observations/{arm}"] for arm in joint.arms})
    return {"proprioception": felt, **episode.pictures} if episode.pictures else felt


def _space(dataset: Dataset, channel: str) -> spaces.Box:
    width, height = dataset.size
    if channel == "depth":
        return spaces.Box(0.0, np.inf, (height, width, 1), np.float32)
    return spaces.Box(0, 255, (height, width, 3 if channel == "rgb" else 1), np.uint8)


def _any(size: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)


def _spec(dataset: Dataset) -> Any:
    """Return the specification of the environment, by which Minari makes it again; None for a user's own task."""
    options = dataset.env.env.options
    if options.task not in list_tasks():
        return None
    words = "".join(word.capitalize() for word in options.task.split("_"))
    kept = ("control", "control_frame", "difficulty", "goals", "start", "knowledge", "messages", "observations")
    with_env = {"scene": dataset.about["environment"]["scene"], **{name: getattr(options, name) for name in kept}}
    spec = copy.deepcopy(gymnasium.spec(f"surgical_marl/{words}-v0"))  # what others make stays as it is
    spec.kwargs.update(with_env)
    spec.max_episode_steps = dataset.env.max_steps
    return spec
