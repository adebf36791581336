"""Networks of several agents: one for each agent type, shared by the agents of that type."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import Tensor, nn

from surgical_marl.learning.vision import PICTURES, make_model

# A small last layer starts every arm near its rest, which is where exploration is safe and
# gradients are largest.
OUTPUT_GAIN = 0.01


class MultiAgentModel(nn.Module):
    """One network for each agent type, shared by the agents of that type.

    Args:
        observations: a sample of the groups, `[N, n, d]` each, and pictures `[N, n, C, H, W]` where there are any.
        outputs: width of the output of one agent, by type.
        model: further arguments of rsl_rl's `MLPModel`.
    """

    is_recurrent = False

    def __init__(self, observations: TensorDict, outputs: Mapping[str, int], **model: Any) -> None:
        super().__init__()
        self.counts = {name: observations[name].shape[-2] for name in outputs}
        self.outputs = dict(outputs)
        # The networks want to be built from one agent's [N, d], and run with any leading axes.
        seen = {name: [group for group in (name, name + PICTURES) if group in observations] for name in outputs}
        sample = TensorDict(
            {group: observations[group][:, 0] for groups in seen.values() for group in groups},
            batch_size=observations.batch_size,
        )
        self.models = nn.ModuleDict(
            {name: make_model(sample, seen[name], width, **model) for name, width in outputs.items()}
        )

    def forward(self, observations: TensorDict, *, stochastic_output: bool = False, **_: Any) -> Tensor:
        """Outputs of all agents, flat: `[N, sum]`, by type and then by agent."""
        return self._join(model(observations, stochastic_output=stochastic_output) for model in self._models())

    def update_normalization(self, observations: TensorDict) -> None:
        """Update the running mean and variance of each type's observations from a batch `[B]`."""
        for name, model in zip(self.outputs, self._models(), strict=True):
            model.update_normalization({name: observations[name].flatten(0, -2)})

    def reset(self, dones: Tensor | None = None, hidden_state: Any = None) -> None:
        """Part of rsl_rl's model interface: an MLP has nothing to reset."""

    def get_hidden_state(self) -> None:
        """Part of rsl_rl's model interface: an MLP has no hidden state."""

    def _models(self) -> Iterable[Any]:
        return self.models.values()

    @staticmethod
    def _join(parts: Iterable[Tensor]) -> Tensor:
        return torch.cat([part.flatten(-2) for part in parts], -1)

    def _split(self, flat: Tensor) -> list[Tensor]:
        """Flat `[N, sum]` -> one `[N, n, a]` for each type."""
        shapes = [(self.counts[name], self.outputs[name]) for name in self.outputs]
        parts = flat.split([count * width for count, width in shapes], -1)
        return [part.unflatten(-1, shape) for part, shape in zip(parts, shapes, strict=True)]


class MultiAgentActor(MultiAgentModel):
    """A Gaussian policy for each agent type; log-probabilities and entropies are per agent."""

    def __init__(self, observations: TensorDict, outputs: Mapping[str, int], **model: Any) -> None:
        super().__init__(observations, outputs, **model)
        with torch.no_grad():
            for policy in self._models():
                policy.mlp[-1].weight.mul_(OUTPUT_GAIN)
                policy.mlp[-1].bias.zero_()

    def distribute(self, observations: TensorDict) -> None:
        """A forward pass that draws no actions."""
        for model in self._models():
            model.distribution.update(model.mlp(model.get_latent(observations)))

    def get_output_log_prob(self, actions: Tensor) -> Tensor:
        """Log-probability of flat actions `[N, sum]` under the last forward pass: `[N, A]`."""
        parts = zip(self._models(), self._split(actions), strict=True)
        return torch.cat([model.get_output_log_prob(part) for model, part in parts], -1)

    def get_kl_divergence(self, old: tuple[Tensor, ...], new: tuple[Tensor, ...]) -> Tensor:
        """KL(old || new) of each agent, `[N, A]`, from two `output_distribution_params`."""
        old_parts = zip(*map(self._split, old), strict=True)
        new_parts = zip(*map(self._split, new), strict=True)
        parts = zip(self._models(), old_parts, new_parts, strict=True)
        return torch.cat([model.get_kl_divergence(before, after) for model, before, after in parts], -1)

    @property
    def output_distribution_params(self) -> tuple[Tensor, ...]:
        """Mean and standard deviation of the last forward pass, flat `[N, sum]` each."""
        params = (model.output_distribution_params for model in self._models())
        return tuple(self._join(parts) for parts in zip(*params, strict=True))

    @property
    def output_entropy(self) -> Tensor:
        """Entropy of each agent's last distribution, `[N, A]`."""
        return torch.cat([model.output_entropy for model in self._models()], -1)

    @property
    def output_std(self) -> Tensor:
        """Standard deviation of the last distribution, flat `[N, sum]`."""
        return self._join(model.output_std for model in self._models())


class Gaussian(GaussianDistribution):
    """rsl_rl's, in float32 whatever the network computed in."""

    def update(self, mlp_output: Tensor) -> None:
        """Take the mean from the network's output."""
        super().update(mlp_output.float())

    def sample(self) -> Tensor:
        """As torch's, which has the host look whether a standard deviation is negative."""
        return self.mean + self.std * torch.randn_like(self.mean)
