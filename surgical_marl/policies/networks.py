"""Networks of several agents: one for each agent type, shared by the agents of that type."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import Tensor, nn

from surgical_marl.policies.attention import AttentionModel, find_entities
from surgical_marl.policies.encoder import ENCODER, PICTURES, PictureModel
from surgical_marl.policies.layout import Layout
from surgical_marl.policies.plain import FURTHEST
from surgical_marl.policies.recurrent import RecurrentModel, RecurrentPictureModel
from surgical_marl.runs.settings import NetworkSettings

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


class LimitedNormaliser(EmpiricalNormalization):
    """rsl_rl's normaliser, with limited results."""

    def forward(self, x: Tensor) -> Tensor:
        """Return normalised observations, within `FURTHEST` of 0."""
        normalised: Tensor = super().forward(x)
        return normalised.clamp(-FURTHEST, FURTHEST)


# A small last layer starts every arm near its rest, which is where exploration is safe and
# gradients are largest.
OUTPUT_GAIN = 0.01


class MultiAgentModel(nn.Module):
    """One network for each agent type, shared by the agents of that type.

    Args:
        observations: a sample of the groups, `[N, n, d]` each, and pictures `[N, n, C, H, W]` where there are any.
        outputs: width of the output of one agent, by type.
        each: type -> arguments of `make_model` for its network alone.
        model: further arguments of `make_model`.

    Attributes:
        is_recurrent: whether the networks are recurrent; `hidden_state` is then `[N, A, S]`.
    """

    def __init__(
        self,
        observations: TensorDict,
        outputs: Mapping[str, int],
        each: Mapping[str, Mapping[str, Any]] | None = None,
        **model: Any,
    ) -> None:
        super().__init__()
        self.counts = {name: observations[name].shape[-2] for name in outputs}
        self.outputs = dict(outputs)
        # Networks are built from one agent's [N, d], and run with any leading axes.
        seen = {name: [group for group in (name, name + PICTURES) if group in observations] for name in outputs}
        sample = TensorDict(
            {group: observations[group][:, 0] for groups in seen.values() for group in groups},
            batch_size=observations.batch_size,
        )
        self.models = nn.ModuleDict(
            {
                name: make_model(sample, seen[name], width, **model, **(each or {}).get(name, {}))
                for name, width in outputs.items()
            }
        )

        first = next(iter(self._models()))
        self.is_recurrent: bool = first.is_recurrent
        if self.is_recurrent:
            self.memory_shape = (sum(self.counts.values()), *first.memory_shape)

    def forward(
        self,
        observations: TensorDict,
        masks: Tensor | None = None,
        hidden_state: Tensor | None = None,
        stochastic_output: bool = False,
    ) -> Tensor:
        """Compute the outputs of all agents, flat: `[N, sum]`, by type and then by agent.

        Args:
            observations: of one step; or of several, `[T, N]`, if there are masks.
            masks: where an episode begins, `[T, N]` bool, for recurrent networks.
            hidden_state: hidden state before the first step, `[N, A, S]`.
            stochastic_output: draw from the distribution, if there is one.
        """
        memories = zip(self._models(), self._memories(hidden_state), strict=True)
        return self._join(model(observations, masks, memory, stochastic_output) for model, memory in memories)

    def update_normalization(self, observations: TensorDict) -> None:
        """Update the running mean and variance of each type's observations from a batch `[B]`."""
        for name, model in zip(self.outputs, self._models(), strict=True):
            model.update_normalization({name: observations[name].flatten(0, -2)})

    def get_hidden_state(self) -> Tensor | None:
        """Return the hidden state after the last step, `[N, A, S]`, or None if the networks are not recurrent."""
        return torch.cat([model.get_hidden_state() for model in self._models()], -2) if self.is_recurrent else None

    def _memories(self, hidden_state: Tensor | None) -> Iterable[Tensor | None]:
        if not self.is_recurrent or hidden_state is None:
            return [None] * len(self.models)
        return hidden_state.split(list(self.counts.values()), -2)

    def _models(self) -> Iterable[Any]:
        return self.models.values()

    @staticmethod
    def _join(parts: Iterable[Tensor]) -> Tensor:
        return torch.cat([part.flatten(-2) for part in parts], -1)

    def _split(self, flat: Tensor) -> list[Tensor]:
        """Split flat values `[N, sum]` into one array `[N, n, a]` for each type."""
        shapes = [(self.counts[name], self.outputs[name]) for name in self.outputs]
        parts = flat.split([count * width for count, width in shapes], -1)
        return [part.unflatten(-1, shape) for part, shape in zip(parts, shapes, strict=True)]


