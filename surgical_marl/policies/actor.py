"""Networks of torch that act: those of a run or of a policy that ships, or untrained ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict
from torch import Tensor

from surgical_marl.envs.observations import each, proprioception
from surgical_marl.policies.acting import Policy
from surgical_marl.policies.layout import Layout, fitting_layout, zeros
from surgical_marl.policies.networks import MultiAgentActor, actor_config, make_actor
from surgical_marl.policies.recurrent import cleared
from surgical_marl.policies.weights import NOT_OF_THIS_NETWORK, read_weights
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.folder import CHECKPOINT, find_run, holds_weights, read_settings
from surgical_marl.runs.settings import Settings

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


def load_actor(run: str | Path, env: BatchedEnv) -> tuple[MultiAgentActor, Layout]:
    """Load the networks of a run or of a policy that ships, on the CPU, and how agents are stacked for them.

    ValueError as for `load_policy`.
    """
    folder = find_run(run)
    settings = read_settings(folder)
    trained, state = _read(folder)
    layout = fitting_layout(env, trained, run, settings.scene)
    actor = untrained_actor(settings, env, layout)
    try:
        actor.load_state_dict(state)
    except RuntimeError:
        raise ValueError(NOT_OF_THIS_NETWORK.format(run)) from None
    return actor, layout


def untrained_actor(settings: Settings, env: BatchedEnv, layout: Layout) -> MultiAgentActor:
    """Make the networks that a run with these settings starts from, on the CPU, by torch's random numbers."""
    seen = {agent: each(zeros(env.observation_space(agent)), torch.from_numpy) for agent in layout.agents}
    samples = TensorDict({**layout.stack(seen)}, batch_size=[1])
    return make_actor(samples, env, layout, actor_config(settings.network)).eval()


def acting_policy(actor: MultiAgentActor, layout: Layout, device: str) -> Policy:
    """Make the deterministic policy of some networks.

    Each action comes from the networks as they are at that time, so they may still learn.
    """
    return _Acting(actor, layout, device)


def _read(folder: Path) -> tuple[dict[str, list[int]], dict[str, Tensor]]:
    """Return agents and widths of each group, and the state of the actor, of a shipped policy or of a run."""
    if holds_weights(folder) and not (folder / CHECKPOINT).is_file():
        groups, weights = read_weights(folder)
        return groups, {name: torch.from_numpy(array) for name, array in weights.items()}
    checkpoint = read_checkpoint(folder)
    try:
        groups = {str(name): [int(width) for width in widths] for name, widths in checkpoint["groups"].items()}
        state = dict(checkpoint["algorithm"]["actor_state_dict"])
        good = all(isinstance(key, str) and isinstance(value, Tensor) for key, value in state.items())
        good = good and all(len(widths) == 3 for widths in groups.values())
    except (KeyError, TypeError, ValueError, AttributeError):
        good = False
    if not good:
        raise ValueError(
            f"{folder / CHECKPOINT} is damaged, or not a checkpoint of this program: restore it from a copy"
        )
    return groups, state


class _Acting:
    """A policy of networks, with a hidden state if they are recurrent."""

    def __init__(self, actor: MultiAgentActor, layout: Layout, device: str) -> None:
        self._actor, self._layout, self._device = actor.to(device), layout, device
        self._memory: Tensor | None = None

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        agents = self._layout.agents
        tensors = {
            agent: each(observations[agent], lambda part: torch.as_tensor(part, device=self._device))
            for agent in agents
        }
        batch = proprioception(tensors[agents[0]]).shape[:-1]
        with torch.inference_mode():
            seen = TensorDict({**self._layout.stack(tensors)}, batch_size=batch)
            flat = self._actor(seen, None, self._remembered(batch)).clamp(-1.0, 1.0)
            self._memory = self._actor.get_hidden_state()
        return {agent: _like(observations[agent], action) for agent, action in self._layout.split(flat).items()}

    def reset(self, ended: Any = None) -> None:
        """Clear the hidden state of all episodes, or of those that `ended`, [N] bool."""
        if ended is None or self._memory is None:
            self._memory = None
        else:
            self._memory = cleared(self._memory, torch.as_tensor(ended, device=self._device))

    def _remembered(self, batch: torch.Size) -> Tensor | None:
        if not self._actor.is_recurrent:
            return None
        shape = (*batch, *self._actor.memory_shape)
        if self._memory is None or self._memory.shape != shape:  # a batch of another size belongs to other episodes
            self._memory = torch.zeros(shape, device=self._device)
        return self._memory


def _like(example: Any, action: Tensor) -> Any:
    example = proprioception(example)
    return action.to(example.device) if isinstance(example, Tensor) else action.cpu().numpy()
