"""Pictures as observation terms: the current pictures and the target pictures of N environments.

The picture of an endoscope is drawn once, for all agents that observe it. Target pictures are drawn once for all
episodes, one for each row of the table of postures, and kept on disk; an episode looks its picture up.

On a GPU the arrays are tensors of torch. On a CPU they are numpy's, so that drawing does not wait for torch's import.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

from surgical_marl.cache import cached
from surgical_marl.scenes.poses import Poses
from surgical_marl.scenes.scene import Scene
from surgical_marl.vision.endoscope import EYES, SIZE, Endoscope, View

AT_ONCE = 256
"""Number of target pictures that are drawn at once."""


class Pictures:
    """The pictures that agents of N environments observe.

    Args:
        scene: with an endoscope.
        terms: agent -> name -> `surgical_marl.tasks.base.terms.Picture`.
        postures: tables of `qpos` [rows, nq] that the pictures to be matched are taken from, by name.
        num_envs: N.
        device: "cpu" or "cuda".
    """

    def __init__(
        self,
        scene: Scene,
        terms: Mapping[str, Mapping[str, Any]],
        postures: Mapping[str, np.ndarray],
        num_envs: int,
        device: str,
    ) -> None:
        self.terms = terms
        every = [picture for own in terms.values() for picture in own.values()]
        live = [picture for picture in every if picture.table is None]
        self._endoscopes = {
            camera: _endoscope(
                scene, camera, [picture for picture in live if picture.camera == camera], num_envs, device
            )
            for camera in dict.fromkeys(picture.camera for picture in live)
        }
        self._wanted = {
            picture: _draw_table(scene, picture, postures[picture.table], device)
            for picture in dict.fromkeys(picture for picture in every if picture.table is not None)
        }

    def draw(
        self, qpos: Any, rows: Any, objects: Poses | None = None, nodes: Mapping[str, Any] | None = None
    ) -> dict[str, dict[str, Any]]:
        """Return agent -> term -> picture [N, H, W, C]. On a GPU nothing waits for the host.

        Args:
            qpos: joint positions [N, nq] of the whole scene.
            rows: of the tables, [N] int64; None without pictures to be matched.
            objects: where free objects are; None for where the scene places them, as in all pictures to be matched.
            nodes: where those of tissue are, by name, [N, n, 3]; None for where they rest, likewise.
        """
        views = {camera: endoscope.render(qpos, objects, nodes) for camera, endoscope in self._endoscopes.items()}
        return {
            agent: {
                name: self.wanted(agent, name, rows) if self.is_matched(agent, name) else _cut(views[term.camera], term)
                for name, term in own.items()
            }
            for agent, own in self.terms.items()
        }

    def is_matched(self, agent: str, name: str) -> bool:
        """Return whether a term is a picture to be matched, and not an endoscope's current picture."""
        return self.terms[agent][name].table is not None

    def wanted(self, agent: str, name: str, rows: Any) -> Any:
        """Return the pictures to be matched [N, H, W, C] in these rows of their table."""
        return self._wanted[self.terms[agent][name]][rows]


def picture_space(term: Any) -> spaces.Box:
    """Return the space of a picture: colours uint8 [H, W, 3], depth float32 [H, W, 1] in m, 0 without a geom."""
    if term.channel == "depth":
        return spaces.Box(0.0, np.inf, (SIZE, SIZE, 1), np.float32)
    return spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)


def _endoscope(scene: Scene, camera: str, terms: list[Any], num_envs: int, device: str) -> Endoscope:
    stereo = any(term.eye != EYES[0] for term in terms)
    channels = tuple(dict.fromkeys(term.channel for term in terms))
    return Endoscope(scene, num_envs, device, stereo=stereo, channels=channels, agent=camera)


def _draw_table(scene: Scene, term: Any, postures: np.ndarray, device: str) -> Any:
    """Return the picture of each posture, [rows, H, W, C], from the cache if they were drawn before."""

    def draw() -> np.ndarray:
        endoscope = _endoscope(scene, term.camera, [term], AT_ONCE, device)
        drawn = []
        for first in range(0, len(postures), AT_ONCE):
            part = postures[first : first + AT_ONCE]
            filled = np.concatenate([part, np.repeat(part[-1:], AT_ONCE - len(part), 0)])
            drawn.append(_cut(endoscope.render(filled), term))
        return np.concatenate(drawn)[: len(postures)]

    model = np.empty(mujoco.mj_sizeModel(scene.model), np.uint8)
    mujoco.mj_saveModel(scene.model, None, model)
    pictures = cached("targets", draw, repr(term), device, model.tobytes(), postures.tobytes())
    if device == "cpu":
        return pictures
    import torch

    return torch.from_numpy(pictures).to(device)


def _cut(view: View, term: Any) -> Any:
    picture = getattr(view, term.channel)[:, EYES.index(term.eye)]
    return picture[..., None] if term.channel == "depth" else picture
