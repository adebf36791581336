"""Imitation of demonstrations, before reinforcement learning begins."""

from __future__ import annotations

import torch
from torch import nn

from surgical_marl.learning.demonstrations import Demonstrations
from surgical_marl.learning.graphs import Replayed
from surgical_marl.policies.networks import MultiAgentActor

RATE = 1e-3
"""Learning rate at the start; it falls to nothing in the form of a cosine."""


def imitate(actor: MultiAgentActor, demonstrations: Demonstrations, steps: int, batch_size: int) -> None:
    """Let an actor's mean actions become those of the oracle, in the least squares sense; its deviation stays as it is.

    Its normalisers of observations learn from the demonstrations first.

    Args:
        actor: without recurrent networks.
        demonstrations: on the actor's device.
        steps: gradient steps, of Adam.
        batch_size: pairs of observation and action in each.
    """
    shown, actions = demonstrations.shown, demonstrations.actions
    cuda = actions.is_cuda
    actor.update_normalization(shown)
    weights = [weight for name, weight in actor.named_parameters() if "distribution" not in name]
    done, rate = torch.zeros((), device=actions.device), torch.tensor(RATE, device=actions.device)
    optimizer = torch.optim.Adam(weights, lr=rate, fused=True, capturable=cuda)

    def descend() -> None:
        rate.copy_(RATE * (1 + torch.cos(torch.pi * done / steps)) / 2)
        chosen = torch.randint(len(actions), (batch_size,), device=actions.device)
        loss = nn.functional.mse_loss(actor(shown[chosen]), actions[chosen])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        done.add_(1)

    graph = Replayed(descend, enabled=cuda)
    for _ in range(steps):
        graph()
    graph.release()
    optimizer.zero_grad()
