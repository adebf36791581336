"""robomimic's format: one HDF5 file with a group for each episode.

    episodes.hdf5
        data/demo_0/{obs, next_obs, actions, rewards, dones, states}
        mask/{train, valid, successful}

`obs` holds `state`, `environment_state` and `<picture>_image`; `states` are joint positions of the whole scene, then
position and quaternion w, x, y, z of each free object.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from surgical_marl.data.dataset import Dataset, Episode
from surgical_marl.scenes.mjcf import mjcf

VALID = 10
"""One of so many episodes is for validation."""
GYM = 2
"""robomimic's number of a Gym environment."""


def write(dataset: Dataset, out: Path) -> None:
    """Write a data set into a new folder."""
    names, rows, good = [], 0, []
    model = mjcf(dataset.env.scene)
    with h5py.File(out / "episodes.hdf5", "w") as file:
        data = file.create_group("data")
        for episode in dataset:
            name = f"demo_{episode.number}"
            group = data.create_group(name)
            _add(dataset, episode, group)
            group.attrs.update(num_samples=len(episode.recording), model_file=model)
            names.append(name)
            good += [name] if episode.recording.succeeded else []
            rows += len(episode.recording)
        data.attrs["total"] = rows
        data.attrs["env_args"] = json.dumps(_environment(dataset))
        valid = names[VALID - 1 :: VALID]
        masks = {"train": [name for name in names if name not in valid], "valid": valid, "successful": good}
        for name, chosen in masks.items():
            file.create_dataset(f"mask/{name}", data=np.array(chosen, dtype="S"))


def _add(dataset: Dataset, episode: Episode, group: Any) -> None:
    recording = episode.recording
    seen = recording.seen
    observed = {
        "state": dataset.signals.state(recording),
        "environment_state": seen["state"],
        **{f"{name}_image": values for name, values in episode.pictures.items()},
    }
    for name, values in observed.items():
        packed: dict[str, Any] = {"compression": "gzip", "compression_opts": 1} if values.ndim > 2 else {}
        group.create_dataset(f"obs/{name}", data=values[:-1], **packed)
        group.create_dataset(f"next_obs/{name}", data=values[1:], **packed)
    group["actions"] = dataset.signals.action(recording)
    group["rewards"] = recording.reward
    group["dones"] = recording.ended.astype(np.int64)
    objects = seen["objects"].reshape(len(seen["objects"]), -1)
    group["states"] = np.concatenate([seen["qpos"], objects], 1)[:-1]


def _environment(dataset: Dataset) -> dict[str, Any]:
    """Return what robomimic knows of the environment."""
    about = dataset.about["environment"]
    return {"env_name": f"surgical_marl/{dataset.env.task_name}", "type": GYM, "env_kwargs": about}
