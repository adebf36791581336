"""Pictures from a scene's endoscope for many environments at once: colour, depth and the geom of each pixel.

    endoscope = Endoscope(load_scene("trimanual_psm_ecm"), num_envs=1024)
    view = endoscope.render(env.qpos, env.drawn_poses, env.drawn_nodes)
    view.rgb                                    # [N, eyes, 64, 64, 3] uint8

Pictures depend on joint positions [N, nq], the poses of free objects and the nodes of tissue alone, in numpy or torch.
Any engine has them, so no second physics is needed. `vision/kinematics.py` computes the poses of all that is seen, and
`vision/raycaster.py` draws it, on a GPU or a CPU with the same code; docs/rendering.md compares the pictures with
C MuJoCo's ray caster.
"""

from __future__ import annotations

import numbers
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from surgical_marl.content import unknown
from surgical_marl.runtime import has_cuda, prepare_warp
from surgical_marl.scenes.poses import Poses
from surgical_marl.scenes.scene import Scene

SIZE = 64
"""Pixels along each side of a picture."""
EYES = ("left", "right")
CHANNELS = ("rgb", "depth", "segmentation")
_TYPES = {"rgb": "uint8", "depth": "float32", "segmentation": "int32"}
BACKGROUND = (0.05, 0.02, 0.02)
"""Background colour: the dark of a body cavity."""


@dataclass(frozen=True)
class View:
    """The pictures of the cameras of N environments.

    The arrays are of the library (numpy or torch) whose array `render` was given. In their shapes, E is the number of
    eyes, H of rows and W of columns. A channel that was not asked for is None.
    """

    rgb: Any = None
    """[N, E, H, W, 3] uint8"""
    depth: Any = None
    """[N, E, H, W] float32: distance along the optical axis, m; 0 where there is no geom."""
    segmentation: Any = None
    """[N, E, H, W] int32: the geom's id in `scene.model`, -1 where there is none. `Endoscope.labels` maps it to its
    owner."""


