"""The encoder of pictures: a small convolutional network before the MLP, both rsl_rl's."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from rsl_rl.models import CNNModel, MLPModel
from tensordict import TensorDict
from torch import Tensor

PICTURES = "_pictures"
"""Suffix of the name of the group of an agent type's pictures."""
ENCODER = {"output_channels": [32, 64, 64], "kernel_size": [4, 4, 3], "stride": [4, 2, 1], "activation": "elu"}
"""The encoder makes 1600 features of 64 x 64 pixels. Its first layer sees patches that don't overlap: on an H200
learning then takes a third less time than with the usual 8 x 8 pixels."""

FURTHEST = 0.3
"""Depth is clipped to this for networks, m; endoscopes are nearer to what they look at."""


class PictureModel(CNNModel):
    """rsl_rl's CNN model, for uint8 pictures [..., C, H, W] beside vectors [..., d], with any leading axes."""

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Tensor | None = None) -> Tensor:
        """Return the normalised vector, followed by the features of the pictures."""
        vector = MLPModel.get_latent(self, obs)
        (group,) = self.obs_groups_2d
        # channels last while they are still bytes, so that cuDNN needs no transposition
        pictures = obs[group].flatten(0, -4).contiguous(memory_format=torch.channels_last)
        features = self.cnns[group](pictures.float() / 255 - 0.5)
        return torch.cat([vector, features.reshape(*vector.shape[:-1], -1)], dim=-1)


def stack_pictures(seen: Sequence[Sequence[Tensor]], joint: bool = False) -> Tensor:
    """Stack the pictures of agents, [..., H, W, c] each, along channels, channels first: [..., n, C, H, W].

    Colours stay uint8. If there is depth, it is scaled to 0 to 255 at `FURTHEST`, and all pictures become float32.
    `joint`: stack all of it along channels, as what one agent sees.
    """
    each = [_channels(parts) for parts in seen]
    return torch.stack([torch.cat(each, -3)] if joint else each, -4).contiguous()


def _channels(parts: Sequence[Tensor]) -> Tensor:
    scaled = [part if part.dtype == torch.uint8 else part.clamp(max=FURTHEST) * (255 / FURTHEST) for part in parts]
    alike = scaled if len({part.dtype for part in scaled}) == 1 else [part.float() for part in scaled]
    return torch.cat(alike, -1).movedim(-1, -3)
