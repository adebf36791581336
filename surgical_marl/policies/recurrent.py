"""Recurrent networks: a GRU or LSTM cell before the MLP.

rsl_rl's recurrent networks cut a rollout where episodes end, into sequences whose number and length are not known in
advance. Here a sequence is a whole rollout of an environment, whose hidden state is cleared where an episode begins. So
every shape is known, and the work can be a CUDA graph.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor, nn

from surgical_marl.policies.encoder import PictureModel

CELLS = {"gru": (nn.GRUCell, 1), "lstm": (nn.LSTMCell, 2)}
"""Cells, and the number of vectors in their hidden state, each as wide as the output."""


class RecurrentModel(MLPModel):
    """rsl_rl's MLP model behind a cell as wide as its first layer.

    It is stateless: the hidden state (memory) is an argument, and `get_hidden_state` returns the next one. A memory is
    `[..., S]`, with S the width of the cell, or twice that for an LSTM (output, then cell).

    Args:
        model: arguments of the model, as of rsl_rl's.
        recurrent: "gru" or "lstm".
        hidden_dims: widths of the layers.
    """

    is_recurrent = True

    def __init__(self, *model: Any, recurrent: str, hidden_dims: list[int], **more: Any) -> None:
        self.cell_width = hidden_dims[0]
        super().__init__(*model, hidden_dims=hidden_dims, **more)
        cell, parts = CELLS[recurrent]
        self.cell = cell(super()._get_latent_dim(), self.cell_width)
        self.memory_shape = (parts * self.cell_width,)
        self._memory: Tensor | None = None

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Any = None) -> Tensor:
        """Compute the output of the cell from observations and memory, `[..., H]`.

        Args:
            obs: of one step; or of T steps of B environments, `[T, B, ...]`, if there are masks.
            masks: where an episode begins, `[T, B]` bool.
            hidden_state: memory before the first step.
        """
        seen, memory = super().get_latent(obs), hidden_state
        if masks is None:
            self._memory = self._step(seen, memory)
            return self._memory[..., : self.cell_width]
        made = []
        for now, begins in zip(seen, masks, strict=True):
            memory = self._step(now, cleared(memory, begins))
            made.append(memory[..., : self.cell_width])
        return torch.stack(made)

    def get_hidden_state(self) -> Tensor:
        """Return the memory after the last step."""
        assert self._memory is not None
        return self._memory

    def _step(self, seen: Tensor, memory: Tensor) -> Tensor:
        parts = memory.flatten(0, -2).split(self.cell_width, -1)
        made = self.cell(seen.flatten(0, -2), parts[0] if len(parts) == 1 else parts)
        return (made if len(parts) == 1 else torch.cat(made, -1)).reshape(memory.shape)

    def _get_latent_dim(self) -> int:
        return self.cell_width


class RecurrentPictureModel(RecurrentModel, PictureModel):
    """A network with an encoder of pictures before its cell."""


class Memory(nn.Module):
    """The hidden states of the networks of N environments, at a fixed place in memory for CUDA graphs.

    Networks that are not recurrent have an empty memory.

    Attributes:
        actor, critic: `[N, ..., S]`, now.
        begun: both, where the last rollout began.
    """

    actor: Tensor
    critic: Tensor

    def __init__(self, num_envs: int, actor: Any, critic: Any, device: str) -> None:
        super().__init__()
        self._models = {"actor": actor, "critic": critic}
        for name, model in self._models.items():
            shape = (num_envs, *getattr(model, "memory_shape", (0,)))
            self.register_buffer(name, torch.zeros(shape, device=device))
        self.begun = (torch.zeros_like(self.actor), torch.zeros_like(self.critic))

    def begin(self) -> None:
        """Store the current memory as that of the rollout's start."""
        for kept, memory in zip(self.begun, self.buffers(), strict=True):
            kept.copy_(memory)

    def step(self) -> None:
        """Copy the hidden states of the networks after a step."""
        for name, model in self._models.items():
            if model.is_recurrent:
                getattr(self, name).copy_(model.get_hidden_state())

    def clear(self, ended: Tensor) -> None:
        """Clear the memory of the episodes that `ended`, `[N]` bool."""
        for memory in self.buffers():
            memory.copy_(cleared(memory, ended))


def cleared(memory: Tensor, where: Tensor) -> Tensor:
    """Return the memory `[N, ...]`, set to zero for the environments that `where` `[N]` marks."""
    return torch.where(where.reshape(-1, *[1] * (memory.dim() - 1)), 0.0, memory)
