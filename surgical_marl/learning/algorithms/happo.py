"""HAPPO: every agent has its own network, and agents learn one after the other.

Each agent learns in response to the new policies of the agents before it.

From the rollout's advantage `A` of all agents together, an agent `i` maximises

    mean(min(r_i M, clip(r_i, 1 - clip, 1 + clip) M)),   M = A * product of r_j over the agents j that learned before

with `r` the ratios of new to old probabilities (Kuba et al. 2022, arXiv 2109.11251; Zhong et al. 2024, JMLR 25). The
order of the agents is drawn anew for every update.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from rsl_rl.storage import RolloutStorage
from torch import Tensor

from surgical_marl.learning.algorithm import Algorithm


class HAPPO(Algorithm):
    """Heterogeneous-agent PPO: own networks that learn one after the other (Kuba et al. 2022, arXiv 2109.11251).

    An update is a part for each agent, and one that ends it. The host draws the order of the agents, and each part
    is the same work whenever its turn comes, so that it can be a CUDA graph. `M` stands in the storage in place of the
    advantages. The critic, whose values are not needed any more, learns in the same mini-batches as the first agent.

    The paper's guarantee is for one reward of the whole team, `team_reward`; with own rewards each agent learns its
    best response to the new policies of the agents before it.
    """

    grouping = "agent"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._actors = [self.actor.alone(agent) for agent in self.actor.outputs]
        ends = torch.tensor(list(self.actor.outputs.values())).cumsum(0).tolist()
        self._columns = [slice(end - width, end) for end, width in zip(ends, self.actor.outputs.values(), strict=True)]
        # Its own generator on the host: processes that draw different actions draw the same orders.
        self._orders = torch.Generator().manual_seed(torch.initial_seed())

    def parts(self) -> Sequence[Callable[[], None]]:
        """Return a function for each agent's part of an update, and one that ends the update."""
        return [*(partial(self._learn_agent, index) for index in range(len(self._actors))), self.conclude]

    def order(self) -> Sequence[int]:
        """Draw the order of the agents for the next update."""
        count = len(self._actors)
        return [*torch.randperm(count, generator=self._orders).tolist(), count]

    def save(self) -> dict[str, Any]:
        """Return all that `load` needs to go on."""
        return {**super().save(), "orders": self._orders.get_state()}

    def load(self, loaded_dict: dict[str, Any], load_cfg: dict[str, Any] | None = None, strict: bool = True) -> bool:
        """Load what `save` returned."""
        self._orders.set_state(loaded_dict["orders"].cpu())
        return super().load(loaded_dict, load_cfg, strict)

    def _learn_agent(self, index: int) -> None:
        """Learn the network of one agent, then weigh the advantages of those that follow with its new policy."""
        actor = self._actors[index]
        for batch in self.batches():
            with self.precision():
                loss, measured = self.policy_loss(actor, self._own(index, batch))
                value = self.value_loss(batch) if index == 0 else torch.zeros_like(loss)
            self.descend(loss + self.value_loss_coef * value, measured[-1])
            self._sums += torch.cat([value.detach()[None], measured / len(self._actors)])
        self._weigh(index)

    @torch.no_grad()
    def _weigh(self, index: int) -> None:
        """Multiply all advantages by the ratios of an agent: only those of agents yet to learn are read again."""
        stored = self.storage
        whole = RolloutStorage.Batch(
            observations=stored.observations,
            actions=stored.actions,
            advantages=stored.advantages,
            old_actions_log_prob=stored.actions_log_prob,
            hidden_states=self.memory.begun,
            masks=stored.begins() if self.actor.is_recurrent else None,
        )
        actor, own = self._actors[index], self._own(index, whole)
        with self.precision():
            actor.distribute(own.observations, own.masks, own.hidden_states[0])
            log_prob = actor.get_output_log_prob(own.actions)
        stored.advantages *= torch.exp(log_prob - own.old_actions_log_prob)

    def _own(self, index: int, batch: RolloutStorage.Batch) -> RolloutStorage.Batch:
        """Return the part of a batch that the actor of one agent needs."""
        columns, place = self._columns[index], slice(index, index + 1)
        memory = batch.hidden_states[0]
        return RolloutStorage.Batch(
            observations=batch.observations,
            actions=batch.actions[..., columns],
            advantages=batch.advantages[..., place],
            old_actions_log_prob=batch.old_actions_log_prob[..., place],
            old_distribution_params=tuple(param[..., columns] for param in batch.old_distribution_params or ()),
            hidden_states=(memory[..., place, :] if isinstance(memory, Tensor) else None, None),
            masks=batch.masks,
        )
