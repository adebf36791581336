"""Which agents are alike: they can share a network."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surgical_marl.envs.env import Env


def alike(env: Env) -> dict[str, list[str]]:
    """Return the agents whose arms are alike and that observe alike, by the name of their arms' type."""
    found: dict[str, list[str]] = {}
    for name, agents in env.scene.types.items():
        kinds: dict[Any, list[str]] = {}
        for agent in agents:
            seen = env.observed[agent]
            names = tuple(_of_type(env, name) for name in seen.names)
            kinds.setdefault((names, tuple(seen.pictures)), []).append(agent)
        found |= {name if k == 0 else f"{name}-seeing-{k + 1}": list(own) for k, own in enumerate(kinds.values())}
    return found


def _of_type(env: Env, term: str) -> str:
    """Return the name of a term; if it is a teammate's, with the type of its arm for the teammate's name."""
    mate, stroke, name = term.partition("/")
    return f"{env.scene.mounts[mate].arm.name}/{name}" if stroke else term
