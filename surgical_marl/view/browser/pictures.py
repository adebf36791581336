"""Pictures on the page: the endoscope's, and the pictures that policies observe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.scenes.poses import Poses
from surgical_marl.view.session import Session

if TYPE_CHECKING:
    from viser import GuiImageHandle, GuiTabHandle, ViserServer

    from surgical_marl.vision.endoscope import Endoscope

SIZE = 192
"""Pixels along each side of the endoscope's picture."""
_FAR = 0.25
"""Distance in m that is white in a picture of depth."""


class Pictures:
    """The pictures of the first environment of a session; none in a scene without an endoscope."""

    def __init__(self, server: ViserServer, folder: GuiTabHandle, session: Session) -> None:
        self._gui, self._folder, self._session = server.gui, folder, session
        self._handles: dict[str, GuiImageHandle] = {}
        self._endoscope: Endoscope | None = None
        scene = session.env.scene
        if any(mount.arm.camera is not None for mount in scene.mounts.values()):
            from surgical_marl.vision.endoscope import Endoscope

            self._endoscope = Endoscope(scene, width=SIZE, height=SIZE)
        self.draw()
        if not self._handles:
            with folder:
                server.gui.add_markdown("No pictures: this scene has no endoscope, and no agent observes a picture.")

    def draw(self) -> None:
        """Show the current pictures."""
        shown = {}
        if self._endoscope is not None:
            env = self._session.env
            poses, nodes = env.drawn_poses, {name: every[:1] for name, every in env.drawn_nodes.items()}
            view = self._endoscope.render(env.qpos[:1], Poses(poses.origin[:1], poses.quaternion[:1]), nodes)
            shown[f"endoscope of {self._endoscope.agent}"] = view.rgb[0, 0]
        shown |= observed(self._session.observations)
        for name, picture in shown.items():
            if name in self._handles:
                self._handles[name].image = picture
            else:
                with self._folder:
                    self._handles[name] = self._gui.add_image(picture, label=name, format="jpeg")


def observed(observations: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the pictures [H, W, 3] uint8 that agents observe in the first environment, by a text for each."""
    found = {}
    for agent, own in observations.items():
        pictures = own if isinstance(own, Mapping) else {}
        for name, picture in pictures.items():
            if name != "proprioception":
                found[f"{agent} observes {name}"] = _coloured(np.asarray(picture)[0])
    return found


def _coloured(picture: np.ndarray) -> np.ndarray:
    """Return a picture of colours as it is, and one of depth [H, W, 1] in m in greys."""
    if picture.dtype == np.uint8:
        return picture
    grey = (255 * np.clip(picture / _FAR, 0.0, 1.0)).astype(np.uint8)
    return np.repeat(grey, 3, -1)
