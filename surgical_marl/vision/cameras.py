"""Pictures of episodes for learning, by the ray caster of `surgical_marl/vision`: colour, depth and segmentation.

A picture's name is that of a view, and of a channel but colour: `endoscope`, `endoscope_right`, `outside`,
`endoscope_depth`, `outside_segmentation` and so on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from surgical_marl.content import unknown
from surgical_marl.runtime import has_cuda
from surgical_marl.scenes.poses import Poses

if TYPE_CHECKING:
    from surgical_marl.scenes.scene import Scene

VIEWS = ("endoscope", "endoscope_right", "outside")
CHANNELS = {"": "rgb", "_depth": "depth", "_segmentation": "segmentation"}
"""Ends of the names of pictures, and the channels that they stand for."""
PICTURES = tuple(view + end for end, view in product(CHANNELS, VIEWS))
NODES = "nodes/"
"""First letters of names of nodes of thread and tissue."""
AT_ONCE = {"cpu": 16, "cuda": 128}
"""Rows that are drawn at once."""


class Picture(NamedTuple):
    """A picture that episodes have for each row."""

    name: str
    view: str
    """One of `VIEWS`."""
    channel: str
    """`rgb`: uint8 [H, W, 3]; `depth`: float32 [H, W, 1], m along the view, 0 where there is nothing; `segmentation`:
    uint8 [H, W, 1], see `Cameras.labels`."""


def find_pictures(names: Sequence[str], scene: Scene) -> tuple[Picture, ...]:
    """Return the pictures of some names; ValueError if there is no such picture in the scene."""
    eyes = any(mount.arm.camera is not None for mount in scene.mounts.values())
    good = [name for name in PICTURES if eyes or name.startswith("outside")]
    for name in names:
        if name not in good:
            raise unknown(f"picture of scene {scene.name!r}", name, good)
    views = {view + end: (view, channel) for view, (end, channel) in product(VIEWS, CHANNELS.items())}
    return tuple(Picture(name, *views[name]) for name in names)


class Cameras:
    """The cameras that draw pictures of one scene.

    Args:
        scene: the scene.
        pictures: what to draw.
        size: width and height, pixels.

    Attributes:
        labels: names of the numbers in a segmentation.
    """

    def __init__(self, scene: Scene, pictures: Sequence[Picture], size: tuple[int, int]) -> None:
        from surgical_marl.vision.endoscope import EYES, SceneCameras  # it imports Warp

        device = "cuda" if has_cuda() else "cpu"
        self._pictures, self._at_once = pictures, AT_ONCE[device]
        # the eyes of an endoscope share a field of view, and what is common to their pictures
        names: dict[bool, dict[str, str]] = {}
        for view in dict.fromkeys(picture.view for picture in pictures):
            outside = view == "outside"
            eye = EYES[view == "endoscope_right"]
            names.setdefault(outside, {})[view] = "overview" if outside else f"{scene.find_camera()}/{eye}"
        self._places = {view: (outside, i) for outside, own in names.items() for i, view in enumerate(own)}
        self._cameras = {
            outside: SceneCameras(
                scene,
                list(own.values()),
                self._at_once,
                device,
                width=size[0],
                height=size[1],
                channels=tuple(dict.fromkeys(picture.channel for picture in pictures if picture.view in own)),
            )
            for outside, own in names.items()
        }
        self.labels = next((cameras.label_names for cameras in self._cameras.values()), ())

    def draw(self, seen: Mapping[str, np.ndarray]) -> Iterator[dict[str, np.ndarray]]:
        """Yield the pictures of some rows at a time, name -> [n, H, W, C], up to the last one.

        Args:
            seen: `qpos` of the whole scene, `origin` and `quaternion` of all that moves but arms, and `nodes/<name>` of
                thread and tissue, [rows, ...] each.
        """
        parts = [seen[name] for name in ("qpos", "origin", "quaternion")]
        soft = {name: part for name, part in seen.items() if name.startswith(NODES)}
        rows = len(parts[0])
        for first in range(0, rows, self._at_once):
            chosen = np.minimum(np.arange(first, first + self._at_once), rows - 1)
            qpos, origin, quaternion = (part[chosen] for part in parts)
            nodes = {name.removeprefix(NODES): part[chosen] for name, part in soft.items()}
            views = {key: own.render(qpos, Poses(origin, quaternion), nodes) for key, own in self._cameras.items()}
            count = min(self._at_once, rows - first)
            found = {}
            for picture in self._pictures:
                key, eye = self._places[picture.view]
                drawn = getattr(views[key], picture.channel)[:count, eye]
                if picture.channel == "segmentation":
                    drawn = self._cameras[key].labels[drawn].astype(np.uint8)
                found[picture.name] = drawn if picture.channel == "rgb" else drawn[..., None]
            yield found
