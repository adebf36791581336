"""Policies of LeRobot: `lerobot:outputs/train/act`, a folder that `lerobot-train` wrote.

It is loaded, and its observations and actions are normalised, by lerobot 0.4.4 or newer. The rate and the form of
actions are those of the data set that it was trained on, if that still lies where it was and `surgical-marl export`
wrote it; otherwise they are said: `lerobot:outputs/train/act,rate=25,actions=joint`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from surgical_marl.policies.adapter import PICTURE, TASK, PolicyAdapter
from surgical_marl.runtime import has_cuda
from surgical_marl.untrusted.files import MAX_JSON, is_file, read_json, user_path

CONFIG, TRAINING = "config.json", "train_config.json"
PLACES = (".", "pretrained_model", "checkpoints/last/pretrained_model")
"""Where a policy lies in the folder of a training."""


class LeRobotPolicy(PolicyAdapter):
    """A policy that lerobot loads: ACT, diffusion policy, VQ-BeT, SmolVLA, pi0 and others that predict chunks.

    Args:
        place: the folder of a training, of one of its checkpoints, or of a policy.
    """

    def __init__(self, place: str) -> None:
        folder = _folder(user_path(place))
        self._read_data(folder)
        try:
            from lerobot.configs.policies import PreTrainedConfig
            from lerobot.policies.factory import get_policy_class, make_pre_post_processors
        except ModuleNotFoundError as error:
            raise ValueError(f"the package {error.name} is not installed: pip install 'lerobot>=0.4.4'") from None
        except ImportError as error:
            raise ValueError(f"lerobot 0.4.4 or newer is needed: {error}") from None
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = "cuda" if has_cuda() else "cpu"
        if getattr(config, "temporal_ensemble_coeff", None) is not None:
            raise ValueError("temporal_ensemble_coeff must be null in its config.json: chunks are executed whole")
        with redirect_stdout(sys.stderr):  # it prints, and results of commands go to stdout
            self._policy = get_policy_class(config.type).from_pretrained(folder, config=config)
            self._before, self._after = make_pre_post_processors(
                config, str(folder), preprocessor_overrides={"device_processor": {"device": config.device}}
            )
        self.history, self.horizon = getattr(config, "n_obs_steps", 1), getattr(config, "n_action_steps", 1)
        self.observes = {name: _shape(name, own.shape) for name, own in config.input_features.items()} | {TASK: ()}

    def act(self, batch: Mapping[str, Any]) -> np.ndarray:
        """Return actions [n, horizon, numbers] for what is observed in n episodes."""
        import torch

        self._policy.reset()
        rows: dict[str, Any] = {}
        with torch.inference_mode():
            for row in range(self.history):
                rows = self._before({key: _tensor(key, values, row) for key, values in batch.items()})
                rows.pop("action", None)  # there is none yet
                self._remember(rows)
            chunk = self._policy.predict_action_chunk(rows)[:, : self.horizon]
            actions = self._after(chunk.flatten(0, 1)).reshape(chunk.shape)
        return np.asarray(actions.float().cpu())

    def _remember(self, rows: dict[str, Any]) -> None:
        """Add a row to the queues of a policy that observes several, as its own `select_action` does."""
        import torch
        from lerobot.policies.utils import populate_queues
        from lerobot.utils.constants import ACTION, OBS_IMAGES

        queues = getattr(self._policy, "_queues", None)
        if queues and OBS_IMAGES in queues:
            rows[OBS_IMAGES] = torch.stack([rows[key] for key in self._policy.config.image_features], dim=-4)
        if queues:
            populate_queues(queues, rows, exclude_keys=[ACTION])

    def _read_data(self, folder: Path) -> None:
        """Take the rate and the actions of the data set of the training, if it is there and of this suite."""
        if not is_file(folder / TRAINING):
            return
        about = read_json(folder / TRAINING, MAX_JSON)
        root = user_path(str((about.get("dataset") or {}).get("root") or ""))
        if not is_file(root / "export.json") or not is_file(root / "meta/info.json"):
            return
        made, info = (read_json(root / name, MAX_JSON) for name in ("export.json", "meta/info.json"))
        self.rate, self.actions = made.get("rate"), made.get("actions")
        self.names = tuple(map(str, info["features"]["action"]["names"]))


def _folder(path: Path) -> Path:
    for place in PLACES:
        if is_file(path / place / CONFIG):
            return path / place
    raise ValueError(f"there is no policy of lerobot in {path}: it lacks {CONFIG}")


def _shape(name: str, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of a column; those of pictures are [3, height, width] in lerobot."""
    return (*shape[1:], shape[0]) if name.startswith(PICTURE) else tuple(shape)


def _tensor(name: str, values: Any, row: int) -> Any:
    """Return a row of a column [n, history, ...] as lerobot has it in a batch."""
    import torch

    if name == TASK:
        return values
    own = torch.from_numpy(np.ascontiguousarray(values[:, row]))
    return own.movedim(-1, -3).float() / 255 if name.startswith(PICTURE) else own
