"""Levels of knowledge: the terms that an agent may observe, and the terms that it observes at a level.

Terms say what they are about, and a level is a rule for that. So every task whose terms say it has all levels.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from surgical_marl.runtime import jnp
from surgical_marl.tasks.base.task import Task
from surgical_marl.tasks.base.terms import About, Picture, Term

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.tasks.base.world import World

MESSAGES = "messages"
"""Name of the term of what teammates said."""


class Rule(NamedTuple):
    """The rule of a level: which terms of the task an agent observes."""

    hides: tuple[About, ...]
    """Subjects of the terms that the agent does not observe."""
    adds: tuple[About, ...]
    """Subjects of its teammates' terms that the agent observes too."""


class InformationLevel:
    """The terms that an agent may observe, and the ones that it observes.

    Args:
        task: declares the terms.
        agent: whose they are.
        level: of `Options.knowledge`.
        messages: of `Options.messages`.

    Attributes:
        usual: names of the terms that the task shows the agent: what critics see, whatever the level.
        names: names of the terms that it observes, unless a scene or a call chooses others.

    Raises:
        ValueError: a level other than "task", and a term that does not say what it is about.
    """

    def __init__(self, task: Task, agent: str, level: str, messages: int) -> None:
        self.agent, self._task, self._level, self._messages = agent, task, level, messages
        self._own = task.terms(agent)
        if level != "task":
            _check_about(self._own, level)
        self._hides, adds = _rule(task, agent, level)
        terms, self.usual = self.terms(task), task.observes(agent)
        shown = [name for name in self.usual if terms[name].about not in self._hides]
        theirs = [f"{mate}/{name}" for mate in _mates(task, agent) for name in task.observes(mate)]
        added = [name for name in theirs if name in terms and terms[name].about in adds]
        self.names = (*shown, *added, *([MESSAGES] if messages else []))

    def terms(self, task: Task) -> dict[str, Term | Picture]:
        """Return all that the agent may observe, by name, read from `task`, whose tables may be traced.

        Beside the terms of the task these are, of each teammate, those about its arm and its goal, as `psm_1/qpos` and
        so on, in the teammate's base frame; and `messages`, K numbers of each teammate, in the order of agents.
        """
        found = dict(task.terms(self.agent))
        for mate in _mates(task, self.agent):
            theirs = task.terms(mate).items()
            found |= {f"{mate}/{name}": term for name, term in theirs if isinstance(term, Term) and _is_own(term)}
        if self._messages:
            numbers = [number for number, agent in enumerate(task.scene.agents) if agent != self.agent]
            ends = np.ones(len(numbers) * self._messages)

            def heard(world: World) -> Array:
                return jnp.concatenate([world.messages[number] for number in numbers])

            found[MESSAGES] = Term(heard, -ends, ends, "messages")
        return found

    def is_own(self, name: str) -> bool:
        """Return whether a term is one of the task for this agent: not a teammate's, and not what these said."""
        return name in self._own

    def check(self, name: str) -> None:
        """Raise ValueError if the level hides a term from the agent."""
        of_mate = () if self.is_own(name) or name == MESSAGES else ("others",)
        if {self.terms(self._task)[name].about, *of_mate} & set(self._hides):
            raise ValueError(
                f"observe shows {self.agent!r} {name!r}, which knowledge {self._level!r} hides from it: leave it out"
            )


def _rule(task: Task, agent: str, level: str) -> Rule:
    if level == "one":
        return Rule((), ("goal",)) if agent == task.informed else Rule(("goal", "team_goal"), ())
    return {"task": Rule((), ()), "all": Rule((), ("arm", "goal")), "own": Rule(("others",), ())}[level]


def _check_about(terms: Mapping[str, Term | Picture], level: str) -> None:
    for name, term in terms.items():
        if term.about is None:
            raise ValueError(
                f"knowledge {level!r} needs terms that say what they are about, and {name!r} does not: "
                "give its Term about='arm', 'others', 'object', 'goal' or 'team_goal'"
            )


def _mates(task: Task, agent: str) -> list[str]:
    return [other for other in task.scene.agents if other != agent]


def _is_own(term: Term) -> bool:
    return term.about in ("arm", "goal")
