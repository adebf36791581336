"""Imitation of demonstrations, before reinforcement learning begins and beside it."""

from __future__ import annotations

import torch
from torch import Tensor, nn

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


class ImitationLoss:
    """How unlikely the oracle's actions are, as a loss beside that of reinforcement learning.

    It keeps an actor from forgetting states that it seldom comes to (A. Rajeswaran et al., 2018, arXiv 1709.10087,
    equation 3, with a weight that stays the same). Standard deviations do not learn from it.

    Args:
        actor: all networks that act.
        demonstrations: on the actor's device.
        batch_size: pairs of observation and action, drawn at each call.
        weight: of the loss.
    """

    def __init__(self, actor: MultiAgentActor, demonstrations: Demonstrations, batch_size: int, weight: float) -> None:
        widths = [actor.counts[group] * width for group, width in actor.outputs.items()]
        self._actions = dict(zip(actor.outputs, demonstrations.actions.split(widths, -1), strict=True))
        self._shown, self._batch_size, self._weight = demonstrations.shown, batch_size, weight
        self._device = demonstrations.actions.device

    def __call__(self, actor: MultiAgentActor) -> Tensor:
        """Return the weighted loss `[]`: half of squared errors, in standard deviations, summed over an agent's action.

        Args:
            actor: all networks, or those of some groups of agents.
        """
        chosen = torch.randint(len(self._shown), (self._batch_size,), device=self._device)
        actor.distribute(self._shown[chosen])
        mean, deviation = actor.output_distribution_params
        wanted = torch.cat([self._actions[group][chosen] for group in actor.outputs], -1)
        errors = ((wanted - mean) / deviation.detach()).square()
        return self._weight * errors.sum(-1).mean() / (2 * sum(actor.counts.values()))
