"""Pictures as terms of agents' observations, drawn in a stage of a step, and after it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from surgical_marl.envs.env import PICTURES, Env
from surgical_marl.envs.free_objects import FreeObjects
from surgical_marl.vision.pictures import Pictures, picture_space

if TYPE_CHECKING:
    from surgical_marl.engines.choose import Engine

Seen = dict[str, dict[str, Any]]
"""agent -> term -> picture [N, H, W, C], of numpy on a CPU and of torch on a GPU."""


class PictureTerms:
    """The pictures of N environments that an engine runs.

    Args:
        env: one of the environments.
        engine: runs them.
        num_envs: N.
        arrays: library of what is put into observations: "numpy", "torch" or "jax".
    """

    def __init__(self, env: Env, engine: Engine, num_envs: int, arrays: str) -> None:
        self._env, self._engine, self._arrays = env, engine, arrays
        self._observed = {agent: tuple(own.pictures) for agent, own in env.observed.items() if own.pictures}
        terms = {agent: env.task.terms(agent) for agent in env.agents}
        names = {agent: (*self._observed.get(agent, ()), *env.task.watched.get(agent, ())) for agent in env.agents}
        wanted = {agent: {name: terms[agent][name] for name in own} for agent, own in names.items() if own}
        self._cuda = engine.device == "cuda"
        self._library = "torch" if self._cuda else "numpy"
        self._pictures = Pictures(env.scene, wanted, env.task.postures, num_envs, engine.device)
        self._matched = ".goal.row" in engine.carry_shapes
        self._free_objects = FreeObjects(env.scene)
        self._num_envs = num_envs
        self._seen: Seen = {}
        self._home: Seen = {}
        if env.begins_at_home and not self._free_objects.drawn:  # home looks the same in all episodes
            rows = self._own(np.zeros(num_envs, np.int64)) if self._matched else None
            drawn = self._pictures.draw(self._own(np.repeat(env.scene.home[None], num_envs, 0)), rows)
            # a list as the index makes a copy
            self._home = {agent: {name: picture[[0]] for name, picture in own.items()} for agent, own in drawn.items()}

    def spaces(self, vectors: dict[str, spaces.Space[Any]]) -> dict[str, spaces.Space[Any]]:
        """Return the spaces of agents that see pictures, from those of their vectors."""
        found: dict[str, spaces.Space[Any]] = {}
        for agent, names in self._observed.items():
            pictures = {name: picture_space(self._env.observed[agent].pictures[name]) for name in names}
            found[agent] = spaces.Dict({"proprioception": vectors[agent], **pictures})
        return found

    def begin(self, found: dict[str, Any]) -> None:
        """Put pictures into what is known of environments that have just been reset, and what is sensed in them."""
        seen = self._draw("")
        sensed = {name: self._present(value) for name, value in self._env.task.sense(seen).items()}
        found["infos"] = {
            agent: {name: sensed.get(name, value) for name, value in info.items()}
            for agent, info in found["infos"].items()
        }
        for kind in ("observations", "final_observations"):
            found[kind] = self._with(found[kind], seen)

    def sense(self) -> dict[str, Any]:
        """Draw the pictures after the physics of a step, and return what the task senses in them, [N] each."""
        self._seen = self._draw(PICTURES)
        return self._env.task.sense(self._seen)

    def show(self, found: dict[str, Any], autoreset: bool) -> None:
        """Put pictures into the outcome of a step: after an autoreset, `observations` are of the next episode."""
        ended = self._own(found["terminated"]) | self._own(found["truncated"])
        found["final_observations"] = self._with(found["final_observations"], self._seen)
        found["observations"] = self._with(found["observations"], self._next(ended) if autoreset else self._seen)

    def _next(self, ended: Any) -> Seen:
        if not self._home:
            # on a GPU the host doesn't know whether an episode ended
            return self._seen if not self._cuda and not ended.any() else self._draw("")
        rows, where, here = self._rows(""), self._where(), ended[:, None, None, None]
        return {
            agent: {
                name: self._pictures.wanted(agent, name, rows)
                if self._pictures.is_matched(agent, name)
                else where(here, self._home[agent][name], picture)
                for name, picture in own.items()
            }
            for agent, own in self._seen.items()
        }

    def _draw(self, place: str) -> Seen:
        objects = nodes = None
        if self._free_objects.drawn:
            objects = self._free_objects.read_drawn(self._engine, self._num_envs, self._library, place)
            nodes = self._free_objects.read_nodes(self._engine, self._library, place)
        return self._pictures.draw(self._read(f"{place}.physics.arms.qpos"), self._rows(place), objects, nodes)

    def _rows(self, place: str) -> Any:
        if not self._matched:
            return None
        rows = self._read(f"{place}.goal.row")
        return rows.long() if self._cuda else rows.astype(np.int64)  # a copy: a step gives its carry away

    def _read(self, name: str) -> Any:
        return self._engine.read(name, self._library)

    def _where(self) -> Any:
        if not self._cuda:
            return np.where
        import torch

        return torch.where

    def _with(self, observations: dict[str, Any], seen: Seen) -> dict[str, Any]:
        found = dict(observations)
        for agent, names in self._observed.items():
            pictures = {name: self._present(seen[agent][name]) for name in names}
            found[agent] = {"proprioception": observations[agent], **pictures}
        return found

    def _own(self, values: Any) -> Any:
        """Return values of any library as pictures are: of numpy, or of torch on the GPU."""
        if not self._cuda:
            return np.asarray(values)
        import torch

        return (values if torch.is_tensor(values) else torch.from_numpy(np.array(values))).to("cuda")

    def _present(self, values: Any) -> Any:
        """Return a picture, or what the task senses, in the library of the observations."""
        if self._arrays == "numpy":
            return values.cpu().numpy() if self._cuda else values
        if self._arrays == "jax":
            import jax

            return jax.dlpack.from_dlpack(values.contiguous()) if self._cuda else jax.numpy.asarray(values)
        import torch

        return values if self._cuda else torch.from_numpy(values)