class SceneCameras:
    """Cameras of a scene's model, in N copies of the scene.

    Only visual geoms (groups 0 to 2) are drawn, as in all pictures. A pixel takes 3 bytes of colour, 4 of depth and 4
    of segmentation: 64 x 64 pixels in all channels take 44 KiB per eye.

    Args:
        scene: what is drawn.
        cameras: names of cameras of `scene.model` with one field of view, from top to bottom. Each is an eye.
        num_envs: N.
        device: "cpu" or "cuda".
        width: of a picture, pixels.
        height: likewise.
        channels: what to draw, of `CHANNELS`.

    Raises:
        ValueError: a size or number below 1, an unknown channel, or a device that is not there.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[str],
        num_envs: int = 1,
        device: str = "cpu",
        *,
        width: int = SIZE,
        height: int = SIZE,
        channels: tuple[str, ...] = ("rgb",),
    ) -> None:
        for name, value in (("num_envs", num_envs), ("width", width), ("height", height)):
            if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, not {value!r}")
        for channel in channels:
            if channel not in CHANNELS:
                raise unknown("channel", channel, CHANNELS)
        if device not in ("cpu", "cuda") or (device == "cuda" and not has_cuda()):
            raise ValueError(f"device {device!r} is not there: the devices are cpu, and cuda where torch finds it")
        self.scene, self.num_envs, self.device, self.channels = scene, num_envs, device, tuple(channels)
        self.labels, self.label_names = _labels(scene)
        self._shape = num_envs, len(cameras), height, width
        self._warp = prepare_warp()
        from surgical_marl.vision.kinematics import Kinematics
        from surgical_marl.vision.raycaster import RayCaster
        from surgical_marl.vision.skin import skins

        ids = [scene.model.camera(camera).id for camera in cameras]
        with self._warp.ScopedDevice(device):
            self._kinematics = Kinematics(scene.model, num_envs)
            own_skins = skins(scene.systems, scene.model)
            self._caster = RayCaster(scene.model, ids, num_envs, width, height, BACKGROUND, own_skins)
        own, count = self._kinematics, scene.model.nmocap
        self._shapes = {
            "qpos": (num_envs, scene.model.nq),
            "origin": (num_envs, count, 3),
            "quaternion": (num_envs, count, 4),
        }
        given = {"qpos": own.qpos, "origin": own.origins, "quaternion": own.turns} if count else {"qpos": own.qpos}
        same = (lambda values: values.numpy()) if device == "cpu" else self._warp.to_torch
        self._given = {name: same(values) for name, values in given.items()}
        """Arrays of numpy or torch in the memory of Warp's, to be filled."""
        surfaces = self._caster.surfaces
        self._nodes = {name: same(surfaces.nodes)[:, rows] for name, rows in surfaces.slices.items()}
        self._rest, self._at_rest = surfaces.rest, True
        self._warp.synchronize_device(device)  # the arrays were made on Warp's own stream

    def render(self, qpos: Any, objects: Poses | None = None, nodes: Mapping[str, Any] | None = None) -> View:
        """Draw the pictures of the cameras at joint positions [N, nq] of the whole scene.

        Free objects are where `objects` says, as `BatchedEnv.drawn_poses` does, in arrays of the same library as
        `qpos`; without it they are where the scene places them.

        Tissue is a smooth surface through its `nodes` [N, n, 3] by name, m, as `BatchedEnv.drawn_nodes` has them; it is
        at rest without both. Those of other systems are passed by.

        The pictures are numpy arrays for a numpy array, and torch tensors for a torch tensor.

        On a GPU, drawing comes after the work that is already on torch's current stream. For a torch tensor, nothing
        waits for the GPU and nothing passes through the host, so that after a first call `render` can be captured in a
        CUDA graph.
        """
        given = {"qpos": qpos} if objects is None else {"qpos": qpos, **vars(objects)}
        for name, values in given.items():
            if tuple(values.shape) != self._shapes[name]:
                what = name if name == "qpos" else f"objects.{name}"
                raise ValueError(f"{what} of shape {tuple(values.shape)} must be {self._shapes[name]}")
        tensor = _is_tensor(qpos)
        for name, own in self._given.items():
            if name in given:
                self._fill(own, given[name])
        if self._nodes:
            if nodes is None and objects is not None:
                raise ValueError(f"poses come without the nodes of {', '.join(self._nodes)}: pass env.drawn_nodes too")
            self._bend(nodes)
        drawn = {name: self._empty(name) for name in CHANNELS}
        with self._stream():
            self._kinematics.update(moved=objects is not None and "origin" in self._given)
            self._caster.draw(self._kinematics, **drawn)
        found = {name: drawn[name].reshape(*self._shape[:2], *drawn[name].shape[1:]) for name in self.channels}
        if tensor and self.device == "cpu":
            found = {name: sys.modules["torch"].from_numpy(picture) for name, picture in found.items()}
        elif not tensor and self.device == "cuda":
            found = {name: picture.cpu().numpy() for name, picture in found.items()}
        return View(**found)

    def _bend(self, nodes: Mapping[str, Any] | None) -> None:
        """Put the nodes of tissue where they are; at rest if there is None."""
        if nodes is None and self._at_rest:
            return
        for name, own in self._nodes.items():
            given = np.broadcast_to(self._rest[name], tuple(own.shape)) if nodes is None else nodes.get(name)
            if given is None or tuple(given.shape) != tuple(own.shape):
                found = "there are none" if given is None else f"not {tuple(given.shape)}"
                raise ValueError(f"nodes[{name!r}] must be {tuple(own.shape)}, {found}")
            self._fill(own, given)
        self._at_rest = nodes is None

    def _fill(self, own: Any, values: Any) -> None:
        """Copy values of numpy or torch into an array of the device."""
        tensor = _is_tensor(values)
        if self.device == "cpu":
            own[:] = values.detach().cpu().numpy() if tensor else values
        else:
            import torch

            own.copy_(values if tensor else torch.from_numpy(np.array(values, np.float32)))

    def _empty(self, channel: str) -> Any:
        """Return arrays to draw on, [N * E, H, W] or with [3] colours; none of a channel that nobody asked for."""
        envs, eyes, height, width = self._shape
        pictures = envs * eyes if channel in self.channels else 0
        shape = (pictures, height, width, *((3,) if channel == "rgb" else ()))
        if self.device == "cpu":
            return np.empty(shape, _TYPES[channel])
        import torch

        return torch.empty(shape, dtype=getattr(torch, _TYPES[channel]), device=self.device)

    def _stream(self) -> Any:
        if self.device == "cpu":
            return self._warp.ScopedDevice("cpu")
        import torch

        # No work is left on Warp's own stream, and waiting for it would break a capture.
        stream = self._warp.stream_from_torch(torch.cuda.current_stream())
        return self._warp.ScopedStream(stream, sync_enter=False)


class Endoscope(SceneCameras):
    """The camera of one agent, in N copies of its scene.

    Args:
        scene: a scene of which an arm has a `camera`.
        num_envs: N.
        device: "cpu" or "cuda".
        width: of a picture, pixels.
        height: likewise. The field of view is the arm's, from top to bottom.
        stereo: both eyes; else the left one.
        channels: what to draw, of `CHANNELS`.
        agent: whose camera; None for the first agent that has one.

    Raises:
        ValueError: a scene without an endoscope, an agent without one, or as `SceneCameras`.
    """

    def __init__(
        self,
        scene: Scene,
        num_envs: int = 1,
        device: str = "cpu",
        *,
        width: int = SIZE,
        height: int = SIZE,
        stereo: bool = False,
        channels: tuple[str, ...] = ("rgb",),
        agent: str | None = None,
    ) -> None:
        self.agent = scene.find_camera(agent)
        self.eyes = EYES if stereo else EYES[:1]
        cameras = [f"{self.agent}/{eye}" for eye in self.eyes]
        super().__init__(scene, cameras, num_envs, device, width=width, height=height, channels=channels)


def _is_tensor(values: Any) -> bool:
    """Return whether values are a tensor of torch, without importing torch."""
    torch = sys.modules.get("torch")
    return torch is not None and bool(torch.is_tensor(values))


def _labels(scene: Scene) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the label of each geom, int32 [ngeom + 1] with the last for -1, and the names of the labels."""
    names = ("nothing", "tissue", *scene.agents, *scene.objects, *scene.drawn)
    model = scene.model
    owners = [model.body(body).name.split("/")[0] for body in model.geom_bodyid]
    own = [names.index(owner) if owner in names[2:] else 1 for owner in owners]
    return np.array([*own, 0], np.int32), names