class MultiAgentActor(MultiAgentModel):
    """A Gaussian policy for each agent type; log-probabilities and entropies are per agent.

    Args:
        observations, outputs, model: as of `MultiAgentModel`.
        messages: how many numbers at the end of each output are a message.
    """

    def __init__(self, observations: TensorDict, outputs: Mapping[str, int], messages: int = 0, **model: Any) -> None:
        super().__init__(observations, outputs, **model)
        with torch.no_grad():
            for policy in self._models():
                # A message tells something from the start, so that it pays to listen (docs/algorithms.md#messages).
                policy.mlp[-1].weight[: len(policy.mlp[-1].weight) - messages].mul_(OUTPUT_GAIN)
                policy.mlp[-1].bias.zero_()

    def alone(self, group: str) -> MultiAgentActor:
        """Return an actor of one group only, with the same network."""
        actor = MultiAgentActor.__new__(MultiAgentActor)
        nn.Module.__init__(actor)
        actor.counts, actor.outputs = {group: self.counts[group]}, {group: self.outputs[group]}
        actor.models = nn.ModuleDict({group: self.models[group]})
        actor.is_recurrent = self.is_recurrent
        return actor

    def distribute(
        self, observations: TensorDict, masks: Tensor | None = None, hidden_state: Tensor | None = None
    ) -> None:
        """Update the distributions by a forward pass that draws no actions."""
        for model, memory in zip(self._models(), self._memories(hidden_state), strict=True):
            model.distribution.update(model.mlp(model.get_latent(observations, masks, memory)))

    def get_output_log_prob(self, actions: Tensor) -> Tensor:
        """Return the log-probability of flat actions `[N, sum]` under the last forward pass, `[N, A]`."""
        parts = zip(self._models(), self._split(actions), strict=True)
        return torch.cat([model.get_output_log_prob(part) for model, part in parts], -1)

    def get_kl_divergence(self, old: tuple[Tensor, ...], new: tuple[Tensor, ...]) -> Tensor:
        """Return KL(old || new) of each agent, `[N, A]`, from two `output_distribution_params`."""
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
    """rsl_rl's distribution, in float32 at least, whatever precision the network has."""

    def update(self, mlp_output: Tensor) -> None:
        """Take the mean from the network's output."""
        super().update(mlp_output.to(torch.promote_types(mlp_output.dtype, torch.float32)))

    def sample(self) -> Tensor:
        """Draw as torch does, but without its check for negative deviations, which waits for the device."""
        return self.mean + self.std * torch.randn_like(self.mean)


def make_model(
    observations: TensorDict, groups: list[str], width: int, recurrent: str = "none", attention: int = 0, **model: Any
) -> nn.Module:
    """Make an MLP, with an encoder before it if there are pictures, and with a recurrent cell if that is asked for.

    Args:
        observations: a sample of the groups, vectors [N, d] and pictures [N, C, H, W].
        groups: names of the groups that the network sees.
        width: of its output.
        recurrent: "gru", "lstm" or "none".
        attention: heads of attention, which then needs `entities`; 0 for none.
        model: further arguments of rsl_rl's models.
    """
    pictures = any(group.endswith(PICTURES) for group in groups)
    if pictures:
        model["cnn_cfg"] = ENCODER
    if recurrent != "none":
        model["recurrent"] = recurrent
    if attention:
        model["attention"] = attention
    kinds: dict[tuple[bool, bool], Any] = {
        (False, False): AttentionModel if attention else MLPModel,
        (True, False): PictureModel,
        (False, True): RecurrentModel,
        (True, True): RecurrentPictureModel,
    }
    made = kinds[pictures, recurrent != "none"](observations, {"all": groups}, "all", width, **model)
    if made.obs_normalization:
        made.obs_normalizer = LimitedNormaliser(made.obs_dim)
    return made


def make_actor(observations: TensorDict, env: BatchedEnv, layout: Layout, config: Mapping[str, Any]) -> MultiAgentActor:
    """Make the actor of the agents of an environment.

    Args:
        observations: a sample of the groups of the layout.
        env: the environment.
        layout: how its agents are stacked.
        config: of `actor_config`.

    Raises:
        ValueError: attention, and nothing to attend to.
    """
    each = None
    if config.get("attention"):
        each = {name: {"entities": found} for name, found in find_entities(env, layout).items()}
    return MultiAgentActor(observations, layout.action_sizes, messages=layout.messages, each=each, **config)


def network_config(network: NetworkSettings) -> dict[str, Any]:
    """Return the arguments of `make_model` for the networks that settings ask for."""
    return {
        "hidden_dims": list(network.hidden),
        "activation": network.activation,
        "obs_normalization": network.normalise_observations,
        "recurrent": network.recurrent,
    }


def actor_config(network: NetworkSettings) -> dict[str, Any]:
    """Return the arguments of `make_actor`, likewise. Critics have no attention: they see the state of all agents."""
    gaussian = {"class_name": Gaussian, "init_std": network.init_std, "std_type": "log"}
    heads = {"attention": network.attention} if network.attention else {}  # rsl_rl's own networks know of none
    return {**network_config(network), "distribution_cfg": gaussian, **heads}
