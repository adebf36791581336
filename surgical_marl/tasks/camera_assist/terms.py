"""Observation terms of camera assistance: tools see what the endoscope shows, and the endoscope knows where to look."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from surgical_marl.runtime import jnp
from surgical_marl.tasks.base.object_task import FAR
from surgical_marl.tasks.base.terms import About, Picture, Term
from surgical_marl.tasks.camera_assist.eye import Eye

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.world import World


GOAL = "goal"
"""Name of the place where an object should be."""


class Shown(NamedTuple):
    """Observation terms of the endoscope's view of the tools' work."""

    scene: Scene
    camera: str
    """The agent with the endoscope."""
    tools: tuple[str, ...]
    object: str | None
    """Name of the object that the tools move; None if each has a target for its tip."""
    eye: Eye
    sights: Callable[[World], Sights]
    """View of tips by agent, objects by name, and `GOAL` or the target of a tool as `<agent>/target`."""

    def to_tool(self, agent: str, work: Mapping[str, Term | Picture]) -> dict[str, Term | Picture]:
        """Return all terms that a tool may observe: those of its work, 0 out of view, and those of the view."""
        terms, needs = dict(work), self._needs(agent)
        for name, term in terms.items():
            if name in needs and isinstance(term, Term):
                terms[name] = hidden(term, self.sights, needs[name])
        target = GOAL if self.object else f"{agent}/target"
        things = {f"{self.object}_seen": seen_places(self.sights, self.object)} if self.object else {}
        return {
            **terms,
            "tip_seen": seen_places(self.sights, agent),
            "other_tips_seen": seen_places(self.sights, *(tool for tool in self.tools if tool != agent)),
            "target_seen": seen_places(self.sights, target, about="team_goal" if self.object else "goal"),
            **things,
            "endoscope_axes": Term(self._axes(agent), -np.ones(6), np.ones(6), "object"),
        }

    def to_camera(self, tools_hold: Callable[[World], Array]) -> dict[str, Term]:
        """Return the terms of the camera beside its joints: it has to know where to look.

        Without `tools_hold`, whether each tool holds the object, it would follow an object to its goal only once it
        moves there, and wait for a tool that does not move it before it sees the goal.
        """
        things = (self.object, GOAL) if self.object else tuple(f"{agent}/target" for agent in self.tools)
        held = {"tools_hold": Term(tools_hold, np.zeros(2), np.ones(2), "others")} if self.object else {}
        tips, work = (seen_places(self.sights, *names, always=True) for names in (self.tools, things))
        return {"tips_in_view": tips, "work_in_view": work._replace(about="goal"), **held}

    def _axes(self, agent: str) -> Callable[[World], Array]:
        """Return a function that reads the endoscope's axes right and up in an arm's base frame, [6]."""
        mount = self.scene.mounts[agent]

        def read(world: World) -> Array:
            found, _ = self.eye.pose(world.arms[self.camera].qpos)
            return (mount.rotation.T.astype(np.float32) @ found)[:, :2].T.ravel()

        return read

    def _needs(self, agent: str) -> dict[str, tuple[str, ...]]:
        """Return the terms of a tool's work that depend on places, and these."""
        if self.object is None:
            target = f"{agent}/target"
            return {"target": (target,), "to_target": (agent, target)}
        found = {f"{n}_{p}": (n,) for n in self.scene.free_objects for p in ("position", "rotation", "velocity")}
        touch = dict.fromkeys(("to_object", "to_useful"), (agent, self.object))
        goal = dict.fromkeys(("target", "target_rotation"), (GOAL,))
        return {**found, **touch, **goal, "to_target": (self.object, GOAL), "others_hold": (self.object,)}


class Sights(NamedTuple):
    """View of an endoscope: places by name, and which of them are visible."""

    place: dict[str, Array]
    """Places in the endoscope's frame, m, [3] each."""
    visible: dict[str, Array]
    """True for places that are in view, [] bool each."""
    origin: Array
    """Origin of the endoscope's frame in the world, m, [3]."""


def hidden(term: Term, sights: Callable[[World], Sights], needs: tuple[str, ...]) -> Term:
    """Return a term that is 0 unless all of some places are in view."""

    def read(world: World) -> Array:
        visible = sights(world).visible
        return jnp.where(jnp.stack([visible[name] for name in needs]).all(), term.read(world), 0.0)

    return Term(read, np.minimum(term.low, 0.0), np.maximum(term.high, 0.0), term.about)


def seen_places(sights: Callable[[World], Sights], *names: str, always: bool = False, about: About = "object") -> Term:
    """Return a term of places in the endoscope's frame, m, each with a flag that it is in view, [4 each].

    Places out of view are zeros, but not if they are `always` known. What a camera shows is `about` objects, unless it
    is a goal.
    """

    def read(world: World) -> Array:
        place, visible, _ = sights(world)
        shown = [place[n] if always else jnp.where(visible[n], place[n], 0.0) for n in names]
        flags = [visible[name].astype(jnp.float32) for name in names]
        return jnp.concatenate([jnp.append(p, flag) for p, flag in zip(shown, flags, strict=True)])

    low, high = np.tile([-FAR, -FAR, -FAR, 0.0], len(names)), np.tile([FAR, FAR, FAR, 1.0], len(names))
    return Term(read, low, high, about)
