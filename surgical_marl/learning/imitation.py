"""Imitation of demonstrations, before reinforcement learning begins and beside it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from typing import Any, Protocol, cast

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from surgical_marl.learning.cuda_graph import GraphedFunction
from surgical_marl.learning.demonstrations import Demonstrations
from surgical_marl.policies.networks import MultiAgentActor
from surgical_marl.runs.progress import progress
from surgical_marl.untrusted.values import LARGEST, as_number, shown

RATE = 1e-3
"""Learning rate at the start; it falls to nothing in the form of a cosine."""
WEIGH = 1000
"""Steps between two looks at how far the actor is off each of the pairs."""
CHUNK = 1 << 16
"""Pairs that it is computed for at a time."""
EVERY = 100
"""Steps between two figures of the progress bar: a GPU waits where one is read."""


class Pairs(Protocol):
    """Observations and actions that are imitated: of `Demonstrations`, or of `surgical_marl.learning.recorded`."""

    shown: TensorDict
    actions: Tensor


class Imitation:
    """Fit an actor's mean actions to the oracle's by least squares.

    Its deviation stays as it is. Its normalisers of observations learn from the demonstrations first. With rounds, the
    steps are done in equal parts. Between two of them the actor plays, and what the oracle would do there is added to
    the demonstrations; from then on half of each batch are pairs drawn in proportion to how far the actor is off.

    Args:
        actor: without recurrent networks.
        demonstrations: on the actor's device.
        steps: gradient steps, of Adam.
        batch_size: pairs of observation and action in each.
        rounds: how often the oracle is asked.

    Attributes:
        done: how many steps are done.
        seconds: how long they took.
    """

    def __init__(
        self,
        actor: MultiAgentActor,
        demonstrations: Pairs,
        steps: int,
        batch_size: int,
        rounds: int = 0,
    ) -> None:
        self.steps, self.done, self.seconds = steps, 0, 0.0
        self._actor, self._demonstrations = actor, demonstrations
        self._batch_size, device = batch_size, demonstrations.actions.device
        self._rounds, self._asked = rounds, 0
        self._off: Tensor | None = None
        """Errors of the actor, added up from pair to pair, [n]."""
        self._step, self._loss = torch.zeros((), device=device), torch.zeros((), device=device)
        self._rate = torch.tensor(RATE, device=device)
        weights = [weight for name, weight in actor.named_parameters() if "distribution" not in name]
        self._cuda = demonstrations.actions.is_cuda
        self._optimizer = torch.optim.Adam(weights, lr=self._rate, fused=True, capturable=self._cuda)
        # as Adam itself would begin, but at once, so that `load` has where to copy to
        self._moments = [
            {"step": torch.zeros((), device=device), **{n: torch.zeros_like(weight) for n in ("exp_avg", "exp_avg_sq")}}
            for weight in weights
        ]
        self._optimizer.state.update(zip(weights, self._moments, strict=True))
        self._graph = GraphedFunction(self._descend, enabled=self._cuda)

    def run(self, stopped: Callable[[], bool] = lambda: False, show: bool = False) -> bool:
        """Do the steps that are left, until something has `stopped` it; return whether none is left.

        Args:
            stopped: asked before each step.
            show: whether to show a progress bar on stderr.
        """
        started = time.perf_counter()
        with progress(self.steps, "step", "imitating", self.done) if show else nullcontext() as bar:
            while self.done < self.steps and not stopped():
                if not self.done:
                    self._actor.update_normalization(self._demonstrations.shown)
                self._ask()
                self._graph()
                self.done += 1
                if bar is not None:
                    if self.done % EVERY == 0:
                        bar.set_postfix_str(f"actions off by {float(self._loss) ** 0.5:.3f}", refresh=False)
                    bar.update()
        self._graph.release()
        self._optimizer.zero_grad()
        self.seconds += time.perf_counter() - started
        return self.done == self.steps

    def state(self) -> dict[str, Any]:
        """Return what `load` needs to go on, beside the actor's weights and random numbers."""
        return {"done": self.done, "seconds": self.seconds, "moments": self._moments}

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state` returned. ValueError, RuntimeError or TypeError if it is of another actor."""
        done, seconds = state["done"], as_number(state.get("seconds", 0.0))
        if type(done) is not int or not 0 <= done <= self.steps:
            raise ValueError(f"{shown(done)} of {self.steps} steps can't be done")
        if not 0 <= seconds < LARGEST:
            raise ValueError(f"they can't have taken {shown(state['seconds'])} s")
        self.done, self.seconds = done, seconds
        self._step.fill_(self.done)
        for own, kept in zip(self._moments, state["moments"], strict=True):
            for name, moment in own.items():
                moment.copy_(kept[name])

    def _ask(self) -> None:
        """Ask the oracle if it is time to, and look from time to time at how far the actor is off.

        A run that goes on asks again as often as it had before, because those answers are not kept.
        """
        due = self.done * (self._rounds + 1) // self.steps
        if self._asked == due and (not due or self.done % WEIGH):
            return
        self._graph.release()
        while self._asked < due:
            cast(Demonstrations, self._demonstrations).ask(self._actor)  # a data set is imitated without rounds
            self._asked += 1
        shown, actions = self._demonstrations.shown, self._demonstrations.actions
        with torch.no_grad():
            pairs = zip(shown.split(CHUNK), actions.split(CHUNK), strict=True)
            parts = [self._actor(part) - wanted for part, wanted in pairs]
        off = torch.cat([part.square().mean(-1).sqrt() for part in parts])
        self._off = off.clamp(max=1.0).double().cumsum(0)  # far off no action is more wrong than another
        self._graph = GraphedFunction(self._descend, enabled=self._cuda)

    def _draw(self) -> Tensor:
        """Return the numbers of a batch's pairs."""
        pairs, device = len(self._demonstrations.actions), self._rate.device
        if self._off is None:
            return torch.randint(pairs, (self._batch_size,), device=device)
        half = self._batch_size // 2
        places = torch.rand(half, dtype=torch.float64, device=device) * self._off[-1]
        hard = torch.searchsorted(self._off, places).clamp(max=pairs - 1)
        return torch.cat([torch.randint(pairs, (self._batch_size - half,), device=device), hard])

    def _descend(self) -> None:
        self._rate.copy_(RATE * (1 + torch.cos(torch.pi * self._step / self.steps)) / 2)
        chosen, demonstrations = self._draw(), self._demonstrations
        loss = nn.functional.mse_loss(self._actor(demonstrations.shown[chosen]), demonstrations.actions[chosen])
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        self._step.add_(1)
        self._loss.copy_(loss.detach())


class ImitationLoss:
    """Negative log-likelihood of the oracle's actions, as a loss beside that of reinforcement learning.

    It keeps an actor from forgetting states that it seldom comes to (A. Rajeswaran et al., 2018, arXiv 1709.10087,
    equation 3, with a weight that stays the same). Standard deviations do not learn from it.

    Args:
        actor: all networks that act.
        demonstrations: on the actor's device.
        batch_size: pairs of observation and action, drawn at each call.
        weight: of the loss.
    """

    def __init__(self, actor: MultiAgentActor, demonstrations: Pairs, batch_size: int, weight: float) -> None:
        self._widths = [actor.counts[group] * width for group, width in actor.outputs.items()]
        self._groups = list(actor.outputs)
        self._demonstrations, self._batch_size, self._weight = demonstrations, batch_size, weight

    def __call__(self, actor: MultiAgentActor) -> Tensor:
        """Return the weighted loss `[]`: half of squared errors, in standard deviations, summed over an agent's action.

        Args:
            actor: all networks, or those of some groups of agents.
        """
        shown, actions = self._demonstrations.shown, self._demonstrations.actions
        chosen = torch.randint(len(actions), (self._batch_size,), device=actions.device)
        actor.distribute(shown[chosen])
        mean, deviation = actor.output_distribution_params
        every = dict(zip(self._groups, actions[chosen].split(self._widths, -1), strict=True))
        wanted = torch.cat([every[group] for group in actor.outputs], -1)
        errors = ((wanted - mean) / deviation.detach()).square()
        return self._weight * errors.sum(-1).mean() / (2 * sum(actor.counts.values()))
