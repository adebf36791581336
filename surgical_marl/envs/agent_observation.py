"""The observation of one agent: the terms that the task, the scene or the call chose, as a vector and as pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.content import unknown
from surgical_marl.envs.information_level import InformationLevel
from surgical_marl.envs.observations import Scale
from surgical_marl.tasks.base.task import Task
from surgical_marl.tasks.base.terms import Picture, Term, read_vector, slices
from surgical_marl.tasks.base.world import World

if TYPE_CHECKING:
    from jax import Array


class AgentObservation:
    """The observation terms of an agent.

    Args:
        task: declares the terms.
        knowledge: what the agent may observe, and what it does where nothing is chosen.
        chosen: names of terms, in the order of the vector; None for those of its knowledge.
        scaled: whether vectors are scaled by their bounds.

    Attributes:
        names: terms of the vector that the agent observes.
        pictures: its pictures, by name.
        stated: terms of this agent in the state for critics: what is chosen of its own, and all that the task shows it.
        slices, stated_slices: where each of the `names`, and of the `stated` terms, is in their vector.
        scales: how the vector of the terms is scaled (False) and that of the `stated` ones (True), if they are.

    Raises:
        ValueError: a name that is no term, or twice; or no term that is a vector.
    """

    def __init__(
        self, task: Task, knowledge: InformationLevel, chosen: Sequence[str] | None, scaled: bool = False
    ) -> None:
        self.scaled, self._knowledge = scaled, knowledge
        agent, terms = knowledge.agent, knowledge.terms(task)
        wanted = knowledge.names if chosen is None else tuple(chosen)
        for name in wanted:
            if name not in terms:
                raise unknown(f"observation term of {agent!r}", name, list(terms))
            if wanted.count(name) > 1:
                raise ValueError(f"observe: {agent!r} is given {name!r} twice")
            knowledge.check(name)
        self.names = tuple(name for name in wanted if isinstance(terms[name], Term))
        self.pictures = {name: term for name in wanted if isinstance(term := terms[name], Picture)}
        first = knowledge.usual if chosen is None else tuple(name for name in chosen if knowledge.is_own(name))
        every = (*first, *(name for name in knowledge.usual if name not in first))
        self.stated = tuple(name for name in every if isinstance(terms[name], Term))
        if not self.names:
            raise ValueError(f"observe: {agent!r} needs a term that is a vector, such as qpos, besides its pictures")
        self.slices: dict[str, slice] = slices(terms, self.names)
        self.stated_slices: dict[str, slice] = slices(terms, self.stated)

        self._limits = {False: _limits(terms, self.names), True: _limits(terms, self.stated)}
        self.scales = {stated: Scale(*limits) for stated, limits in self._limits.items()}

    def read(self, task: Task, world: World, stated: bool = False) -> Array:
        """Return the vector of the terms, or of the `stated` ones, [d], clipped to their bounds."""
        terms = {name: term for name, term in self._knowledge.terms(task).items() if isinstance(term, Term)}
        vector = read_vector(terms, self.stated if stated else self.names, world)
        return self.scales[stated].apply(vector) if self.scaled else vector

    def bounds(self, stated: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the greatest vector of the terms, or of the `stated` ones, [d] each."""
        return self.scales[stated].bounds if self.scaled else self._limits[stated]


def _limits(terms: Mapping[str, Any], names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of terms in SI units, one after the other, [d] each."""
    none = np.zeros(0)
    low, high = ([getattr(terms[name], end) for name in names] for end in ("low", "high"))
    return np.concatenate([none, *low]), np.concatenate([none, *high])
