"""Normalised observations: what is far off the mean is limited, in networks that learn and in loaded ones."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from surgical_marl.learning.normaliser import share_normalisers
from surgical_marl.policies.networks import make_model


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("recurrent", ["none", "gru"])
def test_what_is_far_off_the_mean_is_limited(learns: bool, recurrent: str) -> None:
    observations = TensorDict({"state": torch.randn(64, 3)}, batch_size=[64])
    network = make_model(observations, ["state"], 2, recurrent=recurrent, hidden_dims=[8], obs_normalization=True)
    if learns:
        share_normalisers(network)
        network.update_normalization(observations)

    def outputs(away: float) -> torch.Tensor:
        memory = torch.zeros(1, *network.memory_shape) if recurrent != "none" else None
        with torch.no_grad():
            return network(TensorDict({"state": torch.full((1, 3), away)}, batch_size=[1]), None, memory)

    assert torch.equal(outputs(50.0), outputs(5000.0))
    assert not torch.equal(outputs(5.0), outputs(50.0))
