"""The observation of one agent: the terms that the task, the scene or the call chose, as a vector and as pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.content import unknown
from surgical_marl.tasks.base.task import Task
from surgical_marl.tasks.base.terms import Picture, Term, read_vector, slices
from surgical_marl.tasks.base.world import World

if TYPE_CHECKING:
    from jax import Array


class Observed:
    """The observation terms of an agent.

    Args:
        task: declares the terms.
        agent: whose they are.
        chosen: names of terms, in the order of the vector; the task's own choice if None.

    Attributes:
        names: terms of the vector that the agent observes.
        pictures: its pictures, by name.
        unseen: terms of the task's own choice that are left out of the agent's observation; critics see them.

    Raises:
        ValueError: a name that is no term, or twice; or no term that is a vector.
    """

    def __init__(self, task: Task, agent: str, chosen: Sequence[str] | None) -> None:
        self.agent, terms, usual = agent, task.terms(agent), task.observes(agent)
        wanted = usual if chosen is None else tuple(chosen)
        for name in wanted:
            if name not in terms:
                raise unknown(f"observation term of {agent!r}", name, list(terms))
            if wanted.count(name) > 1:
                raise ValueError(f"observe: {agent!r} is given {name!r} twice")
        self.names = tuple(name for name in wanted if isinstance(terms[name], Term))
        self.pictures = {name: term for name in wanted if isinstance(term := terms[name], Picture)}
        self.unseen = tuple(name for name in usual if name not in wanted and isinstance(terms[name], Term))
        if not self.names:
            raise ValueError(f"observe: {agent!r} needs a term that is a vector, such as qpos, besides its pictures")
        self.slices: dict[str, slice] = slices(terms, self.names)

    def read(self, task: Task, world: World, unseen: bool = False) -> Array:
        """Return the vector of the terms, or of the `unseen` ones, [d], clipped to their bounds."""
        return read_vector(self._terms(task), self.unseen if unseen else self.names, world)

    def bounds(self, task: Task, unseen: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the greatest vector, with the `unseen` terms behind, [d] each."""
        terms = self._terms(task)
        chosen = [terms[name] for name in (*self.names, *(self.unseen if unseen else ()))]
        return np.concatenate([term.low for term in chosen]), np.concatenate([term.high for term in chosen])

    def _terms(self, task: Task) -> dict[str, Term]:
        return {name: term for name, term in task.terms(self.agent).items() if isinstance(term, Term)}
