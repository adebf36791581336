"""Attention over teammates and objects: a network that takes them as a set.

What an agent observes of a teammate, with what that said, is one token, and so is what it observes of an object. Tokens
of a kind share an embedding, so that the network treats them alike, in whatever order they are. The rest of the
observation is the agent's own token, which asks. What all answer stands beside it before the MLP (Vaswani et al., 2017,
arXiv 1706.03762; Zambaldi et al., 2019, "Deep reinforcement learning with relational inductive biases").
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor, nn

from surgical_marl.envs.information_level import MESSAGES
from surgical_marl.policies.layout import Layout
from surgical_marl.tasks.base.object_terms import AT_HAND, PARTS

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

WIDTH = 16
"""Width of a head."""
Entities = tuple[tuple[tuple[int, ...], ...], ...]
"""Kinds of entities -> entities of that kind -> the columns of the observation that tell about it."""


class AttentionModel(MLPModel):
    """rsl_rl's MLP model behind one layer of attention, with any leading axes.

    Args:
        model: arguments of the model, as of rsl_rl's.
        attention: number of heads.
        entities: where in the observation teammates and objects are.
    """

    def __init__(self, *model: Any, attention: int, entities: Entities, **more: Any) -> None:
        observations, groups, which, *_ = model
        count = sum(observations[group].shape[-1] for group in groups[which])
        told = {column for kind in entities for entity in kind for column in entity}
        own = tuple(column for column in range(count) if column not in told)
        self.heads, self._width, self._own_width = attention, attention * WIDTH, len(own)
        super().__init__(*model, **more)
        self._kinds = [torch.Size((len(kind), len(kind[0]))) for kind in ((own,), *entities)]
        columns = [column for kind in ((own,), *entities) for entity in kind for column in entity]
        self.register_buffer("_columns", torch.tensor(columns), persistent=False)  # on the device, for CUDA graphs
        self.embed = nn.ModuleList([nn.Linear(width, self._width) for _, width in self._kinds])
        self.ask = nn.Linear(len(own), self._width)
        self.answer = nn.Linear(self._width, 2 * self._width)

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Tensor | None = None) -> Tensor:
        """Return the agent's own normalised observation, [..., d], followed by what it attends to, [..., 16 heads]."""
        seen = super().get_latent(obs).index_select(-1, self._columns)
        parts = [
            part.unflatten(-1, kind)  # [..., entities, columns]
            for part, kind in zip(seen.split([kind.numel() for kind in self._kinds], -1), self._kinds, strict=True)
        ]
        own = parts[0].squeeze(-2)
        tokens = torch.cat([layer(part) for layer, part in zip(self.embed, parts, strict=True)], -2)
        keys, values = (self._split(part) for part in self.answer(nn.functional.elu(tokens)).chunk(2, -1))
        match = self._split(self.ask(own).unsqueeze(-2)) @ keys.transpose(-1, -2) / WIDTH**0.5
        found = (match.softmax(-1).to(values.dtype) @ values).squeeze(-2).flatten(-2)
        return torch.cat([own, found.to(own.dtype)], -1)

    def _split(self, tokens: Tensor) -> Tensor:
        """Return tokens [..., t, 16 heads] by head, [..., heads, t, 16]."""
        return tokens.unflatten(-1, (self.heads, WIDTH)).transpose(-3, -2)

    def _get_latent_dim(self) -> int:
        return self._own_width + self._width


def find_entities(env: BatchedEnv, layout: Layout) -> dict[str, Entities]:
    """Return where each group's observation tells about teammates and objects.

    Raises:
        ValueError: all arms are one agent, agents see pictures, or a group observes neither teammates nor objects.
    """
    if layout.grouping == "joint" or any(layout.pictures.values()):
        why = "where all arms are one agent" if layout.grouping == "joint" else "where agents observe pictures"
        raise ValueError(f"network.attention must be 0 {why}")
    return {name: _entities(env, members[0]) for name, members in layout.groups.items()}


def _entities(env: BatchedEnv, agent: str) -> Entities:
    terms, scene = env.observation_terms(agent), env.scene
    mates = [other for other in env.agents if other != agent]
    said, each = terms.get(MESSAGES), env.env.options.messages
    found: dict[tuple[str, ...], list[tuple[int, ...]]] = {}
    for number, mate in enumerate(mates):
        own = {name.partition("/")[2]: part for name, part in terms.items() if name.startswith(f"{mate}/")}
        if said is not None:
            own[MESSAGES] = slice(said.start + number * each, said.start + (number + 1) * each)
        kind = (scene.type_of(mate), *own) if len(own) > (said is not None) else ()
        found.setdefault(kind, []).append(_columns(own))
    for thing in (*scene.free_objects, AT_HAND):
        own = {part: terms[name] for part in PARTS if (name := f"{thing}_{part}") in terms}
        found.setdefault(("object", *own), []).append(_columns(own))
    kinds = tuple(tuple(kind) for kind in found.values() if kind[0])
    if not kinds:
        raise ValueError(
            f"network.attention must be 0 where agents such as {agent!r} observe neither teammates (knowledge 'all' or "
            "messages) nor objects"
        )
    return kinds


def _columns(parts: dict[str, slice]) -> tuple[int, ...]:
    return tuple(column for part in parts.values() for column in range(part.start, part.stop))
